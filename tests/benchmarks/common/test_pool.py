import os

import pytest

from benchmarks.common.pool import run_all


def third(number):
    if number == 0:
        raise ZeroDivisionError("of nothing")
    return 3 / number, os.environ["OMP_NUM_THREADS"], os.nice(0)


def test_results_are_kept_as_they_come_and_failures_counted(capfd):
    kept = {}
    n_failed = run_all(third, [1, 0, 3], kept.__setitem__, n_processes=1)
    polite = os.nice(0) + 10
    assert n_failed == 1
    assert kept == {1: (3, "1", min(19, polite)), 3: (1, "1", min(19, polite))}
    assert "failed: 0" in (printed := "".join(capfd.readouterr()))
    assert "of nothing" in printed


def test_what_cannot_be_kept_ends_it():
    def refuse(job, result):
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        run_all(third, [1, 2], refuse, n_processes=1)
