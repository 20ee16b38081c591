"""Bodies of requests: what may be in one, how large, how many, how deep. Whatever enters is bounded here."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BaseModel, ConfigDict, FailFast, Field, model_validator

from rtloop.configuration.references import MAX_HOLD_TICKS
from rtloop.configuration.schedule import ModeName
from rtloop.foundation.options import LARGEST_INTEGER
from rtloop.service.measuring.learning import Asked as Taught
from rtloop.service.measuring.measurement import Asked

MAX_BODY_BYTES = 4 << 20
MAX_VALUES, MAX_DEPTH, MAX_CHARACTERS = 10_000, 6, 4096
"""Of settings: values in all, tables and lists within each other, and of a text."""


def _bounded(settings: dict[str, Any]) -> dict[str, Any]:
    """`settings`. Raises ValueError for what is too much for a section of a configuration."""
    for count, (depth, value) in enumerate(_values(settings, 1), start=1):
        if count > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES} values; fewer are allowed")
        if depth > MAX_DEPTH:
            raise ValueError(f"more than {MAX_DEPTH} tables and lists within each other; fewer are allowed")
        if isinstance(value, str) and len(value) > MAX_CHARACTERS:
            raise ValueError(f"a text of {len(value)} characters; at most {MAX_CHARACTERS} are allowed")
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise ValueError(f"an integer beyond ±{LARGEST_INTEGER}; smaller ones are allowed")
    return settings


def _values(node: Any, depth: int) -> Iterator[tuple[int, Any]]:
    """Everything in `node` with its depth; nothing from below MAX_DEPTH."""
    yield depth, node
    if depth <= MAX_DEPTH and isinstance(node, dict | list):
        for key in node if isinstance(node, dict) else ():
            yield depth, key
        for value in node.values() if isinstance(node, dict) else node:
            yield from _values(value, depth + 1)


Settings = Annotated[dict[str, Any], AfterValidator(_bounded)]
Name = Annotated[str, Field(max_length=100)]


class Body(BaseModel):
    """Base of request bodies."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class LockBody(Body):
    """The emergency key, where the lock is to be taken from somebody else."""

    emergency_key: Annotated[str, Field(max_length=1000)] | None = None


class ModeBody(Body):
    """A mode for all axes."""

    mode: ModeName


class ReferenceBody(Body):
    """A reference as in [axis.reference]; the file of a table lies in or below the configuration's folder."""

    axis: Name
    reference: Settings


class SetpointBody(Body):
    """A constant reference, µm (V in raw mode)."""

    axis: Name
    value: float


class WaveformBody(Body):
    """Samples, `hold_ticks` ticks each; `command_um`, as many, is added to the command of a closed loop."""

    axis: Name
    samples: Annotated[list[float], FailFast(), Field(min_length=1)]
    command_um: Annotated[list[float], FailFast()] = Field(default_factory=list)
    hold_ticks: int = Field(default=1, ge=1, le=MAX_HOLD_TICKS)
    repeat: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.command_um and len(self.command_um) != len(self.samples):
            raise ValueError(
                f"command_um: {len(self.command_um)} numbers for {len(self.samples)} samples; as many are needed"
            )
        return self

    @property
    def columns(self) -> npt.NDArray[np.float64]:
        """Samples (n, 1), or (n, 2) with what is added to the command."""
        return np.array([self.samples, self.command_um] if self.command_um else [self.samples], float).T


class ResponseBody(Body):
    """What `Asked` says: the added motion at most, in µm, the band, how long, where a light mode is expected, and
    whether the gain at rest is measured.
    """

    axis: Name
    amplitude_um: float = Field(default=Asked.amplitude_um, gt=0)
    from_hz: float | None = Field(default=None, gt=0)
    to_hz: float | None = Field(default=None, gt=0)
    duration_s: float = Field(default=Asked.duration_s, ge=1, le=60)
    period_s: float | None = Field(default=None, ge=0.05, le=10)
    near_hz: float | None = Field(default=None, gt=0)
    resonance_only: bool = False
    gain_um: float = Field(default=Asked.gain_um, ge=0)


class LearnBody(Body):
    """One period of the wanted position, in µm, a tick a sample, and how it is learned (`learning.Asked`)."""

    axis: Name
    samples: Annotated[list[float], FailFast(), Field(min_length=4)]
    cycles: int = Field(default=Taught.cycles, ge=1, le=50)
    resonance_percent: float = Field(default=Taught.resonance_percent, ge=0, lt=50)
    keep: bool = Taught.keep

    @property
    def asked(self) -> Taught:
        """As it is learned."""
        return Taught(np.array(self.samples), self.cycles, self.resonance_percent, self.keep)


class TuneBody(Body):
    """Keys of [axis.SECTION] to change."""

    axis: Name
    section: Name
    values: Annotated[Settings, Field(min_length=1)]


class ControllerBody(Body):
    """A whole [axis.controller]."""

    axis: Name
    controller: Settings


class UndoBody(Body):
    """Whose last change is taken back."""

    axis: Name
