"""Generated calls with one bad argument. Each raises an error that names the argument."""

import inspect
import random

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C

from sb3_crpn import ACRPN, CRPN
from sb3_crpn.callbacks import RandomIterateCallback
from sb3_crpn.cubic import (
    cubic_finalsolver,
    cubic_subsolver,
    krylov_basis,
    leftmost_eigenvalues,
    solve_dense,
    solve_krylov,
)
from sb3_crpn.sosp import SospCallback, certify_sosp
from sb3_crpn.theory import (
    Constants,
    ScoreBounds,
    approximate_recipe,
    expectation_recipe,
    gaussian_linear,
    high_probability_recipe,
    softmax_linear,
)
from tests.envs import Drift
from tests.training import make

NAN, INF = float("nan"), float("inf")


def _drawn(rng):
    """A value of a random type that no argument allows."""
    return rng.choice(
        (
            lambda: -rng.uniform(1.5, 9.0),
            lambda: rng.choice((NAN, INF, -INF)),
            lambda: complex(rng.random(), 1.0),
            lambda: "".join(rng.choices("xyz", k=4)),
            lambda: rng.choice((b"", b"1", object(), ..., NotImplemented)),
            lambda: {rng.random()},
            lambda: [[1.0], [2.0, 3.0]],
            lambda: np.array(rng.choices("xyz", k=2)),
            lambda: np.full((2, 1, 3), rng.random()),
            lambda: np.array([True, False, True]),
            lambda: torch.full((2, 2, 2), rng.random(), dtype=torch.complex64),
            lambda: np.datetime64("2024-01-01"),
        )
    )()


THETA, EYE = np.array([1.0, -2.0]), np.eye(2)
SCORES = ScoreBounds(1.0, 1.0, 1.0)
CONSTANTS = Constants(1.0, SCORES, 3, 2)


def _hvp(vector):
    return vector


# Every public function and constructor, and arguments that it takes
SOLVER = {"gradient": THETA, "hvp": _hvp, "alpha": 1.0}
CALLS = {
    CRPN: {"policy": "MlpPolicy", "env": Drift(), "device": "cpu"},
    ACRPN: {"policy": "MlpPolicy", "env": Drift(), "device": "cpu"},
    solve_dense: {"gradient": THETA, "hessian": EYE, "alpha": 1.0},
    solve_krylov: SOLVER,
    cubic_subsolver: SOLVER,
    cubic_finalsolver: SOLVER,
    krylov_basis: {"matvec": _hvp, "start": THETA, "dim": 2},
    leftmost_eigenvalues: {"matvec": _hvp, "like": THETA},
    ScoreBounds: {"G": 1.0, "L_1": 1.0, "L_2": 1.0},
    Constants: {"K": 1.0, "scores": SCORES, "H": 3, "d": 2},
    softmax_linear: {"feature_norm": 1.0},
    gaussian_linear: {
        "feature_norm": 1.0,
        "std": 1.0,
        "action_dim": 1,
        "n_actions": 5,
        "failure_probability": 0.1,
    },
    expectation_recipe: {"constants": CONSTANTS, "epsilon": 0.1},
    high_probability_recipe: {
        "constants": CONSTANTS,
        "epsilon": 0.1,
        "failure_probability": 0.1,
    },
    approximate_recipe: {"constants": CONSTANTS, "epsilon": 0.1, "failure_probability": 0.1},
    Constants.gradient_error: {"self": CONSTANTS, "n_episodes": 3},
    Constants.hessian_error: {"self": CONSTANTS, "n_episodes": 3},
    certify_sosp: {"n_episodes": 4, "epsilon": 1.0},
    SospCallback: {"eval_freq": 1, "eval_env": Drift(), "n_episodes": 4, "epsilon": 1.0},
    RandomIterateCallback: {},
    CRPN.estimate_curvature: {"n_episodes": 2},
}
OPTIONS = ("confidence", "interval", "bounds", "n_eigenvalues", "n_probes", "progress_bar")
# Every string is a valid path. SB3 checks environments
FREE = {"self", "env", "tensorboard_log", "save_path"}


def _names(function):
    names = [*inspect.signature(function).parameters]
    return [*names[:-1], *OPTIONS] if function is SospCallback else names


@pytest.fixture(scope="module")
def models():
    """The algorithms' methods and the certificate need a model."""
    return {
        certify_sosp: ("model", A2C("MlpPolicy", Drift(), device="cpu")),
        CRPN.estimate_curvature: ("self", make(CRPN)),
    }


N_EACH = 12
SEEDS = range(N_EACH)
CASES = [(function, name) for function in CALLS for name in _names(function) if name not in FREE]


def test_there_are_a_thousand_calls():
    assert len(CASES) * N_EACH >= 1000
    assert len({function for function, _ in CASES}) == len(CALLS)


@pytest.mark.parametrize(
    ("function", "name"), CASES, ids=lambda case: getattr(case, "__qualname__", case)
)
def test_bad_values_are_named(function, name, models):
    good = dict(CALLS[function])
    if function in models:
        key, model = models[function]
        good[key] = model
    for seed in SEEDS:
        value = _drawn(random.Random(f"{function.__qualname__} {name} {seed}"))
        with pytest.raises(ValueError, match=rf"(^|: |\s){name}( |=|\()") as error:
            function(**{**good, name: value})
        assert "must be" in str(error.value)
        assert "ambiguous" not in str(error.value)


@pytest.mark.parametrize("function", CALLS, ids=lambda function: function.__qualname__)
def test_unknown_and_missing_arguments_are_named(function, models):
    good = dict(CALLS[function])
    if function in models:
        key, model = models[function]
        good[key] = model
    with pytest.raises(TypeError, match="unheard_of"):
        function(**good, unheard_of=1)
    for name in good:
        parameter = inspect.signature(function).parameters[name]
        if parameter.default is parameter.empty:
            with pytest.raises(TypeError, match=name):
                function(**{key: value for key, value in good.items() if key != name})


@pytest.mark.parametrize("name", ["env"])
@pytest.mark.parametrize("value", [3, "CartPole-v1", None, np.ones(2)])
def test_environments_that_are_none(name, value, models):
    model = models[CRPN.estimate_curvature][1]
    if value is not None:
        with pytest.raises(ValueError, match=f"estimate_curvature: {name}="):
            model.estimate_curvature(2, value)
        with pytest.raises(ValueError, match=f"certify_sosp: {name}="):
            certify_sosp(model, 4, 1.0, env=value)
    with pytest.raises(ValueError, match="SospCallback: eval_env="):
        SospCallback(1, value, 4, 1.0)


@pytest.mark.parametrize("bounds", [(1.0,), (1.0, 2.0, 3.0), (1.0, -1.0), 1.0, (1.0, None), "12"])
def test_bounds_are_two_positive_numbers(bounds, models):
    for call in (
        lambda **options: certify_sosp(models[certify_sosp][1], 4, 1.0, **options),
        lambda **options: SospCallback(1, Drift(), 4, 1.0, **options),
    ):
        with pytest.raises(ValueError, match="bounds="):
            call(interval="bernstein", bounds=bounds)
