"""What a user may say about the law: one model per part of an axis."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rtloop.hil.options import Factor, Numbers, Options, Root
from rtloop.law.hysteresis import PlayModel, play_model
from rtloop.law.layout import MAX_SECTIONS, MAX_TAPS
from rtloop.linear.transfer import Transfer

Matrix = Annotated[tuple[Numbers, ...], Field(strict=False)]


class FeedforwardOptions(Options):
    """Inverse hysteresis: the forward model's thresholds and weights (inverted by formula), or an explicit inverse."""

    thresholds_v: Numbers = ()
    weights_um_per_v: Numbers = ()
    inverse_thresholds_um: Numbers = ()
    inverse_weights_v_per_um: Numbers = ()
    dead_band: Literal["none", "exact"] = "none"
    """What is done about a first threshold r_0 > 0. `exact` leaves no residual but jumps by 2 r_0 at each reversal:
    right for smooth commands known beforehand; a noisy command (closed loop) makes it chatter."""
    dead_band_threshold_v: float = Field(default=1e-6, ge=0)
    """`exact` reverses only when the drive without dead band has turned by more than this."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.models()
        if self.dead_band == "exact" and not self.thresholds_v:
            raise ValueError("dead_band is 'exact': allowed only with thresholds_v, whose first value it needs")
        return self

    def actuator(self) -> PlayModel:
        """The forward model as it was identified, its dead band included."""
        if self.thresholds_v:
            return PlayModel(np.array(self.thresholds_v), np.array(self.weights_um_per_v))
        return self.models()[0]

    def models(self) -> tuple[PlayModel, PlayModel]:
        """Forward model and inverse, consistent with each other."""
        if bool(self.thresholds_v) == bool(self.inverse_thresholds_um):
            raise ValueError(
                "either thresholds_v with weights_um_per_v, or inverse_thresholds_um with inverse_weights_v_per_um, "
                "is needed"
            )
        if self.inverse_thresholds_um:
            inverse = play_model("inverse", self.inverse_thresholds_um, self.inverse_weights_v_per_um)
            if inverse.thresholds[0] != 0:
                raise ValueError(f"inverse_thresholds_um: the first, {inverse.thresholds[0]:g}, must be 0")
            return inverse.inverse(), inverse
        forward = play_model("forward model", self.thresholds_v, self.weights_um_per_v)
        behind = forward.without_dead_band()
        return (forward if self.dead_band == "exact" else behind), behind.inverse()


class TransferOptions(Options):
    """A transfer function in s (rad/s): factors, zeros and poles, two polynomials, or a state space."""

    form: Literal["factors", "zpk", "transfer_function", "state_space"] = "factors"
    gain: float | None = None
    numerator: Annotated[tuple[Factor | float, ...], Field(strict=False)] = ()
    denominator: Annotated[tuple[Factor | float, ...], Field(strict=False)] = ()
    zeros: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    poles: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    a: Matrix = ()
    b: Numbers = ()
    c: Numbers = ()
    d: float | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        allowed = {
            "factors": {"gain", "numerator", "denominator"},
            "zpk": {"gain", "zeros", "poles"},
            "transfer_function": {"numerator", "denominator"},
            "state_space": {"a", "b", "c", "d"},
        }
        parts = set().union(*allowed.values())
        foreign = sorted((self.model_fields_set & parts) - allowed[self.form])
        if foreign:
            raise ValueError(
                f"{', '.join(foreign)}: not part of form {self.form!r}, which takes "
                f"{', '.join(sorted(allowed[self.form]))}"
            )
        self.transfer()
        return self

    def transfer(self) -> Transfer:
        """The transfer function. Raises ValueError for an improper or malformed one."""
        if self.form == "zpk":
            zeros, poles = ([complex(*root) for root in group] for group in (self.zeros, self.poles))
            return Transfer.from_zpk(zeros, poles, self._gain())
        if self.form == "state_space":
            if self.d is None:
                raise ValueError("d: needed in a state space; 0.0 for no direct part")
            return Transfer.from_state_space(np.array(self.a), self.b, self.c, self.d)
        nested = [isinstance(part, tuple) for part in (*self.numerator, *self.denominator)]
        if self.form == "transfer_function":
            if any(nested):
                raise ValueError("numerator and denominator: lists of numbers in form 'transfer_function'")
            return Transfer.from_transfer_function(self.numerator, self.denominator)
        if not all(nested):
            raise ValueError("numerator and denominator: lists of lists of numbers in form 'factors'")
        return Transfer.from_factors(self._gain(), self.numerator, self.denominator)

    def _gain(self) -> float:
        if self.gain is None:
            raise ValueError(f"gain: needed in form {self.form!r}")
        return self.gain


class ControllerOptions(TransferOptions):
    """C(s) and how it becomes C(z)."""

    method: Literal["matched", "tustin", "foh", "zoh"] = "matched"
    prewarp_hz: float | None = Field(default=None, gt=0)
    tracking_s: float = Field(default=0.0005, ge=0)
    """Anti-windup: time constant with which the states follow a command that was limited, short against the loop's
    response. 0 is at once, which lets even a single limited tick throw the slow states off."""
    allow_unstable: bool = False
    """Run although the loop is unstable on the axis's model."""


class ModelOptions(TransferOptions):
    """The plant from command v to position x (both µm) that checks are made against."""

    delay_ticks: int = Field(default=0, ge=0, le=16)
    """Periods of delay beyond the one that a held output always takes."""


class PrefilterOptions(Options):
    """Reference pre-filter: FIR taps, then second-order sections [b0, b1, b2, a1, a2] in z."""

    taps: Numbers = ()
    sections: Matrix = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.taps) > MAX_TAPS or len(self.sections) > MAX_SECTIONS:
            raise ValueError(
                f"{len(self.taps)} taps and {len(self.sections)} sections: "
                f"at most {MAX_TAPS} and {MAX_SECTIONS} are allowed"
            )
        for section in self.sections:
            if len(section) != 5:
                raise ValueError(f"section {list(section)}: five numbers b0, b1, b2, a1, a2 are needed")
            if not np.all(np.abs(np.roots([1.0, *section[3:]])) < 1):
                raise ValueError(f"section {list(section)}: unstable; 1 + a1/z + a2/z² needs its roots within 1")
        return self


class LimitsOptions(Options):
    """What the law may ask for."""

    drive_v: float = Field(default=10.0, gt=0)
    drive_min_v: float | None = Field(default=None, le=0)
    """Lowest drive; -drive_v by default, 0 for an amplifier without a negative side."""
    command_um: float = Field(default=42.0, gt=0)
    slew_v_per_s: float | None = Field(default=None, gt=0)
    """Running slew; none by default, because it breaks a loop that needs fast steps."""
    trip_slew_v_per_s: float = Field(default=1000.0, gt=0)
    """Ramp of a trip, a stop and mode off."""
    bump_s: float = Field(default=0.02, gt=0)
    """Time constant with which the offset of a bumpless change of mode dies out."""

    @property
    def lowest_v(self) -> float:
        """Lowest drive in V."""
        return -self.drive_v if self.drive_min_v is None else self.drive_min_v


class InterlockOptions(Options):
    """When the loop must give up. All are judged on recorded inputs."""

    sensor_min_v: float = -9.99
    sensor_max_v: float = 9.99
    position_um: float = Field(default=60.0, gt=0)
    sample_age_us: float = Field(default=1000.0, ge=0)
    enable_min_v: float = 2.5
    """Where [loop] names an enable input: below it the axis trips."""
    frozen_ticks: int = Field(default=0, ge=0)
    """Trip when the reading stands still for so many ticks while the drive moves by `frozen_drive_v`; 0 is off."""
    frozen_drive_v: float = Field(default=0.5, gt=0)
    tracking_error_um: float = Field(default=5.0, gt=0)
    tracking_ticks: int = Field(default=0, ge=0)
    """Trip when the error is beyond `tracking_error_um` for so many ticks of closed loop; 0 is off."""
    oscillation_um: float = Field(default=4.0, gt=0)
    oscillation_swings: int = Field(default=0, ge=0)
    """Trip after so many reversals by more than `oscillation_um`, each within `swing_ticks`; 0 is off."""
    swing_ticks: int = Field(default=25, ge=1)
    late_us: float = Field(default=1000.0, gt=0)
    late_ticks: int = Field(default=0, ge=0)
    """Trip when so many ticks in a row wake later than `late_us`; 0 is off."""


class HoldOptions(Options):
    """A constant. References are in µm, in V where the mode is raw."""

    kind: Literal["hold"] = "hold"
    value: float = 0.0


class StepsOptions(Options):
    """Levels held one after the other."""

    kind: Literal["steps"]
    levels: Annotated[Numbers, Field(min_length=1)]
    dwell_s: float = Field(gt=0)
    repeat: bool = True


class TableOptions(Options):
    """Samples from a file, one number to a line (.csv, .txt) or an .npy array, `hold_ticks` ticks each."""

    kind: Literal["table"]
    file: str
    hold_ticks: int = Field(default=1, ge=1)
    repeat: bool = True


class WaveOptions(Options):
    """A sine or triangle about `offset`."""

    kind: Literal["sine", "triangle"]
    amplitude: float
    frequency_hz: float = Field(gt=0)
    offset: float = 0.0
    phase_deg: float = 0.0


class ChirpOptions(Options):
    """A swept sine, holding its last frequency at the end."""

    kind: Literal["chirp"]
    amplitude: float
    start_hz: float = Field(gt=0)
    end_hz: float = Field(gt=0)
    duration_s: float = Field(gt=0)
    offset: float = 0.0
    logarithmic: bool = True


class InputOptions(Options):
    """Another input channel of the driver."""

    kind: Literal["input"]
    channel: str
    per_v: float
    offset: float = 0.0


ReferenceOptions = Annotated[
    HoldOptions | StepsOptions | TableOptions | WaveOptions | ChirpOptions | InputOptions, Field(discriminator="kind")
]


class MarginOptions(Options):
    """Below, or above, these `rtloop check` warns."""

    gain: float = Field(default=1.5, ge=1)
    phase_deg: float = Field(default=30.0, ge=0, le=180)
    sensitivity: float = Field(default=3.0, gt=1)
    """Largest |S|."""


class AxisOptions(Options):
    """One axis of the law."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")
    feedforward: FeedforwardOptions
    controller: ControllerOptions | None = None
    model: ModelOptions | None = None
    specification: str | None = None
    """File, relative to the configuration's, with what the loop is asked to do; `rtloop design verify` judges it."""
    margins: MarginOptions = MarginOptions()
    prefilter: PrefilterOptions = PrefilterOptions()
    limits: LimitsOptions = LimitsOptions()
    interlocks: InterlockOptions = InterlockOptions()
    reference: ReferenceOptions = HoldOptions()
