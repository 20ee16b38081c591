"""Options of a reference, a model for each kind: of an axis, of a [[schedule]] entry, or set by a client."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from rtloop.foundation.options import AnyKind, Numbers, Options


class HoldOptions(Options):
    """A constant. References are in µm, in V where the mode is raw."""

    kind: Literal["hold"] = "hold"
    """Selects a constant reference."""
    value: float = 0.0
    """The constant in µm, in V where the mode is raw; a position beyond the position interlock is refused."""


class StepsOptions(Options):
    """Levels held one after the other."""

    kind: Literal["steps"]
    """Selects levels that are held one after the other."""
    levels: Annotated[Numbers, Field(min_length=1)]
    """The levels in µm, in V where the mode is raw."""
    dwell_s: float = Field(gt=0)
    """Duration of each level, rounded to whole ticks; one that rounds to 0 is refused."""
    repeat: bool = True
    """Begin with the first level again after the last; with false, the last level is held."""


class TableOptions(Options):
    """Samples from a file, one number to a line (.csv, .txt) or an .npy array, `hold_ticks` ticks each.

    A second column, (n, 2), is added to the command of a closed loop, in µm.
    """

    kind: Literal["table"]
    """Selects samples from a file."""
    file: str
    """Path of the samples, relative to the configuration's folder; a file above 64 MiB is refused."""
    hold_ticks: int = Field(default=1, ge=1)
    """Ticks for which each sample is held; up to a billion."""
    repeat: bool = True
    """Begin with the first sample again after the last; with false, the last sample is held."""


class WaveOptions(Options):
    """A sine or triangle about `offset`, in µm, or in V in mode raw."""

    kind: Literal["sine", "triangle"]
    """Shape of the wave, which rises through `offset` at its phase 0."""
    amplitude: float
    """Half the distance from peak to peak, in µm, in V where the mode is raw."""
    frequency_hz: float = Field(gt=0)
    """Frequency of the wave; half of the loop's rate or more is refused."""
    offset: float = 0.0
    """Middle of the wave, in µm, in V where the mode is raw."""
    phase_deg: float = 0.0
    """Phase in the tick in which the reference begins."""


class ChirpOptions(Options):
    """A swept sine, holding its last frequency at the end."""

    kind: Literal["chirp"]
    """Selects a sine whose frequency changes with time."""
    amplitude: float
    """Half the distance from peak to peak, in µm, in V where the mode is raw."""
    start_hz: float = Field(gt=0)
    """Frequency at the beginning of the sweep; half of the loop's rate or more is refused."""
    end_hz: float = Field(gt=0)
    """Frequency at the end of the sweep, which then continues; half of the loop's rate or more is refused."""
    duration_s: float = Field(gt=0)
    """Duration of the sweep from `start_hz` to `end_hz`."""
    offset: float = 0.0
    """Middle of the sine, in µm, in V where the mode is raw."""
    logarithmic: bool = True
    """Spend equal times on each octave; with false, the frequency changes by equal amounts in equal times."""


class InputOptions(Options):
    """The voltage of an input channel as reference: volts · per_v + offset, in µm, in V where the mode is raw."""

    kind: Literal["input"]
    """Selects the voltage of an input channel, for example of a function generator."""
    channel: str
    """Name of one of the driver's input channels, such as `adc1`."""
    per_v: float
    """Reference per volt of the channel; where the mode is raw, V per V."""
    offset: float = 0.0
    """Reference at 0 V, in µm, in V where the mode is raw."""


ReferenceOptions = Annotated[
    HoldOptions | StepsOptions | TableOptions | WaveOptions | ChirpOptions | InputOptions,
    Field(discriminator="kind"),
    AnyKind,
]
