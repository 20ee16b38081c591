"""Spectrum of a signal for one client, averaged since its subscription."""

from __future__ import annotations

import numpy as np

from rtloop.client.ticks.tick_stretch import Batch, Stretch
from rtloop.panel.feed.rest_detector import MODE, RestDetector, find_axis, reference_signal
from rtloop.panel.protocol.frames import pack_frame
from rtloop.panel.protocol.subscriptions import SpectrumSubscription
from rtloop.panel.service.service import Description
from rtloop.panel.spectrum.spectrum import Spectrum


class Analyser:
    """Spectrum of a subscription's signal, averaged over the ticks that `feed` received since the last `reset`.

    The constructor raises ValueError for a signal that the loop does not have.
    """

    def __init__(self, subscription: SpectrumSubscription, loop: Description) -> None:
        """Begin without averages. Raises ValueError for a signal that the loop does not have."""
        self._subscription, self._rate_hz = subscription, loop.rate_hz
        self._spectrum = Spectrum(loop.rate_hz, loop.unit(subscription.signal))
        self._batch = Batch(loop.rate_hz)
        self._axis, self._rest = find_axis(subscription.signal, loop.axes), RestDetector()
        self._run = -1

    def update(self, subscription: SpectrumSubscription, loop: Description) -> bool:
        """Take another subscription of the same signal at the same rate, keep the averages, and return True.

        Returns False, unchanged, for another signal or rate. Raises ValueError for a signal that the loop lacks.
        """
        if (subscription.signal, loop.rate_hz) != (self._subscription.signal, self._rate_hz):
            return False
        loop.unit(subscription.signal)
        self._subscription = subscription
        return True

    def reset(self) -> None:
        """Discard all averages and collected ticks; `at_rest` is judged anew."""
        self._batch.take()
        self._spectrum.reset()
        self._rest.reset()

    def feed(self, stretch: Stretch) -> None:
        """Add the next ticks to the averages; the first ticks of a new run discard the old run's averages."""
        if stretch.run != self._run:
            self._run = stretch.run
            self.reset()
        if self._axis is not None:
            self._rest.feed(stretch[reference_signal(self._axis)], stretch[MODE])
        self._average(self._batch.add(stretch))

    def frame(self) -> bytes:
        """Return the binary message "spectrum" of all ticks since the last reset; its arrays may be empty.

        The arrays have a value for each frequency band: `hz` (centre), `amplitude` (density in `unit`/√Hz), `averages`
        (number of averaged periodograms). The header has the subscription, `unit`, the `rms` from low_hz to high_hz,
        `averages_least` and `averages_most` of all bands (0 without a band), `bridged` (missing samples that a straight
        line replaced), and `at_rest`: whether the signal's axis rested all the time, False for a signal of no axis.
        """
        self._average(self._batch.take())
        density, subscription = self._spectrum.density(), self._subscription
        averages = density.averages
        return pack_frame(
            "spectrum",
            {
                **subscription.model_dump(),
                "unit": density.unit,
                "rms": density.rms(subscription.low_hz, subscription.high_hz),
                "averages_least": int(np.min(averages, initial=averages.max(initial=0))),
                "averages_most": int(averages.max(initial=0)),
                "bridged": self._spectrum.bridged_count,
                "at_rest": self._axis is not None and self._rest.at_rest,
            },
            {"hz": density.hz, "amplitude": density.amplitude, "averages": averages},
        )

    def _average(self, batch: Stretch | None) -> None:
        """Add a batch of ticks to the averages of the spectrum; None has no effect."""
        if batch is not None:
            self._spectrum.feed(batch[self._subscription.signal], batch.periods(self._rate_hz))
