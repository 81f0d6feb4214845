"""The damping chosen by held-out episodes, on a decision process whose derivatives are known."""

import pytest
import torch

from benchmarks.experiments.damping import ChosenDamping
from benchmarks.experiments.steps import fisher_subspace
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import Causal
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from tests.benchmarks.experiments.learner import KAPPA, exact_derivatives, make_learner


def test_another_damping_is_a_change_of_coordinates():
    model = make_learner()
    batch = model.estimate_curvature(4).gradient_batch
    group = EpisodeDerivatives(model.policy, model.actor, batch, Causal(KAPPA))
    gradient = group.gradient()
    old, new = (fisher_subspace([group], gradient, damping, dim=3) for damping in (0.1, 2.0))
    space, factors = old.redamped(0.1, 2.0)
    assert torch.allclose(space.fisher, new.fisher, atol=1e-6)
    assert torch.allclose(factors * (old.basis.T @ gradient), space.basis.T @ gradient)
    for one, other in ((space, new), (new, space)):  # eigenvectors have no sign
        assert torch.allclose(one.basis.abs(), other.basis.abs(), atol=1e-5)


def test_a_damping_has_the_value_of_its_first_order_step():
    gradient, hessian, fisher = exact_derivatives()
    model = make_learner(ChosenDamping, n_envs=100, target_kl=0.1)
    batch = model.estimate_curvature(8000).gradient_batch
    model._estimate(UpdateData(batch, []))
    for damping, value in model.values.items():
        step = -torch.linalg.solve(fisher + damping * torch.eye(len(fisher)), gradient)
        step *= (0.2 / float(step @ fisher @ step)) ** 0.5
        expected = -float(gradient @ step + 0.5 * step @ hessian @ step)
        assert value == pytest.approx(expected, rel=0.05, abs=0.002)
    assert model.fisher_damping == max(model.values, key=model.values.get)
