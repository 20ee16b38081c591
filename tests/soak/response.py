"""A service measures its own loop on rigs whose transfer function is known. `make soak NAME=response`.

Five rigs without hysteresis, or behind an inverse that takes all of it: gain margin within 2 %, phase margin within 2°,
and the true position, as it was recorded, within the stated amplitude. Then the paper's resonance moved by −10 … +10 %
with 10 nm and 100 nm of sensor noise: how far off the frequency is that `ctl resonance` finds, in percent. Last, the
paper's rig with the hysteresis that its inverse leaves, where nothing is promised: what a small motion sees. Ends with
1 where one of the promises is missed. The oracle is of scipy and of poles and zeros alone.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rtloop
from tests.design.measured_loops import RATE_HZ, TrueLoop, margins_of
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

PERIOD_S, HELD_UM, AMPLITUDE_UM = 1 / RATE_HZ, 5.0, 0.5
EQ_5_GAIN = -20.7
EQ_5_NUMERATOR = ([1.0, -1.22e5], [1.0, 2.99e4], [1.0, -2.776e4], [1.0, -1.07e4], [1.0, 1430.0], [1.0, 4.3e4, 3.2e9])
EQ_5_DENOMINATOR = ([1.0, 925.0, 4.59e5], [1.0, 55.0, 1.4e7], [1.0, 1.54e4, 4.0e9], [1.0, 964.0, 3.95e9])
EQ_20_GAIN = 0.016
EQ_20_NUMERATOR = ([1.0, 7.9e6], [1.0, 971.0, 4.6e5], [1.0, 43.0, 1.4e7])
EQ_20_DENOMINATOR = ([1.0, 8.8e4], [1.0, 974.0], [1.0, 1.0], [1.0, 1153.0, 1.6e7])
PREWARP_HZ = 595.5
RESONANCE_HZ = float(np.sqrt(1.4e7)) / (2 * np.pi)
SHIFTS = (-0.10, -0.05, 0.0, 0.05, 0.10)
NEEDED_PERCENT = {0.010: 0.06, 0.100: 0.25}
PLAIN = "thresholds_v = [0.0]\nweights_um_per_v = [4.3]\n"
PAPER = Path(__file__).resolve().parents[2] / "deploy" / "paper.toml"


def eq_5(shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Zeros, poles and gain, the resonance moved at constant damping and D(0)."""
    zeros, poles = (np.concatenate([np.roots(one) for one in part]) for part in (EQ_5_NUMERATOR, EQ_5_DENOMINATOR))
    moved = np.abs(np.abs(poles) - np.sqrt(1.4e7)) < 1.0
    assert moved.sum() == 2
    return zeros, np.where(moved, (1 + shift) * poles, poles), EQ_5_GAIN * (1 + shift) ** 2


def held(zeros: np.ndarray, poles: np.ndarray, gain: float, delay_ticks: int) -> Callable[[np.ndarray], np.ndarray]:
    """D(z) behind a zero-order hold by partial fractions: Σ r (e^{pT} − 1)/p / (z − e^{pT}), delayed."""
    residues = [gain * np.prod(p - zeros) / np.prod([p - q for q in np.delete(poles, i)]) for i, p in enumerate(poles)]
    images = np.exp(poles * PERIOD_S)

    def plant(hz: np.ndarray) -> np.ndarray:
        z = np.exp(2j * np.pi * hz * PERIOD_S)
        parts = (r * (a - 1) / p / (z - a) for r, p, a in zip(residues, poles, images, strict=True))
        return sum(parts) * z**-delay_ticks

    return plant


def eq_20(hz: np.ndarray) -> np.ndarray:
    """C(z) by Tustin's rule, prewarped: C(s) at s = w₀/tan(w₀T/2)·(z − 1)/(z + 1)."""
    rate = 2 * np.pi * PREWARP_HZ / np.tan(np.pi * PREWARP_HZ * PERIOD_S)
    s = 1j * rate * np.tan(np.pi * hz * PERIOD_S)
    top = np.prod([np.polyval(one, s) for one in EQ_20_NUMERATOR], axis=0)
    return EQ_20_GAIN * top / np.prod([np.polyval(one, s) for one in EQ_20_DENOMINATOR], axis=0)


def integral(ki_per_s: float, hz: np.ndarray) -> np.ndarray:
    """C(z) of the law `pid` with nothing but k_i."""
    return ki_per_s * PERIOD_S / (np.exp(2j * np.pi * hz * PERIOD_S) - 1)


class Case(NamedTuple):
    """A rig as text, and L."""

    name: str
    text: str
    loop: Callable[[np.ndarray], np.ndarray]
    near_hz: float


def configuration(dynamics: str, controller: str, delay_ticks: int, noise_um: float = 0.010) -> str:
    """A rig without hysteresis."""
    return f"""[loop]
rate_hz = {RATE_HZ:g}
[driver]
kind = "sim"
seed = 5
latency_ticks = {delay_ticks}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
[driver.plant.hysteresis]
truth = "custom"
{PLAIN}[driver.plant.sensor]
noise_um = {noise_um}
[driver.plant.dynamics]
{dynamics}
[[axis]]
name = "x"
[axis.feedforward]
{PLAIN}[axis.controller]
{controller}
[axis.reference]
kind = "hold"
value = {HELD_UM}
[recording]
folder = "FOLDER/recordings"
"""


def of_one_mode(loop: TrueLoop) -> Case:
    """A mode and the law `pid`."""
    omega = 2 * np.pi * loop.hz
    dynamics = (
        f'form = "factors"\ngain = {omega**2!r}\ndenominator = [[1.0, {2 * loop.damping * omega!r}, {omega**2!r}]]'
    )
    controller = f'kind = "pid"\nkp = {loop.kp}\nki_per_s = {loop.ki_per_s}'
    name = f"{loop.hz:g} Hz, ζ {loop.damping:g}, delay {loop.delay_ticks}, PI {loop.kp:g}, {loop.ki_per_s:g}/s"
    return Case(name, configuration(dynamics, controller, loop.delay_ticks), loop.open, 1.03 * loop.hz)


def of_eq_5(shift: float, delay_ticks: int, ki_per_s: float, noise_um: float = 0.010) -> Case:
    """The paper's dynamics with its resonance moved, and an integrator."""
    plant = held(*eq_5(shift), delay_ticks)
    text = configuration(f"resonance_shift = {shift}", f'kind = "pid"\nki_per_s = {ki_per_s}', delay_ticks, noise_um)
    name = f"eq (5) {100 * shift:+.0f} %, delay {delay_ticks}, I {ki_per_s:g}/s, {1000 * noise_um:g} nm"
    return Case(name, text, lambda hz: plant(hz) * integral(ki_per_s, hz), RESONANCE_HZ)


def of_the_paper(truth: str, dead_band: str) -> Case:
    """deploy/paper.toml at rest, on an actuator that is, or is not, that of its inverse."""
    text = PAPER.read_text()
    start, end = text.index("[axis.reference]"), text.index("# [[schedule]]")
    text = f'{text[:start]}[axis.reference]\nkind = "hold"\nvalue = {HELD_UM}\n{text[end:]}'
    for old, new in (
        ('truth = "residual"', f'truth = "{truth}"'), ('dead_band = "none"', f'dead_band = "{dead_band}"'),
        ('specification = "paper-spec.toml"', ""), ('folder = "recordings"', 'folder = "FOLDER/recordings"'),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new, 1)
    plant = held(*eq_5(), 0)
    return Case(
        f"the paper's loop, {truth}, dead band {dead_band}", text, lambda hz: plant(hz) * eq_20(hz), RESONANCE_HZ
    )


def measured(case: Case, body: dict[str, Any]) -> tuple[dict[str, Any], float]:
    """The answer of a service on this rig, and how far the true position went."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Bench(folder, board=False, text=case.text.replace("FOLDER", name)) as bench:
            bench.await_state("running")
            wait_for(lambda: bench.status()["tick"] > 0.5 * RATE_HZ, "a loop at rest")
            first = bench.status()["tick"]
            found = bench.client.post("/response", {"axis": "x", "near_hz": case.near_hz, **body}, 120.0)
            last = bench.status()["tick"]
            path = next((folder / "recordings").glob("*.mcap.part"))
            wait_for(lambda: rtloop.load(path)["tick"][-1] >= last, "the ticks")
            position_um = rtloop.load(path)["x_true_position_um"]
    rest_um = position_um[first - round(0.2 * RATE_HZ) : first].mean()
    return found, float(np.abs(position_um[first:last] - rest_um).max())


def margins_on(case: Case, *, promised: bool = True) -> bool:
    """Whether margins and motion are as promised; a line."""
    found, moved_um = measured(case, {"amplitude_um": AMPLITUDE_UM})
    true = margins_of(case.loop, found["from_hz"], found["to_hz"])
    gain, phase, modulus = (found["margins"][one] for one in ("gain_margin", "phase_margin_deg", "modulus_margin"))
    gain_off, modulus_off = (100 * (one["value"] / true[name] - 1) for one, name in
                             ((gain, "gain_margin"), (modulus, "modulus_margin")))  # fmt: skip
    phase_off = phase["value"] - true["phase_margin_deg"]
    good = abs(gain_off) < 2 and abs(phase_off) < 2 and moved_um <= AMPLITUDE_UM
    print(
        f"{case.name}: gain margin {gain['value']:.4g} ± {gain['std']:.2g} ({gain_off:+.2f} %), phase margin "
        f"{phase['value']:.2f} ± {phase['std']:.2g} ° ({phase_off:+.2f}°), modulus margin {modulus['value']:.4f} "
        f"({modulus_off:+.2f} %), moved {moved_um:.3f} µm{'' if good or not promised else '  BAD'}",
        flush=True,
    )
    return good


def resonance_on(shift: float, noise_um: float) -> bool:
    """Whether the resonance is found as well as retuning needs; a line."""
    case = of_eq_5(shift, 1, 40.0, noise_um)
    found, moved_um = measured(case, {"amplitude_um": AMPLITUDE_UM, "duration_s": 2.0, "resonance_only": True})
    mode, true_hz = found["resonance"], (1 + shift) * RESONANCE_HZ
    off = 100 * (mode["hz"] / true_hz - 1) if mode else np.nan
    good = abs(off) <= NEEDED_PERCENT[noise_um] and moved_um <= AMPLITUDE_UM
    said = f"{mode['hz']:.3f} ± {mode['hz_std']:.2g} Hz, damping {mode['damping']:.5f}" if mode else "none"
    print(f"{case.name}: {said} ({off:+.4f} %), moved {moved_um:.3f} µm{'' if good else '  BAD'}", flush=True)
    return good


def main() -> int:
    """All of it."""
    cases = (
        of_the_paper("nominal", "exact"),
        of_eq_5(0.10, 1, 400.0),
        of_one_mode(TrueLoop(320.0, 0.01, 2, 25.0)),
        of_one_mode(TrueLoop(1500.0, 0.02, 1, 500.0, kp=0.02)),
        of_one_mode(TrueLoop(150.0, 0.02, 0, 20.0)),
    )
    good = [margins_on(case) for case in cases]
    good += [resonance_on(shift, noise_um) for noise_um in NEEDED_PERCENT for shift in SHIFTS]
    for case in (of_the_paper("residual", "none"), of_the_paper("nominal", "none")):
        print("not promised:", end=" ")
        margins_on(case, promised=False)
    print(f"{len(good)} measurements, {good.count(False)} bad")
    return int(not all(good))


if __name__ == "__main__":
    sys.exit(main())
