"""From two recordings to a controller that runs, on rigs drawn at random (`modal_rigs`). `make soak NAME=chain`.

Each rig is recorded under a slow sine and under steps, designed for as `rtloop design auto` does, and what was written
then runs steps of 10 µm on that rig, in virtual time, with noise and quantisation on. A row says what became of it: the
specification met, or by how much it is missed; or the refusal. Ends with 1 where an error other than a refusal came,
a loop tripped, or a run was further from what `check` promises than LIMITS. Settling is shown, but not judged: a notch
leaves a lightly damped mode undamped, and what the inverse leaves of the hysteresis makes it ring.
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
from tests.soak.draws import every_draw

STEP_UM, DWELL_S = 10.0, 0.2
LIMITS = {"overshoot_percent": 20.0, "static_percent": 2.0}
"""How far a run may be from the promise."""


def main() -> int:
    """Every draw, a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.draws)
    return every_draw(seeds, lambda seed, folder: one(modal_rig(seed), folder))


def one(rig: ModalRig, folder: Path) -> tuple[bool, str]:
    """Whether the rig was designed for and ran as promised, or was refused by code 1; and what there is to say."""
    drawn = f"{rig.hz.size} modes from {rig.hz[0]:4.0f} Hz, ζ ≥ {rig.damping.min():.4f}, delay {rig.delay_ticks}:"
    try:
        chain, written = designed_for(rig, folder)
    except RtloopError as error:
        return error.exit_code == 1, f"{drawn} refused, {error.exit_code}: {error}"
    running = prepare(load(written)).checks[0].running
    assert running is not None
    trips, distances = run(written, running)
    far = [name for name, limit in LIMITS.items() if not abs(distances[name]) <= limit]
    found = (
        f"{drawn} found delay {chain.stage.dynamics.delay_ticks}, {chain.stage.dynamics.model.order} poles; "
        f"γ {chain.synthesis.achieved:.3f}, order {chain.synthesis.controller.order}; {verdict(chain)}; "
        + ", ".join(f"{name} {value:+.2f}" for name, value in distances.items())
    )
    return not trips and not far, found + (f"; tripped: {', '.join(trips)}" if trips else "")


def designed_for(rig: ModalRig, folder: Path, order: int | None = None) -> tuple[Chain, Path]:
    """Two recordings, and the configuration that `design auto` writes. Raises RtloopError."""
    sine = record(folder / "sine.mcap", rig.configuration(sine=True), round(SINE_S * 1000))[0]
    steps = record(folder / "steps.mcap", rig.configuration(sine=False), round(STEPS_S * RATE_HZ))[0]
    specification, out = folder / "spec.toml", folder / "designed.toml"
    specification.write_text(SPECIFICATION, encoding="utf-8")
    return write_design(sine, steps, specification, out, order=order), out


def verdict(chain: Chain) -> str:
    """ "meets it", or what is missed: achieved against required, as it runs."""
    output = chain.design.controller
    controller = discretise_controller(chain.synthesis.controller, 1 / output.rate_hz, output.method, output.prewarp_hz)
    assert chain.design.plant is not None
    loop = discrete_loop(controller, chain.design.plant.transfer(), chain.design.plant.delay_ticks)
    asked = chain.design.specification
    values, required = specified_quantities(loop, asked), required_limits(asked)
    missed = [
        f"{name} {values[name]:.4g} for {limit.value:g}"
        for name, limit in required.items()
        if not limit.accepts(values[name])
    ]
    return "misses " + ", ".join(missed) if missed else "meets it"


def with_steps(text: str, levels: list[float], dwell_s: float) -> str:
    """A configuration's text whose first axis follows steps between `levels` in µm, each held for `dwell_s`."""
    configuration = tomlkit.parse(text).unwrap()
    configuration["axis"][0]["reference"] = {"kind": "steps", "levels": levels, "dwell_s": dwell_s}
    return tomlkit.dumps(configuration)


def run(written: Path, promised: LoopAnalysis) -> tuple[list[str], dict[str, float]]:
    """Trips, and how far the first step of 10 µm up is from what was promised."""
    text = with_steps(written.read_text(encoding="utf-8"), [0.0, STEP_UM, 0.0], DWELL_S)
    path = record(written.with_name("run.mcap"), text, round(3 * DWELL_S * RATE_HZ))[0]
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
