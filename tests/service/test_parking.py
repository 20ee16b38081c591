"""Parking after a service has died, and the end of a loop that outlived it. The loop is a real process."""

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
from rtloop.supervision.hardware import Hardware as HardwareNote
from rtloop.supervision.hardware import UnusableNote, configured_hardware, read_note, write_note
from rtloop.supervision.paths import block_path, hardware_path
from tests.faults.bench import Bench
from tests.stage_text import one_axis, wired

WITHOUT_RESTART = ("[recording]", "[service]\nrestarts = 0\n[recording]")
SAFE_V = np.zeros(1)
SIZES = Sizes(columns=1, axes=1, rate_hz=1000.0, snapshot_bytes=8, table_samples=1)
CLAIM = """
import sys
from rtloop.engine.memory import SharedBlock
block = SharedBlock(int(sys.argv[1]))  # stays open: the claim ends with the first descriptor that is closed
block.claim()
print("claimed", flush=True)
sys.stdin.read()
"""


@contextmanager
def driving_process(block):
    """Run a process that claims `block`, as a loop does, until its stdin ends."""
    command = [sys.executable, "-c", CLAIM, str(block.fd)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=[block.fd]) as process:
        assert process.stdout.readline() == b"claimed\n"
        yield process


@pytest.fixture
def block():
    """Return a shared block of one axis at 1 kHz."""
    return SharedBlock.create(SIZES)


def test_a_block_knows_who_drives_and_that_he_died(block):
    assert block.driver_pid() is None
    with driving_process(block) as loop:
        assert block.driver_pid() == loop.pid
        loop.kill()
        loop.wait()
        assert block.driver_pid() is None


def test_a_loop_that_ends_by_itself_is_waited_for(block):
    with driving_process(block) as loop:
        threading.Timer(0.05, loop.stdin.close).start()
        parking._await_end(block, 30.0, 1000.0, SAFE_V)
    assert loop.returncode == 0


def test_a_loop_that_stands_still_is_killed(block, monkeypatch):
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    with driving_process(block) as loop:
        loop.send_signal(signal.SIGSTOP)
        parking._await_end(block, 0.05, 1000.0, SAFE_V)
    assert loop.returncode == -signal.SIGKILL


def test_a_number_in_the_block_is_not_believed(block, monkeypatch):
    """Only the process that holds the claim is killed, whatever process ID the block contains."""
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    with subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE) as bystander:
        with driving_process(block) as loop:
            block.store(Word.LOOP_PID, bystander.pid)
            loop.send_signal(signal.SIGSTOP)
            parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert loop.returncode == -signal.SIGKILL
        parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert bystander.poll() is None
        bystander.stdin.close()


def test_a_service_that_is_alive_is_left_alone(block):
    ended = threading.Event()

    def beat():
        while not ended.wait(0.005):
            block.store(Word.HEARTBEAT_NS, time.monotonic_ns())

    beating = threading.Thread(target=beat)
    beating.start()
    try:
        with driving_process(block) as loop, pytest.raises(UnavailableError, match=f"process {loop.pid} drives"):
            parking._await_end(block, 30.0, 1000.0, SAFE_V)
    finally:
        ended.set()
        beating.join()
    assert loop.returncode == 0


class Hardware:
    """Shared memory that outlives every process: the output (V), all outputs since the start, and a planned death.

    The process dies at instant number `dies_at`. Each write has two instants: before and after it takes effect.
    """

    def __init__(self, volts: float) -> None:
        self._memory = np.frombuffer(mmap.mmap(-1, 8 * 4096))
        self.volts, self.dies_at = volts, 0

    volts = property(lambda self: float(self._memory[0]), lambda self, value: self._memory.__setitem__(0, value))
    dies_at = property(lambda self: int(self._memory[1]), lambda self, value: self._memory.__setitem__(1, value))
    instants = property(lambda self: int(self._memory[2]), lambda self, value: self._memory.__setitem__(2, value))
    count = property(lambda self: int(self._memory[3]), lambda self, value: self._memory.__setitem__(3, value))

    @property
    def written_v(self) -> list[float]:
        return self._memory[4 : 4 + self.count].tolist()

    def set_output(self, volts: float) -> None:
        self._memory[4 + self.count] = self._memory[0] = volts
        self.count += 1

    def write(self, volts: float) -> None:
        self._pass_instant()
        self.set_output(volts)
        self._pass_instant()

    def _pass_instant(self) -> None:
        self.instants += 1
        if self.instants == self.dies_at:
            os._exit(9)

    @property
    def largest_step_v(self) -> float:
        return max(np.abs(np.diff(self.written_v)), default=0.0)


class Card(PythonDriver):
    """Card without readback; `start` sets the output to 0 V."""

    kind = "card"
    hardware: ClassVar[Hardware]
    parks_itself = False

    @property
    def facts(self):
        return Facts((Channel("in"),), (Channel("out"),), hardware_watchdog=self.parks_itself)

    def start(self):
        self.hardware.set_output(self.hardware.volts)
        self.hardware.set_output(0.0)

    def read(self):
        return [0.0]

    def write(self, volts):
        self.hardware.write(volts[0])

    def stop(self):
        pass


class ReadableCard(Card):
    """Card with readback; `start` leaves the output as it is."""

    def start(self):
        self.hardware.set_output(self.hardware.volts)

    def outputs_v(self):
        return [self.hardware.volts]


class MuteCard(ReadableCard):
    """Card without readback; `start` leaves the output as it is."""

    def outputs_v(self):
        return None


class WatchdogCard(Card):
    """Card whose watchdog sets the output to 0 V without a write of the driver."""

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
def dead_service(tmp_path, monkeypatch):
    """Return a function that sets up a service that died with the output of a given card at DRIVE_V.

    The function returns the card's hardware, and a function that runs `rtloop park`.
    """
    config = tmp_path / "lab.toml"
    config.write_text(CONFIGURATION.replace("rate_hz = 100", 'rate_hz = 100\nmode = "raw"'))
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    (tmp_path / "run").mkdir(mode=0o700)

    def set_up(card: type[Card]) -> tuple[Hardware, Callable[[], str]]:
        importers = "configuration.file", "configuration.prepare", "engine.plan", "supervision.hardware"
        for module in (f"rtloop.{importer}" for importer in importers):
            monkeypatch.setattr(f"{module}.driver_class", lambda kind: card)
        (tmp_path / "run" / "lab.block").unlink(missing_ok=True)
        fd = os.open(tmp_path / "run" / "lab.block", os.O_RDWR | os.O_CREAT, 0o600)
        SharedBlock.create(SIZES, fd)["last_drive_v"][:] = DRIVE_V
        os.close(fd)
        Card.hardware = Hardware(DRIVE_V)
        return Card.hardware, lambda: parking.park_configuration(config)

    return set_up


@pytest.mark.parametrize("card", [Card, ReadableCard, MuteCard, WatchdogCard])
def test_what_is_parked_stays_where_it_is(dead_service, card):
    hardware, park = dead_service(card)
    park()
    assert hardware.volts == 0.0
    hardware.count = 0
    for _ in range(3):
        park()
    assert set(hardware.written_v) <= {0.0}


def test_what_was_noted_of_an_output_that_is_safe_already_is_put_right(dead_service):
    """Another process has set the output to 0 V: parking replaces the last drive in the block by 0 V."""
    hardware, park = dead_service(ReadableCard)
    hardware.volts = 0.0
    park()
    fd = os.open(block_path("lab"), os.O_RDWR)
    assert SharedBlock(fd)["last_drive_v"].tolist() == [0.0]
    os.close(fd)


@pytest.mark.parametrize("card", [ReadableCard, MuteCard])
def test_a_card_that_keeps_its_outputs_is_ramped_from_where_they_are(dead_service, card):
    hardware, park = dead_service(card)
    assert "6.500 V" in park()
    assert hardware.written_v[-1] == 0.0
    np.testing.assert_allclose(hardware.written_v[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def test_a_card_that_its_opening_makes_safe_is_not_driven_back(dead_service):
    hardware, park = dead_service(Card)
    park()
    assert set(hardware.written_v) == {DRIVE_V, 0.0}
    assert hardware.written_v.index(0.0) == 1


def test_a_card_that_parks_itself_is_not_driven_back(dead_service):
    """At the time of parking, the output is no longer at the last drive in the block."""
    hardware, park = dead_service(WatchdogCard)
    park()
    assert set(hardware.written_v) == {0.0}


def test_parking_needs_no_file_that_can_be_read_but_for_the_first_time(dead_service, tmp_path):
    hardware, park = dead_service(ReadableCard)
    text = (tmp_path / "lab.toml").read_text()
    write_note(hardware_path("lab"), HardwareNote.from_configuration(load(tmp_path / "lab.toml")))
    (tmp_path / "lab.toml").write_text(text.replace("[driver]", "[drive"))
    assert "6.500 V" in park()
    assert "parking uses the board of the last run" in park()
    np.testing.assert_allclose(hardware.written_v[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)
    assert hardware.written_v[-1] == 0.0
    hardware_path("lab").unlink()
    with pytest.raises(ConfigError):
        park()


def test_a_service_with_a_name_of_its_own_is_parked_by_that_name(dead_service, tmp_path):
    """The last drive is in the block with the service's name, and the card has no readback."""
    hardware, _ = dead_service(MuteCard)
    (tmp_path / "run" / "lab.block").rename(tmp_path / "run" / "bench.block")
    assert parking.park_configuration(tmp_path / "lab.toml", "bench") == "bench: parked from 6.500 V"
    np.testing.assert_allclose(hardware.written_v[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def write_aged_note(folder: Path, name: str, age_s: float, config: Path) -> None:
    """Write the hardware note of a service whose run began `age_s` ago."""
    path = folder / f"{name}.hardware"
    write_note(path, configured_hardware(config))
    os.utime(path, (time.time() - age_s,) * 2)


@pytest.mark.parametrize(("age_s", "own_age_s", "name"), [(10, None, "bench"), (10, 60, "bench"), (10, 5, "lab")])
def test_without_a_name_the_service_that_drove_the_outputs_last_is_parked(
    dead_service, tmp_path, age_s, own_age_s, name
):
    """The card has no readback: under a wrong name the ramp would not begin at the last drive."""
    hardware, park = dead_service(MuteCard)
    run, config = tmp_path / "run", tmp_path / "lab.toml"
    if name == "bench":
        (run / "lab.block").rename(run / "bench.block")
    write_aged_note(run, "bench", age_s, config)
    if own_age_s is not None:
        write_aged_note(run, "lab", own_age_s, config)
    assert park() == f"{name}: parked from 6.500 V"
    np.testing.assert_allclose(hardware.written_v[1:14], DRIVE_V - STEP_V * np.arange(1, 14), atol=1e-12)


def test_a_service_of_other_outputs_is_left_alone(dead_service, tmp_path):
    """The note of the other service names another board, or is unusable."""
    _, park = dead_service(MuteCard)
    path, configured = tmp_path / "run" / "bench.hardware", configured_hardware(tmp_path / "lab.toml")
    for content in (configured, replace(configured, driver_kind="another card"), None):
        write_note(path, content) if content else path.write_bytes(b"no note")
        expected = "bench: parked from 0.000 V" if content is configured else "lab: parked from"
        assert park().startswith(expected)


def test_another_board_in_the_file_is_parked_as_well(dead_service, tmp_path):
    _, park = dead_service(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), HardwareNote.from_configuration(load(config)))
    assert park().count(" V") == 1
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))
    assert park().count(" V") == 2


def test_a_configured_driver_without_its_library_does_not_keep_the_noted_board_from_parking(
    dead_service, tmp_path, monkeypatch
):
    class Missing(ReadableCard):
        def __init__(self, *arguments) -> None:
            raise DriverError("libcard.so: cannot open shared object file")

    hardware, park = dead_service(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), HardwareNote.from_configuration(load(config)))
    for importer in ("configuration.file", "configuration.prepare", "engine.plan", "supervision.hardware"):
        monkeypatch.setattr(f"rtloop.{importer}.driver_class", lambda kind: ReadableCard if kind == "card" else Missing)
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))
    text = park()
    assert "parking uses the board of the last run" in text
    assert "libcard.so" in text
    assert hardware.written_v[-1] == 0.0


@pytest.mark.parametrize("damage", ["whole", "half", "another's"])
def test_a_note_that_is_not_whole_is_none(dead_service, tmp_path, damage):
    board, park = dead_service(ReadableCard)
    hardware = HardwareNote.from_configuration(load(tmp_path / "lab.toml"))
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
        assert board.volts == 0.0  # the configured board is parked
        return
    if damage == "whole":
        assert read_note(path) == hardware
    else:
        with pytest.raises(UnusableNote, match="cannot be used and is ignored: note: "):
            read_note(path)
    park()


@pytest.fixture
def block_of_lab(tmp_path) -> Callable[[], SharedBlock]:
    """Return a function that opens the shared block of the dead service."""

    def open_block() -> SharedBlock:
        fd = os.open(tmp_path / "run" / "lab.block", os.O_RDWR)
        try:
            return SharedBlock(fd)
        finally:
            os.close(fd)

    return open_block


@pytest.mark.parametrize("noted_v", [np.nan, np.inf, -np.inf, 10.001, -50.0, 1e300])
def test_a_drive_that_cannot_have_been_is_not_ramped_from(dead_service, block_of_lab, noted_v):
    """The position of the output is unknown: parking writes 0 V at once, and no other voltage."""
    hardware, park = dead_service(MuteCard)
    block_of_lab()["last_drive_v"][:] = noted_v
    message = park()
    assert hardware.written_v[1:] == [0.0]
    assert f"the last recorded drive is {noted_v:g} V" in message


@pytest.mark.parametrize("card", [Card, ReadableCard])
def test_a_noted_drive_does_not_matter_where_the_card_knows(dead_service, block_of_lab, card):
    hardware, park = dead_service(card)
    block_of_lab()["last_drive_v"][:] = np.nan
    park()
    assert hardware.written_v[-1] == 0.0
    assert hardware.largest_step_v <= (STEP_V + 1e-12 if card is ReadableCard else DRIVE_V)


@pytest.mark.parametrize(("readback_v", "from_v"), [(np.nan, 0.0), (np.inf, 10.0), (1e9, 10.0), (-10.5, -10.0)])
def test_a_card_that_says_what_cannot_be_is_parked_all_the_same(dead_service, readback_v, from_v):
    class WrongReadbackCard(ReadableCard):
        def outputs_v(self):
            return [readback_v]

    hardware, park = dead_service(WrongReadbackCard)
    assert f"{from_v:.3f} V" in park()
    assert hardware.written_v[-1] == 0.0
    assert max(map(abs, hardware.written_v[1:])) < max(abs(from_v), 1e-9)


def test_a_loop_that_noted_no_number_is_not_waited_for_for_ever(block, monkeypatch):
    monkeypatch.setattr(parking, "MARGIN_S", 0.05)
    monkeypatch.setattr(parking, "LONGEST_RAMP_S", 0.05)
    for noted_v in (np.nan, np.inf, 1e300):
        block["last_drive_v"][:] = noted_v
        with driving_process(block) as loop:
            loop.send_signal(signal.SIGSTOP)
            parking._await_end(block, 0.05, 1000.0, SAFE_V)
        assert loop.returncode == -signal.SIGKILL


def test_a_loop_has_the_time_of_its_way_to_the_safe_value_of_its_card(dead_service, monkeypatch):
    class SafeAt2(ReadableCard):
        facts = Facts((Channel("in"),), (Channel("other"), Channel("out", safe_v=2.0)))

        def outputs_v(self):
            return [0.0, self.hardware.volts]

        def write(self, volts):
            self.hardware.write(volts[1])

    waits = []
    monkeypatch.setattr(parking, "_await_end", lambda _, *figures: waits.append(figures))
    hardware, park = dead_service(SafeAt2)
    park()
    assert [(slew, safe_v.tolist()) for _, slew, safe_v in waits] == [(SLEW_V_PER_S, [2.0])]
    assert hardware.written_v[-1] == 2.0


def test_nothing_is_parked_while_the_service_is_alive(dead_service, tmp_path, monkeypatch):
    """A board that is new in the configuration is not parked either."""
    hardware, park = dead_service(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), HardwareNote.from_configuration(load(config)))
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))

    def refuse(*_):
        raise UnavailableError("process 1 drives the outputs and its service is alive")

    monkeypatch.setattr(parking, "_await_end", refuse)
    with pytest.raises(UnavailableError, match="is alive"):
        park()
    assert hardware.written_v == []


def test_a_loop_that_cannot_be_killed_keeps_no_other_board_from_being_parked(dead_service, tmp_path, monkeypatch):
    hardware, park = dead_service(ReadableCard)
    config = tmp_path / "lab.toml"
    write_note(hardware_path("lab"), HardwareNote.from_configuration(load(config)))
    config.write_text(config.read_text().replace('kind = "card"', 'kind = "another"'))

    def fail_to_kill(*_):
        raise DriverError("process 1 drives the outputs and cannot be killed")

    monkeypatch.setattr(parking, "_await_end", fail_to_kill)
    with pytest.raises(RtloopError, match="cannot be killed") as raised:
        park()
    assert raised.value.exit_code == UnavailableError.exit_code
    assert hardware.written_v[-1] == 0.0


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
def test_a_block_that_is_not_understood_counts_as_none(dead_service, tmp_path, text):
    hardware, park = dead_service(ReadableCard)
    (tmp_path / "run" / "lab.block").write_bytes(text)
    assert "the drive voltages that the loop wrote last cannot be read from this file and are ignored" in park()
    assert hardware.written_v[-1] == 0.0


@pytest.mark.parametrize("verb", ["start", "outputs_v", "write", "stop", "facts"])
def test_whatever_a_card_raises_is_an_error_of_that_driver(dead_service, verb):
    def fail(self, *_):
        raise LookupError("no such thing")

    hardware, park = dead_service(type("Failing", (ReadableCard,), {verb: property(fail) if verb == "facts" else fail}))
    with pytest.raises((DriverError, ConfigError), match="no such thing"):
        park()
    assert hardware.volts in (0.0, DRIVE_V)


@pytest.mark.system
def test_a_service_that_died_is_parked_while_its_file_is_being_edited(tmp_path):
    """The service and its loop are killed; the board's process keeps the evidence of the output."""
    with Bench(tmp_path, WITHOUT_RESTART) as bench:
        bench.await_drive()
        bench.config.write_text("[[axis")
        for role in ("rt", "service"):
            os.kill(bench.pid(role), signal.SIGKILL)
        bench.service.wait()
        assert bench.output_record().last_v != 0.0
        assert bench.rtloop("park", bench.config).wait(120.0) == 0
        assert bench.output_record().last_v == 0.0
        assert "parking uses the board of the last run" in bench.log()


def fork_exit_code(work: Callable[[], object]) -> int:
    """Call `work` in a forked process, and return its exit code: 0 unless the process ended in `work`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a fork warns while threads of libraries run
        pid = os.fork()
    if pid == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.mark.parametrize("card", [ReadableCard, MuteCard])
def test_parking_that_dies_at_any_instant_is_gone_on_with(dead_service, card):
    """Parking dies before or after each write; the next parking begins at the present output."""
    hardware, park = dead_service(card)
    park()
    instants = hardware.instants
    assert instants >= 2 * 13
    for instant in range(1, instants + 1):
        hardware, park = dead_service(card)
        hardware.dies_at = instant
        assert fork_exit_code(park) == 9
        park()
        assert hardware.volts == 0.0
        assert hardware.largest_step_v <= STEP_V + 1e-12, f"died at instant {instant}: {hardware.written_v}"
