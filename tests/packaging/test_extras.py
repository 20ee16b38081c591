"""The table of docs/installation.md names every extra for users with its packages, as pyproject.toml does."""

from __future__ import annotations

import re
import tomllib

from rtloop.errors import MissingExtra
from tests.packaging.distribution import ROOT

DEVELOPERS = {"api-test", "bench", "browser", "mutants", "release", "test"}
KEPT_NAMES = {"can"}
"""Extras without packages, kept for old commands."""
EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
PAGE = (ROOT / "docs" / "installation.md").read_text()


def rows() -> dict[str, set[str]]:
    """Return the words of the column `packages` in the page's table, by extra."""
    table = {}
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) == 5 and cells[1].startswith("`"):
            table |= {extra: set(re.split(r"[\s,]+", cells[2])) for extra in re.findall(r"`([\w-]+)`", cells[1])}
    return table


def test_every_extra_of_a_user_has_a_row_with_its_packages() -> None:
    assert rows().keys() == EXTRAS.keys() - DEVELOPERS - KEPT_NAMES
    for extra, words in rows().items():
        assert {re.split("[>=<]", requirement)[0] for requirement in EXTRAS[extra]} <= words, extra


def test_every_extra_that_a_message_or_a_page_names_has_a_row() -> None:
    files = [path for top in ("rtloop", "drivers", "docs") for path in (ROOT / top).rglob("*.*")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files if path.suffix in (".py", ".md"))
    named = set(re.findall(r"rtloop\[(\w+)\]|the extra [`']([\w-]+)", text))
    assert {extra or quoted for extra, quoted in named} <= rows().keys() | KEPT_NAMES | DEVELOPERS


def test_the_command_for_a_wheel_is_told_once():
    message = str(MissingExtra("CSV needs pandas: pip install 'rtloop[data]'"))
    assert message == "CSV needs pandas: pip install 'rtloop[data]' (from a wheel: pip install 'FILE.whl[data]')"
    assert str(MissingExtra(message)) == message
    assert str(MissingExtra("no package is named")) == "no package is named"
