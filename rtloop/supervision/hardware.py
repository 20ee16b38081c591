"""The hardware of a run, noted beside its shared block: what parking needs, whatever becomes of the configuration.

A file that was edited while its service ran may name another board by now, or be no configuration any more. The note in
turn may be one of another version, or name what is no longer installed: it is believed as a whole or not at all.
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
from rtloop.drivers.base import Driver, Wiring, channel_index, require_channels
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class
from rtloop.engine.ramp import require_short_ramp
from rtloop.errors import ConfigError, RtloopError, UnavailableError, one_line_error, output_errors
from rtloop.foundation.trusted import UntrustedPath, open_file
from rtloop.supervision.paths import create_file, host_refusal

MAX_BYTES = 1 << 20


class UnusableNote(RtloopError):
    """A note of the hardware that nothing can be parked by; the message says what of it is not understood."""


class UnreadableNote(RtloopError):
    """A note of the hardware that the system does not let be read now: it may name the only board whose outputs are
    up."""

    exit_code = UnavailableError.exit_code


@dataclass(frozen=True)
class Hardware:
    """A driver, its options as JSON, the channels of each axis, and how outputs are brought down.

    The numbers have the bounds that they have in a configuration.
    """

    driver_kind: str
    driver_options: str
    wiring: Annotated[Mapping[str, Wiring], Field(min_length=1)]
    rate_hz: Annotated[float, Field(gt=0, le=HIGHEST_RATE_HZ)]
    trip_slew_v_per_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    heartbeat_timeout_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]

    @classmethod
    def from_configuration(cls, configuration: Configuration) -> Hardware:
        """What a configuration drives; whether its laws are good is no matter."""
        return cls(
            configuration.driver_kind,
            configuration.driver_options.model_dump_json(exclude_unset=True),
            configuration.wiring,
            configuration.loop.rate_hz,
            min(axis.limits.trip_slew_v_per_s for axis in configuration.axes),
            configuration.loop.heartbeat_timeout_s,
        )

    def drives_same_outputs(self, other: Hardware) -> bool:
        """Whether these are the same outputs of the same board."""
        return (self.driver_kind, json.loads(self.driver_options), dict(self.wiring)) == (
            other.driver_kind, json.loads(other.driver_options), dict(other.wiring)
        )  # fmt: skip

    def driver(self) -> Driver:
        """The driver, not open. Raises ValueError, DriverError; for a ramp that would take too long, too."""
        kind = driver_class(self.driver_kind)
        driver = kind(kind.options_model.model_validate_json(self.driver_options), self.wiring, self.rate_hz)
        require_channels(self.wiring, driver.facts)
        for wiring in self.wiring.values():
            output = driver.facts.outputs[channel_index(driver.facts.outputs, wiring.output)]
            require_short_ramp("trip_slew_v_per_s", self.trip_slew_v_per_s, output)
        return driver


_ADAPTER = TypeAdapter(Hardware)


def write_note(path: Path, hardware: Hardware) -> None:
    """Write it to `path`, whose old note counts until the new one is whole.

    Raises OutputError, HostRefused for a folder that others may write to.
    """
    target, new_path = "the note of the hardware", path.with_name(f"{path.name}.new")
    with output_errors(f"{path}: cannot make {target}"):
        with os.fdopen(create_file(new_path, target), "wb") as file:
            file.write(_ADAPTER.dump_json(hardware))
        os.replace(new_path, path)


def read_note(path: Path) -> Hardware | None:
    """The hardware that is noted at `path`, whose driver can be made; None where nothing is noted.

    Raises UnusableNote, UnreadableNote, HostRefused for a file that others may have put there.
    """
    try:
        with os.fdopen(open_file(path, os.O_RDONLY), "rb") as file:
            hardware = _ADAPTER.validate_json(file.read(MAX_BYTES))
    except FileNotFoundError:
        return None
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise UnreadableNote(f"{path}: the note of the hardware cannot be read: {error.strerror or error}") from None
    except ValidationError as error:
        raise _unusable_note(path, describe(error, "note", None)[0]) from None
    try:
        hardware.driver()
    except ValidationError as error:
        raise _unusable_note(path, describe(error, "note.driver_options", None)[0]) from None
    except Exception as error:  # a third party's driver may raise anything
        raise _unusable_note(path, one_line_error(error)) from error
    return hardware


def configured_hardware(config: Path) -> Hardware:
    """The hardware of a configuration file. Raises ConfigError, InputFileError, DriverError for a missing library.

    Only what drives an output is judged: outputs whose laws are wrong are to be parked all the same.
    """
    hardware = Hardware.from_configuration(load(config))
    try:
        hardware.driver()
    except DriverError:
        raise
    except Exception as error:  # a third party's driver may raise anything
        text = str(error) if isinstance(error, ValueError) else one_line_error(error)
        raise ConfigError(str(config), [f"driver.{text}"]) from error
    return hardware


def _unusable_note(path: Path, reason: str) -> UnusableNote:
    """The error that says why the note at `path` counts as none."""
    return UnusableNote(f"{path}: the note of the hardware is not understood, and counts as none: {reason}")
