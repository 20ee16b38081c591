"""Changes of settings of the running host, on the user's request; they last until the next restart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from rtloop.doctor.findings import Finding


class SettingWrite(NamedTuple):
    """A setting written for a condition: file, text, and the reason of a refusal (empty where it was written)."""

    condition: str
    path: str
    text: str
    refused: str


def apply_remedies(findings: Sequence[Finding], root: Path = Path("/")) -> list[SettingWrite]:
    """Write the settings in `writes` of each bad condition (`good` is False) to files below `root`.

    Returns each write with its outcome; [] for none.
    """
    return [
        SettingWrite(finding.condition, path, text, _write_setting(root / path.lstrip("/"), text))
        for finding in findings
        if finding.good is False
        for path, text in finding.writes.items()
    ]


def _write_setting(path: Path, text: str) -> str:
    """Write a setting to a file. Returns the reason of a refusal, "" where it was written."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        return error.strerror or str(error)
    return ""
