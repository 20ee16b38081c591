"""One run of the driver through netem, and the counts that driver and node must show by captures at both ends."""

from __future__ import annotations

import json
import math
import signal
import struct
import subprocess
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate, groupby
from pathlib import Path

from rtloop.drivers.base import Wiring
from rtloop.drivers.node.driver import UdpDriver
from rtloop.drivers.node.options import UdpOptions
from tests.drivers.node_calls import open_calls
from tests.node.frames import SAMPLE, Sample, parse
from tests.soak.netem.capture import Capture, parse_datagram
from tests.soak.netem.namespaces import NODE_ADDRESS, Network

PORT = 5747
HOLD_TICKS = 2
DIGITAL = 4
"""Digital inputs and outputs of the node."""
AGE = 1 + DIGITAL
COUNTS = slice(AGE + 1, AGE + 6)
"""Indices in the values of `read`: the age; the counts of lost, late, doubled, invalid and foreign samples."""
SETTLE_S = 0.5
LONG_US = 10_000_000


@contextmanager
def node_program(network: Network, program: Path, witness: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    """Run the node in C, whose inputs are its outputs, at the far end; yield its process."""
    options = ["--port", str(PORT), "--loopback", "--hold", str(LONG_US), "--witness", str(witness), *more]
    process = network.start("node", str(program), *options)
    assert process.stdout is not None
    process.stdout.readline()  # The first line is printed when the node is ready.
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def build_driver(rate_hz: float, **options: object) -> UdpDriver:
    """Return a driver, not yet open, of the node at the far end."""
    values = {"host": NODE_ADDRESS, "port": PORT, "wait_s": 30.0, "error_limit": 1_000_000, "hold_ticks": HOLD_TICKS,
              "watchdog_ms": 5000.0, "output_range_v": [-10.0, 9.9997], "input_range_v": [-10.0, 9.9997],
              "digital_inputs": DIGITAL, "digital_outputs": DIGITAL}  # fmt: skip
    return UdpDriver(UdpOptions.model_validate(values | options), {"x": Wiring("adc0", "dac0")}, rate_hz)


@dataclass(frozen=True)
class Outcome:
    """Counts of one run: by the driver, by the node, and by the captures at both ends."""

    drives: int
    at_node: int
    samples: int
    at_loop: int
    broken: int
    netem: tuple[int, int]
    """Packets that netem dropped towards the node and towards the loop."""
    driver: list[int]
    """Lost, late, doubled, invalid, foreign, by the driver; the same by the capture in `capture`."""
    capture: list[int]
    node: list[int]
    """Invalid and old frames by the node; the same by the capture in `node_capture`."""
    node_capture: list[int]
    held: int
    stale: int
    stale_due: int
    """Ticks with an infinite age, and ticks that were held more often in a row than HOLD_TICKS."""
    passed: bool
    """Whether netem's own counts agree with the captures."""
    wrong: int
    """Faults of samples: codes that differ from the applied drive, or another drive than the sample's own."""

    @property
    def is_equal(self) -> bool:
        """Whether driver, node and netem counted as the captures did."""
        return (self.driver, self.node, self.stale) == (self.capture, self.node_capture, self.stale_due) and self.passed


def run(network: Network, program: Path, folder: Path, netem: list[str], rate_hz: float, ticks: int) -> Outcome:
    """Open the driver without netem, run `ticks` ticks behind netem, and wait for frames on their way."""
    with node_program(network, program, folder / "witness") as process:
        driver = build_driver(rate_hz)
        with network.inside("loop"):
            calls = open_calls(driver)
        calls.read()
        first = int(driver._opened_card["sequence"][0])
        network.disturb(*netem)
        captures = []
        for place, link in (("loop", "loop0"), ("node", "node0")):
            with network.inside(place):
                captures.append(Capture(link))
        results, start_s = [], time.monotonic()
        for tick in range(1, ticks + 1):
            assert calls.write([9.0 * math.sin(0.7 * tick), *[0.0] * DIGITAL]) == 0
            time.sleep(max(0.0, start_s + tick / rate_hz - time.monotonic()))
            results.append(calls.read())
        time.sleep(SETTLE_S)
        values = calls.read()[1]
        while (next_values := calls.read()[1])[COUNTS] != values[COUNTS]:
            values = next_values
        for capture in captures:
            capture.end()
        dropped = [network.netem_counts(link) if netem else (0, 0) for link in ("wire1", "wire0")]
        network.disturb()
        driver.close()
        process.send_signal(signal.SIGTERM)
        counters = json.loads(process.communicate(timeout=30)[0])
    return _judge(first, results, values, captures[0], captures[1], dropped, counters)


def _judge(
    first: int, results: list[tuple[int, list[float]]], values: list[float], loop: Capture, node: Capture,
    dropped: list[tuple[int, int]], counters: dict[str, int],
) -> Outcome:  # fmt: skip
    """Return the counts of driver and node, and the counts that the captures demand."""
    sent = [content for packet in loop.sent if (content := _content(packet))]
    at_node = [content for packet in node.received if (content := _content(packet))]
    samples = [content for packet in node.sent if (content := _content(packet))]
    at_loop = [content for packet in loop.received if (content := _content(packet))]
    drives = {struct.unpack_from("<I", content, 4)[0]: content for content in sent}
    statuses = [status for status, _ in results]
    runs = [len(list(group)) for status, group in groupby(statuses) if status == 1]
    stale = sum(math.isinf(result[AGE]) for _, result in results)
    passed = not any(map(sum, dropped)) or (
        [sent for sent, _ in dropped] == [len(end.received) + len(end.lost) for end in (node, loop)]
        and _is_conserved(sent, samples, dropped)
    )
    return Outcome(
        drives=len(sent), at_node=len(at_node), samples=len(samples), at_loop=len(at_loop),
        broken=sum(len(end.received) + len(end.lost) for end in (node, loop)) - len(at_node) - len(at_loop),
        netem=(dropped[0][1], dropped[1][1]), driver=[int(value) for value in values[COUNTS]],
        capture=_driver_counts_due(at_loop, first), node=[counters["invalid"], counters["old"]],
        node_capture=_node_counts_due(at_node, first), held=statuses.count(1), stale=stale,
        stale_due=sum(max(0, length - HOLD_TICKS) for length in runs), passed=passed,
        wrong=_wrong_drives(samples, drives),
    )  # fmt: skip


def _is_conserved(sent: list[bytes], samples: list[bytes], dropped: list[tuple[int, int]]) -> bool:
    """Return whether netem passed or dropped at least as many packets as came: it doubles packets without a count."""
    return all(
        count + dropped_count >= len(packets)
        for (count, dropped_count), packets in zip(dropped, (sent, samples), strict=True)
    )


def _content(packet: bytes) -> bytes | None:
    """Return the content of a packet that the kernel passes to a socket, None for other packets."""
    received = parse_datagram(packet)
    return None if received is None else received.content


def _is_frame(content: bytes) -> bool:
    """Return whether the checksum of a frame is right."""
    return len(content) > 12 and struct.unpack("<I", content[-4:])[0] == zlib.crc32(content[:-4])


def _driver_counts_due(arrived: list[bytes], first: int) -> list[int]:
    """Return lost, late, doubled, invalid and foreign samples by the order of the arrivals at the loop."""
    samples = [content for content in arrived if _is_frame(content) and content[2] == SAMPLE]
    numbers = [struct.unpack_from("<I", content, 4)[0] for content in samples]
    distinct = list(dict.fromkeys(numbers))
    late = sum(number < highest for number, highest in zip(distinct, accumulate(distinct, max), strict=True))
    lost = max(distinct, default=first) - first - len(distinct)
    return [lost, late, len(numbers) - len(distinct), len(arrived) - len(samples), 0]


def _node_counts_due(arrived: list[bytes], first: int) -> list[int]:
    """Return invalid and old drives by the order of the arrivals at the node."""
    newest, old, invalid = first, 0, 0
    for content in arrived:
        if not _is_frame(content):
            invalid += 1
            continue
        sequence = struct.unpack_from("<I", content, 4)[0]
        old += sequence <= newest
        newest = max(newest, sequence)
    return [invalid, old]


def _wrong_drives(samples: list[bytes], drives: dict[int, bytes]) -> int:
    """Return the number of faults: codes that differ from the drive that the previous sample applied, or a sample
    that did not apply the drive of the same sequence.
    """
    faults, applied = 0, 0
    for content in samples:
        sample = parse(content)
        assert isinstance(sample, Sample)
        if applied:
            faults += sample.codes != struct.unpack_from("<i", drives[applied], 24)
        faults += sample.applied != sample.sequence or sample.applied <= applied
        applied = sample.applied
    return faults
