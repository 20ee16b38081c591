"""Components: `rtloop park` after a service that died with its output up, and the hardware note that it reads.

The evidence is the card's memory, which outlives all processes and holds every write.
"""

from __future__ import annotations

import os
import shutil
import struct
from functools import lru_cache
from pathlib import Path

import numpy as np

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Wiring
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import SharedBlock, Sizes
from rtloop.errors import RtloopError
from rtloop.hil import board
from rtloop.hil.board import LSB_V, BoardMemory
from rtloop.supervision import parking
from rtloop.supervision.hardware import Hardware, UnusableNote, read_note, write_note
from rtloop.supervision.paths import block_path, hardware_path
from tests.faults.configuration import BOARD_RATE_HZ, SLEW_V_PER_S, on_a_board
from tests.service.fake_board import set_first_outputs
from tests.syscalls import card
from tests.syscalls.component import Case
from tests.syscalls.traced import Outcome

NAME, DRIVE_CODE = "lab", 8192
DRIVE_V = DRIVE_CODE * LSB_V
STEP_V = SLEW_V_PER_S / BOARD_RATE_HZ
CARD_CHANGES = (
    ('kind = "shm"', f'kind = "{card.KIND}"'), ("board_rate_hz = 8000\n", ""), ('"adc0"', '"in"'), ('"dac0"', '"out"'),
    ("[driver.plant.sensor]\num_per_v = 10.0\nnoise_um = 0.010\nresolution_um = 0.010\n", ""),
)  # fmt: skip


@lru_cache
def _configuration(folder: Path, *changes: tuple[str, str]) -> tuple[str, Hardware, Sizes]:
    """Return the text of a configuration, its hardware, and the sizes of its shared block."""
    config = folder / f"{NAME}.toml"
    config.write_text(text := on_a_board(folder, *changes))
    plan = prepare(load(config)).plan
    options = '{"file":"' + str(folder / "board") + '"}'
    pacing = plan.pacing
    hardware = Hardware(plan.driver_kind, options, plan.wiring, pacing.rate_hz, plan.trip_slew_v_per_s,
                        pacing.heartbeat_timeout_s)  # fmt: skip
    return text, hardware, plan.sizes


class ParkingABoard(Case):
    """Parking of the board of `rtloop hil serve`, whose memory shows the present outputs."""

    changes: tuple[tuple[str, str], ...] = ()

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        os.environ["RUNTIME_DIRECTORY"] = str(folder)
        text, self.hardware, sizes = _configuration(folder, *self.changes)
        self.config, self.card = folder / f"{NAME}.toml", folder / "board"
        self.config.write_text(text)
        fd = os.open(block_path(NAME), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self.block = SharedBlock.create(sizes, fd)
        self.block["last_drive_v"][:] = DRIVE_V
        write_note(hardware_path(NAME), self.hardware)
        self.switch_on()

    def switch_on(self) -> None:
        """Create the card with its output at DRIVE_V, as the dead service left it."""
        fd = os.open(self.card, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        os.ftruncate(fd, board.file_bytes())
        self.memory = BoardMemory(fd)
        os.close(fd)
        self.memory.reset()
        facts = self.memory.facts
        facts["version"], facts["channels"], facts["rate_hz"] = board.VERSION, 1, BOARD_RATE_HZ
        set_first_outputs(self.memory, [DRIVE_CODE])
        facts["magic"] = board.MAGIC

    def written_v(self) -> list[float]:
        """Return all voltages written to the output, the newest last."""
        count = int(self.memory.words[board.WRITTEN])
        return (self.memory.fifo.codes[:count, 0] * LSB_V).tolist()

    def work(self) -> None:
        parking.park_configuration(self.config)

    def judge(self, outcome: Outcome) -> list[str]:
        """Park once more; require 0 V afterwards, and no step above that of the ramp in all writes."""
        problems = []
        if outcome.finished and self._output_v() != 0.0:
            problems.append(f"parking ends without an error; the output is at {self._output_v():.3f} V")
        try:
            self.work()
        except (RtloopError, DriverError) as error:
            problems.append(f"the next process cannot park: {error}")
        if self._output_v() != 0.0:
            problems.append(f"after the next process the output is at {self._output_v():.3f} V")
        levels_v = np.array([DRIVE_V, *self.written_v()])
        if (step_v := float(np.max(np.abs(np.diff(levels_v))))) > STEP_V + LSB_V:
            problems.append(f"a step of {step_v:.3f} V, allowed {STEP_V:.3f} V")
        os.close(self.block.fd)
        return problems

    def _output_v(self) -> float:
        return ([DRIVE_V, *self.written_v()])[-1]


class ParkingTheNoted(ParkingABoard):
    """Parking with a configuration that names another board: only the note names the board whose output is up."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        other_board = folder / "other"
        shutil.copy(self.card, other_board)
        fd = os.open(other_board, os.O_RDWR | os.O_CLOEXEC)
        set_first_outputs(BoardMemory(fd), [0])
        os.close(fd)
        other_board.chmod(0o600)
        self.config.write_text(self.config.read_text().replace(f'"{self.card}"', f'"{other_board}"'))


class ParkingACard(ParkingABoard):
    """Parking of a card whose writes are system calls, and whose outputs cannot be read back."""

    changes = CARD_CHANGES

    def switch_on(self) -> None:
        self.card.write_bytes(struct.pack("<d", DRIVE_V))

    def written_v(self) -> list[float]:
        return card.written_v(self.card)


class Noting(Case):
    """The note of a service that starts on another board: at each moment it is the old note or the new one, whole."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / f"{NAME}.hardware"
        wiring = {"x": Wiring("adc0", "dac0")}
        self.old, self.new = (
            Hardware("shm", f'{{"file":"{folder}/{name}"}}', wiring, BOARD_RATE_HZ, SLEW_V_PER_S, 1.0)
            for name in ("old-board", "new-board")
        )
        write_note(self.path, self.old)

    def work(self) -> None:
        write_note(self.path, self.new)

    def judge(self, outcome: Outcome) -> list[str]:
        """Require the old note or the new one, then the new note after a second write."""
        try:
            problems, note = [], read_note(self.path)
        except UnusableNote as error:
            problems, note = [str(error)], None
        if note not in (self.old, self.new):
            problems.append("the note is neither the old one nor the new one")
        if outcome.finished and note != self.new:
            problems.append("the write ends without an error, and the new note is missing")
        self.work()
        if read_note(self.path) != self.new:
            problems.append("the next process's note is missing")
        unexpected = {path.name for path in self.folder.iterdir()} - {self.path.name}
        return [*problems, *(f"{name} is unexpected" for name in unexpected)]
