import inspect

import numpy as np
import pytest
import torch

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from tests.envs import Drift
from tests.training import both, make

NAN, INF = float("nan"), float("inf")
FLAG = ("yes", 1, None, NAN)
FRACTION = ("1", None, True, -0.1, 1.1, NAN, INF)
POSITIVE = ("1", None, True, 0.0, -1.0, NAN, INF)
COUNT = ("3", True, 0, -2, 1.5, NAN, INF, [4])
BAD = {
    "learning_rate": ("1", None, True, -1e-3, NAN, INF),
    "n_steps": (*COUNT, None),
    "n_episodes": COUNT,
    "n_hessian_episodes": COUNT,
    "alpha": POSITIVE,
    "target_kl": tuple(value for value in POSITIVE if value is not None),
    "metric": ("natural", None, 1, NAN, "Fisher"),
    "fisher_damping": POSITIVE,
    "hessian_estimator": ("dice", None, 0, NAN),
    "hessian_lambda": FRACTION,
    "hessian_shrinkage": ("half", True, -0.1, 1.1, NAN, INF),
    "krylov_dim": COUNT,
    "gamma": FRACTION,
    "gae_lambda": FRACTION,
    "baseline": FLAG,
    "normalize_advantage": FLAG,
    "discount_visitation": FLAG,
    "bootstrap_truncated": FLAG,
    "horizon": COUNT,
    "batch_size": (*COUNT, None),
    "n_reused_rollouts": ("3", None, True, -1, 1.5, NAN),
    "n_critic_updates": ("3", None, True, -1, 1.5, NAN),
    "max_batch_timesteps": COUNT,
    "use_sde": FLAG,
    "sde_sample_freq": ("3", None, True, -2, 1.5, NAN),
    "rollout_buffer_class": (dict, "EpisodeRolloutBuffer", 1),
    "rollout_buffer_kwargs": (5, "x", [1]),
    "stats_window_size": (*COUNT, None),
    "tensorboard_log": (5, ["log"]),
    "policy_kwargs": (5, "x", [1]),
    "verbose": ("loud", None, -1, 1.5, 3),
    "seed": ("0", -1, 1.5, NAN, True, 2**32),
    "device": ("nope", 5, None),
}
BAD_CRPN = {"solver": ("lanczos", None, 1, NAN)}
BAD_ACRPN = {
    "gradient_lipschitz": ("big", None, True, 0.0, -1.0, NAN, INF),
    "sosp_epsilon": POSITIVE,
    "subsolver_steps": COUNT,
    "stop_at_sosp": FLAG,
}
CASES = [
    (algorithm, name, value)
    for algorithm, own in ((CRPN, BAD_CRPN), (ACRPN, BAD_ACRPN))
    for name, values in (BAD | own).items()
    for value in values
]


@pytest.mark.parametrize(("algorithm", "name", "value"), CASES, ids=lambda case: str(case)[-30:])
def test_bad_values_are_named_with_what_is_allowed(algorithm, name, value):
    with pytest.raises(ValueError, match="must be") as error:
        algorithm("MlpPolicy", Drift(dim=2), **{"device": "cpu", name: value})
    assert f"{name}={value!r}" in str(error.value)


@both
def test_every_argument_is_in_the_table(algorithm):
    own = BAD_CRPN if algorithm is CRPN else BAD_ACRPN
    names = inspect.signature(algorithm).parameters.keys()
    assert names - {"policy", "env", "_init_setup_model"} == BAD.keys() | own.keys()


@both
@pytest.mark.parametrize("policy", ["Nope", None, 5, dict])
def test_bad_policies(algorithm, policy):
    with pytest.raises(ValueError, match=r"(?i)policy"):
        algorithm(policy, Drift(), device="cpu")


@both
@pytest.mark.parametrize("env", [None, 5])
def test_bad_environments(algorithm, env):
    with pytest.raises(ValueError, match=r"(?i)env"):
        algorithm("MlpPolicy", env, device="cpu")


@both
def test_unknown_arguments(algorithm):
    with pytest.raises(TypeError, match="clip_range"):
        algorithm("MlpPolicy", Drift(), clip_range=0.2)
    with pytest.raises(TypeError):
        algorithm(*["MlpPolicy"] * 100)


def test_one_algorithm_does_not_take_the_others_arguments():
    with pytest.raises(TypeError, match="sosp_epsilon"):
        CRPN("MlpPolicy", Drift(), sosp_epsilon=0.1)
    with pytest.raises(TypeError, match="solver"):
        ACRPN("MlpPolicy", Drift(), solver="dense")


@both
def test_signature_lists_all_arguments_with_their_defaults(algorithm):
    signature = inspect.signature(algorithm)
    inherited = dict(inspect.signature(PolicyNewtonAlgorithm).parameters)
    assert list(signature.parameters)[: len(inherited)] == list(inherited)
    own = {"solver"} if algorithm is CRPN else BAD_ACRPN.keys()
    assert signature.parameters.keys() == inherited.keys() | own
    assert PAPER.keys() < signature.parameters.keys()
    model = make(algorithm)
    for name in signature.parameters.keys() - {"env", "policy", "device", "_init_setup_model"}:
        assert hasattr(model, name) or hasattr(model, f"_{name}")


@both
def test_numbers_of_numpy_and_positions_are_taken(algorithm):
    model = make(
        algorithm,
        n_steps=np.int64(16),
        gamma=np.float32(0.5),
        baseline=np.bool_(True),
        n_episodes=np.int32(2),
        alpha=2,
        hessian_shrinkage=1,
        krylov_dim=3,
    )
    model.learn(20)
    by_position = algorithm("MlpPolicy", Drift(), 0.5, 64, 2, device="cpu")
    assert by_position.learning_rate == 0.5
    assert by_position.n_steps == 64
    assert by_position.n_episodes == 2


@both
def test_setting_up_later_checks_later(algorithm):
    model = make(algorithm, gamma=2.0, _init_setup_model=False)
    with pytest.raises(ValueError, match=r"gamma=2\.0"):
        model._setup_model()


@both
@pytest.mark.parametrize("n_episodes", [0, 1.5, "2", None])
def test_estimate_curvature_checks_its_argument(algorithm, n_episodes):
    with pytest.raises(ValueError, match="n_episodes"):
        make(algorithm).estimate_curvature(n_episodes)


@both
@pytest.mark.parametrize(
    ("name", "value"), [("alpha", NAN), ("alpha", -1.0), ("n_episodes", NAN), ("n_episodes", 0)]
)
def test_schedules_with_bad_values(algorithm, name, value):
    """A schedule can only be judged when it is called; the policy is then as before."""
    model = make(algorithm, target_kl=None, **{name: lambda _: value})
    theta = model.actor.vector
    with pytest.raises(ValueError, match=name):
        model.learn(50)
    assert torch.equal(model.actor.vector, theta)
