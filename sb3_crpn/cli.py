"""The command line of ``sb3-crpn``, apart from the imports that its scripts need."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

SCRIPTS = ("train", "enjoy", "plot_train", "all_plots", "plot_from_file")


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the ``script`` and its ``options``; exit with a message where they are wrong.

    Parameters
    ----------
    arguments
        ``None``: those of the process.
    """
    parser = argparse.ArgumentParser(
        prog="sb3-crpn", description="rl-zoo's scripts with CRPN and ACRPN."
    )
    parser.add_argument("script", choices=SCRIPTS, help="its own options follow; see SCRIPT --help")
    parser.add_argument("options", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)
