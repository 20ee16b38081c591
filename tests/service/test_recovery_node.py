"""Recovery with a node behind UDP: the node is killed and restarted, then silent for longer than its watchdog's time.

The node's process outlives the loops and keeps its output. A run takes half a minute, most of it waiting.
"""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest

from rtloop.errors import RtloopError
from tests.drivers.node_bench import NodeProcess
from tests.faults.bench import Bench
from tests.faults.configuration import on_a_card
from tests.faults.evidence import wait_for
from tests.faults.recovery import QUICK

pytestmark = pytest.mark.system

SILENT_S = 2.5
"""Longer than the node's watchdog, hold_ticks and error_limit together."""
CODE_V = 20.0 / (1 << 24)
"""A step of the node's converter."""


def configuration(folder: Path, port: int) -> str:
    """Return the configuration of a loop at 500 Hz on the node at `port`."""
    return on_a_card(
        folder,
        ('rate_hz = 2000\nenable_input = "enable"', "rate_hz = 500"),
        (
            'kind = "plain_card"',
            f'kind = "udp"\nhost = "127.0.0.1"\nport = {port}\nhold_ticks = 250\nerror_limit = 500',
        ),
        (f'file = "{folder}/card"\n', "watchdog_ms = 500.0\n"),
        ('input = "in"\noutput = "out"', 'input = "adc0"\noutput = "dac0"'),
        ('[axis.controller]\nform = "zpk"\ngain = 200.0', '[axis.controller]\nform = "zpk"\ngain = 20.0'),
        ("gain = 200.0\npoles = [[-200.0, 0.0]]", "gain = 20.0\npoles = [[-20.0, 0.0]]\ndelay_ticks = 1"),
        ("sample_age_us = 400000.0", "sample_age_us = 600000.0"),
        ("[recording]", f"[service.recover]\n{QUICK}max_per_hour = 20\n[recording]"),
    )


def drives(bench: Bench, node: NodeProcess) -> bool:
    """Return whether the loop drives. Reset a trip before the first drive, as on a busy host, and start the loop."""
    with suppress(RtloopError):
        if bench.status().get("state") == "tripped":
            bench.client.post("/reset")
            bench.client.post("/start")
    return abs(node.output_v) > 1.0


def await_return(bench: Bench, node: NodeProcess, count: int) -> None:
    """Wait until `count` recoveries have ended in the log, and the loop drives the node."""
    wait_for(lambda: bench.log().count(": recovered") >= count, f"return {count}")
    wait_for(lambda: bench.status().get("state") == "running" and abs(node.output_v) > 1.0, "a drive")


@pytest.mark.soak
def test_a_node_that_comes_again_is_driven_again(tmp_path):
    node = NodeProcess("udp", tmp_path, park_slew_v_per_s=500.0)
    try:
        wait_for(lambda: node.steps > 10, "a node that runs")
        with Bench(tmp_path, board=False, text=configuration(tmp_path, node.options["port"])) as bench:
            wait_for(lambda: drives(bench, node), "a drive", poll_s=0.5)
            node.end()
            bench.await_state("tripped")
            node.start()
            await_return(bench, node, 1)
            node.process.send_signal(signal.SIGSTOP)
            time.sleep(SILENT_S)
            node.process.send_signal(signal.SIGCONT)
            wait_for(lambda: abs(node.settled_output_v()) < CODE_V, "the node's watchdog")
            assert node.parkings >= 1
            await_return(bench, node, 2)
            assert bench.stop() == 0
            assert abs(node.settled_output_v()) < CODE_V
    finally:
        node.end()
