"""Stabilizer's data stream (QUARTIQ): the payloads of its UDP datagrams, joined, as `nc -ul 9293 > FILE` writes them.

A frame has a header, `<HBBI`: 0x057B, format, samples per batch, sequence of the first batch. Format 1 follows with
batches of two ADC and two DAC channels, 16-bit codes, one channel after the other.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rtloop.foundation.trusted import open_user_file
from rtloop.interchange.formats.groups import FileColumns
from rtloop.interchange.formats.table import Table, UnreadableData

MAGIC_BYTES = b"\x7b\x05"
HEADER = np.dtype([("magic", "<u2"), ("format", "u1"), ("samples", "u1"), ("sequence", "<u4")])
ADC_DAC_FORMAT, CHANNELS = 1, ("adc0", "adc1", "dac0", "dac1")
LARGEST_FRAME = 1472
"""Bytes of a datagram on Ethernet, which Stabilizer never exceeds."""
VOLTS_PER_CODE = 4.096 * 5 / 2**16
SAMPLE_PERIOD_S = 1.28e-6
"""Stabilizer's own default: 128 periods of its clock of 100 MHz."""


def read_stabilizer(path: Path) -> Table:
    """Return a table of `time` in s by SAMPLE_PERIOD_S, the index `sample`, and adc0, adc1, dac0, dac1 in V.

    Time and index begin with 0, and jump where frames were lost. Raises UnreadableData for another format than the ADC
    and DAC codes, for frames of different lengths or not in the order sent, and for a file that is too large.
    """
    with os.fdopen(open_user_file(path), "rb") as file:
        start = file.read(HEADER.itemsize)
        head = np.frombuffer(start if len(start) == HEADER.itemsize else b"", HEADER)
        size = os.fstat(file.fileno()).st_size
        if len(head) == 0 or head[0]["format"] != ADC_DAC_FORMAT or head[0]["samples"] == 0:
            raise UnreadableData(
                f"{path}: not a Stabilizer stream of format 1 (codes of ADC and DAC); allowed: format 1 only"
            )
        columns = FileColumns(path)
        columns.require_room("the stream", (size // 2,))
        file.seek(0)
        data = np.frombuffer(file.read(), np.uint8)
    samples = int(head[0]["samples"])
    frames = _frames(path, data, samples)
    batches = (frames.shape[1] - HEADER.itemsize) // (2 * len(CHANNELS) * samples)
    sequences = frames[:, : HEADER.itemsize].copy().view(HEADER)["sequence"].reshape(-1)
    codes = frames[:, HEADER.itemsize :].copy().view("<i2").reshape(-1, len(CHANNELS), samples)
    codes[:, 2:] ^= np.int16(-0x8000)  # The DAC's codes have an offset.
    steps = np.diff(sequences, prepend=sequences[:1]).astype(np.int64)
    if np.any(steps[1:] == 0) or np.any(steps >= 1 << 31):
        raise UnreadableData(
            f"{path}: frames of the stream are not in the order in which they were sent; record the stream again"
        )
    first = np.cumsum(steps) * samples
    count = (first[:, None] + np.arange(batches * samples)).reshape(-1)
    columns.add_column("time", count * SAMPLE_PERIOD_S, "s")
    columns.add_column("sample", count)
    for i, name in enumerate(CHANNELS):
        columns.add_column(name, codes[:, i].reshape(-1) * VOLTS_PER_CODE, "V")
    lost = int(np.sum(steps[1:] - batches)) // batches
    about = {
        "lost frames": str(lost),
        "sample period": f"{SAMPLE_PERIOD_S * 1e6:g} µs is assumed; for another period, use --time 'sample * 2.56 µs'",
    }
    return Table(columns.columns, columns.units, "time", about)


def _frames(path: Path, data: np.ndarray, samples: int) -> np.ndarray:
    """Return all frames of `data`, uint8 (n,), as (frames, bytes); the incomplete last one is left out.

    `samples` is the number of samples of each channel in a batch.

    The frames have the shortest length at which each begins with the magic number, format and sample count of the
    first. Raises UnreadableData without such a length.
    """
    step = 2 * len(CHANNELS) * samples
    for length in range(HEADER.itemsize + step, min(len(data), LARGEST_FRAME) + 1, step):
        frames = data[: len(data) // length * length].reshape(-1, length)
        remainder = data[frames.size :][:4]
        if np.all(frames[:, :4] == data[:4]) and np.all(remainder == data[: len(remainder)]):
            return frames
    raise UnreadableData(
        f"{path}: the frames of the stream have different lengths, or bytes are missing; record the stream again"
    )
