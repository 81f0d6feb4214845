"""Symmetric matrices known through products, as means over groups of episodes."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from sb3_crpn.arrays import Array, FloatArray
from sb3_crpn.checks import FLAG, integer
from sb3_crpn.cubic import krylov_basis, leftmost_eigenvalues
from sb3_crpn.progress import progress

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

# VᵀBV of more columns is made from products, whose memory does not grow with columns × timesteps
MAX_FORM_COLUMNS = 128

# to_dense warns above this d, where the dense solver's range ends (DESIGN section 4)
MAX_DENSE = 2000


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

    def to_dense(self, *, progress_bar: bool = False) -> torch.Tensor:
        """Return B, exactly symmetric, float64 [d, d]: d products, for small d and for tests.

        Parameters
        ----------
        progress_bar
            Show the products done; needs tqdm and rich.

        Warns
        -----
        UserWarning
            Before more than 2,000 products.
        """
        d = self.shape[0]
        show = FLAG("to_dense: progress_bar", progress_bar)
        if d > MAX_DENSE:
            warnings.warn(
                f"to_dense takes {d} products and {8e-9 * d * d:.2g} GB: eigenvalues(k) finds the "
                "leftmost eigenvalues, and aslinearoperator() serves SciPy's solvers, with fewer",
                stacklevel=2,
            )
        columns = []
        with progress("products", d, show=show) as tick:
            for unit in torch.eye(d, dtype=torch.float64):
                columns.append(self @ unit)
                tick(1)
        matrix = torch.stack(columns, dim=1)
        return 0.5 * (matrix + matrix.T)

    def eigenvalues(
        self,
        k: int = 1,
        *,
        max_products: int | None = None,
        seed: int = 0,
        progress_bar: bool = False,
    ) -> torch.Tensor:
        """Return the k leftmost eigenvalues, ascending, float64 [k], from products alone.

        Parameters
        ----------
        k
            1 to d.
        max_products, seed
            As in :func:`sb3_crpn.cubic.leftmost_eigenvalues`.
        progress_bar
            Show the products done, whose number is not known before; needs tqdm and rich.
        """
        k = integer(1, self.shape[0])("eigenvalues: k", k)
        show = FLAG("eigenvalues: progress_bar", progress_bar)
        with progress("products", None, show=show) as tick:

            def product(vector: torch.Tensor) -> torch.Tensor:
                tick(1)
                return self @ vector

            like = torch.ones(self.shape[0], dtype=torch.float64)
            return leftmost_eigenvalues(product, like, k, max_products=max_products, seed=seed)

    def aslinearoperator(self) -> LinearOperator:
        """Return B for SciPy: a ``scipy.sparse.linalg.LinearOperator`` of float64 arrays.

        ``scipy.sparse.linalg.eigsh(hessian.aslinearoperator(), k)`` gives eigenvectors, too.
        """
        from scipy.sparse.linalg import LinearOperator  # here: the import takes time

        def product(array: Array) -> FloatArray:
            operand = torch.from_numpy(np.asarray(array, dtype=np.float64))
            result: FloatArray = (self @ operand).cpu().numpy()
            return result

        def vector_product(array: Array) -> FloatArray:
            return product(array.reshape(-1))

        return LinearOperator(
            self.shape,
            matvec=vector_product,
            rmatvec=vector_product,
            matmat=product,
            rmatmat=product,
            dtype=np.dtype(np.float64),
        )

    def __repr__(self) -> str:
        """Return one line."""
        d, weights = self.shape[0], ", ".join(f"{w:.3g}" for w in self.weights)
        return f"GroupedOperator({d} × {d}, group weights {weights})"

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
