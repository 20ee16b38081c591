"""A mutant: one mistake at one place of one file."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

from tests.mutants.rooms import ROOT


class Change(NamedTuple):
    """One operator of cosmic-ray at its occurrence in a module, numbered as cosmic-ray numbers them."""

    operator: str
    occurrence: int


class Mutant(NamedTuple):
    """One mistake in one file; `before` and `after` are the lines that it changes."""

    room: str
    file: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str

    @property
    def place(self) -> str:
        """As an editor jumps to it."""
        return f"{self.file}:{self.line}"

    @property
    def key(self) -> str:
        """A name that lasts as long as the file is as it is."""
        digest = hashlib.sha256((ROOT / self.file).read_bytes()).hexdigest()[:12]
        return f"{self.file} {digest} {self.operator} {self.occurrence}"
