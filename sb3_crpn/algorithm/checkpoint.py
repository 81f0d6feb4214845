"""Files that are replaced in one go, and the random state that a continued run restores."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
import torch


@contextmanager
def replaced_in_one_go(path: str | os.PathLike[str]) -> Iterator[BufferedWriter]:
    """Open a file that takes the place of ``path`` once it is complete.

    Whatever happens before leaves ``path`` intact. Its folder is made.
    """
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    partial = final.with_name(f"{final.name}.partial")
    with partial.open("wb") as stream:
        yield stream
    partial.replace(final)


def read_random_state(device: torch.device) -> dict[str, Any]:
    """Return the states of Python's, NumPy's and PyTorch's generators."""
    state = {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": torch.get_rng_state().numpy(),
    }
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device).numpy()
    return state


def load_random_state(state: dict[str, Any], device: torch.device) -> None:
    """Set the generators to what :func:`read_random_state` returned."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(torch.from_numpy(state["torch"]))
    if "cuda" in state and device.type == "cuda":
        torch.cuda.set_rng_state(torch.from_numpy(state["cuda"]), device)
