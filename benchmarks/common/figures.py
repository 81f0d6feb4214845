"""The style of figures."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl

# Okabe and Ito's colours, which colour-blind readers can distinguish
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
STYLE: dict[str, Any] = {
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 8,
}


def use_style() -> None:
    """Draw to files, in this style."""
    mpl.use("Agg")
    mpl.rcParams.update(STYLE)
