"""Supervision of a real service over a CAN bus; cantools encodes and decodes the frames as an independent oracle."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import cantools.database
import pytest

import rtloop
from rtloop.drivers.can import bus as bus_module
from rtloop.drivers.can.frames import load_frames
from rtloop.drivers.can.options import BusOptions
from rtloop.errors import ConfigError
from rtloop.service.can_bus import CanSupervision, can_supervision
from rtloop.service.lock import Lock
from tests.drivers.can_bench import free_port
from tests.faults.bench import Bench
from tests.faults.evidence import wait_for

pytestmark = pytest.mark.system

DBC_FILE = Path(__file__).resolve().parents[2] / "deploy" / "rtloop.dbc"
DBC: Any = cantools.database.load_file(DBC_FILE)
GROUP = "239.74.163.78"
TIMEOUT_S = 20.0
SECTION = """[service]
arm = true
[service.can]
interface = "udp_multicast"
channel = "{group}"
settings = {{ port = {port}, hop_limit = 0 }}
[recording]"""


class Supervisor:
    """Node on the bus that sends commands to the service and receives its frames."""

    def __init__(self, port: int) -> None:
        self.bus = can.Bus(GROUP, "udp_multicast", ignore_config=True, port=port, hop_limit=0)

    def send(self, name: str, **signals: float) -> None:
        message = DBC.get_message_by_name(name)
        self.send_raw(message.frame_id, message.encode(signals))

    def send_raw(self, identifier: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def receive(self, name: str, accepts: Callable[[dict[str, Any]], bool] = lambda _: True) -> dict[str, Any]:
        """Return the signals of the next frame `name` whose signals `accepts` accepts."""
        identifier, deadline_s, last = DBC.get_message_by_name(name).frame_id, time.monotonic() + TIMEOUT_S, None
        while time.monotonic() < deadline_s:
            message = self.bus.recv(0.5)
            if message is not None and message.arbitration_id == identifier:
                last = DBC.decode_message(identifier, message.data)
                if accepts(last):
                    return last
        raise AssertionError(f"no accepted frame {name}; the last one was {last}")


@pytest.fixture(scope="module")
def port() -> int:
    """Return a free UDP port, which identifies the bus."""
    return free_port()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Bench]:
    """Yield a service on a board, armed on command, with supervision over the bus at `port`."""
    section = SECTION.format(group=GROUP, port=port)
    with Bench(tmp_path_factory.mktemp("can"), ("[recording]", section)) as bench:
        yield bench


@pytest.fixture
def supervisor(bench: Bench, port: int) -> Iterator[Supervisor]:
    """Yield a supervisor on the bus of the service."""
    node = Supervisor(port)
    yield node
    node.bus.shutdown()


def await_events(bench: Bench, kind: str, tick_from: int) -> list[dict[str, Any]]:
    """Wait until the recording has events of a kind from a tick on, and return them."""

    def read_events() -> list[dict[str, Any]]:
        path = next((bench.folder / "recordings").glob("*.mcap.part"))
        return [e for e in rtloop.load(path).events if e["kind"] == kind and e["tick"] >= tick_from]

    return wait_for(read_events, f"{kind} in the file")


def test_heartbeat_and_status(bench, supervisor):
    first = supervisor.receive("Heartbeat")
    second = supervisor.receive("Heartbeat")
    assert second["Counter"] == (first["Counter"] + 1) % 2**16
    assert second["Tick"] > first["Tick"]
    status = supervisor.receive("Status")
    assert (str(status["State"]), str(status["Mode"]), status["Causes"]) == ("stopped", "off", 0)


def test_modes_setpoints_trip_and_reset_are_followed_and_recorded(bench, supervisor):
    bench.client.post("/arm")
    start = bench.ticks
    supervisor.send("Setpoint", Axis=0, Value=12.5)
    supervisor.send("Mode", Mode=3)
    supervisor.receive("Status", lambda s: str(s["State"]) == "running" and str(s["Mode"]) == "closed_loop")
    wait_for(lambda: bench.status()["axes"]["x"]["reference_um"] == 12.5, "the setpoint")
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 5.0}})
    trip = supervisor.receive("Trip")
    assert trip["Causes"] & 1 << 10
    supervisor.receive("Status", lambda s: str(s["State"]) == "tripped" and s["Causes"] & 1 << 10)
    bench.client.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})
    wait_for(lambda: not bench.status()["axes"]["x"]["drive_v"], "a ramp")
    supervisor.send("TripReset", Confirm=1)
    supervisor.receive("Status", lambda s: str(s["State"]) == "stopped" and not s["Causes"])
    for kind in ("set_mode", "set_reference", "reset_trip"):
        who = [event["who"] for event in await_events(bench, kind, start) if event["who"] == "can"]
        assert who == ["can"], kind
    assert await_events(bench, "load_law", start)[-1]["who"] == "operator"


def test_what_cannot_be_followed_is_counted_and_changes_nothing(bench, supervisor):
    before = supervisor.receive("Status")["Refused"]
    reference = bench.status()["axes"]["x"]["reference_um"]
    bad = [
        (0x300, b"\0"),  # too short
        (0x300, bytes(8)),  # too long
        (0x300, b"\7" + bytes(4)),  # no such axis
        (0x300, b"\0" + (10_000_000).to_bytes(4, "little")),  # 1000 µm: outside the envelope
        (0x090, b"\x09"),  # no such mode
        (0x090, b"\x03"),  # not armed
        (0x081, b"\x00"),  # not confirmed
    ]
    for identifier, data in bad:
        supervisor.send_raw(identifier, data)
    after = supervisor.receive("Status", lambda s: s["Refused"] == before + len(bad))
    supervisor.send_raw(0x7FF, b"nobody's")
    assert supervisor.receive("Status")["Refused"] == after["Refused"]
    report = bench.status()
    assert (report["state"], report["mode"], report["axes"]["x"]["reference_um"]) == ("stopped", "off", reference)
    assert "service.can" not in bench.log()
    assert "CAN bus udp_multicast" in bench.log()


def test_a_bus_that_is_not_there_is_said_once(tmp_path):
    section = SECTION.replace("udp_multicast", "socketcan").format(group="can-nowhere", port=1)
    bench = Bench(tmp_path, ("[recording]", section), board=False)
    service = bench.rtloop("serve", bench.config)
    assert service.wait(60) == 69, bench.log()
    assert "service.can: CAN bus socketcan can-nowhere: " in bench.log()
    assert "Traceback" not in bench.log()


def write_dbc(folder: Path, *changes: tuple[str, str], without: str = "") -> BusOptions:
    """Write rtloop's DBC with `changes` and without a message to `folder`; return the options of a bus with it."""
    text = DBC_FILE.read_text()
    if without:
        number = DBC.get_message_by_name(without).frame_id
        text = re.sub(rf"BO_ {number} .*\n( SG_ .*\n)+", "", text)
        text = re.sub(rf"(?m)^(BA_ .*BO_|CM_ BO_|VAL_) {number} .*\n", "", text)
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "own.dbc").write_text(text)
    return BusOptions(interface="virtual", channel="own", dbc=str(folder / "own.dbc"))


def refusal_faults(options: BusOptions, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the faults of a configuration with these options, which is refused before a bus is opened."""
    opened = list[BusOptions]()
    monkeypatch.setattr(bus_module, "open_bus", opened.append)
    service: Any = SimpleNamespace(config="lab.toml")
    service.configuration = SimpleNamespace(service=SimpleNamespace(can=options))
    with pytest.raises(ConfigError) as caught, can_supervision(service):
        pass
    assert opened == []
    return caught.value.faults


@pytest.mark.parametrize("name", ["Setpoint", "Mode", "TripReset", "Status", "Heartbeat", "Trip"])
def test_a_dbc_without_a_message_is_refused_before_the_bus_is_opened(name: str, tmp_path, monkeypatch):
    options = write_dbc(tmp_path, without=name)
    signals = ", ".join(signal.name for signal in DBC.get_message_by_name(name).signals)
    allowed = f"allowed: a message {name} with the signals {signals}"
    assert refusal_faults(options, monkeypatch) == [f"service.can.dbc: {options.dbc}: has no message {name}; {allowed}"]


def test_a_dbc_whose_message_has_another_number_of_signals_is_refused(tmp_path, monkeypatch):
    options = write_dbc(tmp_path, (' SG_ Axis : 0|8@1+ (1,0) [0|255] "" Service\n', ""))
    (fault,) = refusal_faults(options, monkeypatch)
    assert "Setpoint has 1 signals; allowed: a message Setpoint with the signals Axis, Value" in fault


@pytest.mark.parametrize(
    ("layout", "byte", "axis"),
    [("8@1- (1,0)", 0xFF, None), ("8@1- (1,0)", 1, "y"), ("8@1+ (0.5,0)", 1, None), ("8@1+ (0.5,0)", 2, "y")],
)
def test_an_axis_number_is_neither_negative_nor_a_fraction(layout: str, byte: int, axis: str | None, tmp_path):
    """A user's DBC may decode such a number; −1 does not select the last axis."""
    options, commanded_axes = write_dbc(tmp_path, ("Axis : 0|8@1+ (1,0)", f"Axis : 0|{layout}")), list[str]()
    references = SimpleNamespace(set=lambda name, _: commanded_axes.append(name))
    live = SimpleNamespace(prepared=SimpleNamespace(plan=SimpleNamespace(axes=("x", "y"))), references=references)
    service: Any = SimpleNamespace(require_live=lambda: live, lock=Lock())
    supervision = CanSupervision(service, options, None, load_frames(options))
    supervision._execute_frame(can.Message(arbitration_id=0x300, data=bytes([byte, 0, 0, 0, 0]), is_extended_id=False))
    assert (commanded_axes, supervision.refused_count) == (([axis], 0) if axis else ([], 1))
