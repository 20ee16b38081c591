"""The simulated rig with another true plant, the loops on it, and figures of their steps, between ticks too."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtloop.configuration.checks import AxisCheck, Findings, check_axes
from rtloop.configuration.file import Configuration, load
from rtloop.configuration.rig import driver_delay_ticks
from rtloop.design.robust.options import ScenarioOptions
from rtloop.design.robust.programme import Taps
from rtloop.design.robust.scenarios import Family, Scenario
from rtloop.design.robust.shape import Subject, design_taps
from rtloop.design.robust.subject import build_subject
from rtloop.design.synthesis.specification import DesignOptions
from rtloop.design.synthesis.specification_file import load_specification
from rtloop.design.verification.bench import Bench
from rtloop.design.verification.simulation import LIMIT_FLAGS, POINTS
from rtloop.foundation.arrays import Real
from rtloop.hil.options import DynamicsOptions, RigOptions
from rtloop.hil.rig import zeros_poles_gain
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.transfer import Transfer
from rtloop.recording.views.steps import step_metrics
from rtloop.signals import trip_causes
from tests.recording.real_loop import ROOT

DEPLOY = ROOT / "deploy"
RATE_HZ, PERIOD_S = 1e4, 1e-4
LEVELS_UM = (0.0, 10.0, 0.0, 20.0, -20.0, 20.0, 40.0, 0.0, -40.0)
"""Rest, then eight steps: 10, 10, 20, 40, 40, 20, 40, 40 µm."""
DWELL_S, SHORT_S = 0.3, 0.1
"""Durations (s) of a level: where static errors are judged, and for hundreds of runs."""
NOMINAL = Scenario((0.0,), 1.0, 0.0, 0)
TRUTH = Family(Transfer(*zeros_poles_gain(DynamicsOptions())), 0, ScenarioOptions(), PERIOD_S)
"""Eq (5) and the plants around it: true dynamics of the rig, which no loop knows."""


class Steps(NamedTuple):
    """Figures of a run. `table` has a row for each step: height (µm), settling (ms), overshoot and static error (%).
    `peak_v` is the largest |u|; `limited` and `trips` name the limits that acted and the trips.
    """

    table: Real
    peak_v: float
    limited: tuple[str, ...]
    trips: tuple[str, ...]

    @property
    def settling_ms(self) -> float:
        """Longest settling time; infinite after a trip."""
        return np.inf if self.trips else float(self.table[:, 1].max())

    def overshoot(self, height_um: float | None = None) -> float:
        """Return the largest overshoot (%), of steps of one height or of all; infinite after a trip."""
        rows = self.table if height_um is None else self.table[self.table[:, 0] == height_um]
        return np.inf if self.trips else float(rows[:, 2].max())

    @property
    def static_percent(self) -> float:
        """Largest static error; infinite after a trip."""
        return np.inf if self.trips else float(self.table[:, 3].max())


def shifted_plant(percent: float) -> Scenario:
    """Return the nominal plant with its resonance shifted by `percent`."""
    return NOMINAL._replace(resonance=(percent,))


def load_loop(name: str) -> Configuration:
    """Load a configuration of deploy/."""
    return load(DEPLOY / f"{name}.toml")


def specification() -> DesignOptions:
    """Load the specification of deploy/robust.toml."""
    return load_specification(DEPLOY / "robust-spec.toml").design


def axis_check(configuration: Configuration) -> AxisCheck:
    """Return the check of a configuration's only axis."""
    (check,) = check_axes(configuration, Findings())
    return check


def linear_controller(configuration: Configuration) -> DiscreteController:
    """Return C(z) of a configuration's only axis."""
    controller = axis_check(configuration).linear
    assert isinstance(controller, DiscreteController)
    return controller


def replace_sections(configuration: Configuration, **sections: Any) -> Configuration:
    """Return a configuration with other sections of its only axis."""
    (axis,) = configuration.axes
    return replace(configuration, axes=(axis.model_copy(update=sections),))


def replace_taps(configuration: Configuration, taps: Taps) -> Configuration:
    """Return a configuration with both rows of taps replaced."""
    rows = {"taps": tuple(taps.reference.tolist()), "command_taps": tuple(taps.command.tolist())}
    return replace_sections(configuration, prefilter=configuration.axes[0].prefilter.model_copy(update=rows))


def rig_bench(
    configuration: Configuration, truth: Scenario = NOMINAL, seed: int = 1, noise_um: float | None = None, **plant: Any
) -> Bench:
    """Return a bench of the rig with this true plant; `plant`: further sections of the rig, such as a disturbance."""
    options = configuration.driver_options
    assert isinstance(options, RigOptions)
    if truth != NOMINAL:
        plant["dynamics"] = _dynamics(truth)
    if noise_um is not None:
        plant["sensor"] = options.plant.sensor.model_copy(update={"noise_um": noise_um})
    rig = options.model_copy(update={"seed": seed, "plant": options.plant.model_copy(update=plant)})
    return Bench(replace(configuration, driver_options=rig), {})


def run_steps(bench: Bench, dwell_s: float = DWELL_S) -> Steps:
    """Run eight steps; return the figures of each."""
    run = bench.run("x", LEVELS_UM, dwell_s)
    position, reference = bench.true_positions(run, "x").ravel(), np.repeat(run["x_reference_um"], POINTS)
    starts = np.flatnonzero(np.diff(reference)) + 1
    rows = []
    for start, end in zip(starts, [*starts[1:], reference.size], strict=True):
        metrics = step_metrics(reference[start - 1 : end], position[start - 1 : end], POINTS * RATE_HZ)
        if metrics is not None:
            height = abs(reference[start] - reference[start - 1])
            rows.append((height, metrics.settling_time_ms, metrics.overshoot_percent, metrics.static_error_percent))
    flags = int(np.bitwise_or.reduce(run["flags"].astype(np.int64)))
    return Steps(
        np.array(rows), float(np.abs(run["x_drive_v"]).max()),
        tuple(name for flag, name in LIMIT_FLAGS.items() if flags & flag), tuple(trip_causes(flags)),
    )  # fmt: skip


def trace_step(bench: Bench, height_um: float) -> tuple[Real, Real]:
    """Run one step from rest. Return the time since the step (ms) and the position (µm), between ticks too."""
    run = bench.run("x", (0.0, height_um), DWELL_S)
    position = bench.true_positions(run, "x").ravel()[round(DWELL_S * RATE_HZ) * POINTS :]
    return np.arange(position.size) / np.float64(POINTS * RATE_HZ / 1e3), position


def tap_subject(configuration: Configuration) -> Subject:
    """Return the subject for which taps of a configuration are designed, by the specification of robust.toml."""
    return build_subject(
        configuration.axes[0], axis_check(configuration), specification(), driver_delay_ticks(configuration)
    )


def design_taps_within(
    subject: Subject, plant: Transfer, within_percent: float, overshoot: float, settling_ms: float | None = None
) -> Taps:
    """Design both rows of taps for a resonance within `within_percent` of the plant's. Raises NoDesign."""
    scenarios = ScenarioOptions(resonance_percent=within_percent, damping=(1.0,), gain_percent=0.0)
    options = subject.options.model_copy(update={"settling_ms": settling_ms, "scenarios": scenarios})
    return design_taps(replace(subject, plant=plant, overshoot=overshoot, options=options)).taps


def write_shifted_configuration(
    configuration_name: str, truth_percent: float, folder: Path, gain_percent: float = 0.0
) -> Path:
    """Write a configuration of deploy/ with shifts of the rig's resonance and gain; return its path.

    Its specification is copied beside it.
    """
    text = (DEPLOY / f"{configuration_name}.toml").read_text(encoding="utf-8")
    text = text.replace("# [driver.plant.dynamics]", "[driver.plant.dynamics]")
    text = text.replace("# resonance_shift = 0.0", "resonance_shift = 0.0")
    assert text.count("resonance_shift = 0.0") == 1
    path = folder / f"{configuration_name}{truth_percent:+g}{gain_percent:+g}.toml"
    lines = f"resonance_shift = {truth_percent / 100}"
    if gain_percent:
        values = _dynamics(NOMINAL._replace(gain=gain_percent)).model_dump(mode="json", exclude_unset=True)
        lines += "".join(f"\n{name} = {json.dumps(value)}" for name, value in values.items())
    path.write_text(text.replace("resonance_shift = 0.0", lines))
    for name in ("robust-spec.toml", "paper-spec.toml"):
        (folder / name).write_bytes((DEPLOY / name).read_bytes())
    return path


def _dynamics(truth: Scenario) -> DynamicsOptions:
    """Return the rig's dynamics with another true plant."""
    plant = TRUTH.plant(truth)
    zeros, poles = ([(root.real, root.imag) for root in roots.tolist()] for roots in (plant.zeros, plant.poles))
    return DynamicsOptions(form="zpk", gain=plant.gain, zeros=tuple(zeros), poles=tuple(poles))
