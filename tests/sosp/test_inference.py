import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sb3_crpn.sosp.batch_means import BatchMeans
from sb3_crpn.sosp.inference import (
    bernstein_intervals,
    bernstein_radius,
    bootstrap_intervals,
    bootstrap_upper_limit,
)
from sb3_crpn.sosp.spectrum import lanczos_spectrum
from tests.sosp.problems import noisy_sample


def intervals_of(sample, confidence=0.9, seed=0):
    generator = torch.Generator().manual_seed(seed)
    spectrum = lanczos_spectrum(sample.mean_product, sample.gradients[0], generator)
    rng = np.random.default_rng(seed)
    return bootstrap_intervals(sample, spectrum, confidence, generator, rng)


GRADIENTS = {"zero": torch.zeros(4), "small": torch.tensor([0.3, 0.0, 0.0, 0.4])}
HESSIANS = {
    "saddle": torch.diag(torch.tensor([-1.0, 0.0, 0.5, 2.0])),
    "flat": torch.zeros(4, 4),
    "degenerate": torch.diag(torch.tensor([-0.5, -0.5, -0.5, 3.0])),
}


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("hessian", HESSIANS)
def test_the_intervals_cover(gradient, hessian):
    """Each of two limits fails in at most 2.5 % of samples. 15 of 200 has a probability of 1e-4."""
    g, H = GRADIENTS[gradient].double(), HESSIANS[hessian].double()
    norm, lambda_min = g.norm().item(), torch.linalg.eigvalsh(H)[0].item()
    misses = np.zeros(4)
    for seed in range(200):
        of_norm, of_curvature = intervals_of(noisy_sample(g, H, 1.0, 12, seed), 0.9, seed)
        assert of_norm.lower <= of_norm.estimate <= of_norm.upper
        assert of_curvature.lower <= of_curvature.estimate <= of_curvature.upper
        misses += [
            of_norm.lower > norm,
            of_norm.upper < norm,
            of_curvature.lower > lambda_min,
            of_curvature.upper < lambda_min,
        ]
    assert misses.max() < 15


def test_the_intervals_shrink_onto_the_truth():
    g, H = GRADIENTS["small"].double(), HESSIANS["saddle"].double()
    widths = []
    for n_blocks in (10, 50, 400):
        of_norm, of_curvature = intervals_of(noisy_sample(g, H, 1.0, n_blocks, 0))
        widths.append([of_norm.upper - of_norm.lower, of_curvature.upper - of_curvature.lower])
    assert np.all(np.diff(widths, axis=0) < 0.0)
    assert np.all(np.array(widths[-1]) < 1.0)


def test_the_intervals_are_exact_without_noise():
    g, H = GRADIENTS["small"].double(), HESSIANS["saddle"].double()
    for interval, true in zip(
        intervals_of(noisy_sample(g, H, 0.0, 10, 0)), (0.5, -1.0), strict=True
    ):
        assert (interval.lower, interval.upper) == pytest.approx((true, true), abs=1e-6)


def test_blocks_that_show_nothing_prove_nothing():
    zeros = torch.zeros(10, 3, 3, dtype=torch.float64)
    sample = BatchMeans.from_matrices(zeros[:, 0], zeros, zeros[0])
    of_norm, of_curvature = intervals_of(sample)
    assert of_norm.upper == math.inf
    assert of_curvature.lower == -math.inf


def test_what_the_probabilities_imply_widens_the_intervals():
    """Blocks that agree, since none contains a rare action."""
    g, H = GRADIENTS["small"].double(), HESSIANS["saddle"].double()
    sample = noisy_sample(g, H, 0.1, 10, 0)
    widths, previous = [], None
    for implied in (0.0, 0.15, 0.25, 1.0):
        wider = replace(sample, model_covariance_product=lambda v, b=implied: b**2 * v)
        intervals = intervals_of(wider)
        widths.append([interval.upper - interval.lower for interval in intervals])
        if previous is not None:
            assert all(new >= old for new, old in zip(widths[-1], previous, strict=True))
        previous = widths[-1]
    assert widths[2][0] > widths[0][0]
    assert widths[3][1] == math.inf


@pytest.mark.parametrize("n", [10, 40])
def test_the_studentised_limit_covers_the_mean_of_skewed_values(n):
    rng = np.random.default_rng(0)
    misses = [bootstrap_upper_limit(rng.exponential(size=n), 0.1, rng) < 1.0 for _ in range(200)]
    assert np.mean(misses) < 0.18


@pytest.mark.parametrize(("bound", "n", "dimensions"), [(1.0, 100, 5), (30.0, 7, 4610)])
def test_the_bernstein_radius_has_the_stated_tail(bound, n, dimensions):
    r = bernstein_radius(bound, n, dimensions, 0.05)
    tail = dimensions * math.exp(-n * r**2 / 2 / (bound**2 + bound * r / 3))
    assert tail == pytest.approx(0.05)


def test_bernstein_intervals_are_balls_around_the_estimates():
    g, H = GRADIENTS["small"].double(), HESSIANS["saddle"].double()
    sample = noisy_sample(g, H, 0.1, 10, 0)
    spectrum = lanczos_spectrum(
        sample.mean_product, sample.gradients[0], torch.Generator().manual_seed(0)
    )
    of_norm, of_curvature = bernstein_intervals(sample, spectrum, 0.9, (2.0, 5.0), 10_000)
    radius = bernstein_radius(2.0, 10_000, 5, 0.05)
    assert of_norm.upper - of_norm.estimate == pytest.approx(radius)
    radius = bernstein_radius(5.0, 10_000, 8, 0.05)
    assert of_curvature.upper - of_curvature.estimate == pytest.approx(radius)
    assert of_curvature.estimate - of_curvature.lower == pytest.approx(radius, abs=1e-9)
