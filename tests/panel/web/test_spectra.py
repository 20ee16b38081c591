"""One client's spectrum: what it was fed is in it when it is shown, and nothing of what came before a reset."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtloop.panel.stretch import DEADLINE_NS, Stretch
from rtloop.panel.views.spectra import Analyser
from rtloop.panel.views.wishes import wish_of
from tests.panel.web.browser import unpacked

RATE_HZ = 1000.0
LOOP: Any = SimpleNamespace(rate_hz=RATE_HZ, unit=lambda _: "V")


def fed(analyser: Analyser, volts: np.ndarray[Any, Any], first: int, run: int = 0) -> int:
    """In stretches of some ticks, as they are read; the tick behind them."""
    for start in range(0, volts.size, 17):
        part = volts[start : start + 17]
        deadline_ns = (first + start + np.arange(part.size)) * 1e9 / RATE_HZ
        analyser.feed(Stretch((DEADLINE_NS, "x_drive_v"), first + start, np.column_stack([deadline_ns, part]), 0, run))
    return first + volts.size


@pytest.mark.parametrize("anew", ["reset", "another run"])
def test_what_came_before_is_gone_and_what_came_since_is_there(anew: str) -> None:
    analyser = Analyser(wish_of("spectrum", {"signal": "x_drive_v"}), LOOP)
    tick = fed(analyser, np.full(4100, 0.0) + 1e6 * (np.arange(4100) % 2), 0)
    if anew == "reset":
        analyser.reset()
    sine = np.sqrt(2) * np.sin(2 * np.pi * 100 * np.arange(4096) / RATE_HZ)
    fed(analyser, sine, tick, run=int(anew != "reset"))
    header, arrays = unpacked(analyser.frame())
    assert header["averages_most"] == 7, "all of the 4096 samples, in halves of 1024 but for the first"
    assert header["rms"] == pytest.approx(1.0, rel=0.01)
    assert arrays["hz"][np.argmax(arrays["amplitude"])] == pytest.approx(100.0, abs=0.5)
