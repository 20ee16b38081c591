"""What can go wrong with a recording, one class per culprit, with the exit code of the command line.

RecordingError      66  the file is missing, not a recording, or damaged beyond use
├── OutputError     73  a file cannot be written
└── MissingExtra    78  an optional package is needed
"""

from __future__ import annotations

from rtloop.errors import RtloopError


class RecordingError(RtloopError):
    """The recording cannot be read; the message says the file, the fact and what is possible instead."""

    exit_code = 66


class OutputError(RecordingError):
    """The file to be written cannot be."""

    exit_code = 73


class MissingExtra(RecordingError):
    """An optional package is missing; the message names what to install."""

    exit_code = 78
