"""Promise of the axis's model for a harmonic response: figures for the verdicts, curves for the picture."""

from __future__ import annotations

import numpy as np

from rtloop.experiments.linear_model import LinearModel
from rtloop.foundation.arrays import Real

REFERENCE_HZ = 595.5
"""Frequency in place of the resonance for an axis without a model, or without a resonance."""
RESONANCE_BAND = (0.89, 1.11)
HALF_POWER_DB = 20 * np.log10(np.sqrt(2))

Curve = tuple[str, bool, Real, Real]
"""Label, whether dashed, frequencies in Hz, values in dB."""


class HarmonicPromise:
    """Predicted figures; None for every figure without a model, of the closed loop also without a stable loop.

    `resonance_hz` is the model's, or REFERENCE_HZ without one; `near_hz` is a band (from, to) in Hz about it.
    """

    def __init__(self, model: LinearModel | None, measured_hz: Real, rate_hz: float) -> None:
        """Compute the responses of `model` on a grid that covers the resonance and `measured_hz` (n,), which rise.

        No response is computed for a `model` of None.
        """
        self._model = model
        self.resonance_hz = (model and model.resonance_hz) or REFERENCE_HZ
        self.near_hz = RESONANCE_BAND[0] * self.resonance_hz, RESONANCE_BAND[1] * self.resonance_hz
        highest_hz = min(max(float(measured_hz[-1]), 10.0), 0.499 * rate_hz)
        resonance_grid = np.linspace(*self.near_hz, 500)
        grid = np.union1d(
            np.geomspace(min(0.01, measured_hz[0]), highest_hz, 3000), resonance_grid[resonance_grid <= 0.499 * rate_hz]
        )
        self._hz, self._measured_hz = grid, measured_hz
        tracking = model.tracking(grid) if model else None
        self._closed_db = None if tracking is None else 20 * np.log10(np.abs(tracking))
        self._open_db = None if model is None else 20 * np.log10(np.abs(model.plant(grid) / model.static_gain))

    @property
    def peak_hz(self) -> float | None:
        """Frequency in Hz of the plant's largest response; None without a model or for a model without resonance."""
        if self._open_db is None or self._model is None or not self._model.resonance_hz:
            return None
        return float(self._hz[self._open_db.argmax()])

    @property
    def peak_db(self) -> float | None:
        """Largest response of the plant at the measured frequencies, in dB relative to its static gain.

        None without a model or for a model without resonance.
        """
        if self._model is None or not self._model.resonance_hz:
            return None
        return float(20 * np.log10(np.abs(self._model.plant(self._measured_hz) / self._model.static_gain).max()))

    @property
    def closed_low_db(self) -> float | None:
        """Response of the model's closed loop at the lowest measured frequency, in dB.

        None without a model or for a model without a stable loop.
        """
        tracking = self._model.tracking(self._measured_hz[0]) if self._model else None
        return None if tracking is None else float(20 * np.log10(abs(tracking[0])))

    @property
    def bandwidth_hz(self) -> float | None:
        """Frequency in Hz at which the model's closed loop is first 3 dB below its response at the lowest frequency.

        None if the response does not fall so far, without a model, and for a model without a stable loop.
        """
        if self._closed_db is None:
            return None
        attenuated = np.flatnonzero(self._closed_db < self._closed_db[0] - HALF_POWER_DB)
        return float(self._hz[attenuated[0]]) if attenuated.size else None

    def closed_db_beyond(self, hz: float) -> float | None:
        """Largest response in dB of the model's closed loop at the measured frequencies from `hz` on.

        None without such a frequency, without a model, and for a model without a stable loop.
        """
        high = self._measured_hz[self._measured_hz >= hz]
        tracking = self._model.tracking(high) if self._model and high.size else None
        return None if tracking is None else float(20 * np.log10(np.abs(tracking).max()))

    def curves(self, shifts_db: tuple[float | None, ...]) -> list[Curve]:
        """Return curves (label, dashed, Hz, dB): the plant's response shifted by each of `shifts_db`, then the loop's.

        A shift of None has no curve. Without a model there is no curve, without a stable loop no curve of the loop.
        """
        curves: list[Curve] = []
        for shift_db in shifts_db:
            if self._open_db is not None and shift_db is not None:
                label = "" if curves else "model: dynamics, hysteresis at this amplitude"
                curves.append((label, True, self._hz, self._open_db + shift_db))
        if self._closed_db is not None:
            curves.append(("model: closed loop", False, self._hz, self._closed_db))
        return curves
