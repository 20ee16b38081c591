"""All code cells of the documentation's notebook run, with fewer rigs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.campaigns.campaign_files import ROOT

pytestmark = pytest.mark.system

NOTEBOOK = ROOT / "docs/notebooks/campaign.ipynb"


def test_every_cell_of_the_notebook_runs(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib").use("agg")
    (tmp_path / "docs/notebooks").mkdir(parents=True)
    (tmp_path / "deploy").symlink_to(ROOT / "deploy")
    monkeypatch.chdir(tmp_path / "docs/notebooks")
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]).replace("rigs=100", "rigs=20"), "cell", "exec"), names)
    assert len(names["table"]) == 21
    assert names["summary"].yield_of_rigs.rigs == 20
    assert list(Path("campaign-notebook/worst").glob("*.mcap"))
