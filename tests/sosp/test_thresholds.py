import math

import pytest
import torch

from sb3_crpn.sosp import Interval
from sb3_crpn.sosp.model_covariance import episode_fisher
from sb3_crpn.sosp.thresholds import (
    TaskScales,
    choose_thresholds,
    debiased_norm,
    episodes_to_decide,
)
from tests.policies import frozen_episodes, small_policy

SCALES = TaskScales(rms_return=20.0, fisher_norm=4.0)  # s = ½


def test_the_fisher_matrix_of_episodes_is_the_curvature_of_their_divergence():
    """E Σ_i σσᵀ with the expectation over actions enumerated."""
    policy, actor = small_policy("discrete")
    batch = frozen_episodes(policy, lengths=(3, 1, 4))
    distribution = policy.get_distribution(batch.observations).distribution
    log_probs = distribution.logits
    expected = torch.zeros(len(actor), len(actor), dtype=torch.float64)
    for row in log_probs:
        for log_prob in row:
            score = actor.flatten(
                torch.autograd.grad(
                    log_prob, actor.tensors, retain_graph=True, materialize_grads=True
                )
            )
            expected += log_prob.exp().item() * torch.outer(score, score) / batch.n_episodes
    product = episode_fisher(policy, actor, batch)
    identity = torch.eye(len(actor), dtype=torch.float64)
    dense = torch.stack([product(column) for column in identity], dim=1)
    torch.testing.assert_close(dense, expected, rtol=1e-6, atol=1e-9)
    largest = torch.linalg.eigvalsh(expected)[-1].item()
    assert TaskScales.from_episodes(policy, actor, batch).fisher_norm == pytest.approx(
        largest, rel=1e-3
    )


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((None, None, None), (4.0, 64.0)),  # 0.1 · 20 / ½, 4ε/s²
        ((1.0, None, None), (1.0, 16.0)),
        ((None, 3.0, None), (4.0, 3.0)),
        ((None, None, 7.0), (4.0, 7.0)),
        ((1.0, 3.0, 7.0), (1.0, 3.0)),
    ],
)
def test_defaults_fill_in_what_is_not_given(given, expected):
    chosen = choose_thresholds(*given, lambda: SCALES)
    assert (chosen.epsilon, chosen.rho) == pytest.approx(expected)
    epsilon, rho, alpha = given
    assert ("ε given" in chosen.origin) == (epsilon is not None)
    assert ("ρ given" in chosen.origin) == (rho is not None)
    assert ("α of the model" in chosen.origin) == (rho is None and alpha is not None)


def test_slope_and_curvature_change_the_return_by_a_tenth_over_the_distance():
    chosen = choose_thresholds(None, None, None, lambda: SCALES)
    s = SCALES.step_norm
    assert chosen.epsilon * s == pytest.approx(2.0)
    assert 0.5 * math.sqrt(chosen.rho * chosen.epsilon) * s**2 == pytest.approx(2.0)


def test_given_thresholds_need_no_measurement():
    choose_thresholds(1.0, 2.0, None, lambda: pytest.fail("measured"))
    choose_thresholds(1.0, None, 2.0, lambda: pytest.fail("measured"))


def test_a_task_without_returns_has_thresholds_of_zero():
    chosen = choose_thresholds(None, None, None, lambda: TaskScales(0.0, 0.0))
    assert (chosen.epsilon, chosen.rho) == (0.0, 0.0)


FLAT = Interval(0.5, 0.0, 1.0)
INF = math.inf


@pytest.mark.parametrize(
    ("of_gradient", "of_curvature", "norm", "epsilon", "curvature", "expected"),
    [
        (FLAT, Interval(0.0, -0.1, 0.1), 0.0, 0.25, -1.0, 1600),  # 1.0 must become 0.25
        (FLAT, Interval(-2.0, -3.0, -1.0), 0.0, 0.5, -1.5, 400),  # both by a half: equal
        (FLAT, Interval(-2.0, -3.0, -1.0), 0.0, 0.5, -2.1, 10_000),  # 1.0 must become 0.1
        (FLAT, Interval(-2.0, -INF, INF), 0.9, 0.45, -1.0, 400),  # not stationary: that is all
        (FLAT, Interval(-2.0, -INF, INF), 0.0, 0.5, -1.0, None),
        (Interval(0.5, 0.0, INF), FLAT, 0.0, 0.5, -1.0, None),
        (FLAT, FLAT, 0.5, 0.5, -1.0, None),
    ],
)
def test_the_number_of_episodes_goes_with_the_square_of_the_width(
    of_gradient, of_curvature, norm, epsilon, curvature, expected
):
    needed = episodes_to_decide(of_gradient, of_curvature, norm, epsilon, curvature, 100)
    assert needed == (None if expected is None else pytest.approx(expected, rel=0.06))


def test_the_debiased_norm_is_free_of_the_bias_of_noise():
    generator = torch.Generator().manual_seed(0)
    truth = torch.full((100,), 0.1, dtype=torch.float64)  # of norm 1
    squares, naive = [], []
    for _ in range(400):
        noise = 3.0 * torch.randn(20, 100, dtype=torch.float64, generator=generator)
        sample = truth + noise
        naive.append(float(sample.mean(0).norm()))
        squares.append(debiased_norm(sample) ** 2)
    assert sum(naive) / 400 > 5.0
    assert debiased_norm(truth.expand(4, -1)) == pytest.approx(1.0)
    # negative squares are clipped at 0, which leaves some bias
    assert 0.5 < sum(squares) / 400 < 5.0
