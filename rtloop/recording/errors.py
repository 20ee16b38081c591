"""What can go wrong with a recording that is read; what goes wrong in writing one is in `rtloop.errors`."""

from __future__ import annotations

from rtloop.errors import RtloopError


class RecordingError(RtloopError):
    """The file is missing, not a recording, or damaged; the message says the file, the fact and what is possible."""

    exit_code = 66
