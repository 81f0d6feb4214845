"""Checks of arguments: the argument, its value, and what is allowed."""

from __future__ import annotations

import math


def require_real(name: str, value: float, low: float, high: float = math.inf) -> None:
    """Require a finite number in [low, high].

    Raises
    ------
    ValueError
        Naming the argument, its value and the interval.
    """
    if not (math.isfinite(value) and low <= value <= high):
        interval = f"[{low:g}, {high:g}" + (")" if math.isinf(high) else "]")
        raise ValueError(f"{name}={value!r} is not allowed, must be a finite number in {interval}")


def require_positive(name: str, value: float, high: float = math.inf) -> None:
    """Require a finite number in (0, high]."""
    if not (math.isfinite(value) and 0.0 < value <= high):
        interval = f"(0, {high:g}" + (")" if math.isinf(high) else "]")
        raise ValueError(f"{name}={value!r} is not allowed, must be a finite number in {interval}")


def require_count(name: str, value: int) -> None:
    """Require a whole number of at least 1."""
    if value != int(value) or value < 1:
        raise ValueError(f"{name}={value!r} is not allowed, must be an integer >= 1")
