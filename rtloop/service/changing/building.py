"""Another law, built and judged in the limited process: one that takes too long is killed, and the client is told.

The process is started once the loop runs, so that it does not delay the loop, and ends with the service.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared, prepare
from rtloop.laws.limited.process import PROCESS
from rtloop.service.changing.preview import Figures, figures


def prepare_limited(configuration: Configuration) -> Prepared:
    """Prepare a change of a service. Raises ConfigError, DriverError, UnavailableError where it takes too long."""
    return PROCESS.run(prepare, configuration, compiles=_compiles(configuration))


def figures_limited(configuration: Configuration, number: int, least_step_ms: float = 0.0) -> Figures:
    """What a configuration makes of axis `number`, as `figures` does. Raises as `prepare_limited`."""
    return PROCESS.run(_prepared_figures, configuration, number, least_step_ms, compiles=_compiles(configuration))


def expect_changes() -> None:
    """Have the process ready before it is needed."""
    PROCESS.prepare_ahead(prepare)


@contextlib.contextmanager
def builder_ended() -> Iterator[None]:
    """In the end there is no process beside the service any more."""
    try:
        yield
    finally:
        PROCESS.end()


def _prepared_figures(configuration: Configuration, number: int, least_step_ms: float) -> Figures:
    return figures(prepare(configuration), number, least_step_ms)


def _compiles(configuration: Configuration) -> bool:
    """Whether the compiler is needed: what is shipped is compiled already."""
    return any(law.text for law in configuration.laws)
