"""Man pages and completion scripts: a page for each command, no warning of groff, and completion in bash."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from rtloop.cli import main, manual
from tests.test_help import groups

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the man pages and completion scripts; skip the tests without bash."""
    if shutil.which("bash") is None:
        pytest.skip("no bash")
    folder = tmp_path_factory.mktemp("share")
    manual.main(folder)
    return folder


def page(share: Path, name: str) -> str:
    """Return the text of a man page."""
    return (share / "man/man1" / f"{name}.1").read_text()


def test_every_command_has_a_page(share: Path) -> None:
    names = {path.name for path in (share / "man/man1").iterdir()}
    assert {"-".join(("rtloop", *path)) + ".1" for path in groups(main)} <= names
    assert {"rtloop-run.1", "rtloop-ctl-tune.1", "rtloop-hil-serve.1"} <= names
    assert "rtloop-demo" in page(share, "rtloop").replace("\\-", "-")


def test_a_page_has_every_option_and_no_hidden_one(share: Path) -> None:
    text = page(share, "rtloop-init").replace("\\-", "-")
    for option in ("--kind", "--resonance-hz", "--damping", "--range-um", "--sensor-noise-um", "--rate-hz"):
        assert f"\n\\fB{option}" in text
    assert "until" not in page(share, "rtloop-panel")


def test_groff_has_nothing_to_warn_of(share: Path) -> None:
    if shutil.which("groff") is None:
        pytest.skip("no groff")
    pages = sorted((share / "man/man1").iterdir())
    result = subprocess.run(
        ["groff", "-man", "-Kutf8", "-Tutf8", "-ww", "-z", *pages], capture_output=True, text=True, check=True
    )
    assert result.stderr == ""


def test_bash_completes_commands(share: Path, tmp_path: Path) -> None:
    program = tmp_path / "rtloop"
    program.write_text(f"#!{sys.executable}\nfrom rtloop.cli import main\nmain(prog_name='rtloop')\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    script = (
        f"source {share}/bash-completion/completions/rtloop; COMP_WORDS=({program} re); COMP_CWORD=1; "
        f"_rtloop_completion {program}; echo ${{COMPREPLY[@]}}"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    result = subprocess.run(["bash", "-c", script], capture_output=True, text=True, env=environment, check=True)
    assert result.stdout.split() == ["recover", "replay"]
