"""What a loop is asked to do, and the weights that follow from it: the models of SPEC.toml.

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
from rtloop.hil.options import Numbers, Options
from rtloop.linear.options import TransferOptions
from rtloop.linear.transfer import Transfer


class DisturbanceOptions(Options):
    """A disturbance of `largest_um` at the output may leave an error of `error_um`."""

    largest_um: float = Field(gt=0)
    error_um: float = Field(gt=0)
    up_to_hz: float | None = Field(default=None, gt=0)
    """Up to this frequency; without it at all frequencies, as eq (18) of the paper asks."""


class CommandOptions(Options):
    """A step of the reference by `reference_um` may need a command v of `command_um`."""

    reference_um: float = Field(gt=0)
    command_um: float = Field(gt=0)


def _claim_table(value: object) -> object:
    """A claim may be its words alone."""
    return {"says": value} if isinstance(value, str) else value


class ClaimOptions(Options):
    """What a source says of a quantity: its words, and the values that bear them out."""

    says: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def is_number(self) -> bool:
        """A value can contradict it."""
        return self.at_least is not None or self.at_most is not None

    def is_borne_out(self, value: float) -> bool:
        """Whether `value` is as claimed."""
        is_above = self.at_least is None or value >= self.at_least
        return is_above and (self.at_most is None or value <= self.at_most)


class SpecificationOptions(Options):
    """Everything may be left out; what is there is judged."""

    overshoot_percent: float | None = Field(default=None, ge=0, lt=100)
    """Over the final value."""
    static_error_percent: float | None = Field(default=None, gt=0, lt=100)
    settling_ms: float | None = Field(default=None, gt=0)
    """To within 5 % of the final value."""
    bandwidth_hz: float | None = Field(default=None, gt=0)
    """|S| stays below 1/√2 up to here."""
    modulus_margin: float | None = Field(default=None, gt=0, lt=1)
    """Least distance of L from −1, which is 1/max |S|."""
    resonance_decay_ms: float | None = Field(default=None, gt=0)
    """Time constant of the slowest closed-loop mode near the resonance: what a disturbance excites there rings for so
    long. Near is from 0.55 to 1.85 times the resonance of the model."""
    resonance_shift_percent: float | None = Field(default=None, gt=0, le=50)
    """The resonance may move by so much, up and down, and the loop stays stable."""
    disturbance: DisturbanceOptions | None = None
    command: CommandOptions | None = None
    claims: dict[str, Annotated[ClaimOptions, BeforeValidator(_claim_table)]] = Field(default_factory=dict)
    """What a source says of actuator and controller, by the name of a quantity: printed beside what was found."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        unknown = sorted(set(self.claims) - set(QUANTITIES) - set(EXPERIMENT_QUANTITIES))
        if unknown:
            allowed = ", ".join((*QUANTITIES, *EXPERIMENT_QUANTITIES))
            raise ValueError(f"claims: {', '.join(unknown)} is not known; allowed are {allowed}")
        return self

    def claim_words(self, name: str) -> str:
        """The words of a claim; none where nothing is claimed."""
        return self.claims[name].says if name in self.claims else ""


QUANTITIES = {
    "static_error_percent": ("static error", "%"),
    "settling_ms": ("settling (5 %)", "ms"),
    "overshoot_percent": ("overshoot", "%"),
    "peak_command": ("peak of v per unit step", ""),
    "resonance_decay_ms": ("slowest mode near the resonance", "ms"),
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
    "noise_x_nm": ("sensor noise in x, rms, linear", "nm"),
    "noise_v_nm": ("sensor noise in v, rms, linear", "nm"),
    "gamma": ("‖F_l(P, C)‖∞", ""),
}
"""Label and unit of everything that is computed of a loop."""

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
"""What experiments find besides; docs/experiments.md says of each what it is."""


class SensorOptions(Options):
    """What measures x, beyond what the plant's model contains already."""

    noise_um: float = Field(default=0.0, ge=0)
    """White, rms."""
    resolution_um: float = Field(default=0.0, ge=0)
    bandwidth_hz: float | None = Field(default=None, gt=0)
    """First-order lag."""

    @property
    def deviation_um(self) -> float:
        """Noise and rounding together, rms: a step of resolution spreads evenly, by its width over √12."""
        return math.hypot(self.noise_um, self.resolution_um / math.sqrt(12))

    def add_sensor_lag(self, plant: Transfer) -> Transfer:
        """The plant with the sensor's lag behind it."""
        if self.bandwidth_hz is None:
            return plant
        rate = 2 * math.pi * self.bandwidth_hz
        return plant * Transfer.from_zpk([], [-rate], rate)


STEP_HEIGHTS_UM = (1.0, 5.0, 20.0, 40.0)
SAME_HEIGHT = 0.02
"""Heights that differ by no larger part than this are simulated once."""


class SimulationOptions(Options):
    """Steps that are simulated, with everything that is not linear."""

    steps_um: Annotated[Numbers, Field(min_length=1, max_length=16)] | None = None
    """Their heights; by default those of STEP_HEIGHTS_UM and specification.command.reference_um."""
    judged: bool | None = None
    """Whether they must keep static_error_percent, settling_ms and overshoot_percent; by default where residual_percent
    is given, because the simulation then has the hysteresis that the stage has."""
    residual_percent: float = Field(default=0.0, ge=0, lt=100)
    """h/H that the inverse leaves, as a compensation experiment finds it. Of a driver that is no simulated rig."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.steps_um is not None and not all(height > 0 for height in self.steps_um):
            raise ValueError(f"steps_um {list(self.steps_um)}: heights above 0 are allowed")
        return self


class WeightOptions(Options):
    """Weights of one's own, instead of those that the rules of the paper make of the specification."""

    tracking: TransferOptions | None = None
    command: TransferOptions | None = None
    disturbance: TransferOptions | None = None
    disturbance_rule: DisturbanceRule = "printed"


class SynthesisOptions(Options):
    """How the controller is computed and reduced."""

    backoff_percent: float = Field(default=0.4, gt=0, le=100)
    """How far above γ_opt: at γ_opt itself a pole of the controller runs off to infinity."""
    largest_gamma: float = Field(default=5.0, gt=0)
    """γ is the factor by which specifications are missed; beyond this they contradict each other."""
    order: int | None = Field(default=None, ge=0)
    """Of the reduced controller; by default the lowest that loses no more than `largest_loss_percent`."""
    largest_loss_percent: float = Field(default=10.0, ge=0)
    """By how much reduction may raise the norm of the weighted loop."""
    reduction: Literal["residualise", "truncate"] = "residualise"


class OutputOptions(Options):
    """What is written into [axis.controller] beside the transfer function."""

    method: Literal["matched", "tustin", "foh", "zoh"] = "matched"
    prewarp_hz: float | None = Field(default=None, gt=0)
    rate_hz: float = Field(default=10_000.0, gt=0)
    """Of the loop that will run it: it must be stable there, and roots far beyond are not written."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.prewarp_hz is not None and self.method != "tustin":
            raise ValueError(f"prewarp_hz is set, but method is {self.method!r}: allowed with 'tustin' only")
        return self


class DesignOptions(Options):
    """SPEC.toml as a whole."""

    plant: ModelOptions | None = None
    specification: SpecificationOptions = SpecificationOptions()
    sensor: SensorOptions = SensorOptions()
    simulation: SimulationOptions = SimulationOptions()
    weights: WeightOptions = WeightOptions()
    synthesis: SynthesisOptions = SynthesisOptions()
    controller: OutputOptions = OutputOptions()
    scenarios: ScenarioOptions = ScenarioOptions()
    robust: RobustOptions = RobustOptions()
    shape: ShapeOptions = ShapeOptions()

    @property
    def step_heights_um(self) -> tuple[float, ...]:
        """Heights of the steps that are simulated, as `simulation.steps_um` says."""
        if self.simulation.steps_um is not None:
            return self.simulation.steps_um
        command = self.specification.command
        if command is None or any(
            math.isclose(command.reference_um, height, rel_tol=SAME_HEIGHT) for height in STEP_HEIGHTS_UM
        ):
            return STEP_HEIGHTS_UM
        return (*STEP_HEIGHTS_UM, command.reference_um)

    @property
    def judges_simulated_steps(self) -> bool:
        """Whether simulated steps must keep the specification, as `simulation.judged` says."""
        if self.simulation.judged is not None:
            return self.simulation.judged
        return "residual_percent" in self.simulation.model_fields_set


def build_weights(design: DesignOptions) -> Weights:
    """W1, W2, W3: given ones, else by the paper's rules. Raises ValueError naming what a rule lacks."""
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


def _tracking_weight(asked: SpecificationOptions) -> Transfer:
    """Eq (15). A given bandwidth goes before the one that a settling time asks for, 3/t rad/s."""
    if asked.static_error_percent is None:
        raise ValueError("specification.static_error_percent: missing; the tracking weight needs it")
    if asked.bandwidth_hz is not None:
        rate = 2 * math.pi * asked.bandwidth_hz
    elif asked.settling_ms is not None:
        rate = 3 / (1e-3 * asked.settling_ms)
    else:
        raise ValueError("specification.settling_ms: missing, and so is bandwidth_hz; the tracking weight needs one")
    return tracking_weight(asked.static_error_percent / 100, rate, (asked.overshoot_percent or 0.0) / 100)
