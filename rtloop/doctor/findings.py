"""What was found of one condition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Finding:
    """A condition: what it is, what it should be, how late it can make a tick, and the command that mends it.

    `good` is None where the host does not show it. `late_us` is the order of magnitude by which a tick may wake late
    while the condition is not good. `writes` are the files, with their text, that mend it on the running host.
    """

    condition: str
    value: str
    wanted: str
    good: bool | None
    late_us: float
    consequence: str
    fix: str
    writes: Mapping[str, str] = field(default_factory=dict)
