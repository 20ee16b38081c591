"""Execution of a notebook of docs/notebooks, cell by cell, beside the configurations."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
Names = dict[str, Any]


def execute_notebook(name: str, folder: Path) -> Names:
    """Execute all cells of docs/notebooks/`name` in their order, and return the names that they define.

    The working directory becomes a new folder below `folder`, at the notebook's place beside `deploy`. Raises
    AssertionError for a notebook with stored outputs or with two cells of one id.
    """
    place = folder / "docs" / "notebooks"
    place.mkdir(parents=True)
    (folder / "deploy").symlink_to(ROOT / "deploy")
    os.chdir(place)
    cells = json.loads((ROOT / "docs/notebooks" / name).read_text("utf-8"))["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    names: Names = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            assert (cell["outputs"], cell["execution_count"]) == ([], None)
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    return names
