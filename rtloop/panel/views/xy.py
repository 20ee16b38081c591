"""Drive against position of an axis, and the loop that its model of the hysteresis draws over the same drive."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions
from rtloop.panel.rest_detector import MODE, is_at_rest, reference_signal
from rtloop.panel.views.frames import pack_frame
from rtloop.panel.views.service import Description
from rtloop.panel.views.subscriptions import XySubscription
from rtloop.panel.views.tick_history import BLOCK, TickHistory

KIND = "prandtl_ishlinskii"
BINS = 1000
"""Stretches of time, of each of which the extremes of drive and position are shown: 4 points at most."""
NEW_PART = 50
"""One part in so many of what is shown."""
MODEL_BINS, SHAPE_BINS = 150, 500
WARM_BINS = 100
"""The drive before, as coarse as that, is what the model remembers."""


class XyPlot:
    """What `wish` shows. Raises ValueError for an axis that the loop does not have."""

    def __init__(self, subscription: XySubscription, loop: Description) -> None:
        if subscription.axis not in loop.axes:
            raise ValueError(f"xy.axis: {subscription.axis!r}; {', '.join(loop.axes)} are there")
        self._subscription = subscription
        self._ticks = max(round(subscription.seconds * loop.rate_hz), 2)
        self._signals = [f"{subscription.axis}_drive_v", f"{subscription.axis}_position_um"]
        self._rest_signals = [reference_signal(subscription.axis), MODE]
        self._model = play_model(loop.axes[subscription.axis])
        self._shown = (-1, 0)
        """Run and last tick of what was shown."""

    def frame(self, past: TickHistory) -> bytes | None:
        """The last seconds; None before a part of them is new."""
        first, end = past.end - self._ticks, past.end
        if self._shown[0] == past.run and end < self._shown[1] + self._ticks / NEW_PART:
            return None
        self._shown = past.run, end
        drive, position = past.values(self._signals, first, end)
        at_rest = is_at_rest(*past.values(self._rest_signals, first, end))
        valid = np.isfinite(drive) & np.isfinite(position)
        drive, position = drive[valid], position[valid]
        indices = extreme_indices([drive, position], BINS)
        header: dict[str, Any] = {
            "axis": self._subscription.axis,
            "run": past.run,
            "end": end,
            "at_rest": at_rest,
            "loop_percent": None,
        }
        arrays = {"drive_v": drive[indices], "position_um": position[indices]}
        if drive.size and np.ptp(drive) > 0 and not at_rest:
            percent = loop_shape(bin_means(drive, SHAPE_BINS), bin_means(position, SHAPE_BINS)).percent
            header["loop_percent"] = percent if np.isfinite(percent) else None
        if self._model is not None and drive.size:
            arrays |= self._model_curve(past, first, drive, position, header)
        return pack_frame("xy", header, arrays)

    def _model_curve(
        self, past: TickHistory, first: int, drive: Real, position: Real, header: dict[str, Any]
    ) -> dict[str, Real]:
        """The model's loop, moved to where the measured one lies; `offset_um` says by how much."""
        assert self._model is not None
        indices = extreme_indices([drive], MODEL_BINS)
        earlier_drive = self._earlier_drive(past, first)
        model_position = model_output(self._model, np.concatenate([earlier_drive, drive[indices]]))[
            earlier_drive.size :
        ]
        offset_um = float(np.mean(position[indices]) - np.mean(model_position))
        header["offset_um"] = offset_um
        return {"model_drive_v": drive[indices], "model_position_um": model_position + offset_um}

    def _earlier_drive(self, past: TickHistory, first: int) -> Real:
        """The drive before tick `first`: coarsely, and every tick from where points, which are whole blocks, end."""
        if first <= 0:
            return np.zeros(0)
        block_tick = first // BLOCK * BLOCK
        earlier_points = past.points(self._signals[:1], max(first - 4 * self._ticks, 0), block_tick, WARM_BINS)
        (latest,) = past.values(self._signals[:1], block_tick, first)
        return np.concatenate(
            [order_extremes(earlier_points.low[0], earlier_points.high[0]), latest[np.isfinite(latest)]]
        )


def order_extremes(low: Real, high: Real) -> Real:
    """Extremes (points,) of a signal in the order in which it went through them, (2 points,), without what is NaN."""
    valid = np.isfinite(low) & np.isfinite(high)
    low, high = low[valid], high[valid]
    if low.size < 2:
        return np.concatenate([low, high])
    is_rising = np.gradient(low + high) >= 0
    return np.where(is_rising, [low, high], [high, low]).T.ravel()


def play_model(axis: dict[str, Any]) -> PlayModel | None:
    """That of an axis's feedforward; None where it has none."""
    feedforward = axis.get("feedforward") or {}
    if feedforward.get("kind", KIND) != KIND:
        return None
    try:
        return PrandtlIshlinskiiOptions.model_validate(feedforward).actuator()
    except ValueError:
        return None


def bin_means(signal: Real, bins: int) -> Real:
    """Of a signal (n,) in each of `bins` stretches; of few samples, themselves."""
    if signal.size <= bins:
        return signal
    first_samples = -(-np.arange(bins) * signal.size // bins)
    return np.add.reduceat(signal, first_samples) / np.diff(first_samples, append=signal.size)


def extreme_indices(signals: list[Real], bins: int) -> np.ndarray[Any, np.dtype[np.intp]]:
    """Places of the smallest and the largest of each signal (n,) in each of `bins` stretches, in order; all of few."""
    count = signals[0].size
    if count <= 2 * len(signals) * bins:
        return np.arange(count)
    first = -(-np.arange(bins + 1) * count // bins)
    lengths = np.diff(first)
    indices = first[:-1, None] + np.minimum(np.arange(lengths.max()), lengths[:, None] - 1)
    rows = np.arange(bins)
    extreme_indices = [
        indices[rows, find_extreme(signal[indices], axis=-1)]
        for signal in signals
        for find_extreme in (np.argmin, np.argmax)
    ]
    return np.unique(np.concatenate(extreme_indices))
