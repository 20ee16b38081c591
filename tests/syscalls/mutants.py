"""Planted mistakes that the tries have to find: each is planted in the traced process, not in the next process."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rtloop.drivers.base import Driver, Pointers
from rtloop.engine import ramp
from rtloop.recording.file.mcap.chunkfile import ChunkFile
from rtloop.recording.file.writer import Writer
from rtloop.supervision import parking as parking_module
from rtloop.supervision.hardware import _ADAPTER, Hardware
from rtloop.supervision.supervisor import Supervisor
from tests.syscalls import parking
from tests.syscalls.component import Component
from tests.syscalls.components import COMPONENTS, surroundings
from tests.syscalls.sampling import Try, plan
from tests.syscalls.traced import KILLED_AFTER, KILLED_BEFORE


def rename_before_the_end() -> None:
    """The recorder gives a file its name before the index is written."""
    finish = Writer.finish

    def rename_and_finish(writer: Writer, final: Any, **options: Any) -> None:
        os.rename(writer.part, writer.path)
        finish(writer, final, **options)

    Writer.finish, ChunkFile.publish = rename_and_finish, ChunkFile.close  # type: ignore[method-assign]


def remove_before_it_is_whole() -> None:
    """A repair removes the unfinished file before the recovered file is complete."""
    finish = Writer.finish

    def remove_and_finish(writer: Writer, final: Any, **options: Any) -> None:
        writer.path.with_name(f"{writer.path.name}.part").unlink()
        finish(writer, final, **options)

    Writer.finish = remove_and_finish  # type: ignore[method-assign]


def write_the_note_in_place() -> None:
    """The hardware note is written over the old note."""

    def write_in_place(path: Path, hardware: Hardware) -> None:
        path.write_bytes(_ADAPTER.dump_json(hardware))

    parking.write_note = write_in_place  # type: ignore[assignment]


def ignore_refused_writes() -> None:
    """Parking continues with the next value after a refused write."""

    def ramp_on(driver: Driver, pointers: Pointers, from_v: Any, slew_v_per_s: float, on_step: Any = None) -> None:
        write = ramp._WRITE(pointers.write)
        for row in ramp.ramp(from_v, ramp.safe_outputs_v(driver), slew_v_per_s / driver.rate_hz):
            write(pointers.context, np.ascontiguousarray(row).ctypes.data)
            on_step(row)

    parking_module.ramp_to_safe = ramp_on


def tidy_up_at_the_stop() -> None:
    """A service removes unfinished recordings when it is stopped, also those that the recorder has yet to finish."""
    stop = Supervisor.stop

    def remove_and_stop(supervisor: Supervisor) -> None:
        for part in Path(supervisor.prepared.configuration.recording.folder).glob("*.part"):
            part.unlink()
        stop(supervisor)

    Supervisor.stop = remove_and_stop  # type: ignore[method-assign]


class Mutant(NamedTuple):
    """A mistake in a component, and the kinds and calls of injections of which at least one must find the mistake."""

    plant: Callable[[], None]
    component: str
    kinds: tuple[str, ...]
    calls: tuple[str, ...]

    def tries(self, folder: Path) -> list[Try]:
        """Return the tries of the component with the mistake, at these calls and of these kinds."""
        sound = COMPONENTS[self.component]
        tries, _ = plan([sound._replace(case=_mutated_case(sound, self.plant))], folder)
        return [trial for trial in tries if trial[1].kind in self.kinds and trial[1].call.name in self.calls]

    def count_tries(self, folder: Path) -> int | None:
        """Return the number of tries until one finds the mistake; None if no try does."""
        for number, (component, injection) in enumerate(self.tries(folder), start=1):
            if component.measure(folder, injection).problems:
                return number
        return None


MUTANTS = (
    Mutant(rename_before_the_end, "recorder", (KILLED_AFTER,), ("rename",)),
    Mutant(remove_before_it_is_whole, "recover", (KILLED_AFTER,), ("unlink",)),
    Mutant(write_the_note_in_place, "note", (KILLED_AFTER, KILLED_BEFORE), ("openat", "write")),
    Mutant(ignore_refused_writes, "parking-card", ("EIO",), ("write",)),
    Mutant(tidy_up_at_the_stop, "service-stop", (KILLED_AFTER,), ("sendto",)),
)


def _mutated_case(sound: Component, plant: Callable[[], None]) -> Any:
    """Return the component's case with the mistake, which is planted in the child."""

    class MutatedCase(sound.case):  # type: ignore[misc, name-defined]
        def prepare_child(self) -> None:
            super().prepare_child()
            plant()

        def traced_work(self, logs: Path) -> None:
            if not self.is_all_traced:  # prepare_child is not called then
                plant()
            super().traced_work(logs)

    return MutatedCase


def run() -> int:
    """Plant each mistake and print the tries that found it; return 1 if a mistake is not found."""
    missed = 0
    for mutant in MUTANTS:
        with TemporaryDirectory(prefix="rtloop-syscalls-") as name, surroundings():
            number = mutant.count_tries(Path(name))
        print(f"{mutant.plant.__name__} ({mutant.component}): {f'found by try {number}' if number else 'NOT FOUND'}")
        missed += number is None
    if missed:
        print(f"{missed} planted mistakes are not found", file=sys.stderr)
    return int(missed > 0)
