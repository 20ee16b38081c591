"""The host as /proc, /sys and /dev show it, below a root that may be another than /."""

from __future__ import annotations

import gzip
import os
import platform
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Host:
    """Files of the host, and what it granted a real-time process that asked (`rtloop.engine.realtime`)."""

    grants: dict[str, Any]
    root: Path = Path("/")
    release: str = field(default_factory=platform.release)
    version: str = field(default_factory=platform.version)
    allowed_cpus: tuple[int, ...] = field(default_factory=lambda: tuple(sorted(os.sched_getaffinity(0))))

    def read(self, path: str) -> str | None:
        """The stripped text of a file, None where there is none that can be read."""
        try:
            return (self.root / path.lstrip("/")).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def paths(self, pattern: str) -> list[str]:
        """Absolute paths, below the root, of the files that match."""
        return sorted(f"/{path.relative_to(self.root)}" for path in self.root.glob(pattern.lstrip("/")))

    def refusal_reason(self, name: str) -> str:
        """Why something was not granted, in the kernel's words."""
        reasons = (text.partition(": ")[2] for text in self.grants["refused"] if text.startswith(f"{name}: "))
        return next(reasons, "not asked for")

    @property
    def kernel_options(self) -> str | None:
        """The kernel's build configuration, where the host shows it."""
        try:
            return gzip.decompress((self.root / "proc/config.gz").read_bytes()).decode()
        except OSError:
            return self.read(f"/boot/config-{self.release}")

    @property
    def kernel_version(self) -> tuple[int, int]:
        """(6, 12) for 6.12.3-rt."""
        major, minor = f"{self.release.split('-')[0]}.0".split(".")[:2]
        return (int(major), int(minor)) if (major + minor).isdigit() else (0, 0)

    def stolen_s(self) -> float:
        """Seconds that a hypervisor has kept the processors from this host since it started."""
        fields = (self.read("/proc/stat") or "").partition("\n")[0].split()
        return int(fields[8]) / os.sysconf("SC_CLK_TCK") if len(fields) > 8 else 0.0


def parse_cpus(text: str) -> set[int]:
    """{0, 1, 4} of "0-1,4"."""
    cpus: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if first.isdigit():
            cpus.update(range(int(first), int(last or first) + 1))
    return cpus


def format_cpus(cpus: set[int]) -> str:
    """The reverse: "0-1,4" of {0, 1, 4}."""
    parts: list[str] = []
    for cpu in sorted(cpus):
        if cpu - 1 in cpus:
            parts[-1] = f"{parts[-1].partition('-')[0]}-{cpu}"
        else:
            parts.append(str(cpu))
    return ",".join(parts)
