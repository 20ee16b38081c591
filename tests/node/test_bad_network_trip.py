"""A loop behind a bad network trips by `stale` in the tick after the last tick that may be held, not before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtloop.drivers.base import Pointers, Wiring
from rtloop.drivers.contract import DriverCalls
from rtloop.drivers.node.card import OBSERVED
from rtloop.drivers.node.driver import UdpDriver
from rtloop.drivers.node.options import UdpOptions
from rtloop.engine.messages import Kind
from rtloop.signals import Flag
from tests.drivers.lossy_relay import relayed
from tests.drivers.network_plan import Script
from tests.drivers.relayed_nodes import PythonNode
from tests.engine.harness import AXIS, LoopBench, make_plan, text

TICKS, FIRST_LOST = 20, 5
RAW = text(AXIS, "[axis.interlocks]\nsample_age_us = 1e9\n", mode="raw", rate_hz=1000)


class StartedDriver(UdpDriver):
    """A driver whose `open` makes the first `read`, which waits for the node: in the loop it would stop the relay."""

    def open(self) -> Pointers:
        pointers = super().open()
        DriverCalls(pointers, self.facts).read()
        return pointers


@pytest.mark.parametrize("hold_ticks", [0, 1, 3])
@pytest.mark.parametrize("excess", [0, 1])
@pytest.mark.parametrize("direction", ["drive", "sample"])
def test_the_loop_trips_where_more_answers_are_missing_than_it_may_hold(hold_ticks, excess, direction):
    lost = {(direction, FIRST_LOST + i): () for i in range(hold_ticks + excess)}
    with relayed(PythonNode()) as relay:
        options = UdpOptions(
            host="127.0.0.1", port=relay.port, hold_ticks=hold_ticks, error_limit=1000, watchdog_ms=5000, wait_s=60.0
        )
        driver = StartedDriver(options, {"x": Wiring("adc0", "dac0")}, 1000.0)
        bench = LoopBench(replace(make_plan(RAW), observed=OBSERVED), driver)
        relay.begin(Script(lost))
        handled, rows = relay.handled, []
        for tick in range(TICKS):
            rows.append(bench.run(1)[0])
            relay.wait_handled(handled + tick + 1)
        relay.end()
        driver.close()
    flags = np.array(rows)[:, bench.plan.columns.index("flags")].astype(int)
    first = FIRST_LOST + hold_ticks + 1 if excess else TICKS
    np.testing.assert_array_equal((flags & Flag.TRIP_STALE) != 0, np.arange(TICKS) >= first)
    assert bench.kinds().count(Kind.TRIPPED) == excess
    assert relay.output_problems == []
