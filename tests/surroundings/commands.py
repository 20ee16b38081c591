"""Commands that the table of surroundings runs, one short invocation each, and the files that they read."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from rtloop.cli import main as command_line
from tests.test_help import groups

ROOT = Path(__file__).parents[2]
PROGRAM = Path(sys.executable).parent / "rtloop"
CAMPAIGN = """
configuration = "paper.toml"
rigs = 1
[uncertain]
"driver.plant.dynamics.gain_factor" = { uniform = [0.95, 1.05] }
[[experiment]]
kind = "steps"
levels_um = [5.0, 0.0]
[limits]
"steps.overshoot_percent" = 5.0
"""
NODE = {
    "udp": 'kind = "udp"\nhost = "127.0.0.1"\nport = 5{port}\n',
    "serial": 'kind = "serial"\ndevice = "{place}/node"\n',
    "can": 'kind = "can"\ninterface = "udp_multicast"\nchannel = "239.74.163.2"\nport = 4{port}\n',
}


@dataclass(frozen=True)
class Command:
    """A command line: `words` with {stock}, {place}, {port} and {socket}, and how to tell that a service is ready.

    `ready` is "" for a command that ends by itself, "notify" for one that tells systemd, and "port" for one that
    listens at {port}; a service is then ended by SIGINT. `shared` commands are clients of one service for all cells.
    """

    words: str
    ready: str = ""
    shared: bool = False


def _listed() -> list[Command]:
    plain = """
run {stock}/paper.toml --duration 0.05 --unpaced --out out
run {stock}/paper.toml --duration 0.05
run {stock}/damping.toml --duration 0.05 --unpaced
check {stock}/paper.toml
check {stock}/damping.toml
drivers
drivers --selftest {stock}/paper.toml --json
laws
law new mine
doctor {stock}/paper.toml --seconds 0.1 --png doctor.png
info {stock}/short.mcap
replay {stock}/short.mcap
cut {stock}/short.mcap --from 0.1 --out cut.mcap
recover {stock}/short.mcap --out recovered.mcap
export {stock}/short.mcap --to csv --out out.csv
export {stock}/short.mcap --to parquet --out out.parquet
export {stock}/short.mcap --to npz --out out.npz
export {stock}/short.mcap --to hdf5 --out out.hdf5
export {stock}/short.mcap --to mat --out out.mat
plot {stock}/short.mcap --out plot.png
plot {stock}/short.mcap --html --out plot.html
import {stock}/short.csv --out imported.mcap
park {stock}/paper.toml
experiment list
experiment run steps {stock}/paper.toml --out experiment
experiment all --help
experiment paper --help
experiment report {stock}/steps.mcap --out report
campaign run {stock}/small.toml --jobs 1 --out campaign --page campaign.html
campaign report {stock}/campaign --page page.html
campaign rerun {stock}/small.toml 1 --out rerun
campaign search {stock}/small.toml --rigs 1 --jobs 1 --out search
campaign boundary {stock}/small.toml driver.plant.dynamics.gain_factor --jobs 1 --tolerance 1.0
campaign compare {stock}/campaign {stock}/campaign --page compare.html
archive info {stock}/short.mcap --jobs 1 --out info.json
archive replay {stock}/short.mcap --jobs 1 --out replay.json
identify hysteresis {stock}/hysteresis.mcap --out hysteresis.toml --plot hysteresis.png
identify dynamics {stock}/step.mcap --order 2 --out dynamics.toml --plot dynamics.png
identify response {stock}/response.mcap --out response.json --plot response.png
identify resonance {stock}/response.mcap
design synthesise {stock}/paper-spec.toml --out controller.toml
design verify {stock}/paper.toml --out verified
design robust {stock}/paper-spec.toml
design shape {stock}/robust.toml --spec {stock}/robust-spec.toml --out shaped.toml --plot shaped.png
design compensation {stock}/paper.toml --actuator {stock}/hysteresis.toml --plot compensation.png
design auto {stock}/hysteresis.mcap {stock}/step.mcap --specs {stock}/paper-spec.toml --out auto.toml
init started
schema --out schema.json
""".strip().splitlines()
    clients = """
status
arm
lock
release
mode closed_loop
setpoint x 1
reference x amplitude=1.0
tune x controller gain=0.0159
preview x controller gain=0.0159
undo x
watch --count 1
waveform x {stock}/wave.txt
metrics
reload
reset
controller x {stock}/paper.toml
resonance x --amplitude-um 0.05 --duration 0.2 --period 0.1
response x --amplitude-um 0.05 --from-hz 200 --to-hz 1000 --duration 0.2 --period 0.1 --out r.json --plot r.png
retune x --yes
learn x {stock}/wave.txt --cycles 2
stop
start
""".strip().splitlines()
    services = [
        Command("serve {stock}/paper.toml --name cell", "notify"),
        Command("serve {stock}/paper.toml --name cell --panel --panel-port {port}", "port"),
        Command("hil serve {place}/board.toml", "notify"),
        *(Command(f"hil serve {{place}}/{kind}.toml --{kind}", "notify") for kind in NODE),
        Command("demo --port {port}", "port"),
        Command("panel {socket} --port {port}", "port"),
        Command("epics --socket {socket}", "port"),
    ]
    return [
        *map(Command, plain),
        *services,
        *(Command(f"ctl --socket {{socket}} {line}", shared=True) for line in clients),
    ]


COMMANDS = _listed()


LONG = (
    "campaign run", "campaign rerun", "campaign search", "campaign boundary", "campaign compare", "design verify",
    "design shape", "design auto", "identify", "experiment run", "drivers --selftest", "demo",
    "serve {stock}/paper.toml --name cell --panel", "ctl --socket {socket} re", "ctl --socket {socket} learn",
    "ctl --socket {socket} controller",
)  # fmt: skip
"""Beginnings of the commands that compute for seconds, which the option --short leaves out."""


def missing_commands() -> set[str]:
    """Return every command of `rtloop --help`, with subcommands, that COMMANDS lacks."""
    import click

    names = set()
    for path in groups(command_line):
        group: click.Command = command_line
        for name in path:
            assert isinstance(group, click.Group)
            group = group.commands[name]
        assert isinstance(group, click.Group)
        names |= {
            " ".join((*path, name)) for name, command in group.commands.items() if not hasattr(command, "commands")
        }
    words = [command.words.replace("--socket {socket} ", "") for command in COMMANDS]
    return {name for name in names if not any(f"{text} ".startswith(f"{name} ") for text in words)}


def make_stock(stock: Path, environment: dict[str, str]) -> None:
    """Write the files that COMMANDS read into the folder `stock`: configurations, recordings, a law, a campaign."""
    stock.mkdir()
    for file in (ROOT / "deploy").glob("*.toml"):
        shutil.copy(file, stock)
    (stock / "small.toml").write_text(CAMPAIGN)
    (stock / "wave.txt").write_text("0\n1\n2\n1\n0\n")

    def run(*words: str, codes: tuple[int, ...] = (0,)) -> None:
        done = subprocess.run([PROGRAM, *words], cwd=stock, env=environment, capture_output=True, text=True)
        assert done.returncode in codes, (words, done.stderr)

    def record(name: str, config: str, duration: str) -> None:
        run("run", config, "--duration", duration, "--unpaced", "--out", "made", "--json")
        (made,) = (stock / "made").glob("*.mcap")
        made.rename(stock / f"{name}.mcap")

    run("law", "new", "damping")
    record("short", "paper.toml", "0.3")
    record("step", "step-response.toml", "1")
    record("hysteresis", "characterise.toml", "20")
    run("export", "short.mcap", "--to", "csv")
    run("identify", "hysteresis", "hysteresis.mcap", "--out", "hysteresis.toml")
    run("experiment", "run", "steps", "paper.toml", "--out", "steps")
    run("experiment", "run", "response", "paper.toml", "--out", "response")
    for name in ("steps", "response"):
        next((stock / name).rglob("*.mcap")).rename(stock / f"{name}.mcap")
    run("campaign", "run", "small.toml", "--jobs", "1", "--out", "campaign", codes=(0, 1))


def write_node_configurations(place: Path, stock: Path, port: int) -> None:
    """Write the configurations of boards and nodes into a cell's folder, with addresses of this cell alone."""
    paper = (stock / "paper.toml").read_text()
    board = (stock / "board.toml").read_text().replace("/dev/shm/rtloop-board", str(place / "board"))
    (place / "board.toml").write_text(board)
    head, _, tail = paper.partition("[driver]")
    tail = tail[tail.index("[driver.channels.x]") :]
    channels = tail[: tail.index("\n\n")]
    axes = tail[tail.index("[[axis]]") :]
    for kind, text in NODE.items():
        section = text.format(port=port % 10_000 + 1000, place=place)
        (place / f"{kind}.toml").write_text(f"{head}[driver]\n{section}\n{channels}\n\n{axes}")


def clean_environment(home: Path) -> dict[str, str]:
    """Return the environment of the clean column: few variables, and the cache of this user."""
    from rtloop.foundation.native.cache import CACHE_FOLDER

    kept = {name: os.environ[name] for name in ("PATH", "TERM") if name in os.environ}
    return kept | {"HOME": str(home), "XDG_CACHE_HOME": str(CACHE_FOLDER.parents[1]), "LANG": "C.UTF-8"}
