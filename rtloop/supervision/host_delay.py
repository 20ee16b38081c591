"""Delay measured on this host, stored in the runtime folder, and the share of a loop's delay margin that it uses.

`rtloop doctor CONFIG` stores the lateness of the loop's clock. `rtloop drivers --selftest` stores the delay that the
exchange with a node adds to the model's, and with --loopback the ticks that a value takes from an output through a wire
to an input; the held output alone takes one tick. The file NAME.host.json disappears with the next restart of the
machine, after which the kernel's settings may differ.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from pydantic import Field, ValidationError

from rtloop.analysis.margins import delay_margin
from rtloop.configuration.checks import AxisCheck
from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared
from rtloop.errors import ConfigError, OutputError
from rtloop.foundation.options import Options
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, open_file, open_folder
from rtloop.supervision.paths import FOLDER_MODE, client_folders, host_refusal, runtime_folder

MAX_BYTES = 1 << 16
US_PER_S = 1e6


class HostDelay(Options):
    """Delay of this host for one configuration at one rate: p99 of the clock's lateness, delay that the exchange with a
    node adds (p99), ticks through each axis's wire.
    """

    rate_hz: float = Field(gt=0)
    lateness_us: float = Field(default=0.0, ge=0)
    exchange_us: float = Field(default=0.0, ge=0)
    wire_ticks: dict[str, int] = {}  # noqa: RUF012


@dataclass(frozen=True)
class SpentMargin:
    """Delay that this host adds to the delay in an axis's model, and the loop's delay margin `margin_us`.

    `lateness_us` is the clock's p99, `exchange_us` the node's, `wire_ticks` are ticks from output to input beyond the
    model's delay. `more_us` is the sum of all, `more_ticks` the same in periods.
    """

    lateness_us: float
    exchange_us: float
    wire_ticks: int
    more_us: float
    more_ticks: float
    margin_us: float

    @property
    def is_spent(self) -> bool:
        """Whether the added delay reaches the margin: in at least 1 % of the ticks, the delay is then too long."""
        return self.more_us >= self.margin_us

    @property
    def text(self) -> str:
        """The figures as one sentence."""
        percent = 100 * self.more_us / self.margin_us if self.margin_us else float("inf")
        exchange_text = f", exchange with the node {self.exchange_us:.4g} µs" if self.exchange_us else ""
        wire_text = f", {self.wire_ticks} more ticks from output to input" if self.wire_ticks else ""
        return (
            f"measured on this host: {self.more_us:.4g} µs = {self.more_ticks:.3g} ticks of added delay, "
            f"{percent:.3g} % of the {self.margin_us:.4g} µs that the loop tolerates (lateness "
            f"of the clock {self.lateness_us:.4g} µs at the 99th percentile{exchange_text}{wire_text})"
        )


def store_host_delay(configuration: Configuration, **figures: object) -> None:
    """Store measured `figures` (fields of HostDelay) for the configuration's rate in the file NAME.host.json.

    Other figures stored for this rate stay; figures stored for another rate are dropped. Raises OutputError if the
    system refuses, HostRefusal for a folder or file that another user owns or may change.
    """
    rate_hz = configuration.loop.rate_hz
    previous = load_host_delay(configuration)
    updated = (previous or HostDelay(rate_hz=rate_hz)).model_copy(update=figures)
    path = runtime_folder() / _file_name(configuration)
    try:
        close_descriptor(open_folder(path.parent, FOLDER_MODE))
        fd = open_file(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o640)
        with os.fdopen(fd, "w") as file:
            file.write(updated.model_dump_json())
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror}") from None


def load_host_delay(configuration: Configuration) -> HostDelay | None:
    """Return the delay that was stored on this host for the configuration's name and rate.

    None where no such file can be read, or where its delay was measured at another rate.
    """
    for folder in dict.fromkeys((runtime_folder(), *client_folders())):
        try:
            with os.fdopen(open_file(folder / _file_name(configuration), os.O_RDONLY), "rb") as file:
                delay = HostDelay.model_validate_json(file.read(MAX_BYTES))
        except (OSError, ValidationError):
            continue
        if delay.rate_hz == configuration.loop.rate_hz:
            return delay
    return None


def _file_name(configuration: Configuration) -> str:
    """Return the name of the file with the host's delay: NAME.host.json for the configuration's name."""
    return f"{configuration.name}.host.json"


def spent_margin(check: AxisCheck, host: HostDelay) -> SpentMargin | None:
    """Return the delay that a host adds to an axis, and the loop's delay margin; None for an unknown or unstable loop.

    The delay is the sum of the clock's lateness, of the exchange with a node, and of ticks from output to input beyond
    the model's. Without a measurement through the axis's wire, these ticks are 0.
    """
    if check.on_model is None or not check.on_model.is_stable:
        return None
    margin_s, _ = delay_margin(check.on_model)
    extra_ticks = max(host.wire_ticks.get(check.name, 1) - 1 - check.delay_ticks, 0)
    period_us = US_PER_S / host.rate_hz
    more_us = host.lateness_us + host.exchange_us + extra_ticks * period_us
    return SpentMargin(
        host.lateness_us, host.exchange_us, extra_ticks, more_us, more_us / period_us, US_PER_S * margin_s
    )


def require_margins(prepared: Prepared) -> None:
    """Raise one ConfigError with a fault for each axis with `require_margin` whose delay margin the measured delay of
    this host uses up, or whose delay or margin is unknown.

    A run in virtual time, and a configuration without such an axis, pass.
    """
    configuration, faults = prepared.configuration, list[str]()
    required_axes = [axis.name for axis in configuration.axes if axis.margins.require_margin]
    if not required_axes or not prepared.plan.pacing.paced:
        return
    host = load_host_delay(configuration)
    for check in prepared.checks:
        if check.name not in required_axes:
            continue
        key = f"axis.{check.name}.margins.require_margin"
        spent = None if host is None else spent_margin(check, host)
        if host is None:
            faults.append(f"{key}: the delay of this host is unknown; measure it with `rtloop doctor CONFIG`")
        elif spent is None:
            faults.append(
                f"{key}: the delay margin of the axis is unknown, or its loop is unstable on the model; use a linear "
                "controller and a model with which the loop is stable"
            )
        elif spent.is_spent:
            faults.append(
                f"{key}: {spent.text}; no margin of stability is left; use a slower controller, or reduce the delay as "
                "`rtloop doctor` says"
            )
    if faults:
        raise ConfigError(configuration.source, faults)
