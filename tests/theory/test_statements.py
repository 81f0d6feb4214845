"""docs/THEORY.md leads from every numbered statement to its code and its test."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "THEORY.md").read_text()
NUMBERS = {
    "Assumption": 3,
    "Definition": 2,
    "Proposition": 1,
    "Theorem": 4,
    "Lemma": 14,
    "Remark": 4,
}
ALGORITHM_LINES = {
    1: ["input", "simulation", "gradient", "Hessian", "policy update", "output"],
    2: ["input", "loop", "simulation", "gradient", "Hessian", "Cauchy step", "perturbed descent",
        "step", "stopping rule", "Finalsolver", "output"],
}  # fmt: skip


def statements():
    """The rows of section 13: statement ↦ its cells."""
    section = TEXT.partition("## 13. ")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
    return {cells[0]: cells[1:] for cells in rows[1:]}


ROWS = statements()
NAMES = sorted({name for cells in ROWS.values() for name in re.findall(r"`([^`]+)`", str(cells))})


def exists(name):
    """Return whether a file, a test "file::function" or a dotted name exists."""
    path, _, test = name.partition("::")
    if "/" in path:
        found = (ROOT / path).is_file()
        return found and (not test or f"\ndef {test}(" in (ROOT / path).read_text())
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            owner = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            owner = getattr(owner, part, None)
        return owner is not None
    return False


def test_no_statement_is_missing():
    expected = {f"{kind} {k}" for kind, count in NUMBERS.items() for k in range(1, count + 1)}
    expected |= {f"Algorithm {k}, {line}" for k, lines in ALGORITHM_LINES.items() for line in lines}
    assert ROWS.keys() == expected


@pytest.mark.parametrize("statement", ROWS)
def test_every_statement_has_a_test_and_its_line(statement):
    line, *cells = ROWS[statement]
    assert line.isdigit()
    assert "`tests/" in cells[-1]


@pytest.mark.parametrize("name", NAMES)
def test_what_the_table_names_is_there(name):
    assert exists(name)


@pytest.mark.parametrize("name", ["sb3_crpn.theory.Constant", "nowhere.x", "docs/THEORY.tex",
                                  "tests/theory/test_statements.py::test_nothing"])  # fmt: skip
def test_what_is_not_there_is_noticed(name):
    assert not exists(name)
