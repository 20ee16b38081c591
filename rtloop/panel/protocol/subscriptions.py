"""Messages from a page: the subscriptions and actions of a client, each value bounded."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import from_json

from rtloop.client.capture.conditions import Slope
from rtloop.configuration.file import describe

MAX_MESSAGE_BYTES = 1 << 16
MAX_PIXELS = 4096
Number = Annotated[float, Field(ge=-1e100, le=1e100)]
Name = Annotated[str, Field(max_length=100)]


class Subscription(BaseModel):
    """Base class of subscriptions."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class TriggerOptions(Subscription):
    """Trigger of a screen: mode and condition, as in `rtloop.client.capture`. Mode "roll" has no trigger."""

    mode: Literal["auto", "normal", "single", "roll"] = "auto"
    kind: Literal["edge", "window", "trip", "mode", "command", "late", "step"] = "edge"
    source: Name | None = None
    level: Number = 0.0
    slope: Slope = Slope.RISING
    hysteresis: Number = Field(default=0.0, ge=0)
    low: Number = -1.0
    high: Number = 1.0
    threshold: Number = Field(default=0.0, ge=0)
    holdoff_s: float = Field(default=0.0, ge=0, le=3600)
    pre_percent: float = Field(default=50.0, ge=0, le=100)


class ViewSubscription(Subscription):
    """Subscription to a scope screen: signals, duration, width in pixels, trigger."""

    signals: Annotated[tuple[Name, ...], Field(max_length=8)]
    seconds: float = Field(gt=0, le=3600)
    pixels: int = Field(ge=1, le=MAX_PIXELS)
    trigger: TriggerOptions = TriggerOptions()


class SpectrumSubscription(Subscription):
    """Subscription to the spectrum of a signal, with its rms from `low_hz` to `high_hz`."""

    signal: Name
    low_hz: float = Field(default=0.0, ge=0, le=1e9)
    high_hz: float = Field(default=1e9, ge=0, le=1e9)


class XySubscription(Subscription):
    """Subscription to drive against position of an axis over the last `seconds`."""

    axis: Name
    seconds: float = Field(default=2.0, gt=0, le=60)


FIELD_TYPES: dict[str, TypeAdapter[Any]] = {
    "view": TypeAdapter(ViewSubscription | None),
    "arm": TypeAdapter(bool),
    "force": TypeAdapter(bool),
    "hold": TypeAdapter(bool),
    "spectrum": TypeAdapter(SpectrumSubscription | None),
    "reset_spectrum": TypeAdapter(bool),
    "xy": TypeAdapter(XySubscription | None),
    "timing": TypeAdapter(bool),
}


def read_message(text: str) -> dict[str, object]:
    """Return the fields of a JSON message by name, not yet validated.

    Raises ValueError for a text that is no JSON object, and for NaN or infinity in it.
    """
    fields = from_json(text, allow_inf_nan=False)
    if not isinstance(fields, dict):
        raise ValueError(f"not a JSON object; allowed: an object with keys from {', '.join(FIELD_TYPES)}")
    return fields


def validate_field(name: str, value: object) -> Subscription | bool | None:
    """Return the validated value of a message's field, of its type in FIELD_TYPES.

    Raises ValueError that names value and allowed values, also for an unknown field.
    """
    if name not in FIELD_TYPES:
        raise ValueError(f"field {name[:100]!r} of the message: unknown; allowed: {', '.join(FIELD_TYPES)}")
    try:
        return FIELD_TYPES[name].validate_python(value)
    except ValidationError as error:
        raise ValueError("; ".join(describe(error, name, None))) from None
