import numpy as np
import pytest
import torch

from sb3_crpn.sosp.spectrum import lanczos_spectrum


def symmetric(d, seed=0):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(d, d, dtype=torch.float64, generator=generator)
    return 0.5 * (root + root.T)


def spectrum_of(matrix, n_steps=20, n_probes=1, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    return lanczos_spectrum(
        lambda v: matrix @ v, matrix[0], generator, n_steps=n_steps, n_probes=n_probes, **options
    )


@pytest.mark.parametrize("d", [1, 2, 7, 20])
def test_small_spectra_are_exact(d):
    matrix = symmetric(d)
    spectrum = spectrum_of(matrix, n_leftmost=3)
    eigenvalues = torch.linalg.eigvalsh(matrix).numpy()
    np.testing.assert_allclose(spectrum.values, eigenvalues, atol=1e-12)
    np.testing.assert_allclose(spectrum.weights, 1.0 / d)
    np.testing.assert_allclose(spectrum.leftmost, eigenvalues[:3], atol=1e-12)
    assert spectrum.residual < 1e-12


def test_the_leftmost_eigenpair_is_as_accurate_as_its_residual_says():
    matrix = symmetric(200) + torch.diag(torch.linspace(-30.0, 0.0, 200, dtype=torch.float64))
    true = torch.linalg.eigvalsh(matrix)
    for n_steps in (5, 10, 40, 80):
        spectrum = spectrum_of(matrix, n_steps)
        v = spectrum.vector
        assert v.norm() == pytest.approx(1.0)
        assert (matrix @ v - spectrum.leftmost[0] * v).norm() == pytest.approx(
            spectrum.residual, rel=1e-6, abs=1e-9
        )
        assert (true - spectrum.leftmost[0]).abs().min() <= spectrum.residual + 1e-9
        assert spectrum.leftmost[0] >= true[0] - 1e-9
    assert spectrum.leftmost[0] == pytest.approx(true[0].item(), abs=1e-6)


def test_the_density_has_the_moments_of_the_spectrum():
    """Stochastic Lanczos quadrature is unbiased for polynomials of degree < 2k."""
    d, n_probes = 60, 400
    matrix = symmetric(d) / d**0.5
    spectrum = spectrum_of(matrix, n_steps=4, n_probes=n_probes)
    assert spectrum.weights.sum() == pytest.approx(1.0)
    power = torch.eye(d, dtype=torch.float64)
    for degree in range(1, 8):
        power = power @ matrix
        moment = (spectrum.weights * spectrum.values**degree).sum()
        # one probe's variance is 2‖A^p‖_F²/d² at most
        error = 2.0**0.5 * power.norm().item() / d / n_probes**0.5
        assert abs(moment - power.trace().item() / d) < 4.0 * error
    points = np.linspace(-4.0, 4.0, 2001)
    density = spectrum.density(points, width=0.1)
    assert density.sum() * (points[1] - points[0]) == pytest.approx(1.0, abs=1e-6)


def test_more_probes_find_what_one_start_is_blind_to():
    """An operator with two invariant subspaces. A start in one of them spans only that one."""
    d = 40
    matrix = torch.diag(torch.linspace(-1.0, 1.0, d, dtype=torch.float64))
    single = spectrum_of(matrix, n_steps=3)
    several = spectrum_of(matrix, n_steps=3, n_probes=20)
    assert several.leftmost[0] <= single.leftmost[0]
