"""Types of arrays, and vectors and matrices from what users hand over."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array: TypeAlias = npt.NDArray[Any]
FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Observations: TypeAlias = Tensor | dict[str, Tensor]
ArrayLike: TypeAlias = Tensor | npt.NDArray[Any]
Operator: TypeAlias = Callable[[Tensor], Tensor]


def as_vector(name: str, value: ArrayLike) -> Tensor:
    """Return ``value`` as a finite float64 Tensor[d] on its own device, or raise ValueError."""
    vector = _as_tensor(name, value)
    if vector.ndim != 1 or vector.numel() == 0:
        raise ValueError(f"{name} has shape {tuple(vector.shape)}, must be (d,) with d >= 1")
    require_finite(name, vector)
    return vector


def as_symmetric(name: str, value: ArrayLike, dim: int) -> FloatArray:
    """Return the symmetric part of ``value`` as a finite array[dim, dim], or raise ValueError."""
    matrix = _as_tensor(name, value).cpu()
    if matrix.shape != (dim, dim):
        raise ValueError(f"{name} has shape {tuple(matrix.shape)}, must be ({dim}, {dim})")
    require_finite(name, matrix)
    symmetric: FloatArray = ((matrix + matrix.T) / 2).numpy()
    return symmetric


def require_finite(name: str, value: Tensor) -> None:
    """Raise ValueError if an entry is NaN or infinite."""
    finite = torch.isfinite(value)
    if not bool(finite.all()):
        bad = int((~finite).sum())
        raise ValueError(f"{name} has {bad} NaN or infinite entries, must be finite")


def _as_tensor(name: str, value: ArrayLike) -> Tensor:
    """Return real numbers as float64."""
    try:
        tensor = torch.as_tensor(value).detach()
    except (TypeError, ValueError, RuntimeError):
        tensor = torch.zeros((), dtype=torch.bool)
    if tensor.dtype == torch.bool or tensor.is_complex():
        raise ValueError(f"{name}={value!r} is not allowed, must be an array of real numbers")
    return tensor.to(torch.float64)
