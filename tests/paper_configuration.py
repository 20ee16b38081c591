"""The paper's configuration, changed line by line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.errors import ConfigError

PAPER = Path(__file__).resolve().parents[1] / "deploy" / "paper.toml"
TEXT = PAPER.read_text(encoding="utf-8")
RATE = "rate_hz = 10000\n"
CONTROLLER = TEXT[TEXT.index("[axis.controller]") : TEXT.index("# Eq (5)")]
REFERENCE = TEXT[TEXT.index('kind = "steps"') : TEXT.index("# [[schedule]]")]
UNSTABLE = ("gain = 0.016", "gain = 0.16")


def built(*changes: tuple[str, str], more: str = "", **options) -> Prepared:
    """The paper's configuration with some text replaced and some added."""
    text = TEXT
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return prepare(parse(text + more, "paper", PAPER.parent, "paper.toml"), **options)


def faults(*changes: tuple[str, str], more: str = "", **options) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        built(*changes, more=more, **options)
    assert caught.value.exit_code == 78
    return caught.value.faults


def entry(lines: str) -> str:
    return f"[[schedule]]\n{lines}\n"
