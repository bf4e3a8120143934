"""The example notebooks: they run from the first cell to the last, and store no outputs."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(notebook: Path, tmp_path: Path) -> None:
    book = nbformat.read(notebook, as_version=4)  # type: ignore[no-untyped-call]
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    assert all(cell.outputs == [] and cell.execution_count is None for cell in cells), "clear the outputs"
    NotebookClient(book, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    assert not [output for cell in cells for output in cell.outputs if output.get("name") == "stderr"]
    for cell in cells:
        if "lab.animate(" in cell.source or "lab.plot(" in cell.source:
            shown = cell.outputs[-1].data
            assert "data:image/gif;base64," in shown.get("text/html", "") or "image/png" in shown


def test_the_first_swarm_takes_five_lines() -> None:
    book = nbformat.read(FOLDER / "first_swarm.ipynb", as_version=4)  # type: ignore[no-untyped-call]
    first = next(cell.source for cell in book.cells if cell.cell_type == "code")
    assert len([line for line in first.splitlines() if line]) == 5
    assert first.startswith("from fullswarm import Lab\n")
    assert first.endswith("lab.animate()")
