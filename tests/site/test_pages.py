"""The code on the pages runs, in the order of the page, and prints the output that the page shows."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.site.page_code import ROOT, Block, blocks, commands, missing_line, run_page

PAGES = sorted(path for path in (ROOT / "docs").glob("**/*.md") if any(b.language == "console" for b in blocks(path)))
SHORTEST = "index.md"
"""The page that runs in `make test`; the others are soak tests."""


def _page_marks(page: Path) -> list[pytest.MarkDecorator]:
    """Return the mark `soak` for each page but SHORTEST, because the others take too long for `make test`."""
    return [] if page.name == SHORTEST else [pytest.mark.soak]


def test_every_tutorial_has_commands():
    assert {path for path in PAGES if path.parent.name == "tutorial"} == set((ROOT / "docs/tutorial").glob("*.md"))


@pytest.mark.parametrize("page", [pytest.param(page, id=page.name, marks=_page_marks(page)) for page in PAGES])
def test_the_code_on_a_page_runs(page: Path, tmp_path: Path):
    folder = tmp_path / "work"
    folder.mkdir()
    run_page(page, folder)


def test_a_command_that_fails_fails_its_page(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text("```console\n$ false\n```\n")
    folder = tmp_path / "work"
    folder.mkdir()
    with pytest.raises(AssertionError, match="ended with 1"):
        run_page(page, folder)


def test_a_page_is_executed_in_its_order(tmp_path: Path):
    page = tmp_path / "page.md"
    page.write_text(
        '```python title="greeting.py"\nprint("a", 1)\n```\n'
        "```console\n$ python3 greeting.py\na …\n$ touch \\\n      made\n```\n"
        "```python\nfrom os.path import exists\nassert exists('made')\n```\n"
        "```sh\nfalse\n```\n"
    )
    folder = tmp_path / "work"
    folder.mkdir()
    run_page(page, folder)


@pytest.mark.parametrize(
    ("expected", "output", "missing"),
    [
        (["a  1", "c …"], "a 1\nb 2\nc 3\n", None),
        (["c 3", "a 1"], "a 1\nb 2\nc 3\n", "a 1"),
        (["a 2"], "a 1\n", "a 2"),
        (["a"], "a 1\n", "a"),
        ([], "", None),
    ],
)
def test_expected_lines_follow_each_other_in_the_output(expected, output, missing):
    assert missing_line(expected, output) == missing


def test_commands_of_a_block_have_their_output():
    assert list(commands("$ one\nout\n$ two \\\n  more\n")) == [("one", ["out"]), ("two \\\n  more", [])]
    assert blocks(ROOT / "docs/index.md")[0] == Block("sh", "", blocks(ROOT / "docs/index.md")[0].text)
