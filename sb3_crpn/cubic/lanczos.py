"""Orthonormal bases of Krylov spaces by Lanczos with full reorthogonalisation."""

import warnings

import numpy as np
import torch
from torch import Tensor

from sb3_crpn.arrays import ArrayLike, FloatArray, Operator, as_vector
from sb3_crpn.checks import COUNT, SEED, integer
from sb3_crpn.cubic.step import EPS, CountedOperator, random_unit_vector

# krylov_basis regards a space as invariant once the remainder is below this multiple of EPS·‖A‖.
# With repeated eigenvalues the remainder was 5 to 27 times EPS·‖A‖ for d = 30 to 3000, and once
# 150 times for d = 10
_BREAKDOWN = 200.0

# Relative residual of a converged Ritz pair in leftmost_eigenvalues
_TOLERANCE = 1e-8

# The projected problem, O(k³), is solved again after 1 + k/16 products. At most 6 % of the
# products are then superfluous
SOLVE_INTERVAL = 16

# max_products=None: min(d, 1000), and one more in solve_krylov. After d products the space is R^d.
# 1000 vectors of d = 10⁵ take 0.8 GB
MAX_PRODUCTS = 1000


class KrylovSpace:
    """Orthonormal basis Q [k, d] (rows) of the sum of several Krylov spaces of A, and P = QAQᵀ.

    A *chain* is the Lanczos sequence of one start vector, with full reorthogonalisation. It costs
    one product a vector. Its *remainder* is the component of its last product orthogonal to the
    space, whence ``A Qᵀy - QᵀPy = Σ_chains y_last·remainder``. The residual of any vector of the
    space therefore costs no product. The remainder is None after a breakdown, where its norm is
    below ``breakdown``·EPS·‖A‖. The default of 1 drops rounding errors only. The space depends on A
    and the start vectors, not on α. Another α costs no product.
    """

    def __init__(self, operator: CountedOperator, like: Tensor, breakdown: float = 1.0) -> None:
        self.operator = operator
        self.breakdown = breakdown
        self.dim = like.numel()
        self.size = 0
        self.projected: FloatArray = np.zeros((0, 0))
        self.chains: list[list[int]] = []
        self.remainders: list[Tensor | None] = []
        self.norm = 0.0  # the largest ‖Aq‖ so far
        self._rows = like.new_empty(min(self.dim, 16), self.dim)

    @property
    def basis(self) -> Tensor:
        """Q, Tensor[k, d]."""
        return self._rows[: self.size]

    def start_chain(self, start: Tensor) -> int:
        """Start a chain at ``start`` (≠ 0), without a product, and return its index."""
        self.chains.append([])
        self.remainders.append(self._remainder(start, float(torch.linalg.vector_norm(start))))
        return len(self.chains) - 1

    def extend(self, chain: int) -> Tensor | None:
        """Add the next vector q of ``chain`` and return Aq, one product; None after a breakdown."""
        remainder = self.remainders[chain]
        if remainder is None:
            return None
        q = self._orthogonalise(remainder / torch.linalg.vector_norm(remainder))
        self._append(q / torch.linalg.vector_norm(q))
        self.chains[chain].append(self.size - 1)

        product = self.operator(self._rows[self.size - 1])
        self.norm = max(self.norm, float(torch.linalg.vector_norm(product)))
        column = (self.basis @ product).cpu().numpy()
        self.projected = np.pad(self.projected, (0, 1))
        self.projected[-1, :] = self.projected[:, -1] = column
        self.remainders[chain] = product
        self.remainders = [
            None if vector is None else self._remainder(vector, self.norm)
            for vector in self.remainders
        ]
        return product

    def residual(self, coordinates: FloatArray) -> Tensor:
        """Return A Qᵀy - QᵀPy, [d], for y [k], without a product."""
        residual = self._rows.new_zeros(self.dim)
        for chain, remainder in zip(self.chains, self.remainders, strict=True):
            if remainder is not None and chain:
                residual += float(coordinates[chain[-1]]) * remainder
        return residual

    def _append(self, row: Tensor) -> None:
        if self.size == len(self._rows):
            more = min(self.dim, 2 * self.size) - self.size
            self._rows = torch.cat([self._rows, self._rows.new_empty(more, self.dim)])
        self._rows[self.size] = row
        self.size += 1

    def _remainder(self, vector: Tensor, scale: float) -> Tensor | None:
        # "twice is enough" (Kahan, in Parlett 1980)
        remainder = self._orthogonalise(self._orthogonalise(vector))
        negligible = float(torch.linalg.vector_norm(remainder)) <= self.breakdown * EPS * scale
        return None if negligible or self.size == self.dim else remainder

    def _orthogonalise(self, vector: Tensor) -> Tensor:
        return vector - self.basis.T @ (self.basis @ vector)


def krylov_basis(matvec: Operator, start: ArrayLike, dim: int) -> tuple[Tensor, Tensor]:
    """Return a basis of the Krylov space span{b, Ab, …, A^{dim-1}b}, A symmetric, and its image.

    Lanczos with full reorthogonalisation, one product a column.

    Parameters
    ----------
    matvec
        v ↦ Av, float64 Tensor[d] to Tensor[d].
    start
        b, [d]. b = 0 gives k = 0.
    dim
        Maximum number of columns, ≥ 1.

    Returns
    -------
    tuple[Tensor, Tensor]
        Orthonormal Q and AQ, [d, k], float64. k = min(d, dim), or the dimension of an invariant
        Krylov space.

    Raises
    ------
    ValueError
        For an empty or non-finite ``start``, a non-finite product, dim < 1.
    """
    vector = as_vector("krylov_basis: start", start)
    size = min(vector.numel(), COUNT("krylov_basis: dim", dim))
    space = KrylovSpace(CountedOperator("krylov_basis: matvec", matvec), vector, _BREAKDOWN)
    chain = space.start_chain(vector)
    images: list[Tensor] = []
    for _ in range(size):
        image = space.extend(chain)
        if image is None:
            break
        images.append(image)
    basis = space.basis.T.contiguous()
    return basis, torch.stack(images, dim=1) if images else basis.clone()


def leftmost_eigenvalues(
    matvec: Operator,
    like: ArrayLike,
    k: int = 1,
    *,
    max_products: int | None = None,
    seed: int = 0,
) -> Tensor:
    """Return the k leftmost eigenvalues of a symmetric A, ascending, from products alone.

    Lanczos with full reorthogonalisation runs from a random start until k Ritz pairs (θ, v) satisfy
    ‖Av - θv‖ ≤ 1e-8 ‖A‖. An eigenvalue is then within 1e-8 ‖A‖ of each θ. After a breakdown
    another random start continues, and finds further copies of repeated eigenvalues. Without a
    breakdown a repeated eigenvalue may be returned once only.

    Parameters
    ----------
    matvec
        v ↦ Av, float64 Tensor[d] to Tensor[d].
    like
        A vector with the size and device of v, [d].
    k
        Number of eigenvalues, 1 to d.
    max_products
        Maximum number of products, at least k. None: min(d, 1000). Memory: 8·d bytes a product.
        Without convergence the Ritz values are upper bounds, and a RuntimeWarning says so.
    seed
        Seed of the random starts. PyTorch's global generator is not used.

    Returns
    -------
    Tensor
        float64 [k].

    Raises
    ------
    ValueError
        For a wrong shape, a non-finite number (products included), k out of range,
        max_products < k.
    """
    name = "leftmost_eigenvalues"
    vector = as_vector(f"{name}: like", like)
    k = integer(1, vector.numel())(f"{name}: k", k)
    limit = min(vector.numel(), MAX_PRODUCTS) if max_products is None else max_products
    limit = min(vector.numel(), integer(k)(f"{name}: max_products", limit))
    seed = SEED(f"{name}: seed", seed)
    space = KrylovSpace(CountedOperator(f"{name}: matvec", matvec), vector, _BREAKDOWN)
    chain = space.start_chain(random_unit_vector(vector, seed))
    while True:
        for _ in range(1 + space.size // SOLVE_INTERVAL):
            if space.size < limit and space.extend(chain) is None:
                chain = space.start_chain(random_unit_vector(vector, seed + len(space.chains)))
        values, error = _ritz(space, k)
        if len(values) == k and error <= _TOLERANCE * space.norm:
            return values
        if space.size == limit:
            break
    warnings.warn(
        f"{name}: {limit} products are too few for {k} eigenvalues: the residual is {error:.1e}, "
        f"wanted {_TOLERANCE * space.norm:.1e}; the values returned are bounds from above",
        RuntimeWarning,
        stacklevel=2,
    )
    return values


def _ritz(space: KrylovSpace, k: int) -> tuple[Tensor, float]:
    """Return at most k leftmost Ritz values and the largest of their residual norms."""
    values, vectors = np.linalg.eigh(space.projected)
    norms = [float(torch.linalg.vector_norm(space.residual(y))) for y in vectors.T[:k]]
    return torch.from_numpy(values[:k]), max(norms)
