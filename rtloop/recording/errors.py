"""Error of reading a recording; errors of writing one are in `rtloop.errors`."""

from __future__ import annotations

from rtloop.errors import RtloopError


class RecordingError(RtloopError):
    """A file is missing, not a recording, or damaged; the message gives the file, the fault and the remedy."""

    exit_code = 66
