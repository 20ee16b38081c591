"""A card in a file: each write of an output is a system call that appends a voltage to the file.

Its outputs cannot be read back. Opening the card does not change its output.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.python import PythonDriver
from rtloop.foundation.options import Options

KIND = "file_card"


class FileCardOptions(Options):
    file: str


class FileCard(PythonDriver):
    """A driver that appends each written voltage to its file."""

    kind = KIND
    options_model = FileCardOptions
    options: FileCardOptions
    fd: int | None = None

    @property
    def facts(self) -> Facts:
        return Facts((Channel("in"),), (Channel("out"),))

    def start(self) -> None:
        try:
            self.fd = os.open(self.options.file, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        except OSError as error:
            from rtloop.drivers.errors import DriverError

            raise DriverError(f"{self.options.file}: {error.strerror}") from None

    def outputs_v(self) -> None:
        """Return None: the outputs cannot be read back."""

    def read(self) -> tuple[float]:
        return (0.0,)

    def write(self, volts: Sequence[float]) -> None:
        assert self.fd is not None
        os.write(self.fd, struct.pack("<d", volts[0]))

    def stop(self) -> None:
        if self.fd is not None:
            os.close(self.fd)
            self.fd = None


def written_v(path: Path) -> list[float]:
    """Return all voltages written to the card's output, in order."""
    return [value for (value,) in struct.iter_unpack("<d", path.read_bytes())]
