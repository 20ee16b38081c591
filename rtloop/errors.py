"""Errors for users, each with the exit code of the command line.

    RtloopError
    ├── ConfigError      78  the configuration, with every fault in it
    ├── UnavailableError 69  hardware or service not available
    ├── OutputError      73  the output cannot be written
    ├── MissingExtra     78  an optional package is needed
    ├── HostRefusal      77  refused by the host
    ├── NoDesign          1  no controller meets the specification
    ├── LoopFault         1  the loop tripped, lost data or failed
    ├── RecordingError   66  a recording cannot be read            (rtloop.recording.errors)
    ├── InputFileError   66  a file that was named cannot be read  (rtloop.configuration.text_files)
    ├── UnreadableNote   69  a hardware note that cannot be opened (rtloop.supervision.hardware)
    ├── UnreadableData    1  a file of another program; 66 where it cannot be opened (rtloop.interchange.formats.table)
    │   └── AmbiguousData 65  a file with two readings; the message lists the options that decide
    ├── UnsuitableData    1  recordings that tell too little       (rtloop.design.identification.axis_recording)
    └── Refusal, UnconfirmedCommand  1  a command that a running loop refused, or did not confirm  (rtloop.service.desk)

Drivers raise `DriverError` (69, rtloop.drivers.errors), which is independent of these classes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

LOW_SPACE = 1 << 16
"""`OutputError.number` for a disk with less free space than the limit; larger than every errno."""


def fault_list(source: str, faults: Sequence[str]) -> str:
    """Return a text of all faults in a file or request: its name `source`, their count, then a line for each fault."""
    count = "1 fault" if len(faults) == 1 else f"{len(faults)} faults"
    return "\n  ".join([f"{source}: {count}", *faults])


def one_line_error(error: BaseException) -> str:
    """Return "Type: message" of an exception on one line.

    White space, line breaks included, becomes one space, an unprintable character "?".
    """
    words = " ".join(str(error).split())
    return f"{type(error).__name__}: {''.join(letter if letter.isprintable() else '?' for letter in words)}"


class RtloopError(Exception):
    """Base class of the user's errors: the message names the object, its value and the allowed values."""

    exit_code = 1


class ConfigError(RtloopError):
    """An invalid configuration or request, named by `source`; `faults` lists every fault in it, one sentence each."""

    exit_code = 78

    def __init__(self, source: str, faults: Sequence[str]) -> None:
        """Store `source`, the name of a file or request, and its `faults`; the message is their `fault_list`."""
        self.source, self.faults = source, list(faults)
        super().__init__(fault_list(source, self.faults))


class UnavailableError(RtloopError):
    """Hardware, a service or a system resource is not available."""

    exit_code = 69


class OutputError(RtloopError):
    """A file or folder cannot be written; `number` is the cause: an errno, LOW_SPACE, or 0 for any other."""

    exit_code = 73

    def __init__(self, message: str, number: int = 0) -> None:
        """Store the message and the cause `number`: an errno, LOW_SPACE, or 0 for any other cause."""
        super().__init__(message)
        self.number = number


@contextmanager
def output_errors(target: object) -> Iterator[None]:
    """Convert an OSError inside the block to an OutputError that names `target`, such as a path, and the cause.

    The `number` of the OutputError is the errno, 0 without an errno.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{target}: {error.strerror or error}", error.errno or 0) from None


class MissingExtra(RtloopError):
    """An optional package is missing; the message names what to install, also for users of a wheel's file."""

    exit_code = 78

    def __init__(self, message: str) -> None:
        """Store the message; if it names an extra to install, add the command for a wheel's file.

        No command is added if the message has it already.
        """
        extra = re.search(r"pip install 'rtloop\[(\w+)\]'(?! \(from a wheel)", message)
        super().__init__(f"{message} (from a wheel: pip install 'FILE.whl[{extra[1]}]')" if extra else message)


class NoDesign(RtloopError):
    """No controller or no taps meet the specification; the message names the failing condition and a remedy."""

    exit_code = 1


class HostRefusal(RtloopError):
    """The host refuses a privilege or resource that the configuration requires, or a file, folder or socket is not
    trusted, because another user made it or may change it.
    """

    exit_code = 77


class LoopFault(RtloopError):
    """The loop tripped, lost data or failed, or a measurement or change of the running loop did not succeed."""

    exit_code = 1
