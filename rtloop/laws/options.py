"""What every law may be told by a configuration; a law's own model derives from one of these."""

from __future__ import annotations

from rtloop.hil.options import Options


class LawOptions(Options):
    """Base of what a configuration says of a law."""

    kind: str
    """Name of the law."""


class ControllerOptions(LawOptions):
    """Base of what it says of a controller."""

    allow_unstable: bool = False
    """Run although the loop is unstable on the axis's model."""
