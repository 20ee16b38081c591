"""The project's rig with another truth, the loops that run on it, and what their steps come to, between ticks too."""

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
"""Of a level: where static errors are judged, and where hundreds of runs are."""
NOMINAL = Scenario((0.0,), 1.0, 0.0, 0)
TRUTH = Family(Transfer(*zeros_poles_gain(DynamicsOptions())), 0, ScenarioOptions(), PERIOD_S)
"""Eq (5), and every plant around it: the rig's dynamics, which no loop is told."""


class Steps(NamedTuple):
    """Of each step its height in µm, settling in ms, overshoot and static error in %; over all the largest |u| in V,
    what limited and what tripped.
    """

    table: Real
    peak_v: float
    limited: tuple[str, ...]
    trips: tuple[str, ...]

    @property
    def settling_ms(self) -> float:
        """The slowest."""
        return np.inf if self.trips else float(self.table[:, 1].max())

    def overshoot(self, height_um: float | None = None) -> float:
        """The largest in %, of steps of one height or of all."""
        rows = self.table if height_um is None else self.table[self.table[:, 0] == height_um]
        return np.inf if self.trips else float(rows[:, 2].max())

    @property
    def static_percent(self) -> float:
        """The largest."""
        return np.inf if self.trips else float(self.table[:, 3].max())


def shifted(percent: float) -> Scenario:
    """Another resonance, all else as it is."""
    return NOMINAL._replace(resonance=(percent,))


def loop(name: str) -> Configuration:
    """One of those in deploy/."""
    return load(DEPLOY / f"{name}.toml")


def specification() -> DesignOptions:
    """Of deploy/robust.toml."""
    return load_specification(DEPLOY / "robust-spec.toml").design


def check_of(configuration: Configuration) -> AxisCheck:
    """Of its one axis."""
    (check,) = check_axes(configuration, Findings())
    return check


def controller_of(configuration: Configuration) -> DiscreteController:
    """C(z) of its one axis."""
    found = check_of(configuration).linear
    assert isinstance(found, DiscreteController)
    return found


def changed(configuration: Configuration, **sections: Any) -> Configuration:
    """With other sections of its one axis."""
    (axis,) = configuration.axes
    return replace(configuration, axes=(axis.model_copy(update=sections),))


def with_taps(configuration: Configuration, taps: Taps) -> Configuration:
    """With both rows."""
    rows = {"taps": tuple(taps.reference.tolist()), "command_taps": tuple(taps.command.tolist())}
    return changed(configuration, prefilter=configuration.axes[0].prefilter.model_copy(update=rows))


def bench(
    configuration: Configuration, truth: Scenario = NOMINAL, seed: int = 1, noise_um: float | None = None, **plant: Any
) -> Bench:
    """On the rig with this truth; `plant` are further sections of it, such as a disturbance."""
    given = configuration.driver_options
    assert isinstance(given, RigOptions)
    if truth != NOMINAL:
        plant["dynamics"] = _dynamics(truth)
    if noise_um is not None:
        plant["sensor"] = given.plant.sensor.model_copy(update={"noise_um": noise_um})
    rig = given.model_copy(update={"seed": seed, "plant": given.plant.model_copy(update=plant)})
    return Bench(replace(configuration, driver_options=rig), {})


def steps(on: Bench, dwell_s: float = DWELL_S) -> Steps:
    """Eight of them, each judged by itself."""
    run = on.run("x", LEVELS_UM, dwell_s)
    position, reference = on.true_positions(run, "x").ravel(), np.repeat(run["x_reference_um"], POINTS)
    starts = np.flatnonzero(np.diff(reference)) + 1
    rows = []
    for start, end in zip(starts, [*starts[1:], reference.size], strict=True):
        one = step_metrics(reference[start - 1 : end], position[start - 1 : end], POINTS * RATE_HZ)
        if one is not None:
            height = abs(reference[start] - reference[start - 1])
            rows.append((height, one.settling_time_ms, one.overshoot_percent, one.static_error_percent))
    ever = int(np.bitwise_or.reduce(run["flags"].astype(np.int64)))
    return Steps(
        np.array(rows), float(np.abs(run["x_drive_v"]).max()),
        tuple(name for flag, name in LIMIT_FLAGS.items() if ever & flag), tuple(trip_causes(ever)),
    )  # fmt: skip


def trace(on: Bench, height_um: float) -> tuple[Real, Real]:
    """Time since it in ms, and the position in µm, between ticks too, of one step from rest."""
    run = on.run("x", (0.0, height_um), DWELL_S)
    position = on.true_positions(run, "x").ravel()[round(DWELL_S * RATE_HZ) * POINTS :]
    return np.arange(position.size) / np.float64(POINTS * RATE_HZ / 1e3), position


def subject(configuration: Configuration) -> Subject:
    """What taps of it are made for, by its specification."""
    return build_subject(
        configuration.axes[0], check_of(configuration), specification(), driver_delay_ticks(configuration)
    )


def taps_for(
    about: Subject, plant: Transfer, within_percent: float, overshoot: float, settling_ms: float | None = None
) -> Taps:
    """Both rows, for a resonance within so much of a plant's. Raises NoDesign."""
    scenarios = ScenarioOptions(resonance_percent=within_percent, damping=(1.0,), gain_percent=0.0)
    options = about.options.model_copy(update={"settling_ms": settling_ms, "scenarios": scenarios})
    return design_taps(replace(about, plant=plant, overshoot=overshoot, options=options)).taps


def written(configuration_name: str, truth_percent: float, folder: Path, gain_percent: float = 0.0) -> Path:
    """A file of one of deploy/'s loops on a rig whose resonance and gain are elsewhere, for what runs files."""
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
    """The rig's dynamics with another truth."""
    there = TRUTH.plant(truth)
    zeros, poles = ([(root.real, root.imag) for root in roots.tolist()] for roots in (there.zeros, there.poles))
    return DynamicsOptions(form="zpk", gain=there.gain, zeros=tuple(zeros), poles=tuple(poles))
