"""The panel of `rtloop run --panel` ends with the loop and never delays it; `rtloop panel` ends when it is stopped."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtloop.cli import main
from tests.faults.account import account
from tests.faults.bench import Bench
from tests.faults.configuration import ROOT
from tests.faults.evidence import wait_for
from tests.paper_configuration import RATE, TEXT

pytestmark = pytest.mark.system

ADDRESS = re.compile(r"http://(127\.[\d.]+:\d+)/#token=\S+")


def rig_configuration(folder: Path) -> str:
    """Return the paper's configuration at 2 kHz, with recordings in `folder`; it needs no board."""
    return TEXT.replace('folder = "recordings"', f'folder = "{folder}/recordings"').replace(RATE, "rate_hz = 2000\n")


def is_listening(address: str) -> bool:
    """Return whether a process listens on this address, such as 127.0.0.1:80."""
    host, port = address.split(":")
    kernels = bytes(reversed([int(part) for part in host.split(".")])).hex()
    return f"{kernels}:{int(port):04x} 00000000:0000 0a" in Path("/proc/net/tcp").read_text().lower()


def test_a_panel_that_hangs_ends_with_the_run(tmp_path: Path):
    bench = Bench(tmp_path, board=False, text=rig_configuration(tmp_path))
    try:
        run = bench.rtloop("run", bench.config, "--panel", "--panel-port", "0")
        address = wait_for(lambda: ADDRESS.search(bench.log()), "a panel", 120)
        wait_for(lambda: bench.status().get("ticks"), "ticks", 120)
        assert is_listening(address[1])
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        panel = next(pid for pid in children if b"panel" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"))
        os.kill(int(panel), signal.SIGSTOP)
        run.send_signal(signal.SIGINT)
        assert run.wait(60) == 0
        wait_for(lambda: not Path(f"/proc/{panel}").exists(), "the end of the panel")
        assert not is_listening(address[1])
    finally:
        bench.__exit__()
    report = account(tmp_path / "recordings", [])
    assert (report.problems, report.lost) == ([], 0)


def test_a_run_with_a_duration_ends_with_its_panel(tmp_path: Path):
    bench = Bench(tmp_path, board=False, text=rig_configuration(tmp_path))
    try:
        run = bench.rtloop("run", bench.config, "--panel", "--panel-port", "0", "--duration", "1.5")
        assert run.wait(120) == 0
        address = ADDRESS.search(bench.log())
        assert address is None or not is_listening(address[1])
    finally:
        bench.__exit__()
    assert account(tmp_path / "recordings", []).executed >= 3000


def test_options_that_exclude_a_panel_are_refused(tmp_path: Path):
    (tmp_path / "a.toml").write_text("")
    for option in (["--unpaced"], ["--json"], ["--out", "x"]):
        result = CliRunner().invoke(main, ["run", str(tmp_path / "a.toml"), "--panel", *option])
        assert result.exit_code == 2
        assert "--panel: not allowed" in result.output


@pytest.mark.parametrize("options", [(), ("--until-stdin-ends",)], ids=["by hand", "by its service"])
def test_a_panel_beside_a_dead_service_says_so_to_who_starts_it(tmp_path: Path, options: tuple[str, ...]):
    """A panel that its service has started does not warn, for the service does not listen yet."""
    path = tmp_path / "lab.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    command = [sys.executable, "-m", "rtloop", "panel", str(path), "--port", "0", *options]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as panel:
        assert panel.stderr is not None
        output = ""
        while not ADDRESS.search(output):
            line = panel.stderr.readline()
            assert line, output
            output += line
        panel.terminate()
    assert ("the service has died" in output) == (not options)
    assert ("; the panel waits for the service" in output) == (not options)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_panel_that_is_stopped_before_it_serves_ends(tmp_path: Path, number: signal.Signals):
    """The signal comes after the address was printed and before the web server has installed its handlers."""
    program = f"""
import asyncio, os, sys
from pathlib import Path
from rtloop.panel.web import server

run = asyncio.run
asyncio.run = lambda work: (os.kill(os.getpid(), {int(number)}), run(work))
sys.exit(server.serve(Path("lab.sock"), 0, None, lambda _: None, False))
"""
    command = [sys.executable, "-c", program]
    assert subprocess.run(command, cwd=tmp_path, timeout=60, env=os.environ | {"PYTHONPATH": str(ROOT)}).returncode == 0
