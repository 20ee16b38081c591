"""Strictly proper rigs drawn at random: one to six lightly damped modes side by side, up to three samples of delay,
hysteresis.

    D(s) = Σ g_i ω_i²/(s² + 2 ζ_i ω_i s + ω_i²),     Σ g_i = 1

No relation to eq (5). Frequencies 150 Hz to 3 kHz at least 15 % apart, dampings 0.002 to 0.05, gains of either sign;
the actuator makes about ±20 µm of ±10 V.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rtloop.hil.stages.hysteresis import NOMINAL_WEIGHTS_UM_PER_V, THRESHOLDS_V

RATE_HZ = 10_000
SINE_S, DWELL_S, STEPS_S = 25.0, 0.2, 0.6
STEP_V = 6.0
SPECIFICATION = """
[specification]
overshoot_percent = 5.0
static_error_percent = 0.5
settling_ms = 15.0
[specification.command]
reference_um = 10.0
command_um = 12.0
[weights]
disturbance_rule = "none"
[weights.tracking]                 # 0.2 %, 300 rad/s, 5 %: stricter than required: γ and reduction add errors
form = "zpk"
gain = 0.9523809523809523
zeros = [[-315.0, 0.0]]
poles = [[-0.6, 0.0]]
"""


class ModalRig(NamedTuple):
    """Modes (n,), delay, and weights at the thresholds of eq (4); `noise_um` None: the sensor's default noise."""

    seed: int
    hz: np.ndarray[Any, Any]
    damping: np.ndarray[Any, Any]
    gain: np.ndarray[Any, Any]
    delay_ticks: int
    weights_um_per_v: np.ndarray[Any, Any]
    noise_um: float | None = None
    command_um: float = 20.0
    bouc_wen: dict[str, float] | None = None
    """Parameters of the Bouc-Wen hysteresis that replaces the weights; None: plays with the weights."""

    @property
    def reach_um(self) -> float:
        """Displacement (µm) at 10 V after one rise from rest."""
        if self.bouc_wen is None:
            return float(np.sum(self.weights_um_per_v * (10.0 - np.array(THRESHOLDS_V))))
        d, rise, decay, lean = self.bouc_wen.values()
        return 10.0 * d - rise / (decay + lean) * (1.0 - math.exp(-10.0 * (decay + lean)))

    def configuration(self, sine: bool) -> str:
        """Return the configuration (TOML) for the slow sine at 1 kHz if `sine`, else for steps up and down, 10 kHz."""
        omega = 2 * np.pi * self.hz
        poles = np.array([complex(-z * w, w * np.sqrt(1 - z**2)) for z, w in zip(self.damping, omega, strict=True)])
        scale = float(np.exp(np.mean(np.log(omega))))
        relative = omega / scale
        factors = [np.poly1d([1.0, 2 * z * w, w**2]) for z, w in zip(self.damping, relative, strict=True)]
        numerator = np.poly1d([0.0])
        for i, w in enumerate(relative):
            other_factors = [factor for k, factor in enumerate(factors) if k != i]
            numerator += math.prod(other_factors, start=np.poly1d([self.gain[i] * w**2]))
        zeros = scale * np.roots(numerator.coeffs) if numerator.order else np.empty(0)
        leading_coefficient = float(numerator.coeffs[0]) * scale ** (2 * omega.size - numerator.order)
        dynamics = [
            f"zeros = {[[float(z.real), float(z.imag)] for z in zeros.astype(complex)]}",
            f"poles = {[[float(p.real), float(p.imag)] for p in np.concatenate([poles, poles.conj()])]}",
        ]
        reference = (
            'kind = "sine"\namplitude = 10.0\nfrequency_hz = 0.1\n'
            if sine
            else f'kind = "steps"\nlevels = [0.0, {STEP_V}, 0.0]\ndwell_s = {DWELL_S}\n'
        )
        return "\n".join([
            f'[loop]\nrate_hz = {1000 if sine else RATE_HZ}\nmode = "raw"',
            f'[driver]\nkind = "sim"\nseed = {self.seed}\nlatency_ticks = {0 if sine else self.delay_ticks}',
            '[driver.channels.x]\ninput = "adc0"\noutput = "dac0"\num_per_v = 10.0',
            self._hysteresis(),
            f'[driver.plant.dynamics]\nform = "zpk"\ngain = {leading_coefficient!r}',
            *dynamics,
            "" if self.noise_um is None else f"[driver.plant.sensor]\num_per_v = 10.0\nnoise_um = {self.noise_um!r}",
            '[[axis]]\nname = "x"',
            "[axis.feedforward]\nthresholds_v = [0.0]\nweights_um_per_v = [2.0]",
            f"[axis.limits]\ncommand_um = {self.command_um!r}",
            "[axis.interlocks]\nposition_um = 90.0",
            f"[axis.reference]\n{reference}",
        ])  # fmt: skip

    def _hysteresis(self) -> str:
        """Return the configuration's [driver.plant.hysteresis] section."""
        if self.bouc_wen is None:
            truth = f'truth = "custom"\nthresholds_v = {list(THRESHOLDS_V)}'
            return f"[driver.plant.hysteresis]\n{truth}\nweights_um_per_v = {self.weights_um_per_v.tolist()}"
        numbers = "\n".join(f"{name} = {value!r}" for name, value in self.bouc_wen.items())
        return f'[driver.plant.hysteresis]\ntruth = "bouc-wen"\n[driver.plant.hysteresis.bouc_wen]\n{numbers}'


def noisy_rig(seed: int) -> ModalRig:
    """Return a slower, noisier rig of longer stroke than `modal_rig`: 100 Hz to 2 kHz, 10 to 100 nm, about ±43 µm.

    Even seeds take the weights of eq (4) ± 30 %; odd seeds a Bouc-Wen actuator with A 5 to 20 % of d.
    """
    random = np.random.default_rng(10_000 + seed)
    modes = _modes(random, 100.0, 2000.0)
    weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * random.uniform(0.7, 1.3, len(THRESHOLDS_V))
    noise_um = float(np.exp(random.uniform(np.log(0.01), np.log(0.1))))
    if seed % 2 == 0:
        return ModalRig(seed, *modes, weights, noise_um, command_um=43.0)
    d, decay = 4.6 * random.uniform(0.8, 1.2), random.uniform(0.1, 0.4)
    lean, rise_share = decay * random.uniform(-0.5, 0.5), random.uniform(0.05, 0.2)
    numbers = {"um_per_v": d, "rise_um_per_v": rise_share * d, "decay_per_v": decay, "lean_per_v": lean}
    return ModalRig(seed, *modes, weights, noise_um, 43.0, {name: float(value) for name, value in numbers.items()})


def modal_rig(seed: int) -> ModalRig:
    """Return a rig of 150 Hz to 3 kHz, about ±20 µm and the sensor's default noise, drawn with `seed`."""
    random = np.random.default_rng(seed)
    modes = _modes(random, 150.0, 3000.0)
    weights = np.array(NOMINAL_WEIGHTS_UM_PER_V) * random.uniform(0.9, 1.1, len(THRESHOLDS_V)) * 20 / 43
    return ModalRig(seed, *modes, weights)


def _modes(
    random: np.random.Generator, lowest_hz: float, highest_hz: float
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any], int]:
    """Return frequencies (Hz), dampings and gains (n,) of random modes, and the delay in samples."""
    count, delay_ticks = int(random.integers(1, 7)), int(random.integers(0, 4))
    hz = np.empty(0)
    while hz.size != count or np.any(np.diff(np.log(hz)) < 0.15):
        hz = np.sort(np.exp(random.uniform(np.log(lowest_hz), np.log(highest_hz), count)))
    damping = np.exp(random.uniform(np.log(0.002), np.log(0.05), count))
    gain = np.append(1.0, random.uniform(0.03, 0.2, count - 1) * random.choice([-1, 1], count - 1))
    gain[1:] *= min(1.0, 0.5 / max(float(np.abs(gain[1:]).sum()), 1e-9))
    return hz, damping, gain / gain.sum(), delay_ticks
