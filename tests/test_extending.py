"""The recipes of docs/EXTENDING.md: models with these variants train, save and load."""

import copy
import inspect
import math
from dataclasses import dataclass, replace

import pytest
import torch

from sb3_crpn import CRPN
from sb3_crpn.algorithm.declaration import configured, setting
from sb3_crpn.algorithm.solvers import SOLVERS, DenseSolver
from sb3_crpn.checks import COUNT
from sb3_crpn.cubic import CubicStep
from sb3_crpn.cubic.approximate import cauchy_radius
from sb3_crpn.curvature import (
    HESSIAN_ESTIMATORS,
    METRICS,
    SHRINKAGES,
    Causal,
    Constant,
    Fisher,
    JamesStein,
)
from sb3_crpn.episodes import TRACKERS, EpisodeTracker
from tests.training import TrainLog, make, same, several, tensors


@dataclass(frozen=True)
class AbsoluteHessian:
    """M = |H| + εI on the Krylov space (Dauphin et al., NeurIPS 2014)."""

    damping: float = 1e-3

    def generator(self, estimate):
        return estimate.hessian

    def whitening(self, form):
        eigenvalues, vectors = torch.linalg.eigh(form)
        return ((eigenvalues.abs() + self.damping) ** -0.5)[:, None] * vectors.T


class Diagonal:
    """W_ij = A_i δ_ij: no cross-time terms, as `Causal(0.0)`."""

    def apply(self, cost_advantages, lengths, u):
        return cost_advantages.reshape(-1, *[1] * (u.ndim - 1)) * u


class Smoothed:
    """The James-Stein factor, averaged over updates."""

    def __init__(self):
        self.mean = 0.0

    def factor(self, hessians, weights):
        self.mean += 0.1 * (JamesStein().factor(hessians, weights) - self.mean)
        return self.mean


class CauchySolver:
    """The minimiser along -g."""

    def needs_matrix(self, dim):
        return False

    def solve(self, model, alpha):
        g = model.gradient
        norm = float(g.norm())
        curvature = float(g @ model.product(g)) / norm**2
        radius = cauchy_radius(norm, curvature, alpha)
        decrease = norm * radius - curvature * radius**2 / 2 - alpha * radius**3 / 6
        return CubicStep(
            -radius / norm * g, alpha * radius / 2, decrease, 1, math.nan, False, "Cauchy point"
        )


class AtLeast(EpisodeTracker):
    """Whole episodes, at least two of each environment."""

    def begin(self, size, times):
        n_episodes = max(size.n_episodes, 2 * len(times))
        super().begin(replace(size, n_episodes=n_episodes), times)


@configured
class MyCRPN(CRPN):
    """CRPN with a target that is halved every ``halve_every`` updates.

    {parameters}
    """

    halve_every: int = setting(COUNT, "Updates between halvings of ``target_kl``.", 10)

    def _update_target_kl(self, batch):
        return super()._update_target_kl(batch) / 2 ** (self._n_updates // self.halve_every)


class FreshHessian(CRPN):
    """H and F from the fresh rollout alone, g from the earlier ones too."""

    def _estimate(self, data):
        return self._estimate_from(data.joined, data.fresh, data.fresh)


VARIANTS = {
    "metric": (METRICS, AbsoluteHessian),
    "hessian_estimator": (HESSIAN_ESTIMATORS, Diagonal),
    "hessian_shrinkage": (SHRINKAGES, Smoothed),
    "solver": (SOLVERS, CauchySolver),
}


def trained(**arguments):
    return make(CRPN, several(2), n_episodes=4, **arguments).learn(80)


@pytest.mark.parametrize("argument", VARIANTS)
def test_an_object_trains_and_goes_on_after_loading(argument, tmp_path):
    variant = VARIANTS[argument][1]
    model = trained(**{argument: variant()})
    assert not same(model, tensors(trained()))
    model.save(tmp_path / "model")
    state, control = dict(vars(getattr(model, argument))), copy.copy(model.kl_control)
    model.learn(80, reset_num_timesteps=False)
    loaded = CRPN.load(tmp_path / "model", env=several(2), device="cpu")
    assert isinstance(getattr(loaded, argument), variant)
    assert vars(getattr(loaded, argument)) == state
    assert loaded.kl_control == control
    loaded.learn(80, reset_num_timesteps=False)
    assert same(loaded, tensors(model))


@pytest.mark.parametrize("argument", VARIANTS)
def test_a_registered_name_is_the_object(argument, tmp_path, monkeypatch):
    registry, variant = VARIANTS[argument]
    if argument == "hessian_shrinkage":  # a name stands for an object without state
        variant = JamesStein
    with pytest.raises(ValueError, match=f"{argument}='mine'.* must be") as error:
        make(CRPN, **{argument: "mine"})
    assert all(repr(name) in str(error.value) for name in registry)
    monkeypatch.setitem(registry, "mine", lambda algorithm: variant())
    named = trained(**{argument: "mine"})
    assert same(named, tensors(trained(**{argument: variant()})))
    named.save(tmp_path / "model")
    assert getattr(CRPN.load(tmp_path / "model", device="cpu"), argument) == "mine"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ({"metric": "fisher"}, {"metric": Fisher(0.1)}),
        ({"hessian_lambda": 0.5}, {"hessian_estimator": Causal(0.5)}),
        ({"hessian_estimator": "causal", "hessian_lambda": 0.0}, {"hessian_estimator": Diagonal()}),
        ({"hessian_shrinkage": 0.5}, {"hessian_shrinkage": Constant(0.5)}),
        ({"solver": "dense"}, {"solver": DenseSolver()}),
    ],
)
def test_names_stand_for_objects(name, value):
    first, second = trained(**name).actor.vector, trained(**value).actor.vector
    torch.testing.assert_close(first, second, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("argument", VARIANTS)
def test_a_class_is_no_object(argument):
    with pytest.raises(ValueError, match=f"{argument}=<class .* must be"):
        make(CRPN, **{argument: VARIANTS[argument][1]})


def test_a_tracker_decides_what_a_rollout_keeps(tmp_path, monkeypatch):
    log, fewer = TrainLog(), TrainLog()
    model = make(CRPN, several(2), rollout=AtLeast, n_episodes=2).learn(80, log)
    assert set(log["n_episodes"]) == {4}
    make(CRPN, several(2), n_episodes=2).learn(80, fewer)
    assert set(fewer["n_episodes"]) == {2}
    monkeypatch.setitem(TRACKERS, "at least two", AtLeast)
    named = make(CRPN, several(2), rollout="at least two", n_episodes=2).learn(80)
    assert same(named, tensors(model))
    model.save(tmp_path / "model")
    assert CRPN.load(tmp_path / "model", device="cpu").rollout is AtLeast


def test_a_part_of_the_update_is_replaced():
    """The same until there is an earlier rollout, whose episodes H then does without."""
    first = [make(algorithm, n_reused_rollouts=2).learn(1) for algorithm in (CRPN, FreshHessian)]
    assert same(first[0], tensors(first[1]))
    for model in first:
        model.learn(100, reset_num_timesteps=False)
    assert not same(first[0], tensors(first[1]))


def test_an_argument_is_declared_once(tmp_path):
    assert inspect.signature(MyCRPN).parameters["halve_every"].default == 10
    assert "halvings of ``target_kl``" in MyCRPN.__doc__
    with pytest.raises(ValueError, match="MyCRPN: halve_every=0 is not allowed, must be"):
        make(MyCRPN, halve_every=0)
    log = TrainLog()
    model = make(MyCRPN, halve_every=2, target_kl=0.02, scale_target_kl=False).learn(200, log)
    assert log["target_kl"][:5] == [0.02, 0.02, 0.01, 0.01, 0.005]
    model.save(tmp_path / "model")
    assert MyCRPN.load(tmp_path / "model", device="cpu").halve_every == 2
