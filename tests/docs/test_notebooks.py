"""The notebooks run, and were committed with the output of a run.

``python -m tests.docs.test_notebooks`` runs them in place, with their own budgets.
"""

import nbformat
import pytest
from nbclient import NotebookClient

from tests.docs.pages import ROOT, name_of, shortened

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def run(notebook, folder):
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=600, startup_timeout=300, resources=resources).execute()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name_of)
@pytest.mark.filterwarnings("default")  # of Jupyter's own packages
def test_notebooks_run(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        cell.source = shortened(cell.source)
    run(notebook, tmp_path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=name_of)
def test_notebooks_show_their_output(path):
    cells = [c for c in nbformat.read(path, as_version=4).cells if c.cell_type == "code"]
    assert any(cell.outputs for cell in cells)
    outputs = [output for cell in cells for output in cell.outputs]
    assert "error" not in {output.output_type for output in outputs}


if __name__ == "__main__":
    import tempfile

    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            notebook = nbformat.read(path, as_version=4)
            run(notebook, folder)
        for cell in notebook.cells:
            cell.metadata = {}
        nbformat.write(notebook, path)
        print(path)
