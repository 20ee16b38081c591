"""Wheel and source archive contain the whole package and no other files; each module of the wheel can be imported."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from email.message import Message
from email.parser import BytesParser
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

import rtloop
from tests.packaging.distribution import ROOT, build, can_build, copy_tree, unpack_sdist, wheel_files

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not can_build(), reason="setuptools is missing or too old to build rtloop"),
]

LINKED = ("drivers", "hil")
"""Folders of rtloop that are links to top-level folders."""
FORBIDDEN = re.compile(r"(^|/)(tests|__pycache__|\.[^/]*)/|\.(pyc|nbi|nbc|mcap|part)$|~$")
"""Names that no archive may contain: tests, caches, hidden folders, recordings, backups of editors."""
IMPORT_ALL = """
import importlib, sys
sys.path.insert(0, sys.argv[1])
failures = []
for name in sys.stdin.read().split():
    try:
        module = importlib.import_module(name)
        assert module.__file__.startswith(sys.argv[1]), module.__file__
    except ModuleNotFoundError as error:
        failures.append(f"{name} {error.name}")
import rtloop
failures += [f"rtloop.{name} rtloop" for name in rtloop.__all__ if name not in dir(rtloop) or not hasattr(rtloop, name)]
print(*failures, sep="\\n")
"""
"""Prints "MODULE MISSING_MODULE" for each failed import, and "rtloop.NAME rtloop" for a missing public name."""


class Archives(NamedTuple):
    """Wheel and source archive of one copy of the tree, and the wheel and the folder of the unpacked source archive."""

    sdist: Path
    wheel: Path
    sdist_wheel: Path
    sdist_tree: Path


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Archives:
    """Return the archives, built once for the tests of this file."""
    folder = tmp_path_factory.mktemp("dist")
    source = copy_tree(folder / "source")
    sdist = build("sdist", source, folder / "dist")
    tree = unpack_sdist(sdist, folder / "unpacked")
    return Archives(sdist, build("wheel", source, folder / "dist"), build("wheel", tree, folder / "second"), tree)


@pytest.fixture(scope="module")
def metadata(built: Archives) -> Message:
    """Return the METADATA of the wheel."""
    name = next(name for name in wheel_files(built.wheel) if name.endswith(".dist-info/METADATA"))
    return BytesParser().parsebytes(wheel_files(built.wheel)[name])


def test_the_wheel_holds_every_module_and_every_file_of_the_page(built: Archives):
    expected = {
        str(Path("rtloop") / file.relative_to(top))
        for top in [ROOT / "rtloop"]
        for folder in [top, *(top / room for room in LINKED)]
        for pattern in ("*.py", "panel/page/**/*", "*.html", "*.css", "*.dbc", "py.typed")
        for file in folder.rglob(pattern)
        if file.is_file()
    }
    assert any(name.startswith("rtloop/hil/") for name in expected)
    assert expected <= set(wheel_files(built.wheel))


@pytest.mark.parametrize("archive", ["wheel", "sdist"])
def test_no_archive_holds_tests_or_caches(built: Archives, archive: str):
    names = wheel_files(built.wheel) if archive == "wheel" else built.sdist_tree.rglob("*")
    relative = (str(name) if archive == "wheel" else str(Path(name).relative_to(built.sdist_tree)) for name in names)
    assert [name for name in relative if FORBIDDEN.search(f"{name}/" if name.endswith("tests") else name)] == []


def test_the_wheel_holds_rtloop_alone(built: Archives):
    tops = {name.split("/")[0] for name in wheel_files(built.wheel)}
    assert tops == {"rtloop", f"rtloop-{rtloop.__version__}.dist-info"}


def test_the_source_archive_builds_the_same_wheel(built: Archives):
    first, second = wheel_files(built.wheel), wheel_files(built.sdist_wheel)
    assert set(first) == set(second)
    assert [name for name in first if first[name] != second[name] and not name.endswith("/RECORD")] == []


def test_the_source_archive_can_install_a_service(built: Archives):
    needed = ("Makefile", "constraints.txt", "deploy/install", "deploy/paper.toml", "deploy/systemd/rtloop@.service")
    assert [name for name in needed if not (built.sdist_tree / name).is_file()] == []


def test_a_description_of_the_package_is_complete(metadata: Message):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert metadata["Version"] == rtloop.__version__
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["Author"]
    assert metadata["Keywords"]
    assert len(metadata.get_all("Classifier", [])) >= 10
    assert {line.split("=")[0] for line in project["scripts"]} == {"rtloop"}
    assert "Private" not in str(metadata)


def test_the_description_has_one_version_in_one_place():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)
    assert project["project"]["dynamic"] == ["version"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "rtloop.version.__version__"}
    assert "version" not in project["project"]
    assert not re.search(r"^version:", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)


def test_licences_of_bundled_programs_are_packed(built: Archives):
    """The folder of each minified script has its licence, which is among the licences of the wheel too."""
    files = wheel_files(built.wheel)
    licences = [text for name, text in files.items() if ".dist-info/licenses/" in name]
    bundled = {str(Path(name).parent) for name in files if ".min." in name}
    assert bundled
    assert [folder for folder in bundled if files.get(f"{folder}/LICENSE") not in licences] == []


@pytest.mark.soak
def test_each_module_and_each_public_name_of_the_wheel_can_be_imported(built: Archives, tmp_path: Path):
    """A module may need a package of an optional installation; all other packages must be there."""
    with zipfile.ZipFile(built.wheel) as archive:
        archive.extractall(tmp_path)
    modules = [
        name.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for name in wheel_files(built.wheel)
        if name.endswith(".py") and not name.endswith("__main__.py")
    ]
    assert len(modules) > 400
    completed = subprocess.run(
        [sys.executable, "-I", "-c", IMPORT_ALL, str(tmp_path)],
        input="\n".join(modules), capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert completed.returncode == 0, completed.stderr
    failures = [line.split() for line in completed.stdout.splitlines() if line]
    assert [line for line in failures if line[1].startswith("rtloop") or find_spec(line[1].split(".")[0])] == []


def test_the_index_accepts_the_description(built: Archives):
    pytest.importorskip("twine", reason="twine is missing: `make dist` installs it")
    command = [sys.executable, "-m", "twine", "check", "--strict", str(built.wheel), str(built.sdist)]
    completed = subprocess.run(command, capture_output=True, text=True)
    assert completed.returncode == 0, completed.stdout
