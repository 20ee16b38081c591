"""Attacks on a loop and its node by other users of the loop's computer, and by somebody who can forge addresses."""

from __future__ import annotations

import ctypes
import fcntl
import multiprocessing
import os
import random
import socket
import struct
import time
import tty
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest

from rtloop.drivers.contract import DriverCalls
from rtloop.drivers.errors import DriverError
from rtloop.drivers.node import link
from rtloop.drivers.node.driver import NodeDriver, SerialDriver
from rtloop.drivers.node.link import SerialLink, UdpLink
from rtloop.drivers.node.options import SerialOptions, UdpOptions
from tests.drivers.bench_driver import open_driver
from tests.drivers.lossy_relay import Relay, relayed
from tests.drivers.node_bench import ONE_AXIS, NodeProcess, make_key, make_options
from tests.drivers.relayed_nodes import PythonNode
from tests.faults.evidence import wait_for
from tests.node.frames import ANSWER, APPLY, OPEN, UNSEALED, Seal, cobs, drive
from tests.users import ATTACKER, ROOT_ONLY, VICTIM, as_user

pytestmark = pytest.mark.system

PATIENT = {"watchdog_ms": 5000.0, "error_limit": 1_000_000, "hold_ticks": 1000, "wait_s": 60.0}
LARGEST = 2**23 - 1
"""Code of the output's highest voltage."""
UNWATCHED = socket.socket
SHARING = (socket.SO_REUSEADDR, socket.SO_REUSEPORT)
ADDRESSES = (("", socket.AF_INET), ("127.0.0.1", socket.AF_INET), ("::", socket.AF_INET6),
             ("::ffff:127.0.0.1", socket.AF_INET6))  # fmt: skip
"""Addresses whose sockets receive datagrams to 127.0.0.1, with their family."""
NODE_PORT, ONLY_PORT = 5747, 40_000
CLONE_NEWNET, SIOCSIFFLAGS, IFF_UP = 0x4000_0000, 0x8914, 1
"""Numbers of Linux: a new network for unshare(2); the request and the flag that switch an interface on."""


def bound_as_attacker(port: int) -> list[tuple[str, tuple[int, ...]]]:
    """Return address and options of the sockets by which another user gets a share of a UDP port of this computer."""

    def attempt() -> list[tuple[str, tuple[int, ...]]]:
        bound = []
        for (address, family), chosen in product(ADDRESSES, ((), SHARING[:1], SHARING[1:], SHARING)):
            with UNWATCHED(family, socket.SOCK_DGRAM) as thief:
                if family == socket.AF_INET6:
                    thief.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
                for option in chosen:
                    thief.setsockopt(socket.SOL_SOCKET, option, 1)
                try:
                    thief.bind((address, port))
                except OSError:
                    continue
                bound.append((address, chosen))
        return bound

    return as_user(ATTACKER, attempt)


def enter_namespace_with_one_free_port() -> None:
    """Move this process into a network of its own, where a socket that asks for any port gets ONLY_PORT."""
    assert ctypes.CDLL(None, use_errno=True).unshare(CLONE_NEWNET) == 0, os.strerror(ctypes.get_errno())
    with UNWATCHED(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP))
    Path("/proc/sys/net/ipv4/ip_local_port_range").write_text(f"{ONLY_PORT} {ONLY_PORT}")


def hammer_port(seed: int) -> None:
    """Bind ONLY_PORT with every option, again and again; end with code 1 if a datagram of the node arrives."""
    os.setgid(ATTACKER)
    os.setuid(ATTACKER)
    draw = random.Random(seed)
    while True:
        address, family = draw.choice(ADDRESSES)
        with UNWATCHED(family, socket.SOCK_DGRAM) as thief:
            if family == socket.AF_INET6:
                thief.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
            for option in draw.choice(((), SHARING[:1], SHARING[1:], SHARING)):
                thief.setsockopt(socket.SOL_SOCKET, option, 1)
            time.sleep(draw.uniform(0.0, 0.001))
            for _ in range(200):
                with suppress(OSError):
                    thief.bind((address, ONLY_PORT))
                    thief.connect(("::ffff:127.0.0.1" if family == socket.AF_INET6 else "127.0.0.1", NODE_PORT))
                    thief.settimeout(0.0003)
                    if thief.recv(100) == b"node":
                        os._exit(1)


def open_beside_thieves(opens: int) -> int:
    """Open links at ONLY_PORT between two thieves, and send ten datagrams to each. Returns how many were not received.

    An open that finds the port taken is tried again.
    """
    enter_namespace_with_one_free_port()
    thieves = [multiprocessing.get_context("fork").Process(target=hammer_port, args=(seed,)) for seed in (1, 2)]
    for thief in thieves:
        thief.start()
    lost = 0
    with UNWATCHED(socket.AF_INET, socket.SOCK_DGRAM) as node:
        node.bind(("127.0.0.1", NODE_PORT))
        while opens:
            try:
                opened = UdpLink(UdpOptions(host="127.0.0.1", port=NODE_PORT))
            except DriverError:
                continue
            opens -= 1
            for _ in range(10):
                node.sendto(b"node", ("127.0.0.1", ONLY_PORT))
            lost += sum(opened.receive(0.0 if lost else 1.0) != b"node" for _ in range(10))
            opened.close()
    for thief in thieves:
        thief.kill()
        thief.join()
    return lost


@ROOT_ONLY
def test_thieves_that_know_the_next_port_get_no_datagram_of_the_node():
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as other_process:
        assert other_process.submit(open_beside_thieves, 2000).result() == 0


class WatchedSocket(socket.socket):
    """A socket after whose every call an attacker tries to share its port."""

    stolen: list[tuple[str, tuple[int, ...]]]
    attempts: list[str]

    def _attack(self, call: str) -> None:
        if port := self.getsockname()[1]:
            self.attempts.append(call)
            self.stolen += bound_as_attacker(port)

    def setsockopt(self, *arguments) -> None:
        """Set an option, then attack."""
        super().setsockopt(*arguments)
        self._attack("setsockopt")

    def bind(self, address) -> None:
        """Bind, then attack."""
        super().bind(address)
        self._attack("bind")

    def connect(self, address) -> None:
        """Connect, then attack."""
        super().connect(address)
        self._attack("connect")


@ROOT_ONLY
@pytest.mark.parametrize(("host", "bind"), [("127.0.0.1", None), ("127.0.0.1", "127.0.0.1"), ("::1", None)])
def test_no_other_user_shares_the_loop_s_port_at_any_moment(monkeypatch: pytest.MonkeyPatch, host: str, bind):
    WatchedSocket.stolen, WatchedSocket.attempts = [], []
    with monkeypatch.context() as patched:
        patched.setattr(link.socket, "socket", WatchedSocket)
        opened = UdpLink(UdpOptions(host=host, port=5747, bind=bind))
    opened.close()
    assert WatchedSocket.attempts.count("bind") == 2
    assert "connect" in WatchedSocket.attempts
    assert WatchedSocket.stolen == []


def test_the_node_s_datagrams_reach_one_socket_and_all_others_the_other_one():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as node, socket.socket(type=socket.SOCK_DGRAM) as stranger:
        node.bind(("127.0.0.1", 0))
        for _ in range(100):
            opened = UdpLink(UdpOptions(host="127.0.0.1", port=node.getsockname()[1]))
            opened.send(b"hello")
            _, address = node.recvfrom(100)
            for sender, text in ((stranger, b"stranger"), (node, b"node"), (stranger, b"stranger")):
                sender.sendto(text, address)
            assert (opened.receive(1.0), opened.receive(0.0)) == (b"node", None)
            assert opened.strangers_fd is not None
            assert [os.read(opened.strangers_fd, 100) for _ in range(2)] == [b"stranger"] * 2
            opened.close()


@ROOT_ONLY
def test_no_other_user_opens_the_terminal_of_a_loop(tmp_path: Path):
    node_end, loop_end = os.openpty()
    tty.setraw(loop_end)
    terminal = os.ttyname(loop_end)
    os.chmod(terminal, 0o666)  # as for a group whose members may use the device

    def result_of_opening() -> str:
        try:
            os.close(os.open(terminal, os.O_RDWR | os.O_NOCTTY))
        except OSError as error:
            return error.strerror
        return "open"

    def open_as_victim() -> tuple[str, str]:
        opened = SerialLink(SerialOptions(device=terminal))
        try:
            SerialLink(SerialOptions(device=terminal))
        except DriverError as error:
            return str(error), result_of_opening()
        finally:
            opened.close()
        return "", ""

    opened = SerialLink(SerialOptions(device=terminal))
    assert as_user(ATTACKER, result_of_opening) == "Device or resource busy"
    opened.close()
    assert as_user(ATTACKER, result_of_opening) == "open"
    refusal, _ = as_user(VICTIM, open_as_victim)
    assert "another program uses this line; stop that program" in refusal
    os.close(node_end)
    os.close(loop_end)


class Attack:
    """An attacker who knows session, boot, opening and newest sequence of a loop, and sends from its address."""

    def __init__(self, node: NodeProcess, driver: NodeDriver) -> None:
        assert driver._link is not None
        assert driver._card is not None
        names = ("session", "boot", "opening", "last_sequence")
        self.session, self.boot, self.opening, self._newest = (int(driver._card[name][0]) for name in names)
        self._terminal = node.options.get("device")
        self._fd = os.dup(driver._link.fd)  # a socket, or a terminal that was opened before the loop

    def send(self, step: int, flags: int, seal: Seal = UNSEALED) -> None:
        """Send a DRIVE with the largest code, `step` after the newest sequence."""
        content = drive(self.session, (self._newest + step) % 2**32, flags, [LARGEST], 0, 2**32 - 1, seal)
        os.write(self._fd, cobs(content) if self._terminal else content)

    def close(self) -> None:
        """Close the attacker's end."""
        os.close(self._fd)


@pytest.fixture(params=["udp", "udp with a key", "serial with a key"])
def node(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[NodeProcess]:
    """Yield a node's process, which outlives its loops."""
    kind, _, has_key = request.param.partition(" ")
    node = NodeProcess(kind, tmp_path, **({"key": make_key(tmp_path)} if has_key else {}))
    yield node
    node.end()


def test_a_stolen_session_moves_no_output_of_a_node_with_a_key_and_parking_ends_it_without_one(node: NodeProcess):
    driver = node.driver(rate_hz=100.0, **PATIENT)
    calls = DriverCalls(driver.open(), driver.facts)
    calls.read()
    calls.write([1.0])
    wait_for(lambda: node.output_v == pytest.approx(1.0, abs=1e-5), "the drive")
    attack = Attack(node, driver)
    known = attack.boot, attack.opening
    has_key = "key" in node.options
    for step in (1, 2, 1000, 200_000, 2**30, 2**31):
        for seal in (UNSEALED, Seal(bytes(range(16)), *known)):
            attack.send(step, APPLY | ANSWER, seal)
            attack.send(step, OPEN | ANSWER, seal)
    if has_key:
        assert node.settled_output_v() == pytest.approx(1.0, abs=1e-5)
        calls.write([2.0])
        wait_for(lambda: node.output_v == pytest.approx(2.0, abs=1e-5), "the next drive")
        wait_for(lambda: (calls.read()[0], calls.write([2.0])) == (0, 0), "an answer")
        assert driver.error is None
    else:
        wait_for(lambda: node.output_v == pytest.approx(10.0, abs=1e-5), "a stolen output")
    attack.close()
    driver.close()
    assert abs(node.settled_output_v()) < 1e-5


def test_a_session_that_was_recorded_drives_nothing_once_more(tmp_path: Path):
    moved = {}
    for key in (None, make_key(tmp_path)):
        node = PythonNode(key=key)
        with relayed(node) as relay:
            sent = record_session(relay, key)
        voltages = []
        for content in sent:
            relay.now_us += 1000
            node.receive(content, "loop", relay.now_us)
            voltages.append(node.volts(node.outputs[0]))
        moved[key] = max(map(abs, voltages))
        assert len(sent) > 20
    assert moved[None] == pytest.approx(3.0, abs=1e-3)  # The recording drives a node without a key.
    assert moved[key] < 1e-5


def record_session(relay: Relay, key: str | None) -> list[bytes]:
    """Drive 3 V behind a relay in twenty ticks, park, and return all datagrams of the loop."""
    sent, receive = [], relay.node.receive

    def record(content: bytes, sender: str, now_us: int) -> bytes:
        sent.append(content)
        return receive(content, sender, now_us)

    relay.node.receive = record  # type: ignore[method-assign]
    options = make_options("udp", {"host": "127.0.0.1", "port": relay.port, "key": key} | PATIENT)
    with open_driver(link_driver(options)) as calls:
        for _ in range(20):
            calls.read()
            handled = relay.handled
            calls.write([3.0])
            relay.wait_handled(handled + 1)
    relay.node.receive = receive  # type: ignore[method-assign]
    return sent


def link_driver(options) -> NodeDriver:
    """Return a driver of the options' kind, not yet open."""
    from rtloop.drivers.node.driver import UdpDriver

    return (UdpDriver if isinstance(options, UdpOptions) else SerialDriver)(options, ONE_AXIS, 500.0)


def checksum(data: bytes) -> int:
    """Return the checksum of an IP header or an ICMP message (RFC 1071)."""
    total = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def forge_refusals(loop_port: int, node_port: int) -> Callable[[], None]:
    """Return a function that tells the loop's system that no program receives at the node's port: ICMP (RFC 792)."""
    home = socket.inet_aton("127.0.0.1")
    original = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 36, 1, 0, 64, socket.IPPROTO_UDP, 0, home, home)
    original += struct.pack(">HHHH", loop_port, node_port, 16, 0)
    message = struct.pack(">BBHI", 3, 3, 0, 0) + original
    message = message[:2] + struct.pack(">H", checksum(message)) + message[4:]

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as raw:
            raw.sendto(message, ("127.0.0.1", 0))

    return send


@ROOT_ONLY
def test_forged_reports_that_the_node_does_not_listen_lose_no_frame():
    node = PythonNode()
    with relayed(node) as relay:
        options = make_options("udp", {"host": "127.0.0.1", "port": relay.port} | PATIENT)
        driver = link_driver(options)
        with open_driver(driver) as calls:
            assert calls.read()[0] == 0
            assert driver._link is not None
            with socket.socket(fileno=os.dup(driver._link.fd)) as copy:
                send = forge_refusals(copy.getsockname()[1], relay.port)
                send()
                assert copy.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) != 0  # The loop's system believes it.
            for tick in range(20):
                send()
                handled = relay.handled
                calls.write([0.1 * tick])
                relay.wait_handled(handled + 1)
                send()
                assert calls.read()[0] == 0
            send()
