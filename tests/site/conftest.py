"""The built site for the tests of this folder, and a parser of its pages."""

from __future__ import annotations

import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


class Page(HTMLParser):
    """A built page: its anchors, links, loaded files, and the text of its tables by the heading above them."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.anchors: set[str] = set()
        self.duplicates: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.rows: dict[str, list[list[str]]] = {}
        """Cells of the rows below each heading, by the heading's attribute `data-model` or its anchor."""
        self.heading = ""
        self._cell: list[str] | None = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect an element's anchor, links and cells."""
        values = {name: value or "" for name, value in attrs}
        if anchor := values.get("id"):
            self.duplicates |= {anchor} & self.anchors
            self.anchors.add(anchor)
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in ("link", "script", "img", "iframe", "source") and (
            address := values.get("href") or values.get("src")
        ):
            self.loaded.append(address)
        if tag in ("h1", "h2", "h3", "h4"):
            self.heading = values.get("data-model") or values.get("id", "")
        elif tag == "tr":
            self.rows.setdefault(self.heading, []).append([])
        elif tag == "td":
            self._cell = []

    def handle_endtag(self, tag: str) -> None:
        """Add the text of a finished cell to its row."""
        if tag == "td" and self._cell is not None:
            self.rows[self.heading][-1].append("".join(self._cell).strip())
            self._cell = None

    def handle_data(self, data: str) -> None:
        """Collect the text of a cell."""
        if self._cell is not None:
            self._cell.append(data)

    def first_cells(self, heading: str) -> set[str]:
        """Return the first cell of each row below a heading."""
        return {row[0] for row in self.rows.get(heading, ()) if row}


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Page]:
    """Build the site strictly, without a warning; return its pages by path, without ".html"."""
    pytest.importorskip("material", reason="mkdocs-material is not installed (extra `test`)")
    folder = tmp_path_factory.mktemp("site")
    build = subprocess.run(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "--config-file",
            "docs/site/mkdocs.yml",
            "--site-dir",
            folder,
        ],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert build.returncode == 0, build.stderr
    assert "WARNING" not in build.stderr
    return {str(path.relative_to(folder).with_suffix("")): Page(path) for path in folder.rglob("*.html")}
