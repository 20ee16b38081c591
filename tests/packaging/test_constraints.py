"""The pinned versions can be installed with the oldest Python that the project allows."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).resolve().parents[2]


def test_every_installed_pin_accepts_the_oldest_python():
    """Pins of which another version or none is installed here, such as the tools of a release, are not tested."""
    requirement = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    oldest = re.fullmatch(r">=(\d+\.\d+)", requirement)[1] + ".0"
    pins = re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    refused, installed = {}, 0
    for name, version in pins:
        try:
            metadata = distribution(name).metadata
        except PackageNotFoundError:
            continue
        if metadata["Version"] != version:
            continue
        installed += 1
        accepted = metadata.get("Requires-Python", "")
        if not SpecifierSet(accepted).contains(oldest):
            refused[name] = accepted
    assert refused == {}
    assert installed > 50
