"""One configuration on every backend, which differs in [driver] only: no tick is lost and every run replays.

`make soak NAME=backends`
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

import rtloop
from rtloop.recording.views.steps import step_metrics
from rtloop.workbench.tables import table
from tests.drivers.can_bench import GROUP, free_port
from tests.drivers.installing import install
from tests.drivers.node_bench import free_udp_port, make_key
from tests.stage_text import one_axis

ROOT = Path(__file__).resolve().parents[2]
DURATION_S = 8.0
WIDTH = 140
LONGEST_HOLD_US = 5_000_000
PATIENT = "hold_ticks = 1000\nerror_limit = 1000000\nwatchdog_ms = 1000\nwait_s = 60\n"
LAW = """
[loop]
rate_hz = {rate_hz}
{axis}
[axis.interlocks]
sample_age_us = 500000.0
[axis.reference]
kind = "steps"
levels = [10.0, -10.0]
dwell_s = 1.0
"""


class Backend(NamedTuple):
    """A driver under test: `section` is the text below [driver], `channels` are input and output, `board` holds the
    arguments of the `rtloop` command that runs beside the loop, and `rates_hz` are the rates of the loop.
    """

    name: str
    section: str
    channels: tuple[str, str] = ("adc0", "dac0")
    board: tuple[str, ...] | None = None
    rates_hz: tuple[int, ...] = (2_000, 10_000)
    program: tuple[str, ...] | None = None
    """Command of the node in C, whose inputs are its outputs, in place of a board."""


def backends(folder: Path) -> list[Backend]:
    """Return the backends that run on any machine, and the node in C where there is a compiler.

    A node on a busy machine answers late now and then: PATIENT lets the loop hold its last sample meanwhile. An
    exchange over a pseudo-terminal often takes longer than 100 µs, so that serial backends run at 2 kHz only.
    """
    key = make_key(folder)
    bus = f'interface = "udp_multicast"\nchannel = "{GROUP}"\nsettings = {{ port = {free_port()}, hop_limit = 0 }}\n'
    return [
        Backend("sim", 'kind = "sim"\n'),
        Backend("shm", f'kind = "shm"\nfile = "{folder}/board"\nboard_rate_hz = 20000\n', board=("hil", "serve")),
        Backend("can", f'kind = "can"\n{bus}hold_ticks = 800\nwatchdog_ms = 1000\nwait_s = 60\n',
                board=("hil", "serve", "--can"), rates_hz=(2_000,)),
        Backend("third party", 'kind = "bench_card"\n', channels=("in", "out")),
        Backend("udp", f'kind = "udp"\n{address(free_udp_port())}key = "{key}"\n{PATIENT}',
                board=("hil", "serve", "--udp"), rates_hz=(2_000,)),
        Backend("serial", f'kind = "serial"\ndevice = "{folder}/tty"\n{PATIENT}', board=("hil", "serve", "--serial"),
                rates_hz=(2_000,)),
        *c_nodes(folder, key),
    ]  # fmt: skip


def address(port: int) -> str:
    """Return the options of a node at a UDP port of this computer."""
    return f'host = "127.0.0.1"\nport = {port}\n'


def c_nodes(folder: Path, key: str) -> list[Backend]:
    """Compile the node in C below the folder; return it behind UDP, and behind a pseudo-terminal with a key's file.

    The list is empty without a compiler.
    """
    if not (shutil.which("cc") and shutil.which("make")):
        return []
    build = folder / "node"
    subprocess.run(["make", "-s", "-C", ROOT / "deploy/node", "all", f"BUILD={build}"], check=True)
    program = str(build / "rtloop-node"), "--loopback", "--hold", str(LONGEST_HOLD_US)
    port, line = free_udp_port(), f"{folder}/tty-c"
    channels = "digital_inputs = 4\ndigital_outputs = 4\n"
    return [
        Backend("udp, node in C", f'kind = "udp"\n{address(port)}{channels}{PATIENT}',
                program=(*program, "--port", str(port))),
        Backend("serial, node in C", f'kind = "serial"\ndevice = "{line}"\nkey = "{key}"\n{channels}{PATIENT}',
                program=(*program, "--pty", line, "--key", key), rates_hz=(2_000,)),
    ]  # fmt: skip


@contextmanager
def run_board(backend: Backend, config: Path, environment: dict[str, str]) -> Iterator[None]:
    """Run the backend's board or node in a separate process to the end of the context; do nothing without one."""
    if backend.board is None and backend.program is None:
        yield
        return
    command = backend.program or [sys.executable, "-m", "rtloop", *(backend.board or ()), str(config)]
    out, err = (subprocess.PIPE, None) if backend.program else (None, subprocess.PIPE)
    with subprocess.Popen(command, env=environment, text=True, stdout=out, stderr=err) as process:
        output = process.stdout or process.stderr
        assert output is not None
        output.readline()  # The first line is printed when the process is ready.
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)


def measure(backend: Backend, rate_hz: int, folder: Path, environment: dict[str, str]) -> dict[str, Any]:
    """Run the backend and replay the recording. Return the run's summary with `identical` and `steps` added."""
    source, sink = backend.channels
    wiring = f'[driver.channels.x]\ninput = "{source}"\noutput = "{sink}"\num_per_v = 10.0\n'
    config = folder / f"{backend.name.replace(' ', '-')}.toml"
    config.write_text(f"{LAW.format(rate_hz=rate_hz, axis=one_axis(60.0))}[driver]\n{backend.section}{wiring}")
    with run_board(backend, config, environment):
        summary = run_json(environment, "run", config, "--duration", DURATION_S, "--out", folder / "recordings")
    verdict = run_json(environment, "replay", summary["recording"])
    recording = rtloop.load(summary["recording"])
    steps = step_metrics(recording["x_reference_um"], recording["x_position_um"], rate_hz)
    assert steps is not None
    return summary | {"identical": verdict["identical"], "steps": steps}


def run_json(environment: dict[str, str], *arguments: object) -> dict[str, Any]:
    """Run an `rtloop` command and return its JSON. Raises AssertionError unless the exit code is 0."""
    command = [sys.executable, "-m", "rtloop", *map(str, arguments), "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.returncode}: {done.stderr}{done.stdout}"
    return json.loads(done.stdout)


def main() -> None:
    """Print a table of all runs; exit with 1 if a tick is lost or a replay differs."""
    results = table("driver", "Hz", "ticks", "lost", "missed", "replay", "late p50 µs", "p99", "max", "overshoot %",
                 "settling ms", "static error %")  # fmt: skip
    passed = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = os.pathsep.join([str(ROOT), str(install(folder))])
        environment = os.environ | {"PYTHONPATH": path}
        for backend in backends(folder):
            for rate_hz in backend.rates_hz:
                print(f"{backend.name} at {rate_hz} Hz", file=sys.stderr, flush=True)
                result = measure(backend, rate_hz, folder, environment)
                lateness_us, steps = result["lateness_us"], result["steps"]
                passed &= result["complete"] and result["ticks_lost"] == 0 and result["identical"]
                results.add_row(
                    backend.name, str(rate_hz), str(result["ticks_logged"]), str(result["ticks_lost"]),
                    str(result["periods_missed"]), "identical" if result["identical"] else "DIFFERS",
                    *(f"{lateness_us[key]:.1f}" for key in ("p50", "p99", "max")),
                    f"{steps.overshoot_percent:.2f}", f"{steps.settling_time_ms:.1f}",
                    f"{steps.static_error_percent:.3f}",
                )  # fmt: skip
    Console(highlight=False, width=WIDTH).print(results)
    sys.exit(0 if passed else 1)


if __name__ == "__main__":
    main()
