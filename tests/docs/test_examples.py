"""Every Python block of README and documentation runs, a page's blocks in one namespace."""

import gc

import matplotlib
import pytest

from sb3_crpn.algorithm.solvers import SOLVERS
from sb3_crpn.curvature import HESSIAN_ESTIMATORS, METRICS, SHRINKAGES
from sb3_crpn.episodes import TRACKERS
from tests.docs.pages import examples, name_of, source_of

matplotlib.use("Agg")
REGISTRIES = (SOLVERS, HESSIAN_ESTIMATORS, METRICS, SHRINKAGES, TRACKERS)


@pytest.fixture
def registries():
    """Remove what an example has registered."""
    before = [(registry, dict(registry)) for registry in REGISTRIES]
    yield
    for registry, entries in before:
        registry.clear()
        registry.update(entries)


# examples, as scripts do, leave their monitors' files to the end of the process
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("registries")
@pytest.mark.parametrize("page", examples(), ids=name_of)
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = compile(source_of(page), str(page), "exec")
    exec(code, {"__name__": "__main__"})
    gc.collect()


def test_budgets_are_small_and_lines_are_the_page_s(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "text\n```python\nlearn(100_000, n_episodes=50)\n```\n"
        "<!-- not run: no GPU -->\n```python\n1 / 0\n```\n"
    )
    assert source_of(page) == "\n\nlearn(600, n_episodes=8)\n"
