"""The example configurations, which ship in the package: deploy/*.toml of the repository, as rtloop/examples/."""

from __future__ import annotations

import re
from importlib.resources import files

PAPER_FILES = ("paper.toml", "paper-spec.toml", "campaign.toml", "robust.toml", "robust-spec.toml")
"""The paper's loop, its specification and campaign, and the loop of one's own design with which they are compared."""
_REPOSITORY_PATH = re.compile(rf"\bdeploy/({'|'.join(map(re.escape, PAPER_FILES))})")


def read_example(name: str) -> str:
    """Return the text of an example by its file name, such as board.toml. Raises FileNotFoundError for another name."""
    return files("rtloop").joinpath("examples", name).read_text(encoding="utf-8")


def paper_files() -> dict[str, str]:
    """Return the texts of PAPER_FILES by name; comments name these files without the repository's folder deploy/."""
    return {name: _REPOSITORY_PATH.sub(r"\1", read_example(name)) for name in PAPER_FILES}
