"""`rtloop hil serve`: the simulated rig as a board of its own, for driver kind `shm`, or as a node on a CAN bus."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import click

from rtloop.configuration.file import Configuration, load
from rtloop.drivers.can.options import CanOptions
from rtloop.drivers.shm import ShmOptions
from rtloop.engine.plan import Pacing
from rtloop.engine.realtime import prepare_realtime
from rtloop.errors import ConfigError, UnavailableError
from rtloop.hil.board import serve
from rtloop.service.notify import Notifier
from rtloop.values import count_text

BOARD_PRIORITY = 85


def serve_board(config: Path) -> int:
    """Be the board of a configuration's [driver] until SIGINT or SIGTERM. Raises ConfigError, UnavailableError."""
    configuration = load(config)
    options = configuration.driver_options
    if not isinstance(options, ShmOptions):
        kind = configuration.driver_kind
        allowed = "`rtloop hil serve` is the board of kind 'shm', with --can the node of kind 'can'"
        raise ConfigError(str(config), [f"driver.kind: {kind!r}; {allowed}"])
    rate_hz = options.board_rate_hz or configuration.loop.rate_hz
    axes = _axes_by_output(configuration)
    stopped = _stop_signals()
    prepare_realtime(Pacing(rate_hz, priority=BOARD_PRIORITY))
    click.echo(
        f"board at {options.file}: {count_text(len(axes), 'channel')} at {rate_hz:g} Hz; Ctrl-C ends it", err=True
    )
    try:
        ready = lambda: Notifier().send(READY=1)
        samples = serve(Path(options.file), options, axes, rate_hz, stopped, ready)
    except ValueError as error:
        raise ConfigError(str(config), [f"driver: {error}"]) from None
    except OSError as error:
        raise UnavailableError(f"{options.file}: {error.strerror or error}") from None
    click.echo(f"board at {options.file}: {samples} samples", err=True)
    return 0


def serve_node(config: Path) -> int:
    """Be the CAN node of a configuration's [driver] until SIGINT or SIGTERM. Raises ConfigError, DriverError."""
    configuration = load(config)
    options = configuration.driver_options
    if not isinstance(options, CanOptions):
        kind = configuration.driver_kind
        raise ConfigError(str(config), [f"driver.kind: {kind!r}; --can is the node of kind 'can'"])
    from rtloop.drivers.can.node import serve as serve_can

    axes = _axes_by_output(configuration)
    stopped = _stop_signals()
    prepare_realtime(Pacing(configuration.loop.rate_hz, priority=BOARD_PRIORITY))

    def ready() -> None:
        click.echo(f"node on {options.label}: {count_text(len(axes), 'channel')}; Ctrl-C ends it", err=True)
        Notifier().send(READY=1)

    try:
        did = serve_can(options, axes, stopped, ready)
    except ValueError as error:
        raise ConfigError(str(config), [f"driver.{error}"]) from None
    click.echo(f"node on {options.label}: {did}", err=True)
    return 0


def _axes_by_output(configuration: Configuration) -> list[str]:
    """The axis at each output of the board, in their order."""
    return [axis for axis, _ in sorted(configuration.wiring.items(), key=lambda item: item[1].output)]


def _stop_signals() -> Callable[[], bool]:
    """Whether SIGINT or SIGTERM has come since."""
    stopped = False

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return lambda: stopped
