"""Building and analysing a changed configuration in the limited process, which is killed if it takes too long.

The limited process starts some seconds after the loop, so that the loop's start is not delayed, or with the first
change if that comes sooner; it ends with the service.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.laws.limited.process import PROCESS
from rtloop.service.changing.preview import Figures, loop_figures


def prepare_limited(configuration: Configuration) -> Prepared:
    """Build and verify a changed configuration in the limited process, and return the result of `prepare`.

    The limited process is a separate one, killed if it takes too long. Raises ConfigError, DriverError, RtloopError as
    `prepare`, and UnavailableError if the process takes too long, prints too much or ends.
    """
    return PROCESS.run(prepare, configuration, compiles=_needs_compiler(configuration))


def figures_limited(configuration: Configuration, number: int, least_step_ms: float = 0.0) -> Figures:
    """Build a configuration and return `loop_figures` of axis `number`, both in the limited process.

    The step response of these figures lasts at least `least_step_ms`. Raises as `prepare_limited`.
    """
    return PROCESS.run(_prepare_figures, configuration, number, least_step_ms, compiles=_needs_compiler(configuration))


def prepare_builder() -> None:
    """Start the limited process before it is needed, and let it import `prepare`; does not wait for it."""
    PROCESS.prepare_ahead(prepare)


@contextlib.contextmanager
def builder_lifetime() -> Iterator[None]:
    """End the limited process after the work within."""
    try:
        yield
    finally:
        PROCESS.end()


def _prepare_figures(configuration: Configuration, number: int, least_step_ms: float) -> Figures:
    """Build a configuration and return `loop_figures` of axis `number`, from 0; runs in the limited process.

    The step response of the figures lasts at least `least_step_ms`.
    """
    return loop_figures(prepare(configuration), number, least_step_ms)


def _needs_compiler(configuration: Configuration) -> bool:
    """Whether a configuration has laws that must be compiled; shipped laws are compiled already."""
    return any(law.text for law in configuration.laws)
