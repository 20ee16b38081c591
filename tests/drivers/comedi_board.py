"""The stand-in for libcomedi, compiled once a session, and access to its hardware, which is a file."""

from __future__ import annotations

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

MAGIC, OUTPUTS, HIGHEST_CODE = 0xDA9, 4, 65535
HARDWARE = np.dtype(
    [
        ("magic", "u4"),
        ("fail_read", "u4"),
        ("fail_write", "u4"),
        ("code", "u4", OUTPUTS),
        ("range", "u4", OUTPUTS),
        ("mute", "u4"),
    ]
)
OUTPUT_RANGES_V = ((-10.0, 10.0), (0.0, 5.0))


@functools.cache
def stub_library() -> Path:
    """Return the path of the compiled stand-in; skip the test where there is no C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    folder = tempfile.mkdtemp(prefix="rtloop-comedi-")
    library = Path(folder) / "libcomedi.so.0"
    source = Path(__file__).with_name("comedi_stub.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-w", "-o", library, source], check=True)
    return library


def new_board(path: Path, mute: bool = False, share: float = 0.85) -> Path:
    """Write hardware with outputs at 7 V, or at another share of their range; a `mute` board's cannot be read."""
    hardware = np.zeros(1, HARDWARE)
    hardware["magic"], hardware["code"], hardware["mute"] = MAGIC, round(share * HIGHEST_CODE), mute
    path.write_bytes(hardware.tobytes())
    return path


def hardware(path: Path) -> np.ndarray:
    """Return the mapped record of the hardware, which a test can read and change."""
    return np.memmap(path, HARDWARE, "r+", shape=(1,))


def output_v(path: Path, channel: int) -> float:
    """Return the present voltage of an output."""
    board = hardware(path)[0]
    lowest, highest = OUTPUT_RANGES_V[board["range"][channel]]
    return float(lowest + board["code"][channel] * (highest - lowest) / HIGHEST_CODE)
