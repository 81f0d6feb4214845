import sys

import pytest

from sb3_crpn.progress import load_bar, progress


def test_a_bar_counts(capsys):
    with progress("episodes", 3, show=True) as tick:
        for _ in range(3):
            tick(1)
    shown = "".join(capsys.readouterr())
    assert "episodes" in shown
    assert "3/3" in shown


def test_without_one_nothing_is_imported_or_shown(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm.rich", None)
    with progress("episodes", 3, show=False) as tick:
        tick(1)
    assert "".join(capsys.readouterr()) == ""


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.rich", None)
    with pytest.raises(ImportError, match=r"tqdm and rich.*\[extra\]"):
        load_bar()
