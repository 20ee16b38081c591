"""The paper's configuration with changed texts, and the processor for the measured process."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "deploy" / "paper.toml"
TEXT = PAPER.read_text(encoding="utf-8")
STEPS = TEXT[TEXT.index('kind = "steps"') : TEXT.index("# [[schedule]]")]
SINE = 'kind = "sine"\namplitude = 5.0\nfrequency_hz = 1.0\n\n'
"""A reference with which no limit and no interlock acts, at any rate."""
RATE = "[loop]\nrate_hz = 10000\n"
RIG = TEXT[TEXT.index("[driver]") : TEXT.index("[[axis]]")]


def changed(*changes: tuple[str, str]) -> str:
    """Return the paper's configuration with each (old, new) replaced. Raises ValueError if old is not unique."""
    text = TEXT
    for old, new in changes:
        if text.count(old) != 1:
            raise ValueError(f"{PAPER}: {old!r} occurs {text.count(old)} times; allowed: once")
        text = text.replace(old, new)
    return text


def at_rate(rate_hz: float) -> tuple[str, str]:
    """Return the change that sets the rate of the loop."""
    return RATE, f"[loop]\nrate_hz = {rate_hz}\n"


def pinned(cpu: int, spin_us: float = 0.0) -> list[tuple[str, str]]:
    """Return the changes that set the loop's processor and its time of spinning."""
    return [("# cpu = 1", f"cpu = {cpu}"), ("# spin_us = 0", f"spin_us = {spin_us}")]


def last_cpu() -> int:
    """Return the processor of the measured process; other processes use the other processors."""
    return max(os.sched_getaffinity(0))


def write(folder: Path, text: str) -> Path:
    """Write a configuration to a file; return its path."""
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path
