"""One client's spectrum of a signal, averaged since it was asked for."""

from __future__ import annotations

import numpy as np

from rtloop.panel.rest_detector import MODE, RestDetector, find_axis, reference_signal
from rtloop.panel.spectrum import Spectrum
from rtloop.panel.stretch import Batch, Stretch
from rtloop.panel.views.frames import pack_frame
from rtloop.panel.views.service import Description
from rtloop.panel.views.subscriptions import SpectrumSubscription


class Analyser:
    """Of the signal that is wished. Raises ValueError for one that the loop does not have."""

    def __init__(self, subscription: SpectrumSubscription, loop: Description) -> None:
        self._subscription, self._rate_hz = subscription, loop.rate_hz
        self._spectrum = Spectrum(loop.rate_hz, loop.unit(subscription.signal))
        self._batch = Batch(loop.rate_hz)
        self._axis, self._rest = find_axis(subscription.signal, loop.axes), RestDetector()
        self._run = -1

    def update(self, subscription: SpectrumSubscription, loop: Description) -> bool:
        """Take over `wish` where it is of the same signal: what was averaged stays."""
        if (subscription.signal, loop.rate_hz) != (self._subscription.signal, self._rate_hz):
            return False
        loop.unit(subscription.signal)
        self._subscription = subscription
        return True

    def reset(self) -> None:
        """Average anew."""
        self._batch.take()
        self._spectrum.reset()
        self._rest.reset()

    def feed(self, stretch: Stretch) -> None:
        """Average what came, in the end; another run begins anew."""
        if stretch.run != self._run:
            self._run = stretch.run
            self.reset()
        if self._axis is not None:
            self._rest.feed(stretch[reference_signal(self._axis)], stretch[MODE])
        self._average(self._batch.add(stretch))

    def frame(self) -> bytes:
        """As it is now."""
        self._average(self._batch.take())
        density, subscription = self._spectrum.density(), self._subscription
        averages = density.averages
        return pack_frame(
            "spectrum",
            {
                "signal": subscription.signal,
                "unit": density.unit,
                "rms": density.rms(subscription.low_hz, subscription.high_hz),
                "low_hz": subscription.low_hz,
                "high_hz": subscription.high_hz,
                "averages_least": int(np.min(averages, initial=averages.max(initial=0))),
                "averages_most": int(averages.max(initial=0)),
                "bridged": self._spectrum.bridged_count,
                "at_rest": self._axis is not None and self._rest.at_rest,
            },
            {"hz": density.hz, "amplitude": density.amplitude, "averages": averages},
        )

    def _average(self, batch: Stretch | None) -> None:
        if batch is not None:
            self._spectrum.feed(batch[self._subscription.signal], batch.periods(self._rate_hz))
