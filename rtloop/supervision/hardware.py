"""The hardware of a run, noted beside its shared block: what parking needs, whatever becomes of the configuration.

A file that was edited while its service ran may name another board by now, or be no configuration any more.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.registry import driver_class
from rtloop.engine.plan import Plan
from rtloop.errors import OutputError
from rtloop.hil.trusted import Untrusted, open_file, open_folder
from rtloop.supervision.paths import refusal

LARGEST_BYTES = 1 << 20


@dataclass(frozen=True)
class Hardware:
    """A driver, its options as JSON, the channels of each axis, and how outputs are brought down."""

    driver_kind: str
    driver_options: str
    wiring: Mapping[str, Wiring]
    rate_hz: float
    trip_slew_v_per_s: float
    heartbeat_timeout_s: float

    @classmethod
    def of(cls, plan: Plan) -> Hardware:
        """What a plan drives."""
        options = driver_class(plan.driver_kind).options_model(**plan.driver_options)
        return cls(
            plan.driver_kind,
            options.model_dump_json(exclude_unset=True),
            plan.wiring,
            plan.pacing.rate_hz,
            plan.trip_slew_v_per_s,
            plan.pacing.heartbeat_timeout_s,
        )

    def drives_like(self, other: Hardware) -> bool:
        """Whether these are the same outputs of the same board."""
        return (self.driver_kind, json.loads(self.driver_options), dict(self.wiring)) == (
            other.driver_kind, json.loads(other.driver_options), dict(other.wiring)
        )  # fmt: skip

    def driver(self) -> Driver:
        """The driver, not open. Raises ValueError, DriverError."""
        kind = driver_class(self.driver_kind)
        return kind(kind.options_model.model_validate_json(self.driver_options), self.wiring, self.rate_hz)


_AS_JSON = TypeAdapter(Hardware)


def keep(path: Path, hardware: Hardware) -> None:
    """Write it to `path`, whole or not at all. Raises OutputError, HostRefused for a folder others may write to."""
    try:
        folder = open_folder(path.parent)
        try:
            with suppress(FileNotFoundError):
                os.unlink(path.name, dir_fd=folder)
            with suppress(FileNotFoundError):
                os.unlink(f"{path.name}.new", dir_fd=folder)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            with open(os.open(f"{path.name}.new", flags, 0o600, dir_fd=folder), "wb") as file:
                file.write(_AS_JSON.dump_json(hardware))
            os.rename(f"{path.name}.new", path.name, src_dir_fd=folder, dst_dir_fd=folder)
        finally:
            os.close(folder)
    except Untrusted as error:
        raise refusal(error) from None
    except OSError as error:
        raise OutputError(f"{path}: cannot note the hardware: {error.strerror}") from None


def noted(path: Path) -> Hardware | None:
    """What stands there; None where nothing does, or nothing whole. Raises HostRefused for what others may have put."""
    try:
        with open(open_file(path, os.O_RDONLY), "rb") as file:
            return _AS_JSON.validate_json(file.read(LARGEST_BYTES))
    except Untrusted as error:
        raise refusal(error) from None
    except (OSError, ValidationError):
        return None
