"""Clients of Channel Access read and drive a real service through `rtloop epics`; its status is the reference."""

from __future__ import annotations

import os
import random
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

caproto = pytest.importorskip("caproto", reason="caproto is missing: pip install 'rtloop[epics]'")

from rtloop.client import Client  # noqa: E402
from rtloop.errors import RtloopError  # noqa: E402
from tests.command_line import run  # noqa: E402
from tests.epics.bench import HOST, TIMEOUT_S, UM_PER_V, Adapter, make_bench  # noqa: E402
from tests.faults.bench import Bench  # noqa: E402
from tests.faults.configuration import ROOT  # noqa: E402
from tests.faults.evidence import wait_for  # noqa: E402

pytestmark = pytest.mark.system

REFUSED = caproto.ErrorResponseReceived
AXIS_SUFFIXES = ("x:POSITION", "x:REFERENCE", "x:ERROR", "x:DRIVE", "x:SETPOINT")
MODES = ("off", "raw", "feedforward", "closed_loop")
NOISE_UM = 0.2
"""Bound of the sensor's noise on the rig, many standard deviations."""


@pytest.fixture(scope="module")
def ioc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Adapter]:
    """Yield the EPICS server, which lets clients write and starts before the service."""
    with Adapter(make_bench(tmp_path_factory.mktemp("epics")), "LAB:LOOP:", "--allow-control") as adapter:
        yield adapter


@pytest.fixture(scope="module")
def bench(ioc: Adapter) -> Iterator[Bench]:
    """Yield the bench of the service, which starts after the channels have shown that there is no service."""
    assert ioc.await_alarm("CONNECTED", "INVALID", "COMM") == 0
    ioc.await_text("MESSAGE", "the service was stopped, or never started")
    with ioc.bench as bench:
        assert ioc.await_alarm("CONNECTED", "NO", "NO_ALARM") == 1
        yield bench


@pytest.fixture
def running(bench: Bench, ioc: Adapter) -> Iterator[Adapter]:
    """Yield the EPICS server while the loop is closed at 20 µm, armed and started over Channel Access."""
    ioc.write("ARM", 1)
    ioc.write("START", 1)
    ioc.write("x:SETPOINT", 20.0)
    bench.await_state("running")
    yield ioc
    ioc.write("STOP", "execute")
    bench.await_state("stopped")


def await_position(ioc: Adapter, um: float) -> None:
    """Wait until the channel of the position shows `um`."""
    wait_for(lambda: abs(ioc.read("x:POSITION").value - um) < NOISE_UM / 2, f"{um} µm", TIMEOUT_S, 0.05)


def test_channels_show_the_status_of_the_service(bench: Bench, running: Adapter):
    await_position(running, 20.0)
    before = bench.status()
    tick = running.read("TICK").value
    after = bench.status()
    assert before["tick"] <= tick + 1000  # A channel is a tenth of a second old, on a busy host some more.
    assert tick <= after["tick"]
    expected = {"CONNECTED": 1, "MODE": MODES.index("closed_loop"), "ARMED": 1, "TRIPPED": 0}
    assert {name: running.read(name)[:2] for name in expected} == {name: (n, "NO") for name, n in expected.items()}
    assert running.read("STATE") == ("running", "NO", "NO_ALARM")
    assert running.read("CAUSE").value == ""
    assert running.read("RATE").value == pytest.approx(bench.status()["rate_hz"], rel=0.2)
    assert 0 <= running.read("LATE_TICKS").value <= 10_000
    axis = bench.status()["axes"]["x"]
    assert running.read("x:POSITION").value == pytest.approx(axis["position_um"], abs=NOISE_UM)
    assert running.read("x:REFERENCE").value == running.read("x:SETPOINT").value == 20.0
    assert abs(running.read("x:ERROR").value) < NOISE_UM
    assert running.read("x:DRIVE").value == pytest.approx(axis["drive_v"], abs=0.1)


def test_channels_have_units_and_words(running: Adapter):
    control = running.get("x:POSITION", data_type="control").metadata
    assert (control.units, control.precision) == (b"um", 4)
    assert running.get("x:DRIVE", data_type="control").metadata.units == b"V"
    words = running.get("MODE", data_type="control", force_int_enums=True).metadata.enum_strings
    assert tuple(word.decode() for word in words) == MODES
    running.write("MODE", "raw")
    assert running.get("x:SETPOINT", data_type="control").metadata.units == b"V"
    running.write("MODE", 3)
    assert running.get("x:SETPOINT", data_type="control").metadata.units == b"um"


def test_a_written_setpoint_moves_the_position_and_is_the_clients(bench: Bench, running: Adapter):
    """The drive changes as the actuator's gain predicts; the service names the writing client as lock holder."""
    await_position(running, 20.0)
    drive_v = float(bench.blocks[-1]["last_drive_v"][0])
    running.write("x:SETPOINT", 27.5)
    assert running.read("x:SETPOINT").value == 27.5, "a finished write shows its effect"
    await_position(running, 27.5)
    status = bench.status()
    assert status["axes"]["x"]["position_um"] == pytest.approx(27.5, abs=NOISE_UM)
    assert bench.blocks[-1]["last_drive_v"][0] - drive_v == pytest.approx(7.5 / UM_PER_V, abs=0.1)
    assert status["lock"]["name"] == "epics"
    assert f"written by {HOST}: LAB:LOOP:x:SETPOINT: done" in running.log()


def test_a_refused_setpoint_is_an_error_with_the_text_of_ctl(bench: Bench, running: Adapter):
    with pytest.raises(RtloopError) as refusal:
        Client(bench.client.path, "epics").post("/setpoint", {"axis": "x", "value": 1000.0})
    text = " ".join(str(refusal.value).split())
    with pytest.raises(REFUSED, match="ECA_PUTFAIL"):
        running.write("x:SETPOINT", 1000.0)
    assert running.read("MESSAGE").value == f"LAB:LOOP:x:SETPOINT: {text}"
    assert "1000" in text
    assert bench.status()["axes"]["x"]["reference_um"] == 20.0
    assert running.read("x:SETPOINT") == (20.0, "NO", "NO_ALARM")
    running.write("x:SETPOINT", 21.0)
    assert running.read("MESSAGE").value == ""


@pytest.mark.parametrize(
    ("suffix", "value", "options"),
    [
        ("x:SETPOINT", "fast", {"data_type": caproto.ChannelType.STRING}),
        ("x:SETPOINT", "", {"data_type": caproto.ChannelType.STRING}),
        ("x:SETPOINT", " ", {"data_type": caproto.ChannelType.STRING}),
        ("x:SETPOINT", float("nan"), {}),
        ("x:SETPOINT", float("inf"), {}),
        ("x:SETPOINT", [10.0, 12.0], {}),
        ("MODE", 9, {"data_type": caproto.ChannelType.LONG}),
        ("MODE", -1, {"data_type": caproto.ChannelType.LONG}),
        ("MODE", "fast", {}),
        ("STOP", 0, {}),
        ("STOP", "idle", {}),
    ],
)
def test_a_value_that_is_none_changes_nothing(bench: Bench, running: Adapter, suffix: str, value, options):
    with pytest.raises(REFUSED):
        running.write(suffix, value, **options)
    assert running.read("MESSAGE").value.startswith(f"LAB:LOOP:{suffix}: ")
    status = bench.status()
    assert (status["state"], status["mode"], status["axes"]["x"]["reference_um"]) == ("running", "closed_loop", 20.0)


def test_alarms_and_limits_that_a_client_sends_are_dropped(running: Adapter):
    """A client may write a value with metadata; it must neither hide nor invent an alarm."""
    running.write("x:SETPOINT", 22.0, data_type=caproto.ChannelType.STS_DOUBLE, metadata=(7, 3))
    assert running.read("x:SETPOINT") == (22.0, "NO", "NO_ALARM")


def test_another_lock_holder_refuses_writes_but_no_stop(bench: Bench, running: Adapter):
    Client(bench.client.path, "epics").delete("/lock")
    Client(bench.client.path, "ada").lock()
    try:
        with pytest.raises(REFUSED):
            running.write("x:SETPOINT", 25.0)
        assert "ada has held the lock" in running.read("MESSAGE").value
        running.write("STOP", 1)
        bench.await_state("stopped")
    finally:
        Client(bench.client.path, "ada").delete("/lock")
    assert running.read("ARMED").value == 0
    with pytest.raises(REFUSED):
        running.write("START", 1)
    assert "rtloop ctl arm" in running.read("MESSAGE").value


def test_a_trip_is_a_major_alarm_with_its_cause_until_it_is_reset(bench: Bench, running: Adapter):
    by_epics = Client(bench.client.path, "epics")
    by_epics.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 30.0}})
    try:
        running.write("x:SETPOINT", 29.9)
        by_epics.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 25.0}})
        bench.await_state("tripped", "position")
        assert running.await_alarm("TRIPPED", "MAJOR", "STATE") == 1
        assert running.await_alarm("STATE", "MAJOR", "STATE") == "tripped"
        running.await_text("CAUSE", bench.status()["trip_reason"])
        with pytest.raises(REFUSED):
            running.write("START", 1)
        running.write("RESET", 1)
        assert running.read("TRIPPED") == (0, "NO", "NO_ALARM")
    finally:
        bench.await_state("stopped")
        by_epics.post("/tune", {"axis": "x", "section": "interlocks", "values": {"position_um": 60.0}})


def test_without_allow_control_nothing_can_be_written(bench: Bench, running: Adapter):
    """The server also refuses a client that ignores its rights and sends the bytes of a write."""
    with Adapter(bench, "READ:") as ioc:
        assert ioc.read("x:SETPOINT").value == 20.0
        for suffix, value in (("x:SETPOINT", 25.0), ("STOP", 1), ("MODE", 0), ("x:POSITION", 1.0), ("CONNECTED", 0)):
            with pytest.raises(caproto.CaprotoError):
                ioc.write(suffix, value)
        rights, error = _write_despite_rights(ioc, "x:SETPOINT", 25.0)
        assert (rights, error) == (1, True)
        rights, error = _write_despite_rights(running, "x:POSITION", 25.0)
        assert (rights, error) == (1, True), "a measured value is read-only for all clients"
        assert _write_despite_rights(running, "x:SETPOINT", 23.0) == (3, False)
    status = bench.status()
    assert (status["state"], status["axes"]["x"]["reference_um"]) == ("running", 23.0)


def _write_despite_rights(ioc: Adapter, suffix: str, value: float) -> tuple[int, bool]:
    """Return the rights that the server grants (1 read + 2 write), and whether it answers a write with an error.

    The request is composed from the protocol's specification: version, name of the channel, acknowledged write of a
    double.
    """
    name = (ioc.prefix + suffix).encode() + b"\0"
    name += bytes(-len(name) % 8)
    rights, sid = None, None
    with socket.create_connection((HOST, ioc.port), TIMEOUT_S) as connection:
        stream = connection.makefile("rb")
        connection.sendall(
            struct.pack(">4H2I", 0, 0, 0, 13, 0, 0) + struct.pack(">4H2I", 18, len(name), 0, 0, 1, 13) + name
        )
        while True:
            command, size, _, _, first, second = struct.unpack(">4H2I", stream.read(16))
            stream.read(size)
            if command == 22:
                rights = second
            elif command == 18:
                sid = second
                connection.sendall(struct.pack(">4H2I", 19, 8, 6, 1, sid, 5) + struct.pack(">d", value))
            elif command in (11, 19):
                assert rights is not None
                return rights, command == 11 or first != 1


def test_foreign_bytes_end_neither_the_server_nor_the_channels(running: Adapter):
    rng = random.Random(1)
    with socket.socket(type=socket.SOCK_DGRAM) as datagrams:
        for size in (0, 1, 15, 16, 17, 64, 1400, 9000):
            datagrams.sendto(rng.randbytes(size), (HOST, running.port))
        for command in range(30):  # A header of each command, with a random payload.
            datagrams.sendto(struct.pack(">4H2I", command, 8, 5, 13, 1, 1) + rng.randbytes(8), (HOST, running.port))
    texts = [b"GET / HTTP/1.1\r\n\r\n", b"", rng.randbytes(5000), b"\0" * 100, b"\xff" * 100]
    texts += [struct.pack(">4H2I", command, 8, 6, 1, 77, 1) + rng.randbytes(8) for command in range(30)]
    texts.append(struct.pack(">4H2I2I", 18, 0xFFFF, 0, 0, 1, 13, 0xFFFFFFF0, 0))  # A header that announces 4 GiB.
    for text in texts:
        with socket.create_connection((HOST, running.port), TIMEOUT_S) as connection:
            connection.sendall(text)
    assert running.process.poll() is None, running.log()
    running.write("x:SETPOINT", 24.0)
    assert running.read("x:SETPOINT").value == 24.0


def test_a_service_that_stands_still_makes_the_channels_invalid(bench: Bench, running: Adapter):
    os.kill(bench.pid("service"), signal.SIGSTOP)
    try:
        assert running.await_alarm("CONNECTED", "INVALID", "COMM") == 0
        running.await_text("MESSAGE", "has not answered")
    finally:
        os.kill(bench.pid("service"), signal.SIGCONT)
    assert running.await_alarm("CONNECTED", "NO", "NO_ALARM") == 1


def kill_service(bench: Bench, ioc: Adapter) -> None:
    """Kill the service and its loop; check that all channels become INVALID and that the position keeps its value."""
    last_um, service = ioc.read("x:POSITION").value, bench.service
    assert service is not None
    for pid in (bench.pid("service"), bench.pid("rt")):
        os.kill(pid, signal.SIGKILL)
    service.wait()
    assert ioc.await_alarm("CONNECTED", "INVALID", "COMM") == 0
    for suffix in ("STATE", "MODE", "ARMED", "TRIPPED", "TICK", "RATE", "MESSAGE", *AXIS_SUFFIXES):
        ioc.await_alarm(suffix, "INVALID", "COMM")
    assert ioc.read("x:POSITION").value == pytest.approx(last_um, abs=NOISE_UM)
    ioc.await_text("MESSAGE", "the service has died")
    with pytest.raises(REFUSED):
        ioc.write("x:SETPOINT", 20.0)


@pytest.mark.soak
def test_channels_are_valid_again_once_a_killed_service_is_back(bench: Bench, running: Adapter):
    kill_service(bench, running)
    assert bench.rtloop("park", bench.config).wait() == 0
    bench.start_service()
    assert running.await_alarm("CONNECTED", "NO", "NO_ALARM") == 1
    for suffix in ("STATE", "MODE", *AXIS_SUFFIXES):
        running.await_alarm(suffix, "NO", "NO_ALARM")


def test_a_server_that_ends_releases_the_lock(bench: Bench, ioc: Adapter):
    with Adapter(bench, "ENDS:", "--allow-control", "--as", "ends") as ends:
        if bench.status()["lock"]:
            Client(bench.client.path, "epics").delete("/lock")
        ends.write("ARM", 1)
        assert bench.status()["lock"]["name"] == "ends"
    assert bench.status()["lock"] is None
    ioc.write("STOP", 1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--interface", "localhost"), "value is 'localhost'; allowed: an IPv4 address"),
        (("--prefix", "a b"), "value is 'a b'; allowed: 1 to 40 letters"),
    ],
)
def test_an_option_that_cannot_be_used_is_named(options: tuple[str, ...], text: str):
    result = run("epics", *options)
    assert (result.exit_code, text in " ".join(result.output.split())) == (2, True), result.output


@pytest.mark.parametrize(
    ("options", "port", "text"),
    [
        (("--interface", "192.0.2.1"), "5064", "Channel Access on 192.0.2.1: [Errno 99]"),
        ((), "many", "EPICS_CA_SERVER_PORT misconfigured"),
    ],
)
def test_an_address_that_cannot_be_used_is_named(tmp_path: Path, options: tuple[str, ...], port: str, text: str):
    command = [sys.executable, "-m", "rtloop", "epics", "--socket", str(tmp_path / "x.sock"), *options]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "EPICS_CA_SERVER_PORT": port}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert (result.returncode, text in result.stderr) == (69, True), result.stderr
    assert "Traceback" not in result.stderr


def test_all_channels_are_invalid_after_the_death_of_the_service(bench: Bench, ioc: Adapter):
    """This test is the last of the file, for it kills the service for good."""
    kill_service(bench, ioc)
