"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np


def markdown(head: Sequence[Any], body: Iterable[Sequence[Any]]) -> str:
    """Return a table; floats get three significant digits."""
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(_cell(cell) for cell in line)} |" for line in lines)


def number(value: float) -> str:
    """Return three significant digits, without an exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:#.3g}"


def estimate(found: Sequence[float], spec: str | None = ",.2f") -> str:
    """Return "value [low, high]", or the value alone where the bounds are NaN.

    Parameters
    ----------
    found
        Value, low, high.
    spec
        Format of each; ``None``: three significant digits of the largest of the three.
    """
    if spec is None:
        largest = max(np.nanmax(np.abs(found)), 0.01)
        spec = f",.{max(0, 2 - int(np.floor(np.log10(largest))))}f"
    value, low, high = (format(part, spec) for part in found)
    return value if np.isnan(found[1]) else f"{value} [{low}, {high}]"


def _cell(value: Any) -> str:
    return number(value) if isinstance(value, float) else str(value)
