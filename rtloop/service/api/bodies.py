"""Bodies of requests, with bounds on size, number of values and depth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, model_validator

from rtloop.configuration.references import MAX_HOLD_TICKS
from rtloop.configuration.schedule import ModeName
from rtloop.foundation.options import LARGEST_INTEGER
from rtloop.service.measuring.learning import LearnRequest
from rtloop.service.measuring.measurement import ResponseRequest

MAX_BODY_BYTES = 4 << 20
MAX_VALUES, MAX_DEPTH, MAX_CHARACTERS = 10_000, 6, 4096
"""Bounds on settings: number of keys and values, depth of nested tables and lists, characters of a key or text."""


def _require_bounded(settings: dict[str, object]) -> dict[str, object]:
    """Return `settings` itself. Raises ValueError for more than MAX_VALUES keys and values, for nesting deeper than
    MAX_DEPTH, keys and texts longer than MAX_CHARACTERS and integers beyond ±LARGEST_INTEGER.
    """
    for count, (depth, value) in enumerate(_walk_values(settings, 1), start=1):
        if count > MAX_VALUES:
            raise ValueError(f"the table has too many keys and values; allowed: at most {MAX_VALUES}")
        if depth > MAX_DEPTH:
            raise ValueError(
                f"the table is nested too deeply; allowed: at most {MAX_DEPTH} levels of tables, lists and values"
            )
        if isinstance(value, str) and len(value) > MAX_CHARACTERS:
            raise ValueError(
                f"the table has a key or a text of {len(value)} characters, which begins with {value[:20]!r}; allowed: "
                f"at most {MAX_CHARACTERS} characters"
            )
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise ValueError(f"the table has an integer out of range; allowed: {-LARGEST_INTEGER} to {LARGEST_INTEGER}")
    return settings


def _walk_values(node: object, depth: int) -> Iterator[tuple[int, object]]:
    """Yield (depth, value) for `node` itself, at `depth`, then for all keys and values in it, each value one deeper.

    A key has the depth of its table. Contents of tables and lists deeper than MAX_DEPTH are left out.
    """
    yield depth, node
    if depth <= MAX_DEPTH and isinstance(node, dict | list):
        for key in node if isinstance(node, dict) else ():
            yield depth, key
        for value in node.values() if isinstance(node, dict) else node:
            yield from _walk_values(value, depth + 1)


Settings = Annotated[dict[str, Any], AfterValidator(_require_bounded)]
Name = Annotated[str, Field(max_length=100)]


class Body(BaseModel):
    """Base class of request bodies: unknown fields, conversions and NaN are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)
    can_stop: ClassVar[bool] = False
    """Whether `is_stop` can be true."""

    @property
    def is_stop(self) -> bool:
        """Whether the request brings the outputs to safe, and so needs no lock; False unless a subclass differs."""
        return False


class IdentityQuery(Body):
    """Query with the `identity` in the event of a command, as decimal digits."""

    identity: Annotated[str, Field(pattern=r"^[0-9]{1,18}$")]


class LockBody(Body):
    """The emergency key, which takes the lock from its holder. Without the key the request takes a free lock, or renews
    the requester's own.
    """

    emergency_key: Annotated[str, Field(max_length=1000)] | None = None


class ModeBody(Body):
    """A mode for all axes."""

    can_stop: ClassVar[bool] = True
    mode: ModeName

    @property
    def is_stop(self) -> bool:
        """Whether the mode is off, which brings the outputs to safe and needs no lock."""
        return self.mode == "off"


class ReferenceBody(Body):
    """A reference as in [axis.reference]; the file of a table lies in or below the configuration's folder."""

    axis: Name
    reference: Settings


class SetpointBody(Body):
    """A constant reference, µm (V in raw mode)."""

    axis: Name
    value: float


class WaveformBody(Body):
    """Samples (µm; V in raw mode), `hold_ticks` ticks each, once or endlessly (`repeat`).

    `command_um`, of equal length, is added to the command of a closed loop.
    """

    axis: Name
    samples: Annotated[list[float], FailFast(), Field(min_length=1)]
    command_um: Annotated[list[float], FailFast()] = Field(default_factory=list)
    hold_ticks: int = Field(default=1, ge=1, le=MAX_HOLD_TICKS)
    repeat: bool = False

    @model_validator(mode="after")
    def _require_equal_lengths(self) -> Self:
        """Return this body. Raises ValueError unless `command_um` is empty or as long as `samples`."""
        if self.command_um and len(self.command_um) != len(self.samples):
            raise ValueError(
                f"command_um: {len(self.command_um)} numbers for {len(self.samples)} samples; allowed: equal lengths"
            )
        return self

    @property
    def columns(self) -> npt.NDArray[np.float64]:
        """Samples (n, 1) in µm (V in raw mode), or (n, 2) with `command_um`, always in µm, as the second column."""
        return np.array([self.samples, self.command_um] if self.command_um else [self.samples], float).T


class ResponseBody(Body):
    """The fields of `ResponseRequest`: largest added motion (µm), band, duration, expected resonance, span of the gain
    measurement (µm; 0: none).
    """

    axis: Name
    amplitude_um: float = Field(default=ResponseRequest.amplitude_um, gt=0)
    from_hz: float | None = Field(default=None, gt=0)
    to_hz: float | None = Field(default=None, gt=0)
    duration_s: float = Field(default=ResponseRequest.duration_s, ge=1, le=60)
    period_s: float | None = Field(default=None, ge=0.05, le=10)
    near_hz: float | None = Field(default=None, gt=0)
    resonance_only: bool = False
    gain_um: float = Field(default=ResponseRequest.gain_um, ge=0)


class LearnBody(Body):
    """One period of the reference, µm, one sample per tick, and the options of `LearnRequest`."""

    axis: Name
    samples: Annotated[list[float], FailFast(), Field(min_length=4)]
    cycles: int = Field(default=LearnRequest.cycles, ge=1, le=50)
    resonance_percent: float = Field(default=LearnRequest.resonance_percent, ge=0, lt=50)
    keep: bool = LearnRequest.keep

    @property
    def learn_request(self) -> LearnRequest:
        """The samples and options of the body, without the axis, as the request for `learn`."""
        return LearnRequest(np.array(self.samples), self.cycles, self.resonance_percent, self.keep)


class TuneBody(Body):
    """New values for keys of [axis.SECTION]."""

    axis: Name
    section: Name
    values: Annotated[dict[str, Any], Field(min_length=1), AfterValidator(_require_bounded)]


class ControllerBody(Body):
    """A complete section [axis.controller]."""

    axis: Name
    controller: Settings


class UndoBody(Body):
    """The axis whose last change is undone."""

    axis: Name
