"""The paper's configuration, changed line by line, and what a run needs beside it."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAPER = ROOT / "deploy" / "paper.toml"
TEXT = PAPER.read_text(encoding="utf-8")
STEPS = TEXT[TEXT.index('kind = "steps"') : TEXT.index("# [[schedule]]")]
SINE = 'kind = "sine"\namplitude = 5.0\nfrequency_hz = 1.0\n\n'
"""A reference that brings no limit and no interlock into play, at any rate."""
RATE = "[loop]\nrate_hz = 10000\n"
RIG = TEXT[TEXT.index("[driver]") : TEXT.index("[[axis]]")]


def changed(*changes: tuple[str, str]) -> str:
    """The paper's configuration with some text replaced."""
    text = TEXT
    for old, new in changes:
        if text.count(old) != 1:
            raise ValueError(f"{PAPER}: {old!r} is there {text.count(old)} times; once is needed")
        text = text.replace(old, new)
    return text


def at_rate(rate_hz: float) -> tuple[str, str]:
    """Change: the loop's rate."""
    return RATE, f"[loop]\nrate_hz = {rate_hz}\n"


def pinned(cpu: int, spin_us: float = 0.0) -> list[tuple[str, str]]:
    """Changes: a processor, and spinning."""
    return [("# cpu = 1", f"cpu = {cpu}"), ("# spin_us = 0", f"spin_us = {spin_us}")]


def last_cpu() -> int:
    """The processor for what is measured; the others are for everything else."""
    return max(os.sched_getaffinity(0))


def write(folder: Path, text: str) -> Path:
    """A configuration as a file."""
    path = folder / "bench.toml"
    path.write_text(text, encoding="utf-8")
    return path
