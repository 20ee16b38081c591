"""Options of one axis: [[axis]] and its tables, a model each."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from rtloop.analysis.reference import ReferencePath
from rtloop.configuration.laws import ControllerTable, FeedforwardTable
from rtloop.configuration.reference_options import HoldOptions, ReferenceOptions
from rtloop.foundation.options import Numbers, Options
from rtloop.kernel.layout import MAX_SECTIONS, MAX_TAPS
from rtloop.linear.options import Matrix, TransferOptions


class ModelOptions(TransferOptions):
    """The plant from command v to position x (both µm) that checks are made against."""

    delay_ticks: int = Field(default=0, ge=0, le=16)
    """Samples of delay beyond the sample that a held output always takes."""
    coupling: dict[str, float] = Field(default_factory=dict)
    """µm added to this axis's command, at the input of its dynamics, per µm of another axis's command; keys are names
    of axes."""


class PrefilterOptions(Options):
    """Reference pre-filter: FIR taps, then second-order sections [b0, b1, b2, a1, a2] in z."""

    taps: Numbers = ()
    """Coefficients of the FIR filter from the reference to the error, newest sample first; empty means the tap 1."""
    command_taps: Numbers = ()
    """A second row, whose output, in µm, is added to the controller's command."""
    sections: Matrix = ()
    """Second-order sections [b0, b1, b2, a1, a2] behind `taps`, one after the other; each must be stable."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require at most MAX_TAPS taps in a row, and at most MAX_SECTIONS stable sections of five numbers each."""
        taps = max(len(self.taps), len(self.command_taps))
        if taps > MAX_TAPS or len(self.sections) > MAX_SECTIONS:
            raise ValueError(
                f"{taps} taps and {len(self.sections)} sections; "
                f"allowed: up to {MAX_TAPS} taps and {MAX_SECTIONS} sections"
            )
        for section in self.sections:
            if len(section) != 5:
                raise ValueError(
                    f"a second-order section is {list(section)}; allowed: the five numbers b0, b1, b2, a1, a2"
                )
            if not np.all(np.abs(np.roots([1.0, *section[3:]])) < 1):
                raise ValueError(f"section {list(section)}: unstable; allowed: |roots| of 1 + a1/z + a2/z² below 1")
        return self

    def path(self) -> ReferencePath:
        """Return the path of the reference: `taps` (without any, the single tap 1) and sections toward the error, and
        `command_taps` toward the command."""
        return ReferencePath(
            taps=np.array(self.taps or (1.0,)),
            command_taps=np.array(self.command_taps),
            sections=np.array(self.sections, float).reshape(-1, 5),
        )


class LimitsOptions(Options):
    """Limits of command and drive."""

    drive_v: float = Field(default=10.0, gt=0)
    """Highest drive, the last limit before the output; it must lie within the driver's range."""
    drive_min_v: float | None = Field(default=None, le=0)
    """Lowest drive; -drive_v by default, 0 for an amplifier without a negative side."""
    command_um: float = Field(default=42.0, gt=0)
    """Largest magnitude of the command, limited before the feedforward."""
    slew_v_per_s: float | None = Field(default=None, gt=0)
    """Running slew; none by default, because it breaks a loop that needs fast steps."""
    trip_slew_v_per_s: float = Field(default=1000.0, gt=0)
    """Ramp of a trip, a stop and mode off."""
    bump_s: float = Field(default=0.02, gt=0)
    """Time constant with which the offset of a bumpless change of mode dies out."""
    settled_within_um: float | None = Field(default=None, gt=0)
    """An axis whose error stays larger is reported as not settled; no signal is limited. None: not judged."""

    @property
    def lowest_v(self) -> float:
        """Lowest drive in V: drive_min_v, or −drive_v where it is not set."""
        return -self.drive_v if self.drive_min_v is None else self.drive_min_v


class InterlockOptions(Options):
    """Conditions under which the loop trips. All are judged on recorded inputs."""

    sensor_min_v: float = -9.99
    """Trip when the reading is below this voltage; it must be less than `sensor_max_v`."""
    sensor_max_v: float = 9.99
    """Trip when the reading is above this voltage."""
    position_um: float = Field(default=60.0, gt=0)
    """Trip when the position is beyond ± this value; constant references beyond it are refused."""
    sample_age_us: float = Field(default=1000.0, ge=0)
    """Trip when the sample is older than this; a driver that converts in every tick reports the age 0."""
    enable_min_v: float = 2.5
    """Least voltage of the enable input that [loop] names; below it the axis trips."""
    frozen_ticks: int = Field(default=0, ge=0)
    """Trip when the reading stands still for so many ticks while the drive moves by `frozen_drive_v`; 0 is off."""
    frozen_drive_v: float = Field(default=0.5, gt=0)
    """Change of the drive since the last new reading beyond which `frozen_ticks` equal readings trip."""
    tracking_error_um: float = Field(default=5.0, gt=0)
    """Magnitude of the error in closed loop beyond which a tick counts towards `tracking_ticks`."""
    tracking_ticks: int = Field(default=0, ge=0)
    """Trip when the error is beyond `tracking_error_um` for so many ticks of closed loop; 0 is off."""
    oscillation_um: float = Field(default=4.0, gt=0)
    """Distance by which the position must turn back to count as a swing."""
    oscillation_swings: int = Field(default=0, ge=0)
    """Trip after so many reversals by more than `oscillation_um`, each within `swing_ticks`; 0 is off."""
    swing_ticks: int = Field(default=25, ge=1)
    """Longest pause between two swings; after a longer one `oscillation_swings` counts from 0 again."""
    late_us: float = Field(default=1000.0, gt=0)
    """Lateness of a tick beyond which it counts towards `late_ticks`."""
    late_ticks: int = Field(default=0, ge=0)
    """Trip when so many ticks in a row wake later than `late_us`; 0 is off."""


class MarginOptions(Options):
    """Margins below which, or |S| above which, `rtloop check` warns. `require_margin` refuses a start instead."""

    gain: float = Field(default=1.5, ge=1)
    """Gain margin, as a factor, below which `rtloop check` warns."""
    phase_deg: float = Field(default=30.0, ge=0, le=180)
    """Phase margin below which `rtloop check` warns."""
    sensitivity: float = Field(default=3.0, gt=1)
    """Largest |S| without a warning."""
    require_margin: bool = False
    """Refuse to start if the delay measured on this host uses up the loop's delay margin, or if none was measured."""


class AdaptOptions(Options):
    """`rtloop ctl retune` on a schedule, while the service holds a reference in closed loop."""

    every_s: float = Field(ge=10)
    """Interval between two measurements; it begins anew whenever the loop was stopped."""
    amplitude_um: float = Field(default=0.5, gt=0)
    """The position is moved by no more than this while the resonance is measured."""
    gain_um: float = Field(default=0.0, ge=0)
    """Distance in µm of further references, held while the gain is measured. 0: the gain is not measured, and the
    model's gain is used."""
    bound_percent: float = Field(default=10.0, gt=0, le=50)
    """A resonance or gain that differs more from the model's leaves the taps as they are."""
    within_percent: float = Field(default=1.0, ge=0, le=50)
    """The taps are made for resonances so near the measured one."""


class AxisOptions(Options):
    """An axis: its laws, model, limits, interlocks and reference."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")
    """Name of the axis, with which its signals begin (`x_position_um`); [driver.channels] has its channels by this
    name."""
    feedforward: FeedforwardTable
    """Law that turns the command in µm into the drive in V; the shipped one inverts the actuator's hysteresis."""
    controller: ControllerTable | None = None
    """Law that computes the command from reference and position in closed loop; without one this command is 0."""
    model: ModelOptions | None = None
    """Model of the plant, on which `rtloop check` computes margins; without one the loop's stability is not checked."""
    specification: str | None = None
    """File with the requirements on the loop, relative to the configuration's folder; `rtloop design verify` judges
    them."""
    margins: MarginOptions = MarginOptions.of_absent_table()
    """Margins of the loop on its model that `rtloop check` expects."""
    prefilter: PrefilterOptions = PrefilterOptions.of_absent_table()
    """Filter of the reference before the controller; by default the reference passes unchanged."""
    limits: LimitsOptions = LimitsOptions.of_absent_table()
    """Limits of command and drive, and the slew rates of the drive."""
    interlocks: InterlockOptions = InterlockOptions.of_absent_table()
    """Conditions under which the loop trips: all outputs ramp to their safe values, and the mode becomes off."""
    reference: ReferenceOptions = HoldOptions.of_absent_table()
    """Reference from the first tick on, until the schedule or a client sets another one; 0 by default."""
    adapt: AdaptOptions | None = None
    """Schedule on which the taps are made anew, with consent."""
