"""Settings of the running host, changed where the user asked for it; a restart forgets them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.doctor.findings import Finding


class SettingWrite(NamedTuple):
    """One setting: what was written where, and why it could not be (empty where it could)."""

    condition: str
    path: str
    text: str
    refused: str


def apply_remedies(findings: Sequence[Finding], root: Path = Path("/")) -> list[SettingWrite]:
    """Write the settings of every condition that is not good."""
    return [
        SettingWrite(finding.condition, path, text, _write_setting(root / path.lstrip("/"), text))
        for finding in findings
        if finding.good is False
        for path, text in finding.writes.items()
    ]


def _write_setting(path: Path, text: str) -> str:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        return error.strerror or str(error)
    return ""
