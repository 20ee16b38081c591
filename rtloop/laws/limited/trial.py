"""Entry points of commands to user laws: run their code in the limited process, or try it there first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.limited.announcement import is_limited
from rtloop.laws.limited.process import PROCESS, AbandonedJob, Result
from rtloop.laws.registry import LawReference


def needs_limited_process(laws: Iterable[LawReference]) -> bool:
    """Return whether work with these laws must go to the limited process.

    True if one is a user law, with a text, and this process is not limited.
    """
    return not is_limited() and any(law.text for law in laws)


def run_limited(source: str, function: Callable[..., Result], *arguments: object, compiles: bool = False) -> Result:
    """Run `function` in the limited process and return its result; `compiles` says whether it needs the compiler.

    Raises ConfigError, with `source` as its source, for faults of a law and for every ConfigError of `function`;
    DriverError or RtloopError if `function` does; AbandonedJob if the process fails while no law runs; OSError if the
    system refuses the process.
    """
    return _run_for_source(source, partial(PROCESS.run, compiles=compiles), function, *arguments)


def try_limited(source: str, function: Callable[..., object], *arguments: object) -> None:
    """Run `function` in the limited process before it runs in this one; no effect inside a limited process.

    Raises ConfigError, with `source` as its source, if a law's code ends the process, does not return, prints too much,
    leaves a thread or process, closes or replaces a standard stream, or raises an error other than ValueError,
    RtloopError and DriverError. These three are ignored, as they occur again when the caller runs `function` itself.
    Raises AbandonedJob if the process fails while no law runs, OSError if the system refuses the process.
    """
    if not is_limited():
        _run_for_source(source, partial(PROCESS.run, show=False), partial(_run_ignoring_errors, function), *arguments)


def _run_for_source(
    source: str, run: Callable[..., Result], function: Callable[..., object], *arguments: object
) -> Result:
    """Return `run(function, *arguments)`; raise its ConfigError, and its AbandonedJob caused by a law, as ConfigError
    with `source` as source.

    Other errors, also AbandonedJob without a law, pass through.
    """
    try:
        return run(function, *arguments)
    except ConfigError as error:
        raise ConfigError(source, error.faults) from None
    except AbandonedJob as error:
        if not error.by_law:
            raise
        raise ConfigError(source, [str(error)]) from None


def _run_ignoring_errors(function: Callable[..., object], *arguments: object) -> None:
    """Call `function` and ignore ValueError, RtloopError and DriverError."""
    with suppress(ValueError, RtloopError, DriverError):
        function(*arguments)
