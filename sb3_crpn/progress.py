"""Progress bars, which SB3 too leaves optional."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Tick = Callable[[int], object]


def load_bar() -> Any:
    """Return SB3's progress bar, ``tqdm.rich.tqdm``.

    Raises
    ------
    ImportError
        tqdm or rich is not installed.
    """
    try:
        from tqdm.rich import tqdm  # an optional dependency
    except ImportError:
        raise ImportError(
            "progress_bar=True needs tqdm and rich. They come with the extra packages: "
            'pip install ".[extra]" in a clone'
        ) from None
    return tqdm


@contextmanager
def progress(what: str, total: int | None, *, show: bool) -> Iterator[Tick]:
    """Show a bar of ``total`` steps (``None``: unknown) while the block runs.

    Yields
    ------
    Tick
        Takes note of n more steps. It does nothing where ``show`` is False.
    """
    if not show:
        yield lambda n: None
        return
    bar_class = load_bar()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="rich is experimental")
        bar = bar_class(total=total, desc=what)
    with bar:
        yield bar.update
        bar.refresh()
