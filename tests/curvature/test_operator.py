import numpy as np
import pytest
import torch
from scipy.sparse.linalg import eigsh

from sb3_crpn.curvature import Causal, GroupedOperator, estimate_curvature
from tests.policies import frozen_episodes, small_policy


def test_the_operator_is_linear_and_symmetric():
    policy, actor = small_policy("discrete")
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    estimate = estimate_curvature(policy, actor, batch, Causal(0.5))
    generator = torch.Generator().manual_seed(0)
    V = torch.randn(len(actor), 3, dtype=torch.float64, generator=generator)
    for operator in (estimate.hessian, estimate.fisher):
        dense = operator.to_dense()
        assert operator.shape == dense.shape == (len(actor), len(actor))
        assert torch.equal(dense, dense.T)
        torch.testing.assert_close(operator @ V, dense @ V, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(operator @ V[:, 0], dense @ V[:, 0], rtol=1e-9, atol=1e-12)
        combined = operator @ (2.0 * V[:, 0] - V[:, 1])
        torch.testing.assert_close(
            combined, 2.0 * (operator @ V[:, 0]) - operator @ V[:, 1], rtol=1e-9, atol=1e-12
        )
        assert (operator @ V.float()).dtype == torch.float64


@pytest.mark.parametrize("shape", [(), (3,), (3, 4), (4, 1, 1)])
def test_operands_of_the_wrong_shape_are_refused(shape):
    operator = GroupedOperator(4, lambda v: v[None], torch.ones(1))
    with pytest.raises(ValueError, match=r"operand has shape .* must be \(4,\) or \(4, n\)"):
        operator @ torch.ones(shape)


def test_groups_are_weighted_by_their_sizes():
    sizes = torch.tensor([3.0, 1.0], dtype=torch.float64)
    operator = GroupedOperator(2, lambda v: torch.stack([v, 5.0 * v]), sizes)
    assert operator.weights.tolist() == [0.75, 0.25]
    assert (operator @ torch.ones(2)).tolist() == [2.0, 2.0]


def symmetric(*shape):
    generator = torch.Generator().manual_seed(0)
    matrices = torch.randn(*shape, dtype=torch.float64, generator=generator)
    return matrices + matrices.transpose(-1, -2)


@pytest.mark.parametrize("cheap", [False, True])
def test_forms_and_krylov_spaces_are_those_of_the_matrices(cheap):
    """Two terms of every sum, one for each of two ranks."""
    matrices, sizes = symmetric(2, 6, 6), torch.tensor([3.0, 1.0], dtype=torch.float64)
    terms = (0.25 * matrices, 0.75 * matrices)
    asked = []

    def forms(V):
        asked.append(V)
        return V.T @ terms[0] @ V

    operator = GroupedOperator(
        6,
        lambda v: terms[0] @ v,
        sizes,
        forms if cheap else None,
        total=lambda term: 4.0 * term,  # terms[1] = 3 terms[0]
    )
    mean = 0.75 * matrices[0] + 0.25 * matrices[1]
    torch.testing.assert_close(operator.to_dense(), mean)
    V = torch.eye(6, dtype=torch.float64)[:, :3]
    torch.testing.assert_close(operator.group_forms(V), V.T @ matrices @ V)
    assert len(asked) == cheap
    basis, group_forms = operator.krylov(torch.ones(6, dtype=torch.float64), 4)
    torch.testing.assert_close(group_forms, basis.T @ matrices @ basis)
    ones, powers = torch.ones(6, dtype=torch.float64), []
    for _ in range(4):
        powers.append(ones)
        ones = mean @ ones
    K = torch.stack(powers, dim=1)
    torch.testing.assert_close(basis @ (basis.T @ K), K)


def test_products_that_are_not_finite_are_refused():
    operator = GroupedOperator(2, lambda v: v[None] / 0.0, torch.ones(1, dtype=torch.float64))
    for ask in (
        lambda: operator @ torch.ones(2),
        lambda: operator.group_forms(torch.eye(2, dtype=torch.float64)),
        lambda: operator.krylov(torch.ones(2, dtype=torch.float64), 1),
    ):
        with pytest.raises(ValueError, match=r"is not finite.* raise alpha, or set target_kl"):
            ask()


def estimated(lengths=(3, 1, 4, 2, 5)):
    policy, actor = small_policy("discrete")
    return estimate_curvature(policy, actor, frozen_episodes(policy, lengths), Causal(0.5))


def operator_of(matrix):
    return GroupedOperator(len(matrix), lambda v: (matrix @ v)[None], torch.ones(1).double())


def test_scipy_takes_it_as_a_linear_operator():
    hessian = estimated().hessian
    dense, linear = hessian.to_dense(), hessian.aslinearoperator()
    assert linear.shape == hessian.shape
    assert linear.dtype == np.float64
    V = torch.randn(
        hessian.shape[0], 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    np.testing.assert_allclose(linear @ V.numpy(), dense @ V, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(linear.T @ V[:, 0].numpy(), dense @ V[:, 0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        linear @ V[:, :1].float().numpy(), dense @ V[:, :1], rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(
        np.sort(eigsh(linear, 3, which="SA", v0=np.ones(len(dense)))[0]),
        torch.linalg.eigvalsh(dense)[:3],
        rtol=1e-8,
        atol=1e-10,
    )


@pytest.mark.parametrize("k", [1, 4, "d"])
def test_eigenvalues_are_the_leftmost_of_the_matrix(k):
    hessian = estimated().hessian
    k = hessian.shape[0] if k == "d" else k
    expected = torch.linalg.eigvalsh(hessian.to_dense())[:k]
    torch.testing.assert_close(hessian.eigenvalues(k), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("k", [0, 5, 1.0, None])
def test_the_number_of_eigenvalues_is_at_most_the_dimension(k):
    with pytest.raises(ValueError, match=f"^eigenvalues: k={k} .* an integer in \\[1, 4\\]"):
        operator_of(torch.eye(4).double()).eigenvalues(k)


def test_a_matrix_of_thousands_of_products_comes_with_a_warning(monkeypatch):
    monkeypatch.setattr("sb3_crpn.curvature.operator.MAX_DENSE", 3)
    operator_of(torch.eye(3).double()).to_dense()
    with pytest.warns(UserWarning, match=r"to_dense takes 4 products.*eigenvalues\(k\)") as warned:
        matrix = operator_of(torch.eye(4).double()).to_dense()
    assert warned[0].filename == __file__
    assert torch.equal(matrix, torch.eye(4).double())


@pytest.mark.parametrize("name", ["to_dense", "eigenvalues"])
def test_progress_is_shown_on_demand(name, capsys):
    hessian = operator_of(torch.eye(4).double())
    plain = getattr(hessian, name)()
    assert "products" not in "".join(capsys.readouterr())
    assert torch.equal(getattr(hessian, name)(progress_bar=True), plain)
    assert "products" in "".join(capsys.readouterr())
    with pytest.raises(ValueError, match=f"^{name}: progress_bar=1 "):
        getattr(hessian, name)(progress_bar=1)


def test_estimates_are_one_line():
    estimate = estimated()
    d = len(estimate.gradient)
    assert repr(estimate.hessian) == f"GroupedOperator({d} × {d}, group weights 0.6, 0.4)"
    norm, noise = estimate.gradient.norm(), estimate.gradient_noise
    assert str(estimate) == (
        f"CurvatureEstimate(d = {d}, ‖g‖ = {norm:.3g}, noise {noise:.0%} of ‖g‖²)"
    )
