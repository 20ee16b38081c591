"""The program rtloop-node as a process: sessions over UDP and a pseudo-terminal, watchdog, restarts, options."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import time
import tty
from pathlib import Path

import pytest

from tests.node.bench import KEY
from tests.node.frames import (
    ANSWER,
    APPLY,
    AT_SAFE,
    KEYED,
    OPEN,
    PARK,
    READY,
    UNKNOWN,
    VERSION,
    WATCHDOG,
    Refusal,
    Sample,
    Seal,
    Welcome,
    cobs,
    drive,
    hello,
    parse,
)
from tests.node.node_process import (
    NO_KEY,
    Exchange,
    read_witness,
    running,
    serial_client,
    serial_line,
    udp_client,
    wait_until,
)

pytestmark = pytest.mark.system

LONG_US = 4_000_000
"""Hold time of the watchdog that a busy machine does not exceed between two frames."""


def open_and_set(exchange: Exchange, codes: list[int], hold_us: int = LONG_US) -> None:
    """Open session 5 and set the outputs to codes."""
    answer = exchange(drive(5, 1, OPEN | ANSWER, [0] * len(codes), hold_us=hold_us))
    assert isinstance(answer, Sample)
    assert answer.flags == READY | AT_SAFE
    answer = exchange(drive(5, 2, APPLY | ANSWER, codes, digital=9, hold_us=hold_us))
    assert isinstance(answer, Sample)
    assert (answer.flags & READY, answer.applied) == (READY, 2)


def test_a_session_over_udp_from_hello_to_park(programs: Path, tmp_path: Path):
    witness = tmp_path / "witness"
    options = ("--port", "0", "--channels", "2", "--loopback", "--hold", LONG_US, "--witness", witness)
    with running(programs, *map(str, options)) as node, udp_client(node.port) as exchange:
        welcome = exchange(hello(5))
        assert isinstance(welcome, Welcome)
        assert (welcome.counts, welcome.boot, welcome.flags) == ((2, 2, 4, 4), node.boot, 0)
        assert welcome.channels[2][:5] == (-32768, 32767, 0, 330, 10 / 32768)
        open_and_set(exchange, [1000, -2000])
        answer = exchange(drive(5, 3, APPLY | ANSWER, [-32768, 32767], hold_us=LONG_US))
        assert isinstance(answer, Sample)
        assert (answer.codes, answer.digital, answer.boot) == ((1000, -2000), 9, node.boot)
        assert 0 < answer.age_ns < 1e9
        assert [output.code for output in read_witness(witness).outputs] == [-32768, 32767]
        exchange(drive(5, 4, APPLY | ANSWER, [700, 0], hold_us=LONG_US))
        answer = exchange(drive(5, 5, PARK | ANSWER, [0, 0], hold_us=LONG_US))
        while isinstance(answer, Sample) and not answer.flags & AT_SAFE:
            answer = exchange(drive(5, answer.sequence + 1, PARK | ANSWER, [0, 0], hold_us=LONG_US))
        assert isinstance(answer, Sample)
        assert answer.flags == AT_SAFE
        counters = node.stop()
    assert counters == dict(counters, sessions=1, watchdog_trips=0, invalid=0, old=0, refused=0, unsent=0)
    assert [output.code for output in read_witness(witness).outputs] == [0, 0]


@pytest.mark.parametrize("spin", [False, True])
def test_the_watchdog_ramps_the_outputs_down(programs: Path, tmp_path: Path, spin: bool):
    witness = tmp_path / "witness"
    options = ["--port", "0", "--hold", "500000", "--change", "50", "--witness", str(witness), *["--spin"] * spin]
    with running(programs, *options) as node, udp_client(node.port) as exchange:
        for code in range(0, 600, 40):  # no change is larger than a step of the ramp
            if code == 0:
                open_and_set(exchange, [0], hold_us=500_000)
            else:
                exchange(drive(5, 2 + code, APPLY | ANSWER, [code], hold_us=500_000))
            time.sleep(0.0015)  # more than 1 ms of the node's clock
        wait_until(lambda: read_witness(witness).watchdog_trips == 1)
        wait_until(lambda: read_witness(witness).outputs[0].code == 0)
        content = read_witness(witness)
        assert content.outputs[0].change == content.outputs[0].change_per_ms == 50
        assert content.digital == 0
        assert content.writes == 2 + 15 + 1 + 12  # start, OPEN, APPLYs, begin of the ramp, 560 codes by 50
        answer = exchange(drive(5, 1000, APPLY | ANSWER, [560]))
        assert answer == Refusal(1000, 5, node.boot, WATCHDOG, opening=1)
        assert node.stop()["watchdog_trips"] == 1


def test_sigterm_parks_by_a_ramp_before_the_program_ends(programs: Path, tmp_path: Path):
    witness = tmp_path / "witness"
    options = ("--port", "0", "--hold", str(LONG_US), "--change", "100", "--witness", str(witness))
    with running(programs, *options) as node, udp_client(node.port) as exchange:
        open_and_set(exchange, [1050])
        before = read_witness(witness)
        counters = node.stop()
    after = read_witness(witness)
    assert (after.outputs[0].code, after.digital) == (0, 0)
    assert after.writes == before.writes + 1 + 11
    assert counters["watchdog_trips"] == 0


def test_a_killed_and_restarted_node_has_another_boot(programs: Path):
    with running(programs, "--port", "0", "--hold", str(LONG_US)) as node, udp_client(node.port) as exchange:
        open_and_set(exchange, [100])
        node.stop(signal.SIGKILL)
        with running(programs, "--port", str(node.port)) as restarted:
            assert restarted.boot != node.boot
            assert exchange(drive(5, 3, APPLY | ANSWER, [100])) == Refusal(3, 5, restarted.boot, UNKNOWN)


def write_key(path: Path, text: str = KEY.hex() + "\n", mode: int = 0o600) -> Path:
    """Write a file with a key, and return its path."""
    path.write_text(text, encoding="ascii")
    path.chmod(mode)
    return path


def test_a_node_with_a_key_obeys_the_loop_that_has_it(programs: Path, tmp_path: Path):
    options = ("--port", "0", "--hold", str(LONG_US), "--key", write_key(tmp_path / "key"))
    with running(programs, *options) as node, udp_client(node.port) as exchange:
        seal = Seal(KEY, node.boot)
        welcome = exchange(hello(5), seal)
        assert isinstance(welcome, Welcome)
        assert (welcome.flags, welcome.opening) == (KEYED, 0)
        frames = [drive(5, 1 + i, act | ANSWER, [0], hold_us=LONG_US, seal=seal) for i, act in enumerate((OPEN, PARK))]
        assert isinstance(exchange(frames[0], seal), Sample)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for forged in (frames[1][:-12], drive(5, 2, APPLY, [9]), drive(5, 2, APPLY, [9], seal=seal)):
                stranger.sendto(forged, ("127.0.0.1", node.port))
        assert isinstance(exchange(frames[1], seal), Sample)
        counters = node.stop()
    assert counters == dict(counters, sessions=1, invalid=1, foreign=2, old=0, refused=0)


def test_a_session_over_a_pseudo_terminal(programs: Path, tmp_path: Path):
    link = tmp_path / "line"
    with running(programs, "--pty", str(link), "--channels", "3", "--hold", str(LONG_US)) as node:
        with serial_client(link) as exchange:
            assert isinstance(exchange(hello(5)), Welcome)
            open_and_set(exchange, [1, 2, 3])
            assert exchange(hello(5, version=1)) == Refusal(1, 5, node.boot, VERSION)
        with link.open("wb", buffering=0) as line:
            line.write(b"\3garbage\0" + bytes(100) + b"\5cut\0" + b"\x09begun" + b"\0")
        with serial_client(link) as exchange:
            answer = exchange(drive(5, 3, ANSWER, [0, 0, 0], hold_us=LONG_US))
            assert isinstance(answer, Sample)
            assert answer.flags == READY
        counters = node.stop()
    assert counters == dict(counters, damaged=3, invalid=0, sessions=1, unsent=0)
    assert not link.is_symlink()


def test_many_frames_in_one_write_are_all_answered(programs: Path, tmp_path: Path):
    link = tmp_path / "line"
    with running(programs, "--pty", str(link)) as node, serial_line(link) as exchange_bytes:
        frames = [hello(5, version=1, sequence=i) for i in range(60)]
        answers = exchange_bytes(b"".join(map(cobs, frames)), len(frames))
        assert [parse(answer) for answer in answers] == [Refusal(i, 5, node.boot, VERSION) for i in range(60)]


def test_a_serial_device_that_goes_away_parks_the_outputs(programs: Path, tmp_path: Path):
    witness = tmp_path / "witness"
    line_fd, device_fd = os.openpty()
    tty.setraw(device_fd)
    name = os.ttyname(device_fd)
    with running(programs, "--tty", name, "--hold", str(LONG_US), "--change", "100", "--witness", str(witness)) as node:
        os.close(device_fd)
        frames = drive(5, 1, OPEN, [0], hold_us=LONG_US), drive(5, 2, APPLY, [250], hold_us=LONG_US)
        os.write(line_fd, b"".join(map(cobs, frames)))
        wait_until(lambda: read_witness(witness).outputs[0].code == 250)
        os.close(line_fd)
        output, errors = node.process.communicate(timeout=10)
    assert (node.process.returncode, errors) == (1, f"{NO_KEY}--tty: {name}: the device is gone\n")
    assert json.loads(output)["sessions"] == 1
    assert read_witness(witness).outputs[0] == (0, 250, 250)


def test_a_node_that_was_killed_leaves_a_link_that_the_next_one_replaces(programs: Path, tmp_path: Path):
    link = tmp_path / "line"
    with running(programs, "--pty", str(link)) as node:
        node.stop(signal.SIGKILL)
        assert link.is_symlink()
        with running(programs, "--pty", str(link)) as successor, serial_client(link) as exchange:
            welcome = exchange(hello(5))
            assert isinstance(welcome, Welcome)
            assert welcome.boot == successor.boot != node.boot


def test_a_node_is_reached_by_both_versions_of_ip(programs: Path):
    with running(programs, "--port", "0") as node:
        with udp_client(node.port) as exchange:
            assert isinstance(exchange(hello()), Welcome)
            open_and_set(exchange, [7])
        try:
            socket.create_server(("::1", 0), family=socket.AF_INET6).close()
        except OSError:
            pytest.skip("no IPv6 here")
        with udp_client(node.port, "::1") as exchange:
            assert isinstance(exchange(hello()), Welcome)
            assert isinstance(exchange(drive(5, 3, APPLY | ANSWER, [8])), Refusal)  # another address


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--port", "70000"], "--port: value is 70000; allowed: 0 to 65535\n"),
        (["--port", "x"], "--port: value is x; allowed: 0 to 65535\n"),
        (["--port"], "--port: value is missing; allowed: 0 to 65535\n"),
        (["--damping", "1"], "--damping: value is 1; allowed: 0 to 0.999\n"),
        (["--bind", "here"], "--bind: value is here; allowed: a numeric IPv4 or IPv6 address\n"),
        (["--bind"], "--bind: value is missing\n"),
        (["--tty", "/nowhere"], "--tty: /nowhere: No such file or directory\n"),
        (["--tty", "a", "--pty", "b"], "--pty: value is b; allowed: either --tty or --pty\n"),
        (["--key", "/nowhere"], "--key: /nowhere: No such file or directory\n"),
        (["--witness", "/nowhere/file"], "--witness: /nowhere/file: No such file or directory\n"),
        (["--speed", "9"], "--speed: is no option; --help lists them\n"),
    ],
)
def test_a_mistake_on_the_command_line_is_named(programs: Path, options: list[str], message: str):
    result = subprocess.run([programs / "rtloop-node", *options], capture_output=True, text=True, timeout=10)
    assert (result.returncode, result.stderr, result.stdout) == (1, message, "")


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (KEY.hex(), 0o640, "has mode 640; allowed: no right for group and others; run chmod 600 {path}"),
        (KEY.hex(), 0o602, "has mode 602; allowed: no right for group and others; run chmod 600 {path}"),
        (KEY.hex()[1:], 0o600, "is no key; allowed: a file of 32 hexadecimal digits"),
        (KEY.hex() + "0", 0o600, "is no key; allowed: a file of 32 hexadecimal digits"),
        (KEY.hex()[2:] + "0x", 0o600, "is no key; allowed: a file of 32 hexadecimal digits"),
        ("", 0o400, "is no key; allowed: a file of 32 hexadecimal digits"),
    ],
)
@pytest.mark.parametrize("program", [["rtloop-node"], ["exchange", "localhost", "1"]])
def test_a_key_that_others_can_read_or_that_is_none_is_named(
    programs: Path, tmp_path: Path, program: list[str], text: str, mode: int, message: str
):
    path = write_key(tmp_path / "key", text, mode)
    command = [programs / program[0], *program[1:], "--key", path]
    result = subprocess.run(command, capture_output=True, text=True, timeout=10)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == f"--key: {path} {message.format(path=path)}\n"


def test_the_simulated_resonator_overshoots_and_settles_as_its_equation_says(programs: Path):
    """The oracle: after a step the first peak is g·u·(1 + q), the first dip g·u·(1 − q²), with q = e^(−π·d/√(1−d²))."""
    options = ("--port", "0", "--frequency", "40", "--damping", "0.1", "--gain", "2", "--hold", str(LONG_US))
    with running(programs, *options) as node, udp_client(node.port) as exchange:
        open_and_set(exchange, [8000])
        codes, end_s = [], time.monotonic() + 0.4
        while time.monotonic() < end_s:
            answer = exchange(drive(5, 3 + len(codes), ANSWER, [0], hold_us=LONG_US))
            assert isinstance(answer, Sample)
            codes.append(answer.codes[0])
    overshoot = 2.718281828459045 ** (-0.1 * 3.141592653589793 / (1 - 0.1**2) ** 0.5)
    assert max(codes) <= 16000 * (1 + overshoot) + 1
    assert min(codes[codes.index(max(codes)) :]) >= 16000 * (1 - overshoot**2) - 1
    assert abs(codes[-1] - 16000) <= 4  # after 16 periods: e^(−10)


@pytest.mark.parametrize("mode", [["--rate", "1000"], ["--rate", "0"], ["--rate", "1000", "--next-tick"]])
@pytest.mark.parametrize("has_key", [False, True])
def test_the_benchmark_client_exchanges_and_parks(programs: Path, tmp_path: Path, mode: list[str], has_key: bool):
    key = ["--key", write_key(tmp_path / "key")] if has_key else []
    with running(programs, "--port", "0", "--hold", str(LONG_US), *key) as node:
        command = [
            programs / "exchange",
            "127.0.0.1",
            str(node.port),
            "--count",
            "50",
            "--hold",
            str(LONG_US),
            *mode,
            *key,
        ]
        result = subprocess.run(command, capture_output=True, text=True, timeout=30)
        assert result.returncode == 0, result.stderr
        figures = json.loads(result.stdout)
        counters = node.stop()
    assert figures["exchanges"] == 50
    assert 0 <= figures["lost"] < 50  # a busy machine may answer too late
    assert 0 < figures["answer_us"]["p50"] <= figures["answer_us"]["p99"] <= figures["answer_us"]["max"]
    assert counters == dict(counters, sessions=1, watchdog_trips=0, invalid=0, old=0, refused=0)


def test_the_help_lists_the_options(programs: Path):
    text = subprocess.run([programs / "rtloop-node", "--help"], capture_output=True, text=True, check=True).stdout
    for option in (
        "--port",
        "--bind",
        "--tty",
        "--pty",
        "--key",
        "--spin",
        "--priority",
        "--witness",
        "--channels",
        "--loopback",
    ):
        assert f"  {option} " in text
