"""One client's spectrum of a signal, averaged since it was asked for."""

from __future__ import annotations

import numpy as np

from rtloop.panel.rest import MODE, Rest, axis_of, reference_of
from rtloop.panel.spectrum import Spectrum
from rtloop.panel.stretch import Batch, Stretch
from rtloop.panel.views.frames import pack
from rtloop.panel.views.link import Description
from rtloop.panel.views.wishes import SpectrumWish


class Analyser:
    """Of the signal that is wished. Raises ValueError for one that the loop does not have."""

    def __init__(self, wish: SpectrumWish, loop: Description) -> None:
        self._wish, self._rate_hz = wish, loop.rate_hz
        self._spectrum = Spectrum(loop.rate_hz, loop.unit(wish.signal))
        self._batch = Batch(loop.rate_hz)
        self._axis, self._rest = axis_of(wish.signal, loop.axes), Rest()
        self._run = -1

    def rewished(self, wish: SpectrumWish, loop: Description) -> bool:
        """Take over `wish` where it is of the same signal: what was averaged stays."""
        if (wish.signal, loop.rate_hz) != (self._wish.signal, self._rate_hz):
            return False
        loop.unit(wish.signal)
        self._wish = wish
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
            self._rest.feed(stretch[reference_of(self._axis)], stretch[MODE])
        self._average(self._batch.add(stretch))

    def frame(self) -> bytes:
        """As it is now."""
        self._average(self._batch.take())
        density, subscription = self._spectrum.density(), self._wish
        averages = density.averages
        return pack(
            "spectrum",
            {
                "signal": subscription.signal,
                "unit": density.unit,
                "rms": density.rms(subscription.low_hz, subscription.high_hz),
                "low_hz": subscription.low_hz,
                "high_hz": subscription.high_hz,
                "averages_least": int(np.min(averages, initial=averages.max(initial=0))),
                "averages_most": int(averages.max(initial=0)),
                "bridged": self._spectrum.bridged,
                "at_rest": self._axis is not None and self._rest.at_rest,
            },
            {"hz": density.hz, "amplitude": density.amplitude, "averages": averages},
        )

    def _average(self, batch: Stretch | None) -> None:
        if batch is not None:
            self._spectrum.feed(batch[self._wish.signal], batch.periods(self._rate_hz))
