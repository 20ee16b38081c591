"""A capture of Stabilizer's stream, written here by `struct` from its published layout, becomes volts and times."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import rtloop
from rtloop.interchange.formats.table import UnreadableData
from rtloop.interchange.reading import read_in_process
from tests.command_line import run

BATCHES, SAMPLES = 3, 8
LSB_V = 20.48 / 65536


def frame(sequence: int, signal: np.ndarray, format_number: int = 1) -> bytes:
    """Return a frame of three batches of eight samples: `signal` (24,) at adc0, its negative at dac0."""
    data = struct.pack("<HBBI", 0x057B, format_number, SAMPLES, sequence % 2**32)
    for batch in signal.reshape(BATCHES, SAMPLES):
        data += struct.pack("<8h", *batch) + struct.pack("<8h", *[7] * SAMPLES)
        data += struct.pack("<8H", *[int(0x8000 - code) for code in batch]) + struct.pack("<8H", *[0x8000] * SAMPLES)
    return data


@pytest.fixture
def signal() -> np.ndarray:
    """Codes (10 frames, 24 samples) of a converter, drawn at random."""
    return np.random.default_rng(5).integers(-32000, 32000, (10, BATCHES * SAMPLES))


def test_codes_become_volts_and_lost_frames_leave_a_gap_in_time(tmp_path: Path, signal):
    first = 2**32 - 3 * BATCHES  # The sequence begins again at 0 within the file.
    present_frames = [i for i in range(10) if i not in (4, 5)]
    path = tmp_path / "stream.bin"
    path.write_bytes(b"".join(frame(first + i * BATCHES, signal[i]) for i in present_frames) + b"\x7b\x05\x01")
    table = read_in_process(path)
    np.testing.assert_array_equal(table.columns["adc0"], signal[present_frames].reshape(-1) * LSB_V)
    np.testing.assert_array_equal(table.columns["dac0"], -signal[present_frames].reshape(-1) * LSB_V)
    np.testing.assert_array_equal(table.columns["adc1"], 7 * LSB_V)
    assert not table.columns["dac1"].any()
    expected = np.concatenate([np.arange(24) + 24 * i for i in present_frames])
    np.testing.assert_array_equal(table.columns["sample"], expected)
    np.testing.assert_allclose(table.columns["time"], expected * 1.28e-6, rtol=1e-12)
    assert table.about["lost frames"] == "2"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data[:2] + b"\x02" + data[3:], "format 1"),
        (lambda data: data[:100] + data[101:], "different lengths"),
        (lambda data: data[200:400] + data[:200], "order|lengths"),
        (lambda data: data[:5], "format 1|lengths"),
    ],
)
def test_other_streams_are_refused_with_a_reason(tmp_path: Path, signal, change, message):
    path = tmp_path / "stream.bin"
    path.write_bytes(change(b"".join(frame(i * BATCHES, signal[i]) for i in range(4))))
    with pytest.raises(UnreadableData, match=message):
        read_in_process(path)


def test_the_command_writes_a_recording(tmp_path: Path, signal):
    path = tmp_path / "stream.bin"
    path.write_bytes(b"".join(frame(i * BATCHES, signal[i]) for i in range(10)))
    result = run("import", path, "--map", "x_drive_v=dac0", "--map", "x_position_um=adc0 * 2 µm/V")
    assert result.exit_code == 0, result.output
    recording = rtloop.load(tmp_path / "stream.mcap")
    np.testing.assert_allclose(recording["x_position_um"], signal.reshape(-1) * LSB_V * 2, rtol=1e-12)
    assert recording.header["rate_hz"] == pytest.approx(781_250)
