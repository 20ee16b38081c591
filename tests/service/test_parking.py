"""Parking after a service that died: what is done about a loop that outlived it. The loop is a real process."""

import mmap
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from rtloop.configuration.file import load
from rtloop.drivers.base import Channel, Facts
from rtloop.drivers.errors import DriverError
from rtloop.drivers.python import PythonDriver
from rtloop.engine.memory import SharedBlock, Sizes, Word
from rtloop.errors import ConfigError, HostRefusal, RtloopError, UnavailableError
from rtloop.supervision import parking
from rtloop.supervision.hardware import Hardware as Noted
from rtloop.supervision.hardware import UnusableNote, configured_hardware, read_note, write_note
from rtloop.supervision.paths import block_path, hardware_path
from tests.faults.bench import Bench
from tests.one_axis import one_axis, wired

WITHOUT_RESTART = ("[recording]", "[service]\nrestarts = 0\n[recording]")
SAFE_V = np.zeros(1)
SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)
CLAIM = """
import sys
from rtloop.engine.memory import SharedBlock
block = SharedBlock(int(sys.argv[1]))  # kept: the claim goes with the first descriptor that is closed
block.claim()
print("claimed", flush=True)
sys.stdin.read()
"""


@contextmanager
def a_loop(block):
    """A process that drives `block` until its stdin ends."""
    command = [sys.executable, "-c", CLAIM, str(block.fd)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[block.fd]) as process:
        assert process.stdout.readline() == b"claimed\n"
        yield process


@pytest.fixture
def block():
    return SharedBlock.create(SIZES)


def test_a_block_knows_who_drives_and_that_he_died(block):
    assert block.driver_pid() is None
    with a_loop(block) as loop:
        assert block.driver_pid() == loop.pid
        loop.kill()
        loop.wait()
        assert block.driver_pid() is None


def test_a_loop_that_ends_by_itself_is_waited_for(block):
    with a_loop(block) as loop:
        threading.Timer(0.05, loop.stdin.close).start()
        parking._await_end(block, 30.0, 1000.0, SAFE_V)
    assert loop.returncode == 0


def test_a_loop_that_stands_still_is_killed(block, monkeypatch):
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    with a_loop(block) as loop:
        loop.send_signal(signal.SIGSTOP)
        parking._await_end(block, 0.05, 1000.0, SAFE_V)
    assert loop.returncode == -signal.SIGKILL


def test_a_number_in_the_block_is_not_believed(block, monkeypatch):
    """Whoever wrote a process's number there: only the one that holds the claim is killed."""
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE) as other:
        with a_loop(block) as loop:
            block.store(Word.LOOP_PID, other.pid)
            loop.send_signal(signal.SIGSTOP)
            parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert loop.returncode == -signal.SIGKILL
        parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert other.poll() is None
        other.stdin.close()


def test_a_service_that_is_alive_is_left_alone(block):
    ended = threading.Event()

    def beat():
        while not ended.wait(0.005):
            block.store(Word.HEARTBEAT_NS, time.monotonic_ns())

    beating = threading.Thread(target=beat)
    beating.start()
    try:
        with a_loop(block) as loop, pytest.raises(UnavailableError, match=f"process {loop.pid} drives"):
            parking._await_end(block, 30.0, 1000.0, SAFE_V)
    finally:
        ended.set()
        beating.join()
    assert loop.returncode == 0


class Hardware:
    """What outlives every process: the output's volts, everything that was written to it, and a death to come.

    A process may die at two instants of every write: before it takes effect, and after.
    """

    def __init__(self, volts: float) -> None:
        self._memory = np.frombuffer(mmap.mmap(-1, 8 * 4096))
        self.volts, self.dies_at = volts, 0

    volts = property(lambda self: float(self._memory[0]), lambda self, value: self._memory.__setitem__(0, value))
    dies_at = property(lambda self: int(self._memory[1]), lambda self, value: self._memory.__setitem__(1, value))
    instants = property(lambda self: int(self._memory[2]), lambda self, value: self._memory.__setitem__(2, value))
    count = property(lambda self: int(self._memory[3]), lambda self, value: self._memory.__setitem__(3, value))

    @property
    def written(self) -> list[float]:
        return self._memory[4 : 4 + self.count].tolist()

    def note(self, volts: float) -> None:
        self._memory[4 + self.count] = self._memory[0] = volts
        self.count += 1

    def write(self, volts: float) -> None:
        self._instant()
        self.note(volts)
        self._instant()

    def _instant(self) -> None:
        self.instants += 1
        if self.instants == self.dies_at:
            os._exit(9)

    @property
    def largest_step_v(self) -> float:
        return max(np.abs(np.diff(self.written)), default=0.0)


class Card(PythonDriver):
    """Says nothing of its outputs: `start` makes them safe."""

    kind = "card"
    hardware: ClassVar[Hardware]
    parks_itself = False

    @property
    def facts(self):
        return Facts((Channel("in"),), (Channel("out"),), hardware_watchdog=self.parks_itself)

    def start(self):
        self.hardware.note(self.hardware.volts)
        self.hardware.note(0.0)

    def read(self):
        return [0.0]

    def write(self, volts):
        self.hardware.write(volts[0])

    def stop(self):
        pass


class ReadableCard(Card):
    """Knows where its outputs are, and leaves them there."""

    def start(self):
        self.hardware.note(self.hardware.volts)

    def outputs_v(self):
        return [self.hardware.volts]


class MuteCard(ReadableCard):
    """Leaves its outputs where they are, and cannot be asked."""

    def outputs_v(self):
        return None


class OwnWatchdog(Card):
    """Goes to safe by itself, and not by our writes."""

    parks_itself = True

    def start(self):
        self.hardware.volts = 0.0


SLEW_V_PER_S, STEP_V, DRIVE_V = 50.0, 0.5, 6.5
CONFIGURATION = f"""
[loop]
rate_hz = 100
[driver]
kind = "card"
{wired("in", "out")}
{one_axis()}
[axis.limits]
trip_slew_v_per_s = 50.0
"""


@pytest.fixture
def parked(tmp_path, monkeypatch):
    """`rtloop park` for a service that died with its output at DRIVE_V: called with a card, it gives its hardware."""
    config = tmp_path / "lab.toml"
    config.write_text(CONFIGURATION.replace("rate_hz = 100", 'rate_hz = 100\nmode = "raw"'))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    (tmp_path / "run").mkdir(mode=0o700)

    def start(card: type[Card]) -> tuple[Hardware, Callable[[], str]]:
        users = "configuration.file", "configuration.prepare", "engine.plan", "supervision.hardware"
        for module in (f"rtloop.{user}" for user in users):
            monkeypatch.setattr(f"{module}.driver_class", lambda kind: card)
        (tmp_path / "run" / "lab.block").unlink(missing_ok=True)
        fd = os.open(tmp_path / "run" / "lab.block", os.O_RDWR | os.O_CREAT, 0o600)
        SharedBlock.create(SIZES, fd)["last_drive_v"][:] = DRIVE_V
        os.close(fd)
        Card.hardware = Hardware(DRIVE_V)
        return Card.hardware, lambda: parking.park_configuration(config)

    return start


@pytest.mark.parametrize("card", [Card, ReadableCard, MuteCard, OwnWatchdog])
def test_what_is_parked_stays_where_it_is(parked, card):
    hardware, park = parked(card)
    park()
    assert hardware.volts == 0.0
    hardware.count = 0
    for _ in range(3):
        park()
    assert set(hardware.written) <= {0.0}


def test_what_was_noted_of_an_output_that_is_safe_already_is_put_right(parked):
    """Somebody else made it safe: it does not move, and nobody believes any more that it is where it was noted."""
    hardware, park = parked(ReadableCard)
    hardware.volts = 0.0
    park()
    fd = os.open(block_path("lab"), os.O_RDWR)
    assert SharedBlock(fd)["last_drive_v"].tolist() == [0.0]
    os.close(fd)


@pytest.mark.parametrize("card", [ReadableCard, MuteCard])
def test_a_card_that_keeps_its_outputs_is_ramped_from_where_they_are(parked, card):
    hardware, park = parked(card)
    assert "6.500 V" in park()
    assert hardware.written[-1] == 0.0
    np.testing.assert_allclose(hardware.written[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def test_a_card_that_its_opening_makes_safe_is_not_driven_back(parked):
    hardware, park = parked(Card)
    park()
    assert set(hardware.written) == {DRIVE_V, 0.0}
    assert hardware.written.index(0.0) == 1


def test_a_card_that_parks_itself_is_not_driven_back(parked):
    """By the time it is parked, it has left the drive that was noted last."""
    hardware, park = parked(OwnWatchdog)
    park()
    assert set(hardware.written) == {0.0}


def test_parking_needs_no_file_that_can_be_read_but_for_the_first_time(parked, tmp_path):
    hardware, park = parked(ReadableCard)
    text = (tmp_path / "lab.toml").read_text()
    write_note(hardware_path("lab"), Noted.from_configuration(load(tmp_path / "lab.toml")))
    (tmp_path / "lab.toml").write_text(text.replace("[driver]", "[drive"))
    assert "6.500 V" in park()
    assert "parking uses the board of the last run" in park()
    np.testing.assert_allclose(hardware.written[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)
    assert hardware.written[-1] == 0.0
    hardware_path("lab").unlink()
    with pytest.raises(ConfigError):
        park()


def test_a_service_with_a_name_of_its_own_is_parked_by_that_name(parked, tmp_path):
    """Its last drive is in the block of its name, and the card cannot be read back."""
    hardware, _ = parked(MuteCard)
    (tmp_path / "run" / "lab.block").rename(tmp_path / "run" / "bench.block")
    assert parking.park_configuration(tmp_path / "lab.toml", "bench") == "bench: parked from 6.500 V"
    np.testing.assert_allclose(hardware.written[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def noted(folder: Path, name: str, age_s: float, config: Path) -> None:
    """Leave the note of a service whose run began `age_s` ago."""
    path = folder / f"{name}.hardware"
    write_note(path, configured_hardware(config))
    os.utime(path, (time.time() - age_s,) * 2)


@pytest.mark.parametrize(("age_s", "own_age_s", "name"), [(10, None, "bench"), (10, 60, "bench"), (10, 5, "lab")])
def test_without_a_name_the_service_that_drove_the_outputs_last_is_parked(parked, tmp_path, age_s, own_age_s, name):
    """The card cannot be read back: who is parked in a wrong name is not ramped from where it is."""
    hardware, park = parked(MuteCard)
    run, config = tmp_path / "run", tmp_path / "lab.toml"
    if name == "bench":
        (run / "lab.block").rename(run / "bench.block")
    noted(run, "bench", age_s, config)
    if own_age_s is not None:
        noted(run, "lab", own_age_s, config)
    assert park() == f"{name}: parked from 6.500 V"
    np.testing.assert_allclose(hardware.written[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def test_a_service_of_other_outputs_is_left_alone(parked, tmp_path):
    """Its note names another board, or is no note."""
    _, park = parked(MuteCard)
    path, here = tmp_path / "run" / "bench.hardware", configured_hardware(tmp_path / "lab.toml")
    for content in (here, replace(here, driver_kind="another card"), None):
        write_note(path, content) if content else path.write_bytes(b"no note")
        expected = "bench: parked from 0.000 V" if content is here else "lab: parked from"
        assert park().startswith(expected)


def test_another_board_in_the_file_is_parked_as_well(parked, tmp_path):
    _, park = parked(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), Noted.from_configuration(load(config)))
    assert park().count(" V") == 1
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))
    assert park().count(" V") == 2


def test_a_configured_driver_without_its_library_does_not_keep_the_noted_board_from_parking(
    parked, tmp_path, monkeypatch
):
    class Missing(ReadableCard):
        def __init__(self, *arguments) -> None:
            raise DriverError("libcard.so: cannot open shared object file")

    hardware, park = parked(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), Noted.from_configuration(load(config)))
    for user in ("configuration.file", "configuration.prepare", "engine.plan", "supervision.hardware"):
        monkeypatch.setattr(f"rtloop.{user}.driver_class", lambda kind: ReadableCard if kind == "card" else Missing)
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))
    text = park()
    assert "parking uses the board of the last run" in text
    assert "libcard.so" in text
    assert hardware.written[-1] == 0.0


@pytest.mark.parametrize("damage", ["whole", "half", "another's"])
def test_a_note_that_is_not_whole_is_none(parked, tmp_path, damage):
    board, park = parked(ReadableCard)
    hardware = Noted.from_configuration(load(tmp_path / "lab.toml"))
    path = hardware_path("lab")
    write_note(path, hardware)
    assert path.stat().st_mode & 0o777 == 0o600
    if damage == "half":
        path.write_bytes(path.read_bytes()[:-9])
    if damage == "another's":
        path.chmod(0o666)
        with pytest.raises(RtloopError, match="other users may write to this file") as raised:
            park()
        assert raised.value.exit_code == HostRefusal.exit_code
        assert board.volts == 0.0  # the configuration's
        return
    if damage == "whole":
        assert read_note(path) == hardware
    else:
        with pytest.raises(UnusableNote, match="cannot be used and is ignored: note: "):
            read_note(path)
    park()


@pytest.fixture
def block_of_lab(tmp_path) -> Callable[[], SharedBlock]:
    """The shared block of the service that died."""

    def read() -> SharedBlock:
        fd = os.open(tmp_path / "run" / "lab.block", os.O_RDWR)
        try:
            return SharedBlock(fd)
        finally:
            os.close(fd)

    return read


@pytest.mark.parametrize("noted_v", [np.nan, np.inf, -np.inf, 10.001, -50.0, 1e300])
def test_a_drive_that_cannot_have_been_is_not_ramped_from(parked, block_of_lab, noted_v):
    """Nobody knows where the output is: it is made safe at once, and never driven away from safe."""
    hardware, park = parked(MuteCard)
    block_of_lab()["last_drive_v"][:] = noted_v
    message = park()
    assert hardware.written[1:] == [0.0]
    assert f"the last recorded drive is {noted_v:g} V" in message


@pytest.mark.parametrize("card", [Card, ReadableCard])
def test_a_noted_drive_does_not_matter_where_the_card_knows(parked, block_of_lab, card):
    hardware, park = parked(card)
    block_of_lab()["last_drive_v"][:] = np.nan
    park()
    assert hardware.written[-1] == 0.0
    assert hardware.largest_step_v <= (STEP_V + 1e-12 if card is ReadableCard else DRIVE_V)


@pytest.mark.parametrize(("said_v", "from_v"), [(np.nan, 0.0), (np.inf, 10.0), (1e9, 10.0), (-10.5, -10.0)])
def test_a_card_that_says_what_cannot_be_is_parked_all_the_same(parked, said_v, from_v):
    class Liar(ReadableCard):
        def outputs_v(self):
            return [said_v]

    hardware, park = parked(Liar)
    assert f"{from_v:.3f} V" in park()
    assert hardware.written[-1] == 0.0
    assert max(map(abs, hardware.written[1:])) < max(abs(from_v), 1e-9)


def test_a_loop_that_noted_no_number_is_not_waited_for_for_ever(block, monkeypatch):
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    monkeypatch.setattr(parking, "LONGEST_RAMP_S", 0.05)
    for noted_v in (np.nan, np.inf, 1e300):
        block["last_drive_v"][:] = noted_v
        with a_loop(block) as loop:
            loop.send_signal(signal.SIGSTOP)
            parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert loop.returncode == -signal.SIGKILL


def test_a_loop_has_the_time_of_its_way_to_the_safe_value_of_its_card(parked, monkeypatch):
    class SafeAt2(ReadableCard):
        facts = Facts((Channel("in"),), (Channel("other"), Channel("out", safe_v=2.0)))

        def outputs_v(self):
            return [0.0, self.hardware.volts]

        def write(self, volts):
            self.hardware.write(volts[1])

    waits = []
    monkeypatch.setattr(parking, "_await_end", lambda _, *figures: waits.append(figures))
    hardware, park = parked(SafeAt2)
    park()
    assert [(slew, safe_v.tolist()) for _, slew, safe_v in waits] == [(SLEW_V_PER_S, [2.0])]
    assert hardware.written[-1] == 2.0


def test_nothing_is_parked_while_the_service_is_alive(parked, tmp_path, monkeypatch):
    """Not even another board that the configuration names by now."""
    hardware, park = parked(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), Noted.from_configuration(load(config)))
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))

    def alive(*_):
        raise UnavailableError("process 1 drives the outputs and its service is alive")

    monkeypatch.setattr(parking, "_await_end", alive)
    with pytest.raises(UnavailableError, match="is alive"):
        park()
    assert hardware.written == []


def test_a_loop_that_cannot_be_killed_keeps_no_other_board_from_being_parked(parked, tmp_path, monkeypatch):
    hardware, park = parked(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), Noted.from_configuration(load(config)))
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))

    def hang(*_):
        raise DriverError("process 1 drives the outputs and cannot be killed")

    monkeypatch.setattr(parking, "_await_end", hang)
    with pytest.raises(RtloopError, match="cannot be killed") as raised:
        park()
    assert raised.value.exit_code == UnavailableError.exit_code
    assert hardware.written[-1] == 0.0


WORDS = '"words": [8192, "<u8", [64]]'
OTHER_BLOCKS = ("", ', "last_drive_v": [8704, "<U1", [1]]', ', "last_drive_v": [8704, "<f8", [1, 1]]',
                ', "last_drive_v": [8704, "<f8", []]')  # fmt: skip
OTHER_WORDS = ('[8192, "<f8", [64]]', '[8192, "<u8", [8]]', '[8192, "<u8", [8, 8]]')


@pytest.mark.parametrize(
    "text",
    [b"{", b"{}", b'{"words": 3}', b"{" + bytes(range(256)) * 40,
     *(f"{{{WORDS}{drives}}}".encode().ljust(16384, b"\0") for drives in OTHER_BLOCKS),
     *(f'{{"words": {words}, "last_drive_v": [8704, "<f8", [1]]}}'.encode().ljust(16384, b"\0")
       for words in OTHER_WORDS)],
)  # fmt: skip
def test_a_block_that_is_not_understood_counts_as_none(parked, tmp_path, text):
    hardware, park = parked(ReadableCard)
    (tmp_path / "run" / "lab.block").write_bytes(text)
    assert "the drive voltages that the loop wrote last cannot be read from this file and are ignored" in park()
    assert hardware.written[-1] == 0.0


@pytest.mark.parametrize("verb", ["start", "outputs_v", "write", "stop", "facts"])
def test_whatever_a_card_raises_is_an_error_of_that_driver(parked, verb):
    def fail(self, *_):
        raise LookupError("no such thing")

    hardware, park = parked(type("Failing", (ReadableCard,), {verb: property(fail) if verb == "facts" else fail}))
    with pytest.raises((DriverError, ConfigError), match="no such thing"):
        park()
    assert hardware.volts in (0.0, DRIVE_V)


def test_a_service_that_died_is_parked_while_its_file_is_being_edited(tmp_path):
    """The service and its loop are killed; the board, a process of its own, saw what became of the output."""
    with Bench(tmp_path, WITHOUT_RESTART) as bench:
        bench.await_drive()
        bench.config.write_text("[[axis")
        for role in ("rt", "service"):
            os.kill(bench.pid(role), signal.SIGKILL)
        bench.service.wait()
        assert bench.seen().last_v != 0.0
        assert bench.rtloop("park", bench.config).wait(120.0) == 0
        assert bench.seen().last_v == 0.0
        assert "parking uses the board of the last run" in bench.log()


def in_a_process(work: Callable[[], object]) -> int:
    """Exit code of a process of its own that does `work`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads, none of which is ours
        pid = os.fork()
    if pid == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.mark.parametrize("card", [ReadableCard, MuteCard])
def test_parking_that_dies_at_any_instant_is_gone_on_with(parked, card):
    """Before or after each single write; whoever parks then begins where the output is."""
    hardware, park = parked(card)
    park()
    instants = hardware.instants
    assert instants >= 2 * 13
    for instant in range(1, instants + 1):
        hardware, park = parked(card)
        hardware.dies_at = instant
        assert in_a_process(park) == 9
        park()
        assert hardware.volts == 0.0
        assert hardware.largest_step_v <= STEP_V + 1e-12, f"died at instant {instant}: {hardware.written}"
