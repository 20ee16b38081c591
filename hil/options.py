"""Options of the rig: pydantic models of the configuration's keys, with units in their names.

They check values and their combinations. `rtloop.hil.rig.build_rig` checks the rest: repeated poles, improper dynamics,
names of axes.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from rtloop.foundation.options import Factor, Numbers, Options, Root
from rtloop.hil.stages.converters import MAX_LATENCY
from rtloop.hil.stages.creep import MAX_LAGS
from rtloop.hil.stages.hysteresis import MAX_PLAYS


class BoucWenOptions(Options):
    """Bouc-Wen model, y = d·u − h, dh/dt = A·du/dt − B·|du/dt|·h − Γ·du/dt·|h| (Wen 1976, of order 1)."""

    um_per_v: float = Field(gt=0)
    """Displacement per volt, d in the equation."""
    rise_um_per_v: float = Field(gt=0)
    """Initial slope of h, A in the equation; h tends to A/(B + Γ)."""
    decay_per_v: float = Field(gt=0, le=10)
    """Decay of h, B in the equation."""
    lean_per_v: float = Field(default=0.0)
    """Asymmetry Γ of the equation, −B … B; beyond, h would grow without bound."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError unless |lean_per_v| ≤ decay_per_v; beyond, h would grow without bound."""
        if abs(self.lean_per_v) > self.decay_per_v:
            raise ValueError(
                f"lean_per_v: {self.lean_per_v:g}; allowed: -{self.decay_per_v:g} to {self.decay_per_v:g}, "
                "the value of decay_per_v"
            )
        return self


class HysteresisOptions(Options):
    """Hysteresis of the actuator: a named Prandtl-Ishlinskii model, own thresholds and weights, or Bouc-Wen."""

    truth: Literal["residual", "nominal", "custom", "bouc-wen"] = "residual"
    """Model of the actuator: "residual" leaves 3.75 % of hysteresis behind the inverse of eq (4), "nominal" is eq (4)
    itself, "custom" takes the two lists below, "bouc-wen" the table `bouc_wen`."""
    thresholds_v: Numbers = ()
    """Thresholds of the play operators, in ascending order from 0 or more, with `truth` "custom" only."""
    weights_um_per_v: Numbers = ()
    """Weights of the play operators, one for each threshold."""
    bouc_wen: BoucWenOptions | None = None
    """Parameters of the Bouc-Wen model, with `truth` "bouc-wen" only."""
    history_v: Numbers = ()
    """Drives in V before the actuator came to rest at 0 V; it starts with the memory of these drives."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError unless the numbers for this `truth` are present, and the numbers for others are absent.

        'bouc-wen' needs `bouc_wen`; 'custom' needs 1 to MAX_PLAYS increasing `thresholds_v` ≥ 0 with as many weights.
        """
        if self.truth != "bouc-wen":
            self._require_unset("truth", "bouc-wen", "bouc_wen")
        elif self.bouc_wen is None:
            raise ValueError("bouc_wen: missing; truth = 'bouc-wen' needs the table bouc_wen")
        if self.truth != "custom":
            self._require_unset("truth", "custom", "thresholds_v", "weights_um_per_v")
            return self
        thresholds, weights = self.thresholds_v, self.weights_um_per_v
        if not 1 <= len(thresholds) <= MAX_PLAYS:
            raise ValueError(f"thresholds_v has {len(thresholds)} numbers; allowed: 1 to {MAX_PLAYS}")
        if len(weights) != len(thresholds):
            raise ValueError(
                f"weights_um_per_v has {len(weights)} numbers; allowed: one for each of {len(thresholds)} thresholds"
            )
        if thresholds[0] < 0 or any(b <= a for a, b in pairwise(thresholds)):
            raise ValueError(f"thresholds_v: {list(thresholds)} V; allowed: increasing numbers, 0 or more")
        return self


class DynamicsOptions(Options):
    """Vibration x/y = D(s): eq (5) of the paper, or factors in s, or zeros and poles in rad/s."""

    form: Literal["paper", "factors", "zpk"] = "paper"
    """How D(s) is written: "paper" is eq (5); the other forms take their keys."""
    gain: float | None = None
    """Factor on the whole function, required with the forms "factors" and "zpk"; it is not the gain at 0 Hz."""
    numerator: Annotated[tuple[Factor, ...], Field(strict=False)] = ()
    """Factors of the numerator such as [1, 2, 500] for s² + 2 s + 500, with the form "factors"."""
    denominator: Annotated[tuple[Factor, ...], Field(strict=False)] = ()
    """Factors of the denominator, as for `numerator`."""
    zeros: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    """Zeros in rad/s, each as [real, imaginary], with the form "zpk"."""
    poles: Annotated[tuple[Root, ...], Field(strict=False)] = ()
    """Poles in rad/s, each as [real, imaginary], with the form "zpk"."""
    resonance_shift: float = Field(default=0.0, ge=-0.9, le=9.0)
    """Relative shift of the resonance's frequency; damping ratio and D(0) stay."""
    damping_factor: float = Field(default=1.0, gt=0, le=100)
    """Factor on the resonance's damping ratio, which stays below 1; |pole| and D(0) stay."""
    gain_factor: float = Field(default=1.0, gt=0, le=100)
    """Factor on D(s), and so on the actuator's stroke."""

    def __hash__(self) -> int:
        """Return a hash of all values, so that equal options find their coefficients in a cache."""
        return hash(tuple(vars(self).values()))

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError for factors, zeros or poles that this `form` does not use, and for a factor whose first
        number is 0.

        Also raise it for a `gain` that is missing with 'factors' or 'zpk', or given with 'paper'.
        """
        if self.form != "factors":
            self._require_unset("form", "factors", "numerator", "denominator")
        if self.form != "zpk":
            self._require_unset("form", "zpk", "zeros", "poles")
        if (self.gain is None) != (self.form == "paper"):
            raise ValueError(
                f"gain is {self.gain} with form {self.form!r}; the forms 'factors' and 'zpk' need a gain, "
                "the form 'paper' takes none"
            )
        for factor in (*self.numerator, *self.denominator):
            if factor[0] == 0:
                raise ValueError(
                    f"a factor of numerator or denominator is {list(factor)}; allowed: a first number other than 0"
                )
        return self


class CreepOptions(Options):
    """Creep y·(1 + Σ gain/(1 + time_constant·s)); without gains there is no creep."""

    gains: Numbers = ()
    """Final growth of a step in each lag, relative to the step."""
    time_constants_s: Numbers = ()
    """Time constant of each lag, one for each gain."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError for another number of gains than of time constants, for more than MAX_LAGS, and for a time
        constant of 0 or less.
        """
        gains, constants = self.gains, self.time_constants_s
        if len(gains) > MAX_LAGS or len(gains) != len(constants):
            raise ValueError(
                f"gains has {len(gains)} numbers, time_constants_s has {len(constants)}; "
                f"allowed: equal counts, at most {MAX_LAGS}"
            )
        if any(constant <= 0 for constant in constants):
            raise ValueError(f"time_constants_s: {list(constants)} s; allowed: numbers above 0")
        return self


class SensorOptions(Options):
    """Scale, offset, noise, resolution and bandwidth of the displacement sensor."""

    um_per_v: float = 10.0
    """Scale; negative for a sensor that is mounted or wired the wrong way round."""
    offset_um: float = 0.0
    """Distance that the sensor adds to the position."""
    noise_um: float = Field(default=0.010, ge=0)
    """White noise, rms. The paper states none; the default is one step of resolution: the last digit flickers."""
    resolution_um: float = Field(default=0.010, ge=0)
    """Step of the reading, 10 nm for the paper's sensor; 0 for a sensor without steps."""
    bandwidth_hz: float | None = Field(default=None, gt=0)
    """First-order lag; by default no lag: D(s) was identified through the sensor and contains its lag."""

    @field_validator("um_per_v")
    @classmethod
    def _check_scale(cls, um_per_v: float) -> float:
        """Return the scale. Raises ValueError for 0: a sensor of 0 µm/V has no reading."""
        if um_per_v == 0:
            raise ValueError("value is 0, and a sensor with a scale of 0 has no reading; allowed: numbers other than 0")
        return um_per_v


class ConverterOptions(Options):
    """An ADC or a DAC from `min_v` to `range_v`; 0 bits is an ideal converter, which only clips to its range."""

    range_v: float = Field(default=10.0, gt=0)
    """Highest voltage; the converter clips beyond it."""
    min_v: float | None = Field(default=None, le=0)
    """Lowest voltage, below which the converter clips, by default minus `range_v`; 0 for a range of one sign."""
    bits: int = Field(default=16, ge=0, le=32)
    """Resolution of the converter; with 0 it has no steps."""

    @property
    def lowest_v(self) -> float:
        """Lowest voltage: `min_v`, or −`range_v` where it is not set."""
        return -self.range_v if self.min_v is None else self.min_v


class DisturbanceOptions(Options):
    """Disturbance Ω added to the actuator's displacement from `start_s` on: a step and a sine."""

    step_um: float = 0.0
    """Constant part of the disturbance."""
    sine_um: float = 0.0
    """Amplitude of the sine in µm."""
    sine_hz: float = Field(default=1.0, gt=0)
    """Frequency of the sine; half of the loop's rate or more is refused."""
    start_s: float = Field(default=0.0, ge=0, le=1e9)
    """Time from the rig's start to the disturbance."""


class FaultOptions(Options):
    """A fault of the rig from `start_s` on: the reading stands still or becomes 0 V, or the actuator gets 0 V."""

    kind: Literal["none", "sensor_stuck", "sensor_lost", "drive_lost"] = "none"
    """The fault: the reading repeats its last value, the reading becomes 0 V, or the actuator gets 0 V."""
    start_s: float = Field(default=0.0, ge=0, le=1e9)
    """Time from the rig's start to the fault."""


class PlantOptions(Options):
    """Options of one axis of the rig; the defaults are the paper's plant."""

    hysteresis: HysteresisOptions = HysteresisOptions.of_absent_table()
    """Hysteresis from drive to displacement, the first stage of the actuator."""
    creep: CreepOptions = CreepOptions.of_absent_table()
    """Slow growth of the displacement after a change; by default none."""
    disturbance: DisturbanceOptions = DisturbanceOptions.of_absent_table()
    """Displacement that is added before the dynamics; by default none."""
    dynamics: DynamicsOptions = DynamicsOptions.of_absent_table()
    """Vibration of the displacement, with the resonance."""
    sensor: SensorOptions = SensorOptions.of_absent_table()
    """Sensor of the position, which the controller reads."""
    adc: ConverterOptions = ConverterOptions.of_absent_table()
    """Converter from the sensor's voltage to the reading."""
    dac: ConverterOptions = ConverterOptions.of_absent_table()
    """Converter from the drive to the voltage at the actuator."""
    fault: FaultOptions = FaultOptions.of_absent_table()
    """Fault that begins during the run; by default none."""


class RigOptions(Options):
    """Options of the rig: `plants.AXIS` for the axes that have it, `plant` for the others."""

    plant: PlantOptions = PlantOptions.of_absent_table()
    """Plant of every axis that `plants` does not name."""
    plants: dict[str, PlantOptions] = Field(default_factory=dict)
    """Plants of single axes by their names; a key that is absent there has its own default, not the value in
    `plant`."""
    seed: int = Field(default=0, ge=0)
    """Seed of all noise; each axis has a separate stream, determined by its name."""
    coupling: dict[str, dict[str, float]] = Field(default_factory=dict)
    """`coupling.X.Y`: displacement of axis X in µm, before the dynamics, per µm of axis Y. By default the axes are
    independent."""
    loopback: int = Field(default=0, ge=0, le=16)
    """Number of further channel pairs after the axes' pairs; input adc<n> reads the value written to output dac<n>."""
    latency_ticks: int = Field(default=0, ge=0, le=MAX_LATENCY)
    """Additional delay in periods. With 0, the reading of tick k + 1 is the first to show the drive of tick k."""


class BoardOptions(RigOptions):
    """Options of a rig behind a board's clock, with losses between board and controller."""

    dropped_share: float = Field(default=0.0, ge=0, le=1)
    """Probability that a sample is lost: the controller gets the previous sample, whose age grows."""
    repeated_share: float = Field(default=0.0, ge=0, le=1)
    """Probability that a sample has the previous value and a new time: its age does not show it."""

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        """Raise ValueError if the sum of `dropped_share` and `repeated_share` is above 1."""
        if self.dropped_share + self.repeated_share > 1:
            raise ValueError(
                f"dropped_share {self.dropped_share:g} and repeated_share {self.repeated_share:g}; "
                "allowed: a sum of at most 1"
            )
        return self
