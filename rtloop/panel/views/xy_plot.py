"""Drive against position of an axis, with the loop that its hysteresis model draws over the same drive."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real
from rtloop.hysteresis.loop_shape import loop_shape
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions
from rtloop.panel.feed.envelope import bin_starts
from rtloop.panel.feed.rest_detector import MODE, is_at_rest, reference_signal
from rtloop.panel.feed.tick_history import BLOCK, TickHistory
from rtloop.panel.protocol.frames import pack_frame
from rtloop.panel.protocol.subscriptions import XySubscription
from rtloop.panel.service.service import Description

KIND = "prandtl_ishlinskii"
BINS = 1000
"""Time bins; the extremes of drive and position in each are shown, at most 4 points."""
NEW_PART = 50
"""A new frame is due when 1/NEW_PART of the shown ticks is new."""
MODEL_BINS, SHAPE_BINS = 150, 500
"""Time bins for the model's curve and for the width of the measured loop."""
WARM_BINS = 100
"""Time bins of the drive before the shown ticks, from which the model takes its memory."""


class XyPlot:
    """Plot of drive against position for a subscription. Raises ValueError for an axis that the loop does not have."""

    def __init__(self, subscription: XySubscription, loop: Description) -> None:
        """Show drive against position of the subscription's axis, over the subscription's time."""
        if subscription.axis not in loop.axes:
            raise ValueError(f"xy.axis: {subscription.axis!r}; allowed: {', '.join(loop.axes)}")
        self._subscription = subscription
        self._ticks = max(round(subscription.seconds * loop.rate_hz), 2)
        self._signals = [f"{subscription.axis}_drive_v", f"{subscription.axis}_position_um"]
        self._rest_signals = [reference_signal(subscription.axis), MODE]
        self._model = play_model(loop.axes[subscription.axis])
        self._shown = (-1, 0)
        """Run of the newest frame, and the tick after its last."""

    def frame(self, past: TickHistory) -> bytes | None:
        """Return the binary message "xy" of the last seconds; None while less than 1/NEW_PART of its ticks is new.

        Its arrays are `drive_v` and `position_um`, empty if all ticks were lost; with a hysteresis model also its
        curve, `model_drive_v` and `model_position_um`, moved by `offset_um` in the header to the measured mean
        position. The header also has `axis`, `run`, `end` (the tick after the last), `at_rest`, and `loop_percent`, the
        height of the measured loop in percent of the position's range: None at rest, for a constant drive, without a
        whole loop.
        """
        first, end = past.end - self._ticks, past.end
        if self._shown[0] == past.run and end < self._shown[1] + self._ticks / NEW_PART:
            return None
        self._shown = past.run, end
        drive, position = past.values(self._signals, first, end)
        at_rest = is_at_rest(*past.values(self._rest_signals, first, end))
        valid = np.isfinite(drive) & np.isfinite(position)
        drive, position = drive[valid], position[valid]
        indices = extreme_indices([drive, position], BINS)
        header: dict[str, object] = {"axis": self._subscription.axis, "run": past.run, "end": end, "at_rest": at_rest}
        header["loop_percent"] = None
        arrays = {"drive_v": drive[indices], "position_um": position[indices]}
        if drive.size and np.ptp(drive) > 0 and not at_rest:
            percent = loop_shape(bin_means(drive, SHAPE_BINS), bin_means(position, SHAPE_BINS)).percent
            header["loop_percent"] = percent if np.isfinite(percent) else None
        if self._model is not None and drive.size:
            indices = extreme_indices([drive], MODEL_BINS)
            model_position = self._model_position(self._model, past, first, drive[indices])
            header["offset_um"] = float(np.mean(position[indices]) - np.mean(model_position))
            arrays["model_drive_v"] = drive[indices]
            arrays["model_position_um"] = model_position + header["offset_um"]
        return pack_frame("xy", header, arrays)

    def _model_position(self, model: PlayModel, past: TickHistory, first: int, drive: Real) -> Real:
        """Return the model's position (n,), µm, over a drive (n,), V, from tick `first` on.

        The drive before `first`, over at most four times the shown duration, sets the state of the model's hysteresis;
        before that, drive and position count as 0.
        """
        earlier_drive = self._earlier_drive(past, first)
        return model_output(model, np.concatenate([earlier_drive, drive]))[earlier_drive.size :]

    def _earlier_drive(self, past: TickHistory, first: int) -> Real:
        """Return the drive before tick `first`, V (m,), oldest first, over at most four times the shown duration.

        It has the extremes of about WARM_BINS time bins, which end at a multiple of BLOCK, then each tick from there to
        `first`, without lost ticks; empty if `first` ≤ 0.
        """
        if first <= 0:
            return np.zeros(0)
        block_tick = first // BLOCK * BLOCK
        earlier_points = past.points(self._signals[:1], max(first - 4 * self._ticks, 0), block_tick, WARM_BINS)
        (latest,) = past.values(self._signals[:1], block_tick, first)
        extremes = order_extremes(earlier_points.low[0], earlier_points.high[0])
        return np.concatenate([extremes, latest[np.isfinite(latest)]])


def order_extremes(low: Real, high: Real) -> Real:
    """Return the extremes (points,) of a signal as one curve (2·points,): low before high where the signal rises from
    point to point, high before low where it falls. Points with NaN are left out.
    """
    valid = np.isfinite(low) & np.isfinite(high)
    low, high = low[valid], high[valid]
    if low.size < 2:
        return np.concatenate([low, high])
    is_rising = np.gradient(low + high) >= 0
    return np.where(is_rising, [low, high], [high, low]).T.ravel()


def play_model(axis: dict[str, Any]) -> PlayModel | None:
    """Return the hysteresis model of the feedforward in the table [axis] of a configuration.

    None for a feedforward of another kind than `KIND` or with invalid options; a missing kind is `KIND`.
    """
    feedforward = axis.get("feedforward") or {}
    if feedforward.get("kind", KIND) != KIND:
        return None
    try:
        return PrandtlIshlinskiiOptions.model_validate(feedforward).actuator()
    except ValueError:
        return None


def bin_means(signal: Real, bins: int) -> Real:
    """Return the mean of a signal (n,) in each of `bins` time bins, (bins,); the signal itself if n ≤ bins."""
    if signal.size <= bins:
        return signal
    first_samples = bin_starts(signal.size, bins)
    return np.add.reduceat(signal, first_samples) / np.diff(first_samples, append=signal.size)


def extreme_indices(signals: list[Real], bins: int) -> npt.NDArray[np.intp]:
    """Return the indices, ascending, of the smallest and largest sample of each signal (n,) in each of `bins` time
    bins; all n indices if n ≤ 2·signals·bins.
    """
    count = signals[0].size
    if count <= 2 * len(signals) * bins:
        return np.arange(count)
    first = bin_starts(count, bins)
    lengths = np.diff(first, append=count)
    indices = first[:, None] + np.minimum(np.arange(lengths.max()), lengths[:, None] - 1)
    rows = np.arange(bins)
    finders = (np.argmin, np.argmax)
    return np.unique([indices[rows, find(signal[indices], axis=-1)] for signal in signals for find in finders])
