"""The notebooks run from an empty kernel, and are kept without what they put out."""

import asyncio
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.support.marks import stress
from tests.support.processes import PATIENCE

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
FILES = sorted(FOLDER.glob("*.ipynb"))
notebooks = pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
QUICK = ("first_render",)


@notebooks
def test_notebook_is_kept_without_outputs(file):
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None
    assert file.stem in (FOLDER / "README.md").read_text()


@pytest.mark.parametrize("stem", [*QUICK, *stress(*(file.stem for file in FILES if file.stem not in QUICK))])
def test_notebook_runs(stem, tmp_path):
    """Run in a copy of the folder, beside the scenes, so output files stay out of the repository."""
    (tmp_path / "scenes").symlink_to(FOLDER.parent / "scenes")
    (tmp_path / "notebooks").mkdir()
    notebook = nbformat.read(FOLDER / f"{stem}.ipynb", as_version=4)
    client = NotebookClient(
        notebook, timeout=PATIENCE, kernel_name="python3", resources={"metadata": {"path": tmp_path / "notebooks"}}
    )
    asyncio.run(client.async_execute())
    assert any(cell.get("outputs") for cell in notebook.cells)
