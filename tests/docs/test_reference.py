"""What the pages say of the package, compared with the package."""

import inspect
import re
from importlib import import_module

import pytest
import yaml
from sb3_contrib import TRPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger

import sb3_crpn
from benchmarks import documentation
from sb3_crpn import ACRPN, CRPN
from sb3_crpn.sosp import SospCallback
from tests.docs.pages import PAGES, ROOT, examples, name_of, source_of

SITE = "https://sb3-crpn.github.io/sb3-crpn/"
REPOSITORY = "https://github.com/sb3-crpn/sb3-crpn/"
FILES = (REPOSITORY + "blob/main/", "https://raw.githubusercontent.com/sb3-crpn/sb3-crpn/main/")


def page(name):
    return (ROOT / "docs" / name).read_text()


def rows(text, first_cell):
    """The cells of the table rows whose first cell matches."""
    table = (line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| "))
    cells = [[cell.strip() for cell in row] for row in table]
    return [row for row in cells if re.fullmatch(first_cell, row[0])]


class Keys(KVWriter):
    """Remembers what was logged."""

    def __init__(self):
        self.found = set()

    def write(self, key_values, key_excluded, step=0):
        self.found |= set(key_values)

    def close(self):
        pass


def logged(algorithm, callback=None):
    keys = Keys()
    model = algorithm("MlpPolicy", "Pendulum-v1", n_steps=200, seed=0, device="cpu")
    model.set_logger(Logger(None, [keys]))
    model.learn(400, callback)
    return keys.found


def test_every_log_entry_is_described():
    callback = SospCallback(400, make_vec_env("Pendulum-v1"), n_episodes=4, epsilon=1.0)
    entry = r"`(rollout|time|train|sosp)/.*`"
    described = rows(page("crpn.md"), entry) + rows(page("certificate.md"), entry)
    assert all(len(row) == 4 and row[1] and row[2] for row in described)
    names = [row[0].strip("`") for row in described]
    assert len(names) == len(set(names))
    assert (
        set(names)
        == logged(CRPN, callback)
        == logged(ACRPN) | {name for name in names if name.startswith("sosp/")}
    )


@pytest.mark.parametrize("other", [PPO, TRPO])
def test_migration_tables_name_every_argument(other):
    section = page("migration.md").partition(f"## From {other.__name__}\n")[2].partition("\n## ")[0]
    table = {row[0]: row[1] for row in rows(section, r"`.*`")}
    theirs, ours = (set(inspect.signature(cls).parameters) for cls in (other, CRPN))
    names = [name for cell in table for name in re.findall(r"`(\w+)`", cell)]
    assert set(names) == theirs
    assert len(names) == len(theirs)
    for cell, replacement in table.items():
        if replacement == "the same":
            assert set(re.findall(r"`(\w+)`", cell)) <= ours
        elif replacement != "none":
            assert set(re.findall(r"`(\w+)`", replacement)) <= ours
    same_name = {name for name in theirs & ours if name not in ("policy", "env")}
    assert all(table[f"`{name}`"] == f"`{name}`" for name in same_name)


def test_tuning_names_arguments_that_exist():
    last_column = " ".join(row[2] for row in rows(page("tuning.md"), ".*") if len(row) == 3)
    named = set(re.findall(r"`(\w+)(?:=[^`]*)?`", last_column)) - {"VecNormalize"}
    assert "target_kl" in named
    assert named <= set(inspect.signature(CRPN).parameters)


# The modules whose ``__all__`` is public; of the others, the API page names what is
PUBLIC = ("sb3_crpn", "sb3_crpn.cubic", "sb3_crpn.sosp", "sb3_crpn.theory")
DIRECTIVE = re.compile(r"^\.\. auto(?:class|function|exception):: (sb3_crpn[\w.]*)$", re.MULTILINE)


def documented():
    """The dotted names that autodoc describes, and PAPER."""
    text = "".join(page(name) for name in ("api.md", "crpn.md", "acrpn.md"))
    return {*DIRECTIVE.findall(text), "sb3_crpn.PAPER"}


def test_public_names_are_documented():
    public = {f"{module}.{name}" for module in PUBLIC for name in import_module(module).__all__}
    aliases = {f"sb3_crpn.{name}" for name in ("MlpPolicy", "CnnPolicy", "MultiInputPolicy")}
    assert public - {"sb3_crpn.__version__"} - aliases <= documented()
    for name in documented():
        module, _, attribute = name.rpartition(".")
        assert getattr(import_module(module), attribute) is not None


def test_public_names_have_an_example():
    code = "\n".join(source_of(example) for example in examples())
    # a base class, the type of an operator and that of an attribute are used without their names
    unnamed = {"PolicyNewtonAlgorithm", "GroupedOperator", "CurvatureEstimate", "ActorParameters"}
    names = {name.rpartition(".")[2] for name in documented()}
    assert {name for name in names - unnamed if not re.search(rf"\b{name}\b", code)} == set()


@pytest.mark.parametrize("path", list(documentation.pages()), ids=name_of)
def test_tables_are_those_of_the_measurements(path):
    text = path.read_text()
    assert documentation.render(text) == text


LINK = re.compile(r"\]\(([^)\s]+)\)")
DOCUMENTS = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_links_lead_to_files(path):
    outside = path.name in ("README.md",)
    for link in LINK.findall(path.read_text()):
        target = link.partition("#")[0]
        if target.startswith(SITE):
            name = target.removeprefix(SITE).removesuffix(".html") or "index"
            assert any((ROOT / "docs" / f"{name}{end}").is_file() for end in (".md", ".ipynb")), (
                link
            )
        elif target.startswith(FILES):
            inside = next(target.removeprefix(f) for f in FILES if target.startswith(f))
            assert (ROOT / inside).exists(), link
        elif target and not target.startswith("http"):
            assert not outside, f"{link}: the README is read outside the repository, too"
            assert (path.parent / target).exists(), link


def test_the_release_is_the_same_everywhere():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    changelog = (ROOT / "CHANGELOG.md").read_text()
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    assert released[0] == (sb3_crpn.__version__, str(citation["date-released"]))
    assert citation["version"] == sb3_crpn.__version__


def test_addresses_are_the_project_s():
    metadata = (ROOT / "pyproject.toml").read_text()
    urls = re.findall(
        r"https://[^\"]+", metadata.partition("[project.urls]")[2].partition("\n[")[0]
    )
    assert len(urls) == 4
    assert all(url.startswith((REPOSITORY[:-1], SITE)) for url in urls)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120
