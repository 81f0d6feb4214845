"""Symmetric matrices known through products, as means over groups of episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch

from sb3_crpn.cubic import krylov_basis

# VᵀBV of more columns is made from products, whose memory does not grow with columns × timesteps
MAX_FORM_COLUMNS = 128


class GroupedOperator:
    """A symmetric d × d matrix B = Σ_k w_k B_k, known through its products B_k v.

    k runs over K groups of whole episodes; Σ w_k = 1. ``operator @ v`` costs one product with each
    group. With several ranks every result is that of all ranks' episodes: all must ask for it.

    Parameters
    ----------
    size
        d.
    group_products
        v ↦ B_k v, float64 [d] to [K, d], or terms that ``total`` adds up to it.
    sizes
        What w_k is proportional to, [K]: the group's episodes, or its steps.
    group_forms
        V ↦ VᵀB_k V, [d, n] to [K, n, n], or terms that ``total`` adds up to it, where there is a
        cheaper way to it than products for a few columns.
    total
        The sum of the terms that the ranks hold.
    """

    def __init__(
        self,
        size: int,
        group_products: Callable[[torch.Tensor], torch.Tensor],
        sizes: torch.Tensor,
        group_forms: Callable[[torch.Tensor], torch.Tensor] | None = None,
        total: Callable[[torch.Tensor], torch.Tensor] = lambda term: term,
    ) -> None:
        self.shape = (size, size)
        self.weights = sizes / sizes.sum()
        self._group_products = group_products
        self._group_forms = group_forms
        self._total = total

    def __matmul__(self, other: torch.Tensor) -> torch.Tensor:
        """Return B v for v of shape [d], or B V for V of shape [d, n]; float64.

        Raises
        ------
        ValueError
            Wrong shape, or the product is not finite.
        """
        other = torch.as_tensor(other, dtype=torch.float64)
        if other.shape[:1] != self.shape[:1] or other.ndim > 2:
            raise ValueError(
                f"operand has shape {tuple(other.shape)}, must be ({self.shape[1]},) "
                f"or ({self.shape[1]}, n)"
            )
        if other.ndim == 1:
            return self._sum("a product", self.mean(self._group_products(other)))
        columns = [self.mean(self._group_products(column)) for column in other.T]
        return self._sum("a product", torch.stack(columns, dim=1))

    def group_forms(self, basis: torch.Tensor) -> torch.Tensor:
        """Return VᵀB_k V for V = ``basis`` [d, n], [K, n, n], on the CPU."""
        if self._group_forms is not None and basis.shape[1] <= MAX_FORM_COLUMNS:
            forms = self._group_forms(basis)
        else:
            columns = [self._group_products(column) for column in basis.T]
            forms = basis.T @ torch.stack(columns, dim=2)
        return self._sum("a projected matrix", forms.cpu())

    def krylov(self, start: torch.Tensor, dim: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return an orthonormal basis V [d, n] of K(B, start), n ≤ ``dim``, and VᵀB_k V [K, n, n].

        The forms come from the n products that generate the basis, and lie on the CPU.
        """
        columns: list[torch.Tensor] = []

        def product(vector: torch.Tensor) -> torch.Tensor:
            columns.append(self._group_products(vector))
            return self._sum("a product", self.mean(columns[-1]))

        basis, _ = krylov_basis(product, start, dim)
        forms = basis.T @ torch.stack(columns, dim=2)
        return basis, self._sum("a projected matrix", forms.cpu())

    def mean(self, groups: torch.Tensor) -> torch.Tensor:
        """Return Σ_k w_k x_k for x_k of any shape, [K, …] to […]."""
        mean: torch.Tensor = torch.tensordot(self.weights.to(groups.device), groups, dims=1)
        return mean

    def to_dense(self) -> torch.Tensor:
        """Return B, exactly symmetric, [d, d]: d products, for small d and for tests."""
        matrix = self @ torch.eye(self.shape[0], dtype=torch.float64)
        return 0.5 * (matrix + matrix.T)

    def _sum(self, name: str, term: torch.Tensor) -> torch.Tensor:
        return require_finite(name, self._total(term))


def require_finite(name: str, derivative: torch.Tensor) -> torch.Tensor:
    """Return ``derivative``, or raise ValueError where an entry is NaN or infinite.

    It is to be a sum over all ranks, so that all of them raise and none waits for another.
    """
    if not derivative.isfinite().all():
        raise ValueError(
            f"{name} is not finite: log π(a|s), or a derivative of it, overflows at the policy's "
            "parameters, as where the standard deviation of its actions has vanished. Training "
            "gets there by steps that are too long: raise alpha, or set target_kl"
        )
    return derivative
