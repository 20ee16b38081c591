"""The host, read from /proc, /sys and /dev below a root folder, which tests replace."""

from __future__ import annotations

import gzip
import os
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Host:
    """Files of a host below `root`, its kernel, and the real-time rights that a process was granted there.

    `grants` is the report of `prepare_realtime`: scheduler, priority, mlock, pm_qos, timer_slack_ns, and refused.
    `release` and `version` name the kernel, `allowed_cpus` the processors of this process.
    """

    grants: dict[str, Any]
    root: Path = Path("/")
    release: str = field(default_factory=platform.release)
    version: str = field(default_factory=platform.version)
    allowed_cpus: tuple[int, ...] = field(default_factory=lambda: tuple(sorted(os.sched_getaffinity(0))))

    def read(self, path: str) -> str | None:
        """Return the stripped text of the file `path` below `root`; None if it is missing or unreadable."""
        try:
            return (self.root / path.lstrip("/")).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def paths(self, pattern: str) -> list[str]:
        """Return the files below `root` that match a glob pattern, sorted, as absolute paths of the host, without
        `root`.
        """
        return sorted(f"/{path.relative_to(self.root)}" for path in self.root.glob(pattern.lstrip("/")))

    def refusal_reason(self, name: str) -> str:
        """Return the kernel's reason for refusing the right `name`, such as "mlock"; "not requested" if `grants` has no
        refusal of this right.
        """
        reasons = (text.partition(": ")[2] for text in self.grants["refused"] if text.startswith(f"{name}: "))
        return next(reasons, "not requested")

    @property
    def kernel_options(self) -> str | None:
        """Text of the kernel's build configuration (CONFIG_… lines); None if the host does not show it."""
        try:
            return gzip.decompress((self.root / "proc/config.gz").read_bytes()).decode()
        except OSError:
            return self.read(f"/boot/config-{self.release}")

    @property
    def kernel_version(self) -> tuple[int, int]:
        """Major and minor version of the kernel, (6, 12) for 6.12.3-rt; (0, 0) for another form."""
        major, minor = f"{self.release.split('-')[0]}.0".split(".")[:2]
        return (int(major), int(minor)) if (major + minor).isdigit() else (0, 0)

    def stolen_s(self) -> float:
        """Return the processor time in s that a hypervisor took from this host since the host's start, summed over all
        processors; 0 if the host does not show it.
        """
        fields = (self.read("/proc/stat") or "").partition("\n")[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK") if len(fields) > 8 else 0.0


def parse_cpus(text: str) -> set[int]:
    """Return the processors in a kernel's list: "0-1,4" gives {0, 1, 4}; other text is ignored."""
    cpus: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if first.isdecimal() and (last or first).isdecimal():
            cpus.update(range(int(first), int(last or first) + 1))
    return cpus


def format_cpus(cpus: set[int]) -> str:
    """Return a set of processors as the kernel writes it: {0, 1, 4} gives "0-1,4"."""
    parts: list[str] = []
    for cpu in sorted(cpus):
        if cpu - 1 in cpus:
            parts[-1] = f"{parts[-1].partition('-')[0]}-{cpu}"
        else:
            parts.append(str(cpu))
    return ",".join(parts)
