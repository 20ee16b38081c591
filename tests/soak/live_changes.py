"""A law under continuous random changes of every parameter that may change while the loop runs.

Two axes in virtual time, as fast as the loop runs, changed by the code that a service uses. No write may fall outside
a record (canaries surround each record, and every index is checked), no drive may exceed its limits or its slew, and
the recording must replay identical.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

import rtloop
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import Kind
from rtloop.recording.capture.requester_names import RequesterNames
from rtloop.recording.replay.replay import replay
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Desk
from rtloop.signals import Mode
from rtloop.supervision.child import Child
from rtloop.supervision.supervisor import Processes, Supervisor
from tests.laws.changing import MODEL, Changes
from tests.recording.real_loop import ROOT

DRIVE_V, SLEW_V_PER_S, TRIP_SLEW_V_PER_S, RATE_HZ = 9.0, 3000.0, 700.0, 10_000.0
ROTATE_MIB, BLOCK_TICKS, SPARE_SAMPLES = 256.0, 1_000_000, 1 << 14
TEXT = (ROOT / "deploy" / "two-axis.toml").read_text(encoding="utf-8")
LIMITS = ("drive_v = 10.0\n", f"drive_v = {DRIVE_V}\nslew_v_per_s = {SLEW_V_PER_S}\n")
TRIP = ("trip_slew_v_per_s = 1000.0", f"trip_slew_v_per_s = {TRIP_SLEW_V_PER_S}")


class GuardedProcesses(Processes):
    """Processes of a run, with canaries around the loop's records."""

    def __init__(self) -> None:
        self.fd = SharedBlock.reserve()
        self.loop = Child("tests.soak.guarded_process", self.fd)
        self.names = RequesterNames.create()
        self.recorder = Child("rtloop.recording.capture.recorder", self.fd, names=self.names.fd)


class EveryChange(Changes):
    """Random changes, on either axis, of every parameter that may change while the loop runs."""

    def kinds(self) -> Sequence[Callable[[], object]]:
        """Return a method for each kind of change."""
        kinds = self._prefilter, self._controller, self._limits, self._interlocks, self._mode, self._reference
        return (*kinds, self._waveform, self._tare, self._reset)

    @property
    def _axis(self) -> str:
        """Name of a random axis."""
        return self._chance.choice("xy")

    def _prefilter(self) -> None:
        """Set random taps, command taps and sections."""
        count, sections = self._chance.choice((0, 1, 2, 7, 48, 127, 128)), self._chance.choice((0, 0, 1, 3, 12))
        taps = [self._chance.uniform(0, 1) for _ in range(count)]
        poles = [self._chance.uniform(0.05, 0.9) for _ in range(sections)]
        command_taps = [self._chance.uniform(-0.2, 0.2) for _ in range(self._chance.choice((0, 0, 1, 31, 128)))]
        values = {
            "taps": [tap / sum(taps) for tap in taps],
            "command_taps": command_taps,
            "sections": [[(1 - p) ** 2, 0.0, 0.0, -2 * p, p * p] for p in poles],
        }
        self._live.tune(self._axis, "prefilter", values)

    def _controller(self) -> None:
        """Load an integrator with up to 23 more poles and zeros, all above the crossover: always a stable loop."""
        order = self._chance.randrange(0, 24)
        poles = [-self._chance.uniform(3e3, 2e4) for _ in range(order)]
        zeros = [pole * self._chance.uniform(0.9, 1.1) for pole in poles]
        controller = {
            "form": "zpk",
            "gain": self._chance.uniform(20.0, 80.0),
            "zeros": [[zero, 0.0] for zero in zeros],
            "poles": [[-0.5, 0.0], *([pole, 0.0] for pole in poles)],
            "method": self._chance.choice(("tustin", "matched", "zoh")),
        }
        self._live.load_controller(self._axis, controller)

    def _limits(self) -> None:
        """Set a random command limit and bump time."""
        values = {"command_um": self._chance.uniform(10.0, 42.0), "bump_s": self._chance.uniform(0.001, 0.1)}
        self._live.tune(self._axis, "limits", values)

    def _interlocks(self) -> None:
        """Set random thresholds of the interlocks."""
        values = {
            "position_um": self._chance.choice((20.0, 60.0, 60.0, 60.0)),
            "oscillation_swings": self._chance.choice((0, 8)),
            "tracking_ticks": self._chance.choice((0, 500)),
            "frozen_ticks": self._chance.choice((0, 1000)),
        }
        self._live.tune(self._axis, "interlocks", values)

    def _mode(self) -> None:
        """Set a random mode."""
        self._desk.submit(Kind.SET_MODE, values=[float(self._chance.choice(list(Mode)))])

    def _reference(self) -> None:
        """Set a random sine, triangle or sequence of steps."""
        amplitude_um, offset_um = self._chance.uniform(0.0, 9.0), self._chance.uniform(-9.0, 9.0)
        reference: dict[str, Any] = {"kind": self._chance.choice(("sine", "triangle")), "frequency_hz": 40.0}
        reference |= {"amplitude": amplitude_um, "offset": offset_um}
        if self._chance.random() < 0.4:
            levels = [self._chance.uniform(-9.0, 9.0) for _ in range(self._chance.randrange(1, 50))]
            reference = {"kind": "steps", "levels": levels, "dwell_s": 0.01}
        self._live.references.set(self._axis, reference)

    def _waveform(self) -> None:
        """Set a waveform of constant samples, with one or two columns."""
        count = self._chance.choice((1, 2, 1000, SPARE_SAMPLES // 4))
        columns = [self._chance.uniform(-9.0, 9.0) for _ in range(self._chance.choice((1, 2)))]
        samples = np.tile(columns, (count, 1))
        self._live.references.set_waveform(
            self._axis, samples, self._chance.randrange(1, 5), self._chance.random() < 0.5
        )

    def _tare(self) -> None:
        """Set a random offset, of up to 0.05 V, of the reading of one axis."""
        self._live.tare(self._chance.randrange(2), self._chance.uniform(-0.05, 0.05))

    def _reset(self) -> None:
        """Reset the trip and close the loop."""
        self._desk.submit(Kind.RESET_TRIP)
        self._desk.submit(Kind.SET_MODE, values=[float(Mode.CLOSED_LOOP)])


def record(folder: Path, ticks: int, seed: int) -> tuple[list[Path], EveryChange, dict[str, Any]]:
    """Run `ticks` ticks under changes. Return the recording's files, the changes and the report on the canaries."""
    text = TEXT.replace(*LIMITS).replace(*TRIP)
    # Without a model no margins are computed, and a change takes milliseconds.
    text = MODEL.sub("", text[: text.index("[recording]")])
    text += f'[recording]\nfolder = "{folder}"\nrotate_mib = {ROTATE_MIB}\nmin_free_mib = 0.0\n'
    with GuardedProcesses() as processes:
        prepared = prepare(parse(text, "changes", folder, "changes"), duration_s=ticks / RATE_HZ, paced=False)
        prepared = replace(prepared, plan=replace(prepared.plan, spare_samples=SPARE_SAMPLES))
        supervisor = Supervisor(processes, prepared, folder / "changes.mcap")
        desk = Desk(supervisor.block)
        changes = EveryChange(LiveLaw(prepared, supervisor.block, desk, {}), desk, Random(seed))
        ended = threading.Event()

        def change() -> None:
            """Make changes to the end of the run."""
            while not ended.is_set() and not supervisor.ended:
                if supervisor.ticks:
                    changes.one()

        changer = threading.Thread(target=change)
        changer.start()
        try:
            result = supervisor.run()
        finally:
            ended.set()
            changer.join()
        assert result.outcome == "done", result
        return result.recordings, changes, supervisor._reports["canaries"]


def largest_drives(paths: list[Path]) -> dict[str, float]:
    """Return the largest recorded |drive| (drive_v) and its largest change in a tick (step_v), in V, over both axes."""
    largest = {"drive_v": 0.0, "step_v": 0.0}
    recording = rtloop.load(paths)
    for axis in "xy":
        drive_v = recording[f"{axis}_drive_v"]
        largest["drive_v"] = max(largest["drive_v"], float(np.abs(drive_v).max()))
        largest["step_v"] = max(largest["step_v"], float(np.abs(np.diff(drive_v, prepend=0.0)).max()))
    return largest


def main() -> None:
    """Run, replay and print in parts of ten million ticks. Raises AssertionError for a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int, default=100_000_000)
    parser.add_argument("--seed", type=int, default=14)
    options = parser.parse_args()
    ticks = changed = refused = 0
    for number in range(-(-options.ticks // BLOCK_TICKS // 10)):
        with tempfile.TemporaryDirectory(prefix="rtloop-changes-") as name:
            paths, changes, canaries = record(Path(name), 10 * BLOCK_TICKS, options.seed + number)
            largest, verdict = largest_drives(paths), replay(rtloop.load(paths))
        ticks, changed, refused = ticks + verdict.ticks, changed + changes.done.total(), refused + changes.refused
        print(
            f"seed {options.seed + number}: {verdict.ticks} ticks, {changes.done.total()} changes "
            f"{dict(changes.done)}, {changes.refused} refused; "
            f"{canaries['broken']} bytes overwritten around {canaries['records']} records; "
            f"largest |drive| {largest['drive_v']:.6f} of {DRIVE_V} V, largest step {largest['step_v']:.6f} of "
            f"{SLEW_V_PER_S / RATE_HZ} V; replay {'identical' if verdict.identical else verdict.first_difference}",
            flush=True,
        )
        assert canaries["records"]
        assert canaries["broken"] == 0
        assert largest["drive_v"] <= DRIVE_V
        assert largest["step_v"] <= SLEW_V_PER_S / RATE_HZ * (1 + 1e-9)
        assert verdict.identical
        assert not verdict.problems
    print(f"{ticks} ticks, {changed} changes, {refused} refused: no write outside a record, all replay identical")


if __name__ == "__main__":
    main()
