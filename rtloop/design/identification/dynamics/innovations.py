"""ARMAX prediction error in modal coordinates: one-step-ahead errors of a model, and how they depend on it.

    y = G u + H ε + offset,     G = B/A = Σ r_i / (z − λ_i),     H = C/A = 1 + Σ k_i / (z − λ_i),     λ = exp((σ + jω)T)
    ε = H⁻¹ (y − G u − offset),     dε = −H⁻¹ (dG u + dH ε + d offset)

This is the ARMAX model A y = B u + C ε (Ljung, System Identification, 1999, section 4.2) with orders
na = nb = nc = n and one sample of delay, but its unknowns are modes and not coefficients of polynomials, which span
many powers of ten where slow and fast poles meet. A mode is filtered as a first-order recursion, H⁻¹ as sections of
second order; no product is expanded. Before the first sample everything is at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter, sosfilt

from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.modal import ModalSystem


@dataclass(frozen=True)
class Innovations:
    """A model y = G u + H ε + offset, sampled every `period_s`: G = Σ r/(z − λ), H = 1 + Σ k/(z − λ) with white noise
    ε.

    `rates` (m,), log(λ)/T in rad/s, have one of each pair, real ones with imaginary part 0. The residues r (m,) and the
    noise gains k (m,) belong to these poles; the sums include the conjugates. Before the first sample all is at rest.
    """

    period_s: float
    rates: Complex
    residues: Complex
    noise_gains: Complex
    offset: float = 0.0

    @property
    def order(self) -> int:
        """Number of poles, conjugates included."""
        return int(np.where(self.rates.imag != 0, 2, 1).sum())

    @property
    def z_poles(self) -> Complex:
        """Poles λ in z (m,), one of each pair."""
        return np.exp(self.rates * self.period_s)

    @property
    def static_gain(self) -> float:
        """Gain G at z = 1, output per input at rest."""
        return float((_pair_weights(self) * self.residues / (1 - self.z_poles)).sum().real)

    def discrete(self) -> ModalSystem:
        """Return G, the model without noise and offset, as a sum over all modes in z, conjugates included.

        It has one output and no direct gain.
        """
        pairs = self.rates.imag != 0
        poles = np.concatenate([self.z_poles, self.z_poles[pairs].conj()])
        residues = np.concatenate([self.residues, self.residues[pairs].conj()])
        return ModalSystem(poles, residues[None, :], np.zeros(1))

    def simulate_output(self, u: Real) -> Real:
        """Return the model's output G u + offset for the input `u` (samples,), without noise, in the shape of `u`."""
        return (
            self.offset
            + (_pair_weights(self)[:, None] * self.residues[:, None] * _mode_responses(self, u)).sum(axis=0).real
        )

    def predictor_poles(self) -> Complex:
        """Return the poles in z (n,), conjugates included, of H⁻¹, the inverse of the noise model.

        They are inside the unit circle for a usable model.
        """
        blocks, columns, rows = np.zeros((self.order, self.order)), np.zeros(self.order), np.zeros(self.order)
        i = 0
        for rate, z_pole, gain in zip(self.rates, self.z_poles, self.noise_gains, strict=True):
            blocks[i, i], columns[i], rows[i] = z_pole.real, gain.real, 1.0
            if rate.imag:
                blocks[i : i + 2, i : i + 2] = [[z_pole.real, -z_pole.imag], [z_pole.imag, z_pole.real]]
                columns[i + 1], rows[i] = gain.imag, 2.0
                i += 1
            i += 1
        return np.linalg.eigvals(blocks - np.outer(columns, rows)).astype(complex)

    def whiten(self, signals: Real, poles: Complex) -> Real:
        """Return each of `signals` (k, samples) filtered from rest by the inverse noise model H⁻¹; unchanged if H = 1.

        `poles` (n,) are the `predictor_poles`.
        """
        if not self.order or not np.any(self.noise_gains):
            return signals
        pairs = self.rates.imag != 0
        zeros = np.concatenate([self.z_poles, self.z_poles[pairs].conj()])
        sections = np.concatenate([_factors(zeros), _factors(poles)], axis=1)
        return np.asarray(sosfilt(sections, signals), dtype=float)

    def errors(self, u: Real, y: Real) -> Real | None:
        """Return the one-step-ahead prediction errors ε (samples,) for input `u` and output `y`, from rest.

        None where the predictor is unstable or a pole or noise gain is not finite.
        """
        if not np.all(np.isfinite([*self.z_poles, *self.noise_gains])):
            return None
        poles = self.predictor_poles()
        if np.any(np.abs(poles) >= 1):
            return None
        return self.whiten(y - self.simulate_output(u), poles)

    def sensitivities(self, u: Real, errors: Real, *, noise: bool) -> Real:
        """Return the derivative of the prediction errors ε by each unknown, (unknowns, samples), as `pack` orders them.

        `errors` (samples,) are ε for the input `u` (samples,). They are used only with `noise`, which adds the noise
        gains to the unknowns; without `noise`, the effect of the rates on H is left out.
        """
        through_input = _mode_responses(self, u)
        through_noise = _mode_responses(self, errors) if noise else through_input
        rows: list[Real] = []
        for i, z_pole in enumerate(self.z_poles):
            pole_response = self.residues[i] * _mode_response(z_pole, through_input[i])
            if noise:
                pole_response = pole_response + self.noise_gains[i] * _mode_response(z_pole, through_noise[i])
            gradients = [
                self.period_s * z_pole * pole_response,
                through_input[i],
                *([through_noise[i]] if noise else []),
            ]
            pair = self.rates[i].imag != 0
            rows += [row for part in gradients for row in (_pair_gradient(part) if pair else [part.real])]
        rows.append(np.ones(u.size))
        return -self.whiten(np.array(rows), self.predictor_poles())

    def pack(self, *, noise: bool) -> Real:
        """Return the unknowns mode by mode: rate, residue and, if `noise`, noise gain (a real number each, for a pair
        real and imaginary part); then the offset.
        """
        values: list[float] = []
        for i, rate in enumerate(self.rates):
            for number in (rate, self.residues[i], *([self.noise_gains[i]] if noise else [])):
                values += [number.real, number.imag] if rate.imag != 0 else [number.real]
        return np.array([*values, self.offset])

    def unpack(self, values: Real, *, noise: bool) -> Innovations:
        """Return the model with the unknowns `values`, in the order of `pack`; pairs stay pairs, real modes stay real.

        Without `noise`, the noise gains stay, and `values` lack them.
        """
        unknowns: list[list[complex]] = []
        numbers = iter(values[:-1].tolist())
        for rate in self.rates:
            pair = rate.imag != 0
            unknowns.append([complex(next(numbers), next(numbers) if pair else 0.0) for _ in range(3 if noise else 2)])
        columns = np.array(unknowns, dtype=complex).reshape(len(unknowns), 3 if noise else 2).T
        gains = columns[2] if noise else self.noise_gains
        return Innovations(self.period_s, columns[0], columns[1], gains, float(values[-1]))


def _factors(roots: Complex) -> Real:
    """Return factors 1 + a z⁻¹ + b z⁻² (sections, 3) with these `roots` (n,), pairs first by rising angle, then real
    ones from the smallest on; the last factor of an odd number of real roots has b = 0.

    `scipy.signal.zpk2sos` gives the same product, with neighbours beside each other, in a hundred times the time.
    """
    upper = roots[roots.imag > 0]
    upper = upper[np.argsort(np.angle(upper))]
    real = np.sort(roots[roots.imag == 0].real)
    real = np.append(real, [0.0] * (real.size % 2)).reshape(-1, 2)
    sums, products = -2 * upper.real, upper.real**2 + upper.imag**2
    second = np.concatenate([sums, -real.sum(axis=1)])
    return np.column_stack([np.ones(second.size), second, np.concatenate([products, real.prod(axis=1)])])


def _pair_weights(model: Innovations) -> Real:
    """Return weights (m,): 2 for each pair, whose conjugate is not in the model, and 1 for each real mode."""
    return np.where(model.rates.imag != 0, 2.0, 1.0)


def _mode_responses(model: Innovations, signal: Real) -> Complex:
    """Return each mode's response 1/(z − λ) to `signal`, (m, samples)."""
    return np.array([_mode_response(z_pole, signal) for z_pole in model.z_poles]).reshape(model.rates.size, signal.size)


def _mode_response(z_pole: complex, signal: Real | Complex) -> Complex:
    """Return the response of 1/(z − `z_pole`) to `signal`, (samples,), from rest."""
    return np.asarray(lfilter([0.0, 1.0], [1.0, -z_pole], signal), dtype=complex)


def _pair_gradient(response: Complex) -> list[Real]:
    """Return two rows (samples,): the derivatives of 2 Re(w·response) by the real and the imaginary part of w."""
    return [2 * response.real, -2 * response.imag]
