"""The drivers printed in docs/drivers.md keep the contract."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.drivers.installing import built_modules
from tests.drivers.processes import ROOT, completed

pytestmark = pytest.mark.system

FILE = re.compile(r"^    (?:# |/\* )(\w+\.(?:py|c))(?: \*/)?\n((?:    .*\n|\n)+)", re.MULTILINE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write the files printed on the page into a folder, and return the folder."""
    for name, text in FILE.findall((ROOT / "docs" / "drivers.md").read_text()):
        (tmp_path / name).write_text(textwrap.dedent(text))
    return tmp_path


def pytest_summary(folder: Path, test: str) -> str:
    """Run a test file of the folder with pytest and return the last line of the report."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-W",
        "error",
        "--rootdir",
        folder,
        "--basetemp",
        folder / "basetemp",
        folder / test,
    ]
    return completed(*command, folder=folder).stdout.strip().splitlines()[-1]


def test_in_plain_python(folder):
    assert pytest_summary(folder, "test_mycard.py").startswith("13 passed")


def test_as_native_functions(folder):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    command = re.search(r"`(cc .*mycard\.c)`", (ROOT / "docs" / "drivers.md").read_text())
    assert command
    subprocess.run(command[1].split(), cwd=folder, check=True)
    test = (folder / "test_mycard.py").read_text()
    test = test.replace(
        "from mycard import MyCard, MyCardOptions",
        "from mycard import MyCardOptions\nfrom mycard_native import NativeCard as MyCard",
    )
    test = test.replace("return list(vendor.volts)", 'return list(driver.card.at) if hasattr(driver, "card") else None')
    (folder / "test_native.py").write_text(test)
    assert pytest_summary(folder, "test_native.py").startswith("13 passed")


def test_a_broken_copy_fails(folder):
    """The page's driver with outputs wrong by 0.1 V fails the page's test."""
    text = (folder / "mycard.py").read_text()
    assert text.count("vendor.write(channel, value)") == 1
    (folder / "mycard.py").write_text(
        text.replace("vendor.write(channel, value)", "vendor.write(channel, value + 0.1)")
    )
    assert "failed" in pytest_summary(folder, "test_mycard.py")


def test_the_installed_package_has_all_its_modules(folder):
    """A package built by setuptools as the page says holds all modules that the driver imports."""
    page = (ROOT / "docs" / "drivers.md").read_text()
    (lines,) = re.findall(r'^    \[project\.entry-points\."rtloop\.drivers"\]\n(?:    .*\n|\n)+', page, re.MULTILINE)
    project = '[project]\nname = "mycard"\nversion = "1"\n'
    (folder / "pyproject.toml").write_text(f"{project}{textwrap.dedent(lines)}")
    assert built_modules(folder) == ["mycard.py", "vendor.py"]
    program = f"import sys; sys.path.insert(0, {str(folder / 'built')!r}); import mycard; mycard.MyCard"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=60)
