"""Record, identify, design and run, on rigs drawn at random (`modal_rigs`). `make soak NAME=chain`.

Each rig is recorded under a slow sine and under steps, and a controller is designed as by `rtloop design auto`. The
designed configuration then runs steps of 10 µm on that rig, in virtual time, with noise and quantisation. A row tells
whether the specification is met, or by how much it is missed, or the refusal. The exit code is 1 where an error other
than a refusal occurred, a loop tripped, or a run was further than LIMITS from the promise of `check`. Settling is
printed, not judged: a notch leaves a lightly damped mode undamped, and the residual hysteresis makes it ring.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import tomlkit

import rtloop
from rtloop.analysis.closed_loop import discrete_loop
from rtloop.analysis.loop_analysis import LoopAnalysis
from rtloop.cli.auto import write_design
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.design.chain import Chain
from rtloop.design.verification.judgement import required_limits, specified_quantities
from rtloop.errors import RtloopError
from rtloop.linear.discretise import discretise_controller
from rtloop.signals import trip_causes
from tests.design.modal_rigs import RATE_HZ, SINE_S, SPECIFICATION, STEPS_S, ModalRig, modal_rig
from tests.recording.real_loop import record
from tests.soak.draws import check_draws

STEP_UM, DWELL_S = 10.0, 0.2
LIMITS = {"overshoot_percent": 20.0, "static_percent": 2.0}
"""Largest distance of a run from its promise, in percentage points."""


def main() -> int:
    """Check every drawn rig and print a line for each; return 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.draws)
    return check_draws(seeds, lambda seed, folder: design_and_run(modal_rig(seed), folder))


def design_and_run(rig: ModalRig, folder: Path) -> tuple[bool, str]:
    """Return whether the design ran as promised or was refused with code 1, and a line of text."""
    rig_text = f"{rig.hz.size} modes from {rig.hz[0]:4.0f} Hz, ζ ≥ {rig.damping.min():.4f}, delay {rig.delay_ticks}:"
    try:
        chain, designed = design_rig(rig, folder)
    except RtloopError as error:
        return error.exit_code == 1, f"{rig_text} refused, {error.exit_code}: {error}"
    running = prepare(load(designed)).checks[0].running
    assert running is not None
    trips, distances = run(designed, running)
    missed = [name for name, limit in LIMITS.items() if not abs(distances[name]) <= limit]
    text = (
        f"{rig_text} identified delay {chain.stage.dynamics.delay_ticks}, {chain.stage.dynamics.model.order} poles; "
        f"γ {chain.synthesis.achieved:.3f}, order {chain.synthesis.controller.order}; {verdict(chain)}; "
        + ", ".join(f"{name} {value:+.2f}" for name, value in distances.items())
    )
    return not trips and not missed, text + (f"; tripped: {', '.join(trips)}" if trips else "")


def design_rig(rig: ModalRig, folder: Path, order: int | None = None) -> tuple[Chain, Path]:
    """Record a rig twice and design for it as `design auto` does. Return the chain and the path of the configuration.

    Raises RtloopError.
    """
    sine = record(folder / "sine.mcap", rig.configuration(sine=True), round(SINE_S * 1000))[0]
    steps = record(folder / "steps.mcap", rig.configuration(sine=False), round(STEPS_S * RATE_HZ))[0]
    specification, out = folder / "spec.toml", folder / "designed.toml"
    specification.write_text(SPECIFICATION, encoding="utf-8")
    return write_design(sine, steps, specification, out, order=order), out


def verdict(chain: Chain) -> str:
    """Return "meets it", or each missed limit with the value of the discretised loop."""
    options = chain.design.controller
    controller = discretise_controller(
        chain.synthesis.controller, 1 / options.rate_hz, options.method, options.prewarp_hz
    )
    assert chain.design.plant is not None
    loop = discrete_loop(controller, chain.design.plant.transfer(), chain.design.plant.delay_ticks)
    specification = chain.design.specification
    values, required = specified_quantities(loop, specification), required_limits(specification)
    missed = [
        f"{name} {values[name]:.4g} for {limit.value:g}"
        for name, limit in required.items()
        if not limit.accepts(values[name])
    ]
    return "misses " + ", ".join(missed) if missed else "meets it"


def replace_reference_by_steps(text: str, levels: list[float], dwell_s: float) -> str:
    """Return a configuration's text with steps between `levels` (µm), each held for `dwell_s`, on its first axis."""
    configuration = tomlkit.parse(text).unwrap()
    configuration["axis"][0]["reference"] = {"kind": "steps", "levels": levels, "dwell_s": dwell_s}
    return tomlkit.dumps(configuration)


def run(designed: Path, promised: LoopAnalysis) -> tuple[list[str], dict[str, float]]:
    """Run a step of STEP_UM up and down. Return the trips, and the distances of the step up from the promise."""
    text = replace_reference_by_steps(designed.read_text(encoding="utf-8"), [0.0, STEP_UM, 0.0], DWELL_S)
    path = record(designed.with_name("run.mcap"), text, round(3 * DWELL_S * RATE_HZ))[0]
    recording = rtloop.load(path)
    flags = np.unique(recording["flags"])
    trips = sorted({cause for value in flags for cause in trip_causes(value)})
    start = round(DWELL_S * RATE_HZ)
    step = recording["x_true_position_um"][start + 1 : 2 * start] / STEP_UM
    final = float(np.mean(step[-200:]))
    outside = np.flatnonzero(np.abs(step / final - 1) > 0.05)
    settling_ms = 1e3 * (outside[-1] + 1 if outside.size else 0) / RATE_HZ
    return trips, {
        "settling_ms": settling_ms - 1e3 * promised.settling_time_s,
        "overshoot_percent": 100 * (float(step.max()) / final - 1) - promised.overshoot_percent,
        "static_percent": 100 * abs(final - 1) - promised.static_error_percent,
    }


if __name__ == "__main__":
    sys.exit(main())
