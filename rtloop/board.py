"""`rtloop hil serve`: the simulated rig as a board of its own, for driver kind `shm`."""

from __future__ import annotations

import signal
from pathlib import Path

import click

from drivers.shm import ShmOptions
from hil.board import serve
from rtloop.config import load
from rtloop.engine.plan import Pacing
from rtloop.engine.realtime import prepare_realtime
from rtloop.errors import ConfigError, UnavailableError
from rtloop.service.notify import Notifier

BOARD_PRIORITY = 85


def serve_board(config: Path) -> int:
    """Be the board of a configuration's [driver] until SIGINT or SIGTERM. Raises ConfigError, UnavailableError."""
    configuration = load(config)
    options = configuration.driver_options
    if not isinstance(options, ShmOptions):
        kind = configuration.driver_kind
        raise ConfigError(str(config), [f"driver.kind: {kind!r}; `rtloop hil serve` is the board of kind 'shm' alone"])
    rate_hz = options.board_rate_hz or configuration.loop.rate_hz
    axes = [axis for axis, _ in sorted(configuration.wiring.items(), key=lambda item: item[1].output)]
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    prepare_realtime(Pacing(rate_hz, priority=BOARD_PRIORITY))
    click.echo(f"board at {options.file}: {len(axes)} channels at {rate_hz:g} Hz; Ctrl-C ends it", err=True)
    try:
        ready = lambda: Notifier().send(READY=1)
        samples = serve(Path(options.file), options, axes, rate_hz, lambda: stopped, ready)
    except ValueError as error:
        raise ConfigError(str(config), [f"driver: {error}"]) from None
    except OSError as error:
        raise UnavailableError(f"{options.file}: {error.strerror or error}") from None
    click.echo(f"board at {options.file}: {samples} samples", err=True)
    return 0
