"""A note of the hardware of a run, in a file beside its shared block, so that `rtloop park` finds the right board.

The configuration file may have been edited while its service ran: it may name another board, or be invalid. The note
may come from another version, or name a driver that is not installed: it is then ignored as a whole.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError

from rtloop.configuration.file import HIGHEST_RATE_HZ, Configuration, describe, load
from rtloop.drivers.base import Channel, Driver, Wiring, channel_index, require_channels
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class
from rtloop.engine.ramp import require_short_ramp
from rtloop.errors import ConfigError, RtloopError, UnavailableError, one_line_error, output_errors
from rtloop.foundation.trusted import UntrustedPath, open_file
from rtloop.supervision.paths import create_file, host_refusal

MAX_BYTES = 1 << 20


class UnusableNote(RtloopError):
    """A note of the hardware that cannot be used for parking; the message names the invalid part."""


class UnreadableNote(RtloopError):
    """A note of the hardware that the system refuses to open. The note may name the only board whose outputs are up."""

    exit_code = UnavailableError.exit_code


@dataclass(frozen=True)
class Hardware:
    """A driver, its options as JSON, the channels of each axis, and the figures of the ramp to safe.

    The numbers have the same bounds as in a configuration.
    """

    driver_kind: str
    driver_options: str
    wiring: Annotated[Mapping[str, Wiring], Field(min_length=1)]
    rate_hz: Annotated[float, Field(gt=0, le=HIGHEST_RATE_HZ)]
    trip_slew_v_per_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    heartbeat_timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]

    @classmethod
    def from_configuration(cls, configuration: Configuration) -> Hardware:
        """Return the hardware that a configuration drives; its slew rate is the lowest of the configuration's axes."""
        return cls(
            configuration.driver_kind,
            configuration.driver_options.model_dump_json(exclude_unset=True),
            configuration.wiring,
            configuration.loop.rate_hz,
            min(axis.limits.trip_slew_v_per_s for axis in configuration.axes),
            configuration.loop.heartbeat_timeout_s,
        )

    def drives_same_outputs(self, other: Hardware) -> bool:
        """Whether `other` has the same driver, options and wiring; rate, slew rate and heartbeat timeout may differ."""
        return (self.driver_kind, json.loads(self.driver_options), dict(self.wiring)) == (
            other.driver_kind, json.loads(other.driver_options), dict(other.wiring)
        )  # fmt: skip

    def driver(self) -> Driver:
        """Create and return the driver, without opening it.

        Raises ValueError for an unknown driver, invalid options and a channel that the driver lacks; DriverError, for
        example for a missing library.
        """
        kind = driver_class(self.driver_kind)
        driver = kind(kind.options_model.model_validate_json(self.driver_options), self.wiring, self.rate_hz)
        require_channels(self.wiring, driver.facts)
        return driver


_ADAPTER = TypeAdapter(Hardware)


def write_note(path: Path, hardware: Hardware) -> None:
    """Write a note to `path`, in a folder that is made if missing; an old note stays until the new one is complete.

    Raises OutputError if the system refuses, HostRefusal for a folder that another user owns or may change.
    """
    target, new_path = "the note of the hardware for `rtloop park`", path.with_name(f"{path.name}.new")
    with output_errors(f"{path}: cannot write {target}"):
        with os.fdopen(create_file(new_path, target), "wb") as file:
            file.write(_ADAPTER.dump_json(hardware))
        os.replace(new_path, path)


def read_note(path: Path) -> Hardware | None:
    """Return the hardware noted at `path`, with a driver that can be created; None if there is no note.

    Raises UnusableNote for invalid content, a driver that cannot be created or a ramp that takes too long,
    UnreadableNote if the system refuses, and HostRefusal for a file that another user may have written.
    """
    try:
        with os.fdopen(open_file(path, os.O_RDONLY), "rb") as file:
            hardware = _ADAPTER.validate_json(file.read(MAX_BYTES))
    except FileNotFoundError:
        return None
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise UnreadableNote(
            f"{path}: cannot read the note of the hardware, which names the board of the last run: "
            f"{error.strerror or error}. The outputs of this board may still carry voltage; make the file readable, "
            "then park again"
        ) from None
    except ValidationError as error:
        raise _unusable_note(path, describe(error, "note", None)[0]) from None
    try:
        _require_short_ramp(hardware, hardware.driver())
    except ValidationError as error:
        raise _unusable_note(path, describe(error, "note.driver_options", None)[0]) from None
    except Exception as error:  # A third party's driver may raise anything.
        raise _unusable_note(path, one_line_error(error)) from error
    return hardware


def configured_hardware(config: Path) -> Hardware:
    """Return the hardware of a configuration file, which must be valid as a whole; create its driver once as a test.

    Raises InputFileError for a file that cannot be read, ConfigError for an invalid one, also if an axis's ramp takes
    too long. An error while the driver is created is raised on if it is a DriverError, such as a missing library; each
    other one becomes a ConfigError.
    """
    configuration = load(config)
    hardware = Hardware.from_configuration(configuration)
    try:
        outputs = _wired_outputs(hardware.driver())
    except DriverError:
        raise
    except Exception as error:  # A third party's driver may raise anything.
        text = str(error) if isinstance(error, ValueError) else one_line_error(error)
        raise ConfigError(str(config), [f"driver.{text}"]) from error
    for axis in configuration.axes:
        try:
            key = f"axis.{axis.name}.limits.trip_slew_v_per_s"
            require_short_ramp(key, axis.limits.trip_slew_v_per_s, outputs[axis.name])
        except ValueError as error:
            raise ConfigError(str(config), [str(error)]) from None
    return hardware


def _wired_outputs(driver: Driver) -> dict[str, Channel]:
    """Return the output channel of each axis, by the axis's name."""
    outputs = driver.facts.outputs
    return {axis: outputs[channel_index(outputs, wiring.output)] for axis, wiring in driver.wiring.items()}


def _require_short_ramp(hardware: Hardware, driver: Driver) -> None:
    """Raise ValueError if the slew rate in the hardware's note is too slow to ramp any output down in time.

    Only one output is judged: the one whose safe value is nearest to the farther end of its range. The note has one
    slew rate, the slowest axis's, and does not name this axis.
    """
    outputs = _wired_outputs(driver).values()
    nearest = min(outputs, key=lambda output: max(output.maximum_v - output.safe_v, output.safe_v - output.minimum_v))
    require_short_ramp("trip_slew_v_per_s", hardware.trip_slew_v_per_s, nearest)


def _unusable_note(path: Path, reason: str) -> UnusableNote:
    """Return, without raising it, the error for a note at `path` that is ignored because of `reason`."""
    return UnusableNote(
        f"{path}: the note of the hardware, which names the board of the last run, cannot be used and is ignored: "
        f"{reason}"
    )
