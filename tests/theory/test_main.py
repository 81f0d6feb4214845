"""The table of ``python -m sb3_crpn.theory``."""

from pathlib import Path

import pytest

from sb3_crpn.theory.__main__ import PROBLEMS, numbers, recipe_pairs, table

TEXT = (Path(__file__).parents[2] / "docs" / "THEORY.md").read_text()


def test_the_committed_table_is_the_code_s():
    assert f"<!-- table: theory -->\n{table()}\n<!-- end -->" in TEXT


def test_the_table_compares_recipes_of_one_guarantee():
    for problem in PROBLEMS.values():
        for printed, ours in recipe_pairs(problem).values():
            assert printed.gradient_bound == pytest.approx(ours.gradient_bound)


def test_ratios_named_by_hand():
    """H = 10, γ = 1: L_H 21.6 times smaller, M_1 14 times, M_2 3.2 times."""
    found = dict(numbers(PROBLEMS["softmax, H = 10, d = 10, gamma = 1"]))
    ratios = {name: printed / ours for name, (printed, ours) in found.items()}
    assert ratios["L_H"] == pytest.approx(21.6, abs=0.05)
    assert ratios["M_1"] == pytest.approx(14.2, abs=0.05)
    assert ratios["M_2"] == pytest.approx(3.24, abs=0.01)
