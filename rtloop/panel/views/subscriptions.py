"""What a client may wish to see, each wish bounded; nothing else gets in by the WebSocket."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic_core import from_json

from rtloop.configuration.file import describe
from rtloop.panel.conditions import Slope

MAX_MESSAGE_BYTES = 1 << 16
MAX_PIXELS = 4096
Number = Annotated[float, Field(ge=-1e100, le=1e100)]
Name = Annotated[str, Field(max_length=100)]


class Subscription(BaseModel):
    """Base of wishes."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class TriggerOptions(Subscription):
    """When a sweep is taken, as `rtloop.panel.trigger` and `rtloop.panel.conditions` have it; a roll has no trigger."""

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
    """A screen."""

    signals: Annotated[tuple[Name, ...], Field(max_length=8)]
    seconds: float = Field(gt=0, le=3600)
    pixels: int = Field(ge=1, le=MAX_PIXELS)
    trigger: TriggerOptions = TriggerOptions()


class SpectrumSubscription(Subscription):
    """A signal's density, and between which frequencies its rms is told."""

    signal: Name
    low_hz: float = Field(default=0.0, ge=0, le=1e9)
    high_hz: float = Field(default=1e9, ge=0, le=1e9)


class XySubscription(Subscription):
    """An axis's drive and position over the last seconds."""

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


def read_message(text: str) -> dict[str, Any]:
    """By their names, as they came; `validate_field` judges each. Raises ValueError for what is no JSON object."""
    fields = from_json(text, allow_inf_nan=False)
    if not isinstance(fields, dict):
        raise ValueError("a message is a JSON object of wishes")
    return fields


def validate_field(name: str, value: Any) -> Any:
    """What is wished. Raises ValueError with what is wrong and what is allowed."""
    if name not in FIELD_TYPES:
        raise ValueError(f"wish {name[:100]!r}: {', '.join(FIELD_TYPES)} are known")
    try:
        return FIELD_TYPES[name].validate_python(value)
    except ValidationError as error:
        raise ValueError("; ".join(describe(error, name, None))) from None
