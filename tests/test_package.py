"""The distributions: the source distribution has its tests, the wheel runs without the sources."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(command, folder, **environment):
    """Run ``command`` in ``folder`` and return what it prints."""
    done = subprocess.run(
        command, cwd=folder, env=os.environ | environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with the source distribution and the wheel."""
    folder = tmp_path_factory.mktemp("dist")
    run([sys.executable, "-m", "hatchling", "build", "-d", str(folder)], ROOT)
    return folder


def test_the_source_distribution_holds_what_its_tests_need(built, tmp_path):
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    # nothing is asserted while modules are imported, and to rewrite assertions takes long
    options = ["--collect-only", "-q", "--assert=plain", "-p", "no:cacheprovider"]
    output = run([sys.executable, "-m", "pytest", *options], source, PYTHONPATH=str(source))
    ours = {path.relative_to(ROOT) for path in (ROOT / "tests").rglob("test_*.py")}
    theirs = {path.relative_to(source) for path in (source / "tests").rglob("test_*.py")}
    assert ours == theirs
    assert "tests collected" in output
    assert {path.name for path in (ROOT / "docs").iterdir() if path.suffix in (".md", ".png")} <= {
        path.name for path in (source / "docs").iterdir()
    }


def test_the_wheel_trains_saves_and_loads(built, tmp_path):
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(tmp_path / "site")
        names = file.namelist()
    assert {name.partition("/")[0] for name in names if "dist-info" not in name} == {"sb3_crpn"}
    script = [sys.executable, str(ROOT / "tests" / "wheel.py")]
    output = run(script, tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert output.startswith(str(tmp_path / "site"))


def test_help_comes_without_pytorch():
    code = "import sys; from sb3_crpn.cli import parse; parse(['train']); print(*sys.modules)"
    assert "torch" not in run([sys.executable, "-c", code], ROOT).split()
    usage = run([sys.executable, "-X", "importtime", "-m", "sb3_crpn", "--help"], ROOT)
    assert "plot_from_file" in usage
