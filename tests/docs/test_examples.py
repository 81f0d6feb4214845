"""Every Python block of README and documentation runs, a page's blocks in one namespace."""

import matplotlib
import pytest

from tests.docs.pages import examples, name_of, source_of

matplotlib.use("Agg")


@pytest.mark.parametrize("page", examples(), ids=name_of)
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = compile(source_of(page), str(page), "exec")
    exec(code, {"__name__": "__main__"})


def test_budgets_are_small_and_lines_are_the_page_s(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "text\n```python\nlearn(100_000)\n```\n<!-- not run: no GPU -->\n```python\n1 / 0\n```\n"
    )
    assert source_of(page) == "\n\nlearn(600)\n"
