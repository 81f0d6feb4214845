import numpy as np
import pytest
import torch

from sb3_crpn.cubic import krylov_basis, leftmost_eigenvalues
from tests.cubic.problems import SPECTRA, large


def symmetric(eigenvalues, seed=0):
    """A dense matrix of the given eigenvalues."""
    values = torch.as_tensor(eigenvalues, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(
        torch.randn(len(values), len(values), dtype=torch.float64, generator=generator)
    )[0]
    return rotation @ torch.diag(values) @ rotation.T


@pytest.mark.parametrize(
    ("eigenvalues", "most"),
    [
        (np.r_[-3.0, -2.0, -1.0, np.linspace(0.0, 1.0, 197)], 60),
        (np.r_[-1e-6, np.linspace(0.0, 1e3, 99)], 100),  # small beside the norm
        (np.r_[-1.0, np.zeros(49)], 6),  # a repeated eigenvalue fills up what is asked for
        (np.zeros(5), 5),
        (np.r_[2.0], 1),
    ],
    ids=["gaps", "small", "low rank", "zero", "one"],
)
def test_they_are_the_leftmost_and_no_product_is_wasted(eigenvalues, most):
    matrix, count = symmetric(eigenvalues), 0

    def matvec(v):
        nonlocal count
        count += 1
        return matrix @ v

    for k in {1, min(3, len(matrix))}:
        count = 0
        values = leftmost_eigenvalues(matvec, matrix[0], k)
        np.testing.assert_allclose(
            values, np.sort(eigenvalues)[:k], atol=1e-8 * np.abs(eigenvalues).max(), rtol=0
        )
        assert count <= most


def test_too_few_products_give_bounds_and_a_warning():
    matrix = symmetric(np.linspace(-1.0, 1.0, 300))
    with pytest.warns(RuntimeWarning, match="10 products are too few for 3 eigenvalues"):
        values = leftmost_eigenvalues(lambda v: matrix @ v, matrix[0], 3, max_products=10)
    exact = torch.linalg.eigvalsh(matrix)[:3]
    assert torch.all(values > exact + 1e-3)


def test_the_same_seed_gives_the_same_values():
    matrix = symmetric(np.linspace(-1.0, 1.0, 40))
    state = torch.get_rng_state()
    first, second = (leftmost_eigenvalues(lambda v: matrix @ v, matrix[0], 2) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"k": 4}, r"k=4 .* \[1, 3\]"),
        ({"k": 2, "max_products": 1}, "max_products=1 .* >= 2"),
        ({"seed": -1}, "seed=-1"),
        ({"like": [np.nan]}, "like"),
        ({"matvec": lambda v: v / 0.0}, "matvec"),
    ],
)
def test_wrong_arguments_are_named(wrong, name):
    arguments = {"matvec": lambda v: v, "like": np.ones(3), **wrong}
    with pytest.raises(ValueError, match=f"leftmost_eigenvalues: {name}"):
        leftmost_eigenvalues(**arguments)


@pytest.mark.parametrize("dim", [1, 2, 15, 60])
@pytest.mark.parametrize("spectrum", [None, *SPECTRA])
def test_basis_is_orthonormal_and_spans_the_krylov_space(dim, spectrum):
    problem = large(eigenvalues=SPECTRA.get(spectrum))
    hvp = problem.hvp()
    Q, AQ = krylov_basis(hvp, problem.gradient, dim)
    torch.testing.assert_close(AQ, hvp.hessian @ Q)
    k = Q.shape[1]
    assert Q.shape == (problem.dim, k)
    assert k <= dim
    torch.testing.assert_close(Q.T @ Q, torch.eye(k, dtype=Q.dtype), atol=1e-13, rtol=0)
    assert torch.equal(torch.stack(hvp.calls, 1), Q)  # once per column, in order
    # A maps each column but the last into the space: it is a Krylov space, and starts at g
    outside = hvp.hessian @ Q - Q @ (Q.T @ (hvp.hessian @ Q))
    assert outside[:, :-1].norm() <= 1e-11
    g = torch.from_numpy(problem.gradient)
    torch.testing.assert_close(Q[:, 0], g / g.norm())


def test_basis_stops_at_breakdown():
    problem = large(eigenvalues=SPECTRA["clusters"])
    for operator, start, dim, shape in [
        (problem.hvp(), problem.gradient, 50, (300, 3)),
        (lambda v: 0 * v, np.ones(5), 3, (5, 1)),
        (lambda v: v, np.ones(1), 3, (1, 1)),
        (lambda v: v, np.ones(2), 10**15, (2, 1)),  # ends at once
        (lambda v: v, np.zeros(4), 3, (4, 0)),
    ]:
        Q, AQ = krylov_basis(operator, start, dim)
        assert Q.shape == AQ.shape == shape


def test_basis_checks_its_input():
    with pytest.raises(ValueError, match="krylov_basis: dim=0"):
        krylov_basis(lambda v: v, np.ones(3), 0)
    with pytest.raises(ValueError, match="start has 1 NaN"):
        krylov_basis(lambda v: v, [np.nan, 1.0], 2)
