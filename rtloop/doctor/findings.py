"""The result of checking one condition of a host."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Finding:
    """A condition: present value, wanted value, consequence of a bad value, and the command that corrects it.

    `good` is None where the host does not show the condition. `late_us` is the order of magnitude by which a tick may
    wake late while the value is bad. `writes` maps files to texts that mend the condition on the running host.
    """

    condition: str
    value: str
    wanted: str
    good: bool | None
    late_us: float = 0.0
    consequence: str = ""
    fix: str = ""
    writes: Mapping[str, str] = field(default_factory=dict)
