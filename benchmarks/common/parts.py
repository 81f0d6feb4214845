"""Results of a benchmark of several parts. A run of a part replaces its results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.table import Row, Table


@dataclass(frozen=True)
class Parts:
    """Rows of nested values by part, in a CSV file with a line a row: its part, and it as JSON."""

    path: Path

    def read(self) -> dict[str, list[Row]]:
        """Return the rows of each part, or none without a file."""
        parts: dict[str, list[Row]] = {}
        for line in Table(self.path).read().to_dict("records"):
            parts.setdefault(line["part"], []).append(json.loads(line["row"]))
        return parts

    def replace(self, part: str, rows: Sequence[Row]) -> None:
        """Put the rows in place of the part's."""
        Table(self.path).replace([{"part": part, "row": row} for row in rows], part=part)
