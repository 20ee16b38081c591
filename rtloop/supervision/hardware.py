"""The hardware of a run, noted beside its shared block: what parking needs, whatever becomes of the configuration.

A file that was edited while its service ran may name another board by now, or be no configuration any more.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from rtloop.drivers.base import Driver, Wiring
from rtloop.drivers.registry import driver_class
from rtloop.engine.plan import Plan
from rtloop.errors import writing
from rtloop.hil.trusted import Untrusted, open_file
from rtloop.supervision.paths import new_file, refusal

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
    """Write it to `path`. Raises OutputError, HostRefused for a folder that others may write to."""
    what = "the note of the hardware"
    with os.fdopen(new_file(path, what), "wb") as file, writing(f"{path}: cannot make {what}"):
        file.write(_AS_JSON.dump_json(hardware))
        file.flush()


def noted(path: Path) -> Hardware | None:
    """What stands there; None where nothing does, or nothing whole. Raises HostRefused for what others may have put."""
    try:
        with os.fdopen(open_file(path, os.O_RDONLY), "rb") as file:
            return _AS_JSON.validate_json(file.read(LARGEST_BYTES))
    except Untrusted as error:
        raise refusal(error) from None
    except (OSError, ValidationError):
        return None
