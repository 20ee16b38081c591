"""Models of SPEC.toml: requirements on a loop, and the weights derived from them.

[plant]  [specification]  [specification.disturbance]  [specification.command]  [specification.claims]
[sensor]  [simulation]  [weights]  [synthesis]  [controller]  [scenarios]  [robust]  [shape]  [shape.scenarios]
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from rtloop.configuration.axis import ModelOptions
from rtloop.design.robust.options import RobustOptions, ScenarioOptions, ShapeOptions
from rtloop.design.synthesis.weights import (
    DisturbanceRule,
    Weights,
    command_weight,
    disturbance_weight,
    tracking_weight,
)
from rtloop.foundation.options import Numbers, Options
from rtloop.linear.options import TransferOptions
from rtloop.linear.transfer import Transfer


class DisturbanceOptions(Options):
    """A disturbance of `largest_um` at the output may leave an error of `error_um`."""

    largest_um: float = Field(gt=0)
    """Largest disturbance of the position."""
    error_um: float = Field(gt=0)
    """Largest error that this disturbance may leave."""
    up_to_hz: float | None = Field(default=None, gt=0)
    """Upper frequency of the disturbance; None means all frequencies, as in eq (18) of the paper."""


class CommandOptions(Options):
    """A step of the reference by `reference_um` may need a command v of `command_um`."""

    reference_um: float = Field(gt=0)
    """Height of the step, the largest one for which `rtloop design shape` makes taps."""
    command_um: float = Field(gt=0)
    """Largest command that the step may need; divided by `reference_um`, it limits the command's peak per unit step."""


def _claim_table(value: object) -> object:
    """Return {"says": value} for a claim that is only a string; any other value unchanged."""
    return {"says": value} if isinstance(value, str) else value


class ClaimOptions(Options):
    """Claim of a source about a quantity: its words, and the limits that its value must keep to confirm it."""

    says: str
    """Words of the source; a claim that has only words may be written as a text in place of a table."""
    at_least: float | None = None
    """Least value that confirms the claim, itself included; by default there is none."""
    at_most: float | None = None
    """Largest value that confirms the claim, itself included; by default there is none."""

    @property
    def is_number(self) -> bool:
        """Whether the claim has a limit that a value can contradict."""
        return self.at_least is not None or self.at_most is not None

    def is_borne_out(self, value: float) -> bool:
        """Whether `value` lies within the claim's limits, both included; True without limits."""
        is_above = self.at_least is None or value >= self.at_least
        return is_above and (self.at_most is None or value <= self.at_most)


class SpecificationOptions(Options):
    """Requirements on the loop. All are optional; those present are judged."""

    overshoot_percent: float | None = Field(default=None, ge=0, lt=100)
    """Largest overshoot, relative to the final value."""
    static_error_percent: float | None = Field(default=None, gt=0, lt=100)
    """Largest static error, relative to the step."""
    settling_ms: float | None = Field(default=None, gt=0)
    """Longest settling time, to within 5 % of the final value."""
    bandwidth_hz: float | None = Field(default=None, gt=0)
    """Least bandwidth: |S| stays below 1/√2 up to this frequency."""
    modulus_margin: float | None = Field(default=None, gt=0, lt=1)
    """Least distance of L from −1, which is 1/max |S|."""
    resonance_decay_ms: float | None = Field(default=None, gt=0)
    """Longest time constant of the closed-loop modes near the resonance (0.55 to 1.85 times the model's): the
    ringing time after a disturbance.
    """
    resonance_shift_percent: float | None = Field(default=None, gt=0, le=50)
    """Shift of the resonance, up and down, for which the loop must stay stable."""
    disturbance: DisturbanceOptions | None = None
    """Disturbance that the loop must reject; without it, none is judged, and the weight W3 is 0."""
    command: CommandOptions | None = None
    """Command that a step may need; without it, the command's peak is not judged, and no taps can be designed."""
    claims: dict[str, Annotated[ClaimOptions, BeforeValidator(_claim_table)]] = Field(default_factory=dict)
    """Claims of a source about actuator and controller, keyed by quantity; printed beside the computed values."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError for claims about other quantities than QUANTITIES and EXPERIMENT_QUANTITIES."""
        unknown = sorted(set(self.claims) - set(QUANTITIES) - set(EXPERIMENT_QUANTITIES))
        if unknown:
            allowed = ", ".join((*QUANTITIES, *EXPERIMENT_QUANTITIES))
            raise ValueError(f"claims: unknown quantity {', '.join(unknown)}; allowed: claims about {allowed}")
        return self

    def claim_words(self, name: str) -> str:
        """Return the words of the claim about quantity `name`; "" without a claim."""
        return self.claims[name].says if name in self.claims else ""


QUANTITIES = {
    "static_error_percent": ("static error", "%"),
    "settling_ms": ("settling (5 %)", "ms"),
    "overshoot_percent": ("overshoot", "%"),
    "peak_command": ("peak of v per unit step", ""),
    "resonance_decay_ms": ("longest decay at 0.55 … 1.85 × resonance", "ms"),
    "resonance_shift_percent": ("resonance may move by ±", "%"),
    "bandwidth_hz": ("bandwidth, |S| < 0.71", "Hz"),
    "disturbance_hz": ("disturbance held up to", "Hz"),
    "max_re_pole": ("largest real part of a pole", "rad/s"),
    "max_abs_pole": ("largest |pole| in z", ""),
    "crossover_hz": ("crossover", "Hz"),
    "phase_margin_deg": ("phase margin", "°"),
    "gain_margin": ("gain margin", ""),
    "modulus_margin": ("modulus margin", ""),
    "max_sensitivity": ("max |S|", ""),
    "sensitivity_1hz": ("|S| at 1 Hz", ""),
    "noise_x_nm": ("x due to sensor noise, rms, linear loop", "nm"),
    "noise_v_nm": ("v due to sensor noise, rms, linear loop", "nm"),
    "gamma": ("‖F_l(P, C)‖∞ without delay", ""),
}
"""Label and unit of each quantity computed for a loop."""

EXPERIMENT_QUANTITIES = (
    "hysteresis_percent",
    "hysteresis_um",
    "range_um",
    "hysteresis_fit",
    "open_overshoot_percent",
    "resonance_hz",
    "open_fit",
    "residual_percent",
    "residual_um",
    "slope",
    "omega_um",
    "tracking",
    "open_low_db",
    "closed_low_db",
    "closed_high_db",
    "disturbance_left_nm",
)
"""Further quantities found by experiments; docs/experiments.md describes each."""


class SensorOptions(Options):
    """Sensor of x, beyond the part that the plant's model already contains."""

    noise_um: float = Field(default=0.0, ge=0)
    """White noise of the sensor, rms."""
    resolution_um: float = Field(default=0.0, ge=0)
    """Step of the sensor's reading; 0 for a sensor without steps."""
    bandwidth_hz: float | None = Field(default=None, gt=0)
    """Bandwidth of a first-order lag."""

    @property
    def deviation_um(self) -> float:
        """Noise and rounding combined, in µm rms; the rounding error is uniform over one step of resolution, so that
        its rms is `resolution_um`/√12.
        """
        return math.hypot(self.noise_um, self.resolution_um / math.sqrt(12))

    def add_sensor_lag(self, plant: Transfer) -> Transfer:
        """Return the plant in series with the sensor's lag; the plant itself if `bandwidth_hz` is None."""
        if self.bandwidth_hz is None:
            return plant
        rate = 2 * math.pi * self.bandwidth_hz
        return plant * Transfer.from_zpk([], [-rate], rate)


STEP_HEIGHTS_UM = (1.0, 5.0, 20.0, 40.0)
"""Default heights of the simulated steps."""
SAME_HEIGHT = 0.02
"""Heights with a smaller relative difference are simulated once."""


class SimulationOptions(Options):
    """Steps simulated with all nonlinear effects."""

    steps_um: Annotated[Numbers, Field(min_length=1, max_length=16)] | None = None
    """Heights of the steps; default STEP_HEIGHTS_UM and specification.command.reference_um."""
    judged: bool | None = None
    """Whether simulated steps must meet static_error_percent, settling_ms and overshoot_percent. Default: those of
    specification.command.reference_um; all if steps_um or residual_percent is given.
    """
    residual_percent: float = Field(default=0.0, ge=0, lt=100)
    """Hysteresis h/H left by the inverse, as a compensation experiment measures it. For drivers other than a
    simulated rig.
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError unless all step heights are above 0."""
        if self.steps_um is not None and not all(height > 0 for height in self.steps_um):
            raise ValueError(f"steps_um: {list(self.steps_um)}; allowed: heights above 0 µm")
        return self


class WeightOptions(Options):
    """User-defined weights, in place of those derived from the specification by the paper's rules."""

    tracking: TransferOptions | None = None
    """Weight W1 of the error, in place of that from settling time, bandwidth, overshoot and static error, eq (15)."""
    command: TransferOptions | None = None
    """Weight W2 of the command, in place of that from `specification.command`, eq (17)."""
    disturbance: TransferOptions | None = None
    """Weight W3 of the disturbance, in place of that from `specification.disturbance`."""
    disturbance_rule: DisturbanceRule = "printed"
    """Rule for W3: "printed" as eq (19) of the paper has it, "implied" as eq (18) implies, "none" for 0."""


class SynthesisOptions(Options):
    """Options for computing and reducing the controller."""

    backoff_percent: float = Field(default=0.4, gt=0, le=100)
    """Margin of γ over γ_opt in percent: at γ_opt a pole of the controller goes to infinity."""
    largest_gamma: float = Field(default=5.0, gt=0)
    """Largest γ accepted. γ is the factor by which specifications are missed; beyond this they contradict each other.
    """
    order: int | None = Field(default=None, ge=0)
    """Order of the reduced controller; default the lowest that loses at most `largest_loss_percent`."""
    largest_loss_percent: float = Field(default=10.0, ge=0)
    """Largest increase of the weighted loop's norm by the reduction."""
    reduction: Literal["residualise", "truncate"] = "residualise"
    """Reduction of the order: "residualise" keeps the controller's gain at 0 Hz, "truncate" its gain at infinity."""


class OutputOptions(Options):
    """Discretisation options written to [axis.controller] beside the transfer function."""

    method: Literal["matched", "tustin", "foh", "zoh"] = "matched"
    """Rule that makes C(z) of C(s), as `method` of a controller in the configuration."""
    prewarp_hz: float | None = Field(default=None, gt=0)
    """Frequency at which "tustin" keeps the response of C(s); with other methods it is refused."""
    rate_hz: float = Field(default=10_000.0, gt=0)
    """Rate of the loop that will run the controller: the controller must be stable at it, and roots far above it are
    omitted.
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError if `prewarp_hz` is set with another method than "tustin"."""
        if self.prewarp_hz is not None and self.method != "tustin":
            raise ValueError(
                f"prewarp_hz is set, but method is {self.method!r}; remove prewarp_hz, or set method = 'tustin'"
            )
        return self


class DesignOptions(Options):
    """Whole content of SPEC.toml."""

    plant: ModelOptions | None = None
    """Model of the plant, from command to position; required for synthesis, and for verification of an axis without a
    model."""
    specification: SpecificationOptions = SpecificationOptions()
    """Requirements on the loop; an absent requirement is not judged."""
    sensor: SensorOptions = SensorOptions()
    """Noise, resolution and bandwidth of the sensor, for predictions of noise and for simulated steps."""
    simulation: SimulationOptions = SimulationOptions()
    """Steps that are simulated with hysteresis, converters and limits."""
    weights: WeightOptions = WeightOptions()
    """Weights of the H∞ problem; by default they follow from the requirements."""
    synthesis: SynthesisOptions = SynthesisOptions()
    """Accepted γ, and order of the reduced controller."""
    controller: OutputOptions = OutputOptions()
    """Rate and discretisation of the controller that is written."""
    scenarios: ScenarioOptions = ScenarioOptions()
    """Plants around the model that a robust controller must tolerate."""
    robust: RobustOptions = RobustOptions()
    """Limits and effort of the search for a robust controller."""
    shape: ShapeOptions = ShapeOptions()
    """Number of taps for fast steps, the steps' limits, and plants that they must fit."""

    @property
    def required_plant(self) -> ModelOptions:
        """Model of the plant. Raises ValueError without one."""
        if self.plant is None:
            raise ValueError("plant: missing; add a section [plant], the stage's model from command to position in µm")
        return self.plant

    @property
    def step_heights_um(self) -> tuple[float, ...]:
        """Heights of the simulated steps in µm, not sorted: `simulation.steps_um`, else STEP_HEIGHTS_UM and, as the
        last, the reference step of `specification.command`, if it is given and not within SAME_HEIGHT of one of them.
        """
        if self.simulation.steps_um is not None:
            return self.simulation.steps_um
        command = self.specification.command
        if command is None or any(
            math.isclose(command.reference_um, height, rel_tol=SAME_HEIGHT) for height in STEP_HEIGHTS_UM
        ):
            return STEP_HEIGHTS_UM
        return (*STEP_HEIGHTS_UM, command.reference_um)

    @property
    def counted_heights_um(self) -> tuple[float, ...]:
        """Heights of the simulated steps that must meet the specification: `simulation.judged` says all or none.

        Without it, all if `simulation` names heights or a residual hysteresis, else those of `specification.command`.
        """
        simulation, command = self.simulation, self.specification.command
        if simulation.judged is not None:
            return self.step_heights_um if simulation.judged else ()
        if simulation.model_fields_set & {"steps_um", "residual_percent"}:
            return self.step_heights_um
        return tuple(
            height
            for height in self.step_heights_um
            if command and math.isclose(command.reference_um, height, rel_tol=SAME_HEIGHT)
        )


def build_weights(design: DesignOptions) -> Weights:
    """Build W1, W2, W3: user-defined ones, otherwise by the paper's rules.

    Without `specification.command`, the rule of W2 takes a command as large as the reference; without a disturbance,
    W3 is 0. Raises ValueError if the rule of W1 lacks the static error, or has neither settling time nor bandwidth, and
    if a rule has to invert a W1 with fewer zeros than poles.
    """
    own_weights, specification = design.weights, design.specification
    tracking = own_weights.tracking.transfer() if own_weights.tracking else _tracking_weight(specification)
    if own_weights.command:
        command = own_weights.command.transfer()
    else:
        moderation = (
            specification.command.command_um / specification.command.reference_um if specification.command else 1.0
        )
        command = command_weight(tracking, moderation)
    if own_weights.disturbance:
        disturbance = own_weights.disturbance.transfer()
    else:
        disturbance_options = specification.disturbance
        ratio = disturbance_options.error_um / disturbance_options.largest_um if disturbance_options else 1.0
        disturbance = disturbance_weight(
            tracking, ratio, own_weights.disturbance_rule if disturbance_options else "none"
        )
    return Weights(tracking, command, disturbance)


def _tracking_weight(specification: SpecificationOptions) -> Transfer:
    """Return the tracking weight, eq (15). A bandwidth has priority over 3/t rad/s from the settling time t.

    Raises ValueError if the static error is missing, or if bandwidth and settling time are both missing.
    """
    if specification.static_error_percent is None:
        raise ValueError(
            "specification.static_error_percent: missing; set this number, or the tracking weight W1 in "
            "[weights.tracking]"
        )
    if specification.bandwidth_hz is not None:
        rate = 2 * math.pi * specification.bandwidth_hz
    elif specification.settling_ms is not None:
        rate = 3 / (1e-3 * specification.settling_ms)
    else:
        raise ValueError(
            "specification.settling_ms, bandwidth_hz: both missing; set one of them, or the tracking weight W1 in "
            "[weights.tracking]"
        )
    return tracking_weight(
        specification.static_error_percent / 100, rate, (specification.overshoot_percent or 0.0) / 100
    )
