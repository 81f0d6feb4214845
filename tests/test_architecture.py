"""The layers of DESIGN section 6: what each module may import."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sb3_crpn

PACKAGE = Path(sb3_crpn.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_FUNCTION_LINES = 40
# Layers in which each module has the test file of its name
TESTED_BY_MODULE = {"cubic", "curvature", "episodes", "sosp", "theory"}

# From bottom to top. A module imports from the layers before it only
GROUND = {"checks", "arrays"}
LAYERS = {
    "cli": set(),
    "checks": set(),
    "arrays": set(),
    "progress": set(),
    "cubic": GROUND,
    "parameters": set(),
    "distributed": {"arrays"},
    "vec_env": {"arrays"},
    "policy": {"arrays", "parameters"},
    "episodes": {"arrays", "progress", "distributed", "policy"},
    "curvature": GROUND | {"progress", "cubic", "parameters", "policy", "episodes"},
    "algorithm": GROUND
    | {"progress", "cubic", "parameters", "policy", "distributed", "vec_env", "episodes"}
    | {"curvature"},
    "crpn": {"episodes", "algorithm"},
    "acrpn": {"checks", "episodes", "algorithm"},
    "sosp": GROUND
    | {"progress", "cubic", "parameters", "policy", "episodes", "curvature", "algorithm"},
    "theory": {"checks"},
    "callbacks": {"checks", "algorithm"},
    "__init__": {"crpn", "acrpn", "sosp", "theory", "callbacks"},
    "zoo": {"checks", "cli", "distributed", "crpn", "acrpn", "__init__"},
    "__main__": {"cli", "zoo"},
}
ARRAYS = {"numpy", "scipy", "torch"}
SB3 = {"stable_baselines3", "gymnasium"}
THIRD_PARTY = {
    "cli": set(),
    "__main__": set(),
    "checks": set(),
    "arrays": {"numpy", "torch"},
    "progress": {"tqdm"},
    "cubic": ARRAYS,
    "parameters": {"torch"},
    "distributed": {"numpy", "torch"},
    "sosp": {*ARRAYS, *SB3, "matplotlib"},
    "theory": set(),
    "algorithm": {*ARRAYS, *SB3, "typing_extensions"},
    "zoo": {*ARRAYS, *SB3, "rl_zoo3", "optuna"},
}


def layer_of(path):
    """The layer of a file: the name of its folder, or of the file outside folders."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(source, package):
    """The dotted names of the imports of ``source``, a module in ``package``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from (
                f"{module}.{alias.name}" if module == "sb3_crpn" else module for alias in node.names
            )


def violations(layer, names):
    """The imported ``names`` that a module of ``layer`` may not import."""
    third_party = THIRD_PARTY.get(layer, ARRAYS | SB3)
    for name in names:
        root, *rest = name.split(".")
        if root == "sb3_crpn":
            inner = rest[0] if rest and rest[0] in LAYERS else "__init__"
            if inner != layer and inner not in LAYERS[layer]:
                yield name
        elif root not in sys.stdlib_module_names and root not in third_party:
            yield name


def test_importing_the_package_leaves_slow_modules_out():
    """Modules that take a second to import and that few calls need."""
    code = "import sys; from sb3_crpn import CRPN; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "sb3_crpn.crpn" in loaded.stdout.split()
    assert {"scipy.signal", "scipy.stats", "rl_zoo3"}.isdisjoint(loaded.stdout.split())


def package_of(path):
    return ".".join(path.relative_to(PACKAGE.parent).parent.parts)


def test_every_module_has_its_layer():
    assert {layer_of(path) for path in FILES} <= set(LAYERS)
    names = list(LAYERS)
    for layer, below in LAYERS.items():
        assert below <= set(names[: names.index(layer)])


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    names = imports(path.read_text(), package_of(path))
    assert list(violations(layer_of(path), names)) == []


@pytest.mark.parametrize(
    ("layer", "source"),
    [
        ("checks", "import numpy as np"),
        ("arrays", "from sb3_crpn.checks import COUNT"),
        ("cubic", "import stable_baselines3"),
        ("cubic", "from sb3_crpn.episodes import EpisodeBatch"),
        ("parameters", "import numpy as np"),
        ("distributed", "from sb3_crpn.parameters import ActorParameters"),
        ("episodes", "from sb3_crpn.curvature import Causal"),
        ("curvature", "from sb3_crpn import CRPN"),
        ("curvature", "from sb3_crpn import algorithm"),
        ("curvature", "from ..algorithm import PolicyNewtonAlgorithm"),
        ("curvature", "from .. import algorithm"),
        ("algorithm", "def f():\n    import sb3_crpn.crpn"),
        ("crpn", "from sb3_crpn.acrpn import ACRPN"),
        ("algorithm", "import rl_zoo3"),
        ("theory", "import torch"),
    ],
)
def test_forbidden_imports_are_noticed(layer, source):
    assert list(violations(layer, imports(source, f"sb3_crpn.{layer}")))


def body_length(function):
    """Lines of a function below its signature and docstring."""
    has_docstring = ast.get_docstring(function) is not None
    statements = function.body[has_docstring:]
    return function.end_lineno - statements[0].lineno + 1 if statements else 0


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_functions_are_short(path):
    functions = [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    ]
    lengths = [
        (function.name, function.lineno, body_length(function))
        for function in functions
        if function.name not in ("__init__", "__post_init__")
    ]
    assert [entry for entry in lengths if entry[-1] > MAX_FUNCTION_LINES] == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_files_are_short(path):
    assert len(path.read_text().splitlines()) <= 300


MIRRORED = [
    path for path in FILES if layer_of(path) in TESTED_BY_MODULE and path.stem != "__init__"
]


@pytest.mark.parametrize("path", MIRRORED, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_every_module_has_its_test_file(path):
    folder = Path(__file__).parent / path.relative_to(PACKAGE).parent
    assert (folder / f"test_{path.stem.strip('_')}.py").is_file()
