"""A mutant: one mistake at one place in a file."""

from __future__ import annotations

import hashlib
from typing import NamedTuple

from tests.mutants.rooms import ROOT


class Change(NamedTuple):
    """An operator of cosmic-ray, and the number (from 0) of the place in a module where it acts."""

    operator: str
    occurrence: int


class Mutant(NamedTuple):
    """A mistake in one file; `before` and `after` are the lines that it changes."""

    room: str
    file: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str

    @property
    def place(self) -> str:
        """FILE:LINE, a form that editors can open."""
        return f"{self.file}:{self.line}"

    @property
    def key(self) -> str:
        """Identifier of the mutant; it changes when the file's contents change."""
        digest = hashlib.sha256((ROOT / self.file).read_bytes()).hexdigest()[:12]
        return f"{self.file} {digest} {self.operator} {self.occurrence}"
