"""The key that loop and node share: its file, the tags that it makes, and a loop and a node that do not fit."""

from __future__ import annotations

import os
import pickle
import re
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.stream_reader import StreamReader

from rtloop.configuration.cautions import option_cautions
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.driver import NodeDriver, UdpDriver
from rtloop.drivers.node.keys import read_key
from rtloop.drivers.node.tags import Seal, key_words, siphash, tag_of
from rtloop.supervision.hardware import Hardware
from tests.drivers.bench_driver import open_driver
from tests.drivers.lossy_relay import relayed
from tests.drivers.node_bench import ONE_AXIS, NodeProcess, free_udp_port, make_key, make_options
from tests.drivers.processes import completed
from tests.drivers.processes import rtloop as start_rtloop
from tests.drivers.relayed_nodes import PythonNode
from tests.node import frames
from tests.stage_text import one_axis
from tests.users import ATTACKER, ROOT_ONLY

pytestmark = pytest.mark.system

KEY = "0123456789abcdefFEDCBA9876543210"
CONFIG = """
[loop]
rate_hz = 500
mode = "raw"
[driver]
kind = "udp"
{key}
[driver.channels.x]
input = "adc0"
output = "dac0"
um_per_v = 10.0
"""


def test_the_published_vector():
    message = np.arange(15, dtype=np.uint8)
    low, high = map(np.uint64, key_words(bytes(range(16))))
    assert siphash(low, high, message.ctypes.data, 15) == 0xA129CA6149BE45E5


@settings(max_examples=200, deadline=None)
@given(key=st.binary(min_size=16, max_size=16), data=st.binary(max_size=90), start=st.integers(0, 7))
def test_the_compiled_function_is_that_of_the_paper_at_any_length_and_address(key: bytes, data: bytes, start: int):
    memory = np.frombuffer(bytes(start) + data + b"\xff", np.uint8)
    low, high = map(np.uint64, key_words(key))
    assert siphash(low, high, memory.ctypes.data + start, len(data)) == frames.siphash(key, data)


@settings(max_examples=100, deadline=None)
@given(
    key=st.binary(min_size=16, max_size=16),
    words=st.lists(st.integers(0, 2**32 - 1), min_size=9, max_size=12),
)
def test_a_tag_covers_boot_opening_and_turn(key: bytes, words: list[int]):
    content = b"".join(word.to_bytes(4, "little") for word in words[3:])
    tag = frames.Seal(key, *words[:3]).tag(content).to_bytes(8, "little")
    assert tag_of(content, Seal(key, *words[:3])) == tag
    for changed in range(3):
        other = [word ^ (place == changed) for place, word in enumerate(words[:3])]
        assert tag_of(content, Seal(key, *other)) != tag
    assert tag_of(content, Seal(None, *words[:3])) == bytes(8)


@pytest.mark.parametrize("text", [KEY, f"{KEY}\n", f"{KEY}\r\n", KEY.lower()])
def test_a_key_is_read(tmp_path: Path, text: str):
    path = Path(make_key(tmp_path))
    path.write_bytes(text.encode())
    assert read_key(str(path)) == bytes.fromhex(KEY)


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        ("", 0o600, "32 hexadecimal digits"),
        (KEY[:-1], 0o600, "32 hexadecimal digits"),
        (KEY + "0", 0o600, "32 hexadecimal digits"),
        (f"{KEY}\n\n", 0o600, "32 hexadecimal digits"),
        (f" {KEY}", 0o600, "32 hexadecimal digits"),
        (f"{KEY[:16]} {KEY[17:]}", 0o600, "32 hexadecimal digits"),
        (f"0x{KEY[2:]}", 0o600, "32 hexadecimal digits"),
        ("ab" * 16, 0o600, "16 equal bytes are no key"),
        (KEY, 0o640, "permissions 640; allowed: none for group and others .chmod 600 .*make a new one"),
        (KEY, 0o602, "permissions 602; .*chmod 600"),
        (KEY, 0o4601, "chmod 600"),
    ],
)
def test_a_key_that_cannot_be_used_is_refused_with_the_remedy(tmp_path: Path, text: str, mode: int, message: str):
    path = tmp_path / "node.key"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(DriverError, match=f"^driver.key: {path}: .*{message}") as caught:
        read_key(str(path))
    assert text == "" or text.strip() not in str(caught.value)


def test_a_key_is_a_regular_file_and_no_link(tmp_path: Path):
    (tmp_path / "link").symlink_to(make_key(tmp_path))
    os.mkfifo(tmp_path / "fifo", 0o600)
    for name, message in (
        ("link", "a symbolic link; allowed: the file itself"),
        ("fifo", "not a regular file"),
        (".", "Is a directory"),
        ("none", "No such file"),
    ):
        with pytest.raises(DriverError, match=message):
            read_key(str(tmp_path / name))


@ROOT_ONLY
def test_a_key_of_another_user_is_refused(tmp_path: Path):
    path = make_key(tmp_path)
    os.chown(path, ATTACKER, ATTACKER)
    with pytest.raises(DriverError, match=f"belongs to user {ATTACKER}, not to this user or root"):
        read_key(path)


def configuration(folder: Path, key: str) -> Path:
    """Write a configuration for a node, with a line `key`, and return its path."""
    path = folder / "stage.toml"
    reference = '[axis.reference]\nkind = "hold"\nvalue = 1.0\n'
    path.write_text(CONFIG.format(key=key) + one_axis() + "[axis.interlocks]\nsample_age_us = 1e9\n" + reference)
    return path


def test_the_path_starts_at_the_folder_of_the_configuration_and_the_key_is_nowhere_but_in_the_driver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "stage"
    folder.mkdir()
    key = make_key(folder)
    digits = Path(key).read_text().strip()
    config = configuration(folder, 'key = "node.key"')
    monkeypatch.chdir(tmp_path)
    loaded = load(config.relative_to(tmp_path))
    prepared = prepare(loaded)
    assert option_cautions(prepared) == []
    monkeypatch.chdir("/")
    note = Hardware.from_configuration(loaded)
    driver = note.driver()
    stored = pickle.dumps((prepared.plan, loaded, note, vars(driver)))
    assert isinstance(driver, NodeDriver)
    assert driver._options.key == key
    assert digits.encode() not in stored
    assert bytes.fromhex(digits) not in stored


def test_a_recording_of_a_node_with_a_key_names_its_file_and_never_has_the_key(tmp_path: Path):
    digits = Path(make_key(tmp_path)).read_text().strip()
    place = f'host = "127.0.0.1"\nport = {free_udp_port()}\nwait_s = 60.0\nwatchdog_ms = 5000.0\nhold_ticks = 1000\n'
    config = configuration(tmp_path, place + 'key = "node.key"')
    node = start_rtloop("hil", "serve", config, "--udp")
    try:
        ran = completed(sys.executable, "-m", "rtloop", "run", config, "--duration", "0.5", "--out", tmp_path / "out")
    finally:
        node.terminate()
        node.communicate()
    assert "Traceback" not in ran.stderr
    (recording,) = (tmp_path / "out").glob("*.mcap")
    with recording.open("rb") as file:
        contents = [content for record in StreamReader(file).records for content in _contents(record)]
    written = b"".join([recording.read_bytes(), *contents, ran.stdout.encode(), ran.stderr.encode()])
    assert b"node.key" in written
    assert len(contents) > 20
    for secret in (digits.encode(), bytes.fromhex(digits), bytes.fromhex(digits)[::-1], bytes.fromhex(digits)[:8]):
        assert secret not in written


def _contents(record: object) -> list[bytes]:
    """Return all texts and bytes of an MCAP record, those of a map too."""
    values = [
        part
        for value in vars(record).values()
        for part in ([*value.keys(), *value.values()] if isinstance(value, dict) else [value])
    ]
    return [
        str(value).encode() if isinstance(value, str) else value for value in values if isinstance(value, str | bytes)
    ]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "",
            "driver.key: none, so everybody who can send to the node, such as all users of this computer,",
        ),
        ('key = "none.key"', r"driver.key: .*/none.key: No such file"),
    ],
)
def test_a_check_warns_of_a_missing_key(tmp_path: Path, line: str, message: str):
    (warning,) = option_cautions(prepare(load(configuration(tmp_path, line))))
    assert re.search(message, warning)


def test_a_simulated_node_and_parking_read_the_key_of_the_configuration(tmp_path: Path):
    (folder := tmp_path / "stage").mkdir()
    make_key(folder)
    place = f'host = "127.0.0.1"\nport = {free_udp_port()}\n'
    config = configuration(folder, place + 'key = "node.key"')
    node = start_rtloop("hil", "serve", config, "--udp")
    try:
        assert node.stderr is not None
        assert "Ctrl-C ends the node" in node.stderr.readline()
        parked = completed(sys.executable, "-m", "rtloop", "park", config)
        (tmp_path / "other").mkdir()
        other = completed(sys.executable, "-m", "rtloop", "park", configuration(tmp_path / "other", place))
    finally:
        node.terminate()
        node.communicate()
    assert (parked.returncode, other.returncode) == (0, 69), parked.stderr + other.stderr
    assert "the node has a key, and driver.key is not set" in " ".join(other.stderr.split())


@pytest.mark.parametrize(
    ("node_key", "loop_key", "message"),
    [
        ("a", None, "the node has a key, and driver.key is not set; set driver.key to a file with the node's key"),
        (None, "a", "the node has no key; give the node the key in driver.key, or remove driver.key"),
        ("a", "b", "the node has another key than the file in driver.key; give both the same key"),
    ],
)
def test_a_loop_and_a_node_with_different_keys_do_not_begin(tmp_path: Path, node_key, loop_key, message):
    paths = {name: make_key(tmp_path, name) for name in "ab"}
    with relayed(PythonNode(key=paths.get(node_key))) as relay:
        driver = relay_driver(relay.port, paths.get(loop_key))
        with pytest.raises(DriverError, match=message):
            driver.open()
        assert relay.drives == {}


def relay_driver(port: int, key: str | None) -> NodeDriver:
    """Return a driver, not yet open, whose node is at a port of this computer."""
    options = make_options("udp", {"host": "127.0.0.1", "port": port, "key": key, "wait_s": 60.0})
    return UdpDriver(options, ONE_AXIS, 500.0)


class OldNode(PythonNode):
    """A node that speaks version 1: it refuses each HELLO of another version."""

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Return the REFUSAL, 28 bytes, of version 1."""
        refusal = data[8:12] + (7).to_bytes(4, "little") + (1).to_bytes(2, "little") * 2 + bytes(4)
        return frames.frame(frames.REFUSAL, int.from_bytes(data[4:8], "little"), refusal)


def test_a_node_of_version_1_is_named_with_what_to_do():
    with relayed(OldNode()) as relay, pytest.raises(DriverError, match=r"speaks version 1 .* allowed: 2; install"):
        relay_driver(relay.port, None).open()


class ForgingNode(PythonNode):
    """A node in front of whose first answers an attacker sends a WELCOME and a VERSION refusal of his own."""

    forged = 0

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Return the attacker's answer for the first frames, then the node's own."""
        answer = super().receive(data, sender, now_us)
        self.forged += 1
        if self.forged == 1:
            return OldNode.receive(self, data, sender, now_us)  # type: ignore[arg-type]
        if self.forged == 2:
            return frames.frame(frames.WELCOME, 1, answer[8:-12], frames.UNSEALED)
        return answer


def test_forged_descriptions_keep_no_loop_from_its_node(tmp_path: Path):
    key = make_key(tmp_path)
    with relayed(ForgingNode(key=key)) as relay, open_driver(relay_driver(relay.port, key)) as calls:
        assert calls.read()[0] == 0


class EarlyCopyNode(PythonNode):
    """A node that an attacker's copy of the first OPEN reaches before it, without the flag OPEN."""

    has_copied = False

    def receive(self, data: bytes, sender: str, now_us: int) -> bytes:
        """Return the node's refusal of the copy, which has the tag of the loop's own frame; then its own answers."""
        if self.has_copied or data[2] != frames.DRIVE or not data[12] & frames.OPEN:
            return super().receive(data, sender, now_us)
        self.has_copied = True
        copy = data[:12] + bytes([frames.ANSWER]) + data[13:-4]
        return super().receive(copy + zlib.crc32(copy).to_bytes(4, "little"), sender, now_us)


def test_a_refusal_that_a_copy_elicits_keeps_no_loop_from_its_node(tmp_path: Path):
    key = make_key(tmp_path)
    node = EarlyCopyNode(key=key)
    with relayed(node) as relay, open_driver(relay_driver(relay.port, key)) as calls:
        assert calls.read()[0] == 0
    assert node.has_copied


def test_a_key_that_is_replaced_while_the_loop_runs_takes_effect_at_the_next_start(tmp_path: Path):
    key = make_key(tmp_path)
    node = NodeProcess("udp", tmp_path, key=key)
    try:
        with open_driver(node.driver()) as calls:
            calls.read()
            calls.write([2.0])
            make_key(tmp_path)
        assert abs(node.settled_output_v()) < 1e-5
        with pytest.raises(DriverError, match="another key"):
            node.driver().open()
    finally:
        node.end()
