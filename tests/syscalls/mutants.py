"""Planted mistakes that a call has to find: each is made in the traced process alone, and the next hand is sound."""

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

    def named_first(writer: Writer, final: Any, **options: Any) -> None:
        os.rename(writer.part, writer.path)
        finish(writer, final, **options)

    Writer.finish, ChunkFile.publish = named_first, ChunkFile.close  # type: ignore[method-assign]


def remove_before_it_is_whole() -> None:
    """A repair removes the unfinished file before the recovered one has its end."""
    finish = Writer.finish

    def removed_first(writer: Writer, final: Any, **options: Any) -> None:
        writer.path.with_name(f"{writer.path.name}.part").unlink()
        finish(writer, final, **options)

    Writer.finish = removed_first  # type: ignore[method-assign]


def write_the_note_in_place() -> None:
    """The note of the hardware is written over the old one."""

    def in_place(path: Path, hardware: Hardware) -> None:
        path.write_bytes(_ADAPTER.dump_json(hardware))

    parking.write_note = in_place  # type: ignore[assignment]


def ignore_refused_writes() -> None:
    """Parking goes on with the next value where a write was refused."""

    def careless(driver: Driver, pointers: Pointers, from_v: Any, slew_v_per_s: float, on_step: Any = None) -> None:
        write = ramp._WRITE(pointers.write)
        for row in ramp.ramp(from_v, ramp.safe_outputs_v(driver), slew_v_per_s / driver.rate_hz):
            write(pointers.context, np.ascontiguousarray(row).ctypes.data)
            on_step(row)

    parking_module.ramp_to_safe = careless


def tidy_up_at_the_stop() -> None:
    """A service that is told to end removes unfinished recordings, as its recorder will finish its own."""
    stop = Supervisor.stop

    def tidy(supervisor: Supervisor) -> None:
        for part in Path(supervisor.prepared.configuration.recording.folder).glob("*.part"):
            part.unlink()
        stop(supervisor)

    Supervisor.stop = tidy  # type: ignore[method-assign]


class Mutant(NamedTuple):
    """A mistake in a component, the kinds and calls that may find it; any of them has to."""

    plant: Callable[[], None]
    component: str
    kinds: tuple[str, ...]
    calls: tuple[str, ...]

    def tries(self, folder: Path) -> list[Try]:
        """What is tried of the component with its mistake."""
        sound = COMPONENTS[self.component]
        tries, _ = plan([sound._replace(case=_with(sound, self.plant))], folder)
        return [one for one in tries if one[1].kind in self.kinds and one[1].call.name in self.calls]

    def found_after(self, folder: Path) -> int | None:
        """The number of tries after which a judge finds the mistake; None if no try does."""
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


def _with(sound: Component, plant: Callable[[], None]) -> Any:
    """The component's case with a mistake, planted in the child."""

    class Planted(sound.case):  # type: ignore[misc, name-defined]
        def prepare_child(self) -> None:
            super().prepare_child()
            plant()

        def traced_work(self, logs: Path) -> None:
            if not self.is_all_traced:  # then nobody prepares the child
                plant()
            super().traced_work(logs)

    return Planted


def run() -> int:
    """Plant each mistake; 1 where one is not found."""
    missed = 0
    for mutant in MUTANTS:
        with TemporaryDirectory(prefix="rtloop-syscalls-") as name, surroundings():
            number = mutant.found_after(Path(name))
        print(f"{mutant.plant.__name__} ({mutant.component}): {f'found by try {number}' if number else 'NOT FOUND'}")
        missed += number is None
    if missed:
        print(f"{missed} planted mistakes are not found", file=sys.stderr)
    return int(missed > 0)
