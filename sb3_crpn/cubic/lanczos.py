"""Orthonormal bases of Krylov spaces by Lanczos with full reorthogonalisation."""

import warnings

import numpy as np
import torch
from torch import Tensor

from sb3_crpn.arrays import ArrayLike, FloatArray, Operator, as_vector
from sb3_crpn.checks import COUNT, SEED, integer
from sb3_crpn.cubic.step import EPS, CountedOperator, random_unit_vector

# krylov_basis takes a space for invariant where the remainder is below this multiple of EPS·‖A‖:
# repeated eigenvalues left 5 to 27 for d = 30 to 3000, once 150 for d = 10
_BREAKDOWN = 200.0

# leftmost_eigenvalues takes an eigenvalue for found where its residual is below this part of ‖A‖
_TOLERANCE = 1e-8

# max_products=None: min(d, 1000), as for solve_krylov
_MAX_PRODUCTS = 1000


class KrylovSpace:
    """Orthonormal basis Q [k, d] (rows) of a few Krylov chains of A, and P = QAQᵀ.

    A chain grows from a start vector by Lanczos with full reorthogonalisation, one product a
    vector. Its *end* is the part of its last product that the space lacks, so that
    ``A Qᵀy - QᵀPy = Σ_chains y_last·end``: the residual of anything solved in the space is known
    without a product. An end is None where the chain has broken down, its end below
    ``breakdown``·EPS·‖A‖; the default keeps all that could show in a residual. The space depends
    on A and the starts only, so that solving for another α costs no product.
    """

    def __init__(self, operator: CountedOperator, like: Tensor, breakdown: float = 1.0) -> None:
        self.operator = operator
        self.breakdown = breakdown
        self.dim = like.numel()
        self.size = 0
        self.projected: FloatArray = np.zeros((0, 0))
        self.chains: list[list[int]] = []
        self.ends: list[Tensor | None] = []
        self.norm = 0.0  # the largest ‖Aq‖ so far
        self._rows = like.new_empty(min(self.dim, 16), self.dim)

    @property
    def basis(self) -> Tensor:
        """Q, Tensor[k, d]."""
        return self._rows[: self.size]

    def open(self, start: Tensor) -> int:
        """Begin a chain at ``start`` (≠ 0) and return its number; no product yet."""
        self.chains.append([])
        self.ends.append(self._end(start, float(torch.linalg.vector_norm(start))))
        return len(self.chains) - 1

    def extend(self, chain: int) -> Tensor | None:
        """Add the end q of ``chain`` to the basis and return Aq, one product; None at its end."""
        end = self.ends[chain]
        if end is None:
            return None
        q = self._outside(end / torch.linalg.vector_norm(end))
        self._append(q / torch.linalg.vector_norm(q))
        self.chains[chain].append(self.size - 1)

        product = self.operator(self._rows[self.size - 1])
        self.norm = max(self.norm, float(torch.linalg.vector_norm(product)))
        column = (self.basis @ product).cpu().numpy()
        self.projected = np.pad(self.projected, (0, 1))
        self.projected[-1, :] = self.projected[:, -1] = column
        self.ends[chain] = product
        self.ends = [None if e is None else self._end(e, self.norm) for e in self.ends]
        return product

    def _append(self, row: Tensor) -> None:
        if self.size == len(self._rows):
            more = min(self.dim, 2 * self.size) - self.size
            self._rows = torch.cat([self._rows, self._rows.new_empty(more, self.dim)])
        self._rows[self.size] = row
        self.size += 1

    def _end(self, vector: Tensor, scale: float) -> Tensor | None:
        outside = self._outside(self._outside(vector))  # twice is enough (Kahan, in Parlett 1980)
        noise = self.breakdown * EPS * scale
        full = self.size == self.dim
        return None if full or float(torch.linalg.vector_norm(outside)) <= noise else outside

    def _outside(self, vector: Tensor) -> Tensor:
        return vector - self.basis.T @ (self.basis @ vector)


def krylov_basis(matvec: Operator, start: ArrayLike, dim: int) -> tuple[Tensor, Tensor]:
    """Orthonormal basis of the Krylov space span{b, Ab, …, A^{dim-1}b}, A symmetric.

    Lanczos with full reorthogonalisation, at one product a column.

    Parameters
    ----------
    matvec
        v ↦ Av, float64 Tensor[d] to Tensor[d].
    start
        b, [d]. Zero spans nothing: k = 0.
    dim
        Columns wanted, ≥ 1; more than d are d.

    Returns
    -------
    tuple[Tensor, Tensor]
        Q and AQ, [d, k], float64, k ≤ min(d, dim); fewer where the space is invariant before.

    Raises
    ------
    ValueError
        For an empty or non-finite ``start``, a non-finite product, dim < 1.
    """
    vector = as_vector("krylov_basis: start", start)
    size = min(vector.numel(), COUNT("krylov_basis: dim", dim))
    space = KrylovSpace(CountedOperator("krylov_basis: matvec", matvec), vector, _BREAKDOWN)
    chain = space.open(vector)
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

    Lanczos with full reorthogonalisation from a random start, until the Ritz pairs (θ, v) have
    ‖Av - θv‖ ≤ 1e-8 ‖A‖: an eigenvalue lies as near to θ. Where the chain has spanned all that
    its start can see, another start finds more, such as repeated eigenvalues; a repeated one may
    be returned once where the chain goes on beyond it.

    Parameters
    ----------
    matvec
        v ↦ Av, float64 Tensor[d] to Tensor[d].
    like
        A vector of A's size and device, [d].
    k
        Eigenvalues wanted, 1 to d.
    max_products
        Most products spent, at least k; None: min(d, 1000). Memory: 8·d bytes a product. Where they
        run out, a warning says so, and the last values are bounds from above.
    seed
        Of the random starts; the global generator is not touched.

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
    limit = min(vector.numel(), _MAX_PRODUCTS) if max_products is None else max_products
    limit = min(vector.numel(), integer(k)(f"{name}: max_products", limit))
    seed = SEED(f"{name}: seed", seed)
    space = KrylovSpace(CountedOperator(f"{name}: matvec", matvec), vector, _BREAKDOWN)
    chain = space.open(random_unit_vector(vector, seed))
    while True:
        for _ in range(1 + space.size // 16):  # the projected problem is O(k³), see krylov.py
            if space.size < limit and space.extend(chain) is None:
                chain = space.open(random_unit_vector(vector, seed + len(space.chains)))
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
    """Return the leftmost Ritz values, at most k of them, and the largest of their residuals."""
    values, vectors = np.linalg.eigh(space.projected)
    residuals = torch.zeros(space.dim, min(k, len(values)), dtype=torch.float64)
    for chain, end in zip(space.chains, space.ends, strict=True):
        if end is not None and chain:
            residuals += torch.outer(end.cpu(), torch.from_numpy(vectors[chain[-1], :k]))
    error = float(torch.linalg.vector_norm(residuals, dim=0).max())
    return torch.from_numpy(values[:k]), error
