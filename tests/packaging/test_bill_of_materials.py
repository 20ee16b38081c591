"""The list of packages that `make dist` writes (SBOM) names each installed package with its version."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

pytest.importorskip("cyclonedx_py", reason="cyclonedx-bom is missing: `make dist` installs it")


def _normal_name(name: str) -> str:
    """Return the name of a package as the index compares names."""
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.soak
def test_each_installed_package_is_listed_with_its_version(tmp_path: Path):
    out = tmp_path / "list.json"
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--output-file", str(out), sys.executable]
    completed = subprocess.run(command, capture_output=True, text=True)
    assert completed.returncode == 0, completed.stderr
    listed = {(_normal_name(part["name"]), part["version"]) for part in json.loads(out.read_bytes())["components"]}
    folders = [path for path in sys.path if "site-packages" in path]
    installed = {(_normal_name(package.name), package.version) for package in distributions(path=folders)}
    assert len(installed) > 20
    assert installed <= listed
