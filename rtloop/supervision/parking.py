"""Parking: bring outputs to their safe values without the loop, ramping from where they are."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.base import Driver
from rtloop.drivers.errors import DriverError
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.ramp import found_v, output_indices, ramp_to_safe, safe_outputs_v
from rtloop.errors import RtloopError, UnavailableError
from rtloop.supervision.hardware import Hardware, noted
from rtloop.supervision.paths import block_path, hardware_path, open_block

POLL_S = 0.005
KILL_S = 5.0
MARGIN_S = 2.0
"""Beyond what a loop without its supervisor needs, before it is taken to stand still."""


def park_configuration(config: Path) -> str:
    """Park the outputs of a configuration in place of a service that died; what was done, in words.

    A loop that outlived its service is given the time to ramp down by itself, and killed if it does not. What counts is
    the hardware that the service ran with; if the configuration names another by now, that is parked as well. Raises
    ConfigError where no service has run yet, DriverError, UnavailableError while the service is alive.
    """
    name, unread = config.stem, ""
    last, configured = noted(hardware_path(name)), None
    try:
        configured = Hardware.of(prepare(load(config)).plan)
    except (DriverError, RtloopError) as error:
        if last is None:
            raise
        unread = f", as it last ran; the configuration is of no use:\n{error}"
    from_v: list[float] = []
    with _last_block(block_path(name)) as block:
        noted_v = None
        driven = last or configured
        assert driven is not None
        if block is not None:
            with _answering(block_path(name)):
                _await_end(block, driven.heartbeat_timeout_s, driven.trip_slew_v_per_s)
            noted_v = block["last_drive_v"] if len(block["last_drive_v"]) == len(driven.wiring) else None
        from_v += park(driven.driver(), driven.trip_slew_v_per_s, noted_v)
    if last is not None and configured is not None and not configured.drives_like(last):
        from_v += park(configured.driver(), configured.trip_slew_v_per_s)
    return f"{name}: parked from {', '.join(f'{value:.3f} V' for value in from_v)}{unread}"


@contextmanager
def _last_block(path: Path) -> Iterator[SharedBlock | None]:
    """A service's shared block; None where there is none."""
    fd = open_block(path)
    if fd is None:
        yield None
        return
    try:
        block = None
        with suppress(EOFError), _answering(path):  # its service died before there was anything in it
            block = SharedBlock.attach(fd, lambda: True)
        yield block
    finally:
        os.close(fd)


@contextmanager
def _answering(path: Path) -> Iterator[None]:
    """Raise UnavailableError where the system refuses to tell something of the shared block at `path`."""
    try:
        yield
    except OSError as error:
        raise UnavailableError(f"{path}: {error.strerror or error}") from None


def _await_end(block: SharedBlock, heartbeat_timeout_s: float, slew_v_per_s: float) -> None:
    """Wait until nobody drives any more. Raises UnavailableError while a service is alive, DriverError."""
    ramp_s = float(np.max(np.abs(block["last_drive_v"]))) / slew_v_per_s
    beat_ns = block.load(Word.HEARTBEAT_NS)
    kill_s = time.monotonic() + heartbeat_timeout_s + ramp_s + MARGIN_S
    while (pid := block.driven_by()) is not None:
        if block.load(Word.HEARTBEAT_NS) != beat_ns:
            raise UnavailableError(f"process {pid} drives the outputs and its service is alive; stop that instead")
        if time.monotonic() > kill_s + KILL_S:
            raise DriverError(f"process {pid} drives the outputs and cannot be killed")
        if time.monotonic() > kill_s:
            block.kill_driver()
        time.sleep(POLL_S)


def park(driver: Driver, slew_v_per_s: float, noted_v: npt.NDArray[np.float64] | None = None) -> list[float]:
    """Ramp every output from where it is to its safe value, then close the driver; where they were, in V.

    `noted_v` (axes,) is where the axes' drives were noted last, and is kept up to date: it counts where the card cannot
    say it. What is parked already does not move. Raises DriverError.
    """
    pointers = driver.open()
    try:
        from_v, index = found_v(driver, noted_v), output_indices(driver)

        def note(outputs_v: npt.NDArray[np.float64]) -> None:
            if noted_v is not None:
                noted_v[:] = outputs_v[index]

        ramp_to_safe(driver, pointers, from_v, slew_v_per_s, note)
        note(safe_outputs_v(driver))
        return from_v.tolist()
    finally:
        driver.close()
