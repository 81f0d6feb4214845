"""The matrix: every supported Python, with the oldest and with the newest dependencies.

nox                                          # all cells, a selection of the tests
nox -s tests -p 3.11 -- tests/test_crpn.py   # one Python; pytest's arguments follow --
MATRIX_EXTRAS=extra,zoo,mujoco nox -- tests  # the whole suite, with more of the package's extras

Environments are made by uv, which finds or downloads the Pythons. On Linux, PyTorch's CUDA build
takes 5 GB an environment; ``UV_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu`` and
``UV_INDEX_STRATEGY=unsafe-best-match`` choose the CPU build.
"""

import os

import nox

PYTHONS = ["3.10", "3.11", "3.12", "3.13"]
# uv's names: every direct dependency at its lower bound, or the newest release
RESOLUTIONS = ["lowest-direct", "highest"]
# Training, saving, loading, vector environments and rl-zoo's training: a minute where the whole
# suite takes an hour
SELECTION = [
    "tests/test_acrpn.py",
    "tests/test_sb3_contract.py",
    "tests/test_zoo.py",
    "-k=stop_at or load or checkpoints or vec or tensorboard or progress_bar or source_tree",
]
EXTRAS = os.environ.get("MATRIX_EXTRAS", "extra,zoo")

nox.options.default_venv_backend = "uv"
nox.options.sessions = ["tests"]


@nox.session(python=PYTHONS)
@nox.parametrize("resolution", RESOLUTIONS)
def tests(session: nox.Session, resolution: str) -> None:
    """Install the package and run a selection of its tests."""
    pyproject = nox.project.load_toml("pyproject.toml")
    group = nox.project.dependency_groups(pyproject, "test")
    # editable: rl-zoo's scripts then read the tree's hyperparameters, as a test expects
    session.install("--resolution", resolution, "--editable", f".[{EXTRAS}]", *group)
    # deprecations depend on the versions, and are errors in the suite's own environment alone
    options = ["-o", "filterwarnings=default", *(session.posargs or SELECTION)]
    session.run("pytest", *options, env={"OMP_NUM_THREADS": "1"})
