"""What commands do with the code of somebody's own law: run it in the limited process, or try it there first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import Any

from rtloop.drivers.errors import DriverError
from rtloop.errors import ConfigError, RtloopError
from rtloop.laws.limited.announced import is_limited
from rtloop.laws.limited.process import PROCESS, AbandonedJob
from rtloop.laws.registry import LawReference


def needs_limited_process(laws: Iterable[LawReference]) -> bool:
    """Whether work with these laws belongs into the limited process: one is somebody's own, and this is not it."""
    return not is_limited() and any(law.text for law in laws)


def run_limited(source: str, function: Callable[..., Any], *arguments: Any, compiles: bool = False) -> Any:
    """What `function` returns in the limited process; `compiles` says whether it needs the compiler.

    Raises as it does, and ConfigError of `source` for a law's faults.
    """
    return _run_for_source(source, partial(PROCESS.run, compiles=compiles), function, *arguments)


def try_limited(source: str, function: Callable[..., Any], *arguments: Any) -> None:
    """Run `function` in the limited process before it runs here, unless this is that process.

    Raises ConfigError of `source` where a law's code ends the process, does not come to an end, or leaves something
    running. Errors of the usual kinds are left for the caller to meet.
    """
    if not is_limited():
        _run_for_source(source, partial(PROCESS.run, show=False), partial(_run_ignoring_errors, function), *arguments)


def _run_for_source(source: str, run: Callable[..., Any], function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return run(function, *arguments)
    except ConfigError as error:
        raise ConfigError(source, error.faults) from None
    except AbandonedJob as error:
        if not error.by_law:
            raise
        raise ConfigError(source, [str(error)]) from None


def _run_ignoring_errors(function: Callable[..., Any], *arguments: Any) -> None:
    with suppress(ValueError, RtloopError, DriverError):
        function(*arguments)
