"""Hooks of mkdocs: generated pages of the reference, and pages and links outside `docs/`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from site_pages.command_page import command_page
from site_pages.configuration_pages import campaign_page, configuration_page, specification_page
from site_pages.example_pages import anchor, example_page
from site_pages.python_page import python_page
from site_pages.request_page import request_page
from site_pages.signal_page import signal_page

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    "reference/campaign.md": campaign_page,
    "reference/commands.md": command_page,
    "reference/configuration.md": configuration_page,
    "reference/examples.md": example_page,
    "reference/python.md": python_page,
    "reference/requests.md": request_page,
    "reference/signals.md": signal_page,
    "reference/specification.md": specification_page,
}
"""Page of the reference by its place in the site."""
COPIES = {
    "assets/icon.svg": "rtloop/panel/page/icon.svg",
    "assets/iframe-worker.js": "docs/site/assets/iframe-worker.js",
    "assets/site.css": "docs/site/assets/site.css",
    "changes.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "host-tuning.md": "deploy/host-tuning.md",
}
"""File of the tree by its place in the site."""
PLACES = {source: place for place, source in COPIES.items()}
LINKED = r"deploy/[\w/-]+\.toml|docs/[\w./-]+|" + "|".join(map(re.escape, PLACES))
"""Path in the tree, as a link on a page may have it."""


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add the generated pages and the copies to the site."""
    for place, build in PAGES.items():
        files.append(File.generated(config, place, content=build()))
    for place, source in COPIES.items():
        files.append(File.generated(config, place, content=(ROOT / source).read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return a page's text with its links out of `docs/` turned into links within the site."""
    place = page.file.src_uri
    up = "../" * place.count("/")
    to_tree = "" if place in COPIES else f"../{up}"  # A copy's links start at the top of the tree.

    def inside(match: re.Match[str]) -> str:
        path = match[1]
        if path.endswith(".toml"):
            return f"]({up}reference/examples.md#{anchor(ROOT / path)}"
        return f"]({up}{PLACES.get(path) or path.removeprefix('docs/')}"

    return re.sub(rf"\]\({re.escape(to_tree)}({LINKED})", inside, markdown)
