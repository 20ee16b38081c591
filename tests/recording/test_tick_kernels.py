"""The compiled checks of a chunk of ticks against numpy: bytes that never vary, whole numbers, times that grow."""

from __future__ import annotations

import numpy as np
import pytest

from rtloop.recording.file.mcap.container import DamagedChunk
from rtloop.recording.file.topics import format
from rtloop.recording.file.topics.tick_kernels import RecordLayout, first_fault
from rtloop.recording.file.topics.ticks import TickLayout

COLUMNS = ("tick", "deadline_ns", "lateness_us", "flags", "x_adc_v")
BOUNDS = np.array([[0.0, 100.0], [0.0, 1e6], [-5.0, 5.0]])
END_NS = 1 << 40


def expected_fault(numbers: np.ndarray, times_ns: np.ndarray) -> tuple[int, int] | None:
    """Return (check, row) of the first failed check, computed on whole arrays; None if there is no fault."""
    low, high = BOUNDS[:, :1], BOUNDS[:, 1:]
    with np.errstate(invalid="ignore"):
        checks = [*~((numbers >= low) & (numbers <= high) & (numbers % 1.0 == 0.0))]
    if not np.any(checks):
        for row in numbers[:2]:
            checks.append(np.concatenate([[False], np.diff(row) <= 0.0]))
        starts = times_ns[0] - numbers[1].astype(np.int64)
        is_in_range = (times_ns[0] >= 0) & (times_ns[0] < END_NS)
        checks.append(~is_in_range | (times_ns[0] != times_ns[1]) | (starts != starts[0]))
    return next(((number, int(np.argmax(is_bad))) for number, is_bad in enumerate(checks) if is_bad.any()), None)


@pytest.mark.parametrize("seed", range(200))
def test_the_first_fault_is_that_of_whole_arrays(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 9))
    numbers: np.ndarray = np.stack([
        5.0 + np.arange(count), 100.0 * np.arange(count), random.integers(-5, 6, count).astype(float)
    ])  # fmt: skip
    times_ns = np.tile(7_000 + numbers[1].astype(np.int64), (2, 1))
    for _ in range(int(random.integers(0, 3))):
        if random.integers(2):
            numbers[random.integers(3), random.integers(count)] += random.choice(
                [0.5, -1.0, -300.0, 1e9, np.nan, np.inf]
            )
        else:
            times_ns[random.integers(2), random.integers(count)] += random.choice([1, -100_000, END_NS])
    assert first_fault(numbers, BOUNDS, times_ns, END_NS) == expected_fault(numbers, times_ns)


def test_the_ends_of_the_bounds_are_allowed_and_the_end_of_time_is_not() -> None:
    numbers, times_ns = np.array([[0.0, 100.0], [0.0, 1e6], [-5.0, 5.0]]), np.array([[0, 10**6]] * 2)
    assert first_fault(numbers, BOUNDS, times_ns, END_NS) is None
    assert first_fault(numbers, BOUNDS, times_ns + END_NS - 1 - 10**6, END_NS) is None
    assert first_fault(numbers, BOUNDS, times_ns + END_NS - 10**6, END_NS) == (5, 1)
    assert first_fault(numbers, BOUNDS, times_ns - 1, END_NS) == (5, 0)


@pytest.mark.parametrize("count", [1, 4, 9])
def test_each_byte_that_never_varies_is_looked_at_in_each_tick(count: int) -> None:
    """Opcode, length, channel, sequence and tags never vary; times and values do."""
    layout = TickLayout(COLUMNS)
    records = format.blank_ticks(COLUMNS, count)
    format.fill_ticks(records, COLUMNS, np.outer(1.0 + np.arange(count), np.ones(len(COLUMNS))), 5)
    size = records.dtype.itemsize
    varying_fields = [("_log_time", 8), ("_publish_time", 8), *((name, 8) for name in COLUMNS)]
    varying = {records.dtype.fields[name][1] + k for name, width in varying_fields for k in range(width)}
    for place in range(count * size):
        content = bytearray(records.tobytes())
        content[place] ^= 0x10
        try:
            layout.parse_ticks(bytes(content), COLUMNS)
            message = ""
        except DamagedChunk as error:
            message = str(error)
        assert (message == "contains other data than ticks") is (place % size not in varying), place
    assert layout.parse_ticks(records.tobytes(), COLUMNS).last == count


@pytest.mark.parametrize("seed", range(50))
def test_the_words_of_records_are_those_at_their_offsets(seed: int) -> None:
    """Records of 8 to 60 random bytes; then one bit of one record is flipped."""
    random = np.random.default_rng(seed)
    size, count = int(random.integers(8, 61)), int(random.integers(0, 9))
    template, is_fixed = random.integers(0, 256, size, np.uint8), random.random(size) < 0.5
    records = random.integers(0, 256, (count, size), np.uint8)
    records[:, is_fixed] = template[is_fixed]
    offsets = random.integers(0, size - 7, int(random.integers(1, 6)))
    layout = RecordLayout(template, is_fixed)
    words = layout.take_out(records.tobytes(), offsets)
    assert words is not None
    expected = [[int.from_bytes(record[k : k + 8].tobytes(), "little") for record in records] for k in offsets]
    assert words.tolist() == expected
    if count:
        row, byte = int(random.integers(count)), int(random.integers(size))
        records[row, byte] ^= 1 << int(random.integers(8))
        assert (layout.take_out(records.tobytes(), offsets) is None) is bool(is_fixed[byte])


def test_offsets_and_contents_beyond_the_records_are_refused() -> None:
    layout = RecordLayout(np.zeros(10, np.uint8), np.ones(10, bool))
    for content, offset in ((bytes(20), 3), (bytes(20), -1), (bytes(19), 0)):
        with pytest.raises(ValueError, match="allowed: whole records of 10 bytes"):
            layout.take_out(content, np.array([0, offset]))
    for size, marks in ((7, 7), (10, 9)):
        with pytest.raises(ValueError, match="allowed: at least 8 bytes, and one flag for each byte"):
            RecordLayout(np.zeros(size, np.uint8), np.ones(marks, bool))


@pytest.mark.parametrize(("numbers", "bounds", "times"), [
    ((1, 3), (1, 2), (2, 3)), ((2, 3), (3, 2), (2, 3)), ((2, 3), (2, 2), (2, 2)), ((2, 0), (2, 2), (2, 0)),
])  # fmt: skip
def test_shapes_that_do_not_fit_are_refused(numbers, bounds, times) -> None:
    with pytest.raises(ValueError, match="at least 2 columns and 1 tick"):
        first_fault(np.zeros(numbers), np.zeros(bounds), np.zeros(times, np.int64), END_NS)


CHANGES = {
    "flags: 0.5; allowed: a whole number from 0 to 4.29497e+09": ("flags", 2, 0.5),
    "tick: 1234567.5; allowed: a whole number from 0 to ": ("tick", 2, 1234567.5),
    "out of order: tick 7 after 1234567": ("tick", 0, 1234567.0),
    "out of order: tick 6 after 6": ("tick", 1, 6.0),
    "out of order: deadline_ns 200 after 250": ("deadline_ns", 1, 250.0),
    "the log times of the ticks do not match their deadlines": ("_log_time", 1, 3),
    "contains other data than ticks": ("_channel", 3, 2),
}


@pytest.mark.parametrize("message", CHANGES)
def test_each_fault_of_a_chunk_is_named_with_its_value(message: str) -> None:
    """Ticks 6 … 9 and deadlines 0 … 300 ns are valid; one changed value is a fault."""
    records = format.blank_ticks(COLUMNS, 4)
    rows = np.zeros((4, len(COLUMNS)))
    rows[:, 0], rows[:, 1] = 6.0 + np.arange(4), 100.0 * np.arange(4)
    format.fill_ticks(records, COLUMNS, rows, 1_000)
    layout = TickLayout(COLUMNS)
    ticks = layout.parse_ticks(records.tobytes(), COLUMNS)
    assert ticks.rows.tobytes() == rows.tobytes()
    assert (ticks.first, ticks.last, ticks.numbers.tolist()) == (6, 9, [6.0, 7.0, 8.0, 9.0])
    name, row, value = CHANGES[message]
    records[name][row] = value
    with pytest.raises(DamagedChunk, match=message.replace("+", r"\+")):
        layout.parse_ticks(records.tobytes(), COLUMNS)
