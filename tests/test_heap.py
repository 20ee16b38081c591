"""Freed memory stays in the process: no new pages for the next arrays of that size."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from rtloop.foundation.heap import keep_freed_memory
if sys.argv[1] == "kept":
    keep_freed_memory()
def touch():
    for _ in range(50):
        arrays = [np.ones(1 << 19) for _ in range(3)]
        del arrays
touch()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
touch()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the heap of another C library has other rules")
def test_arrays_of_megabytes_take_pages_that_the_process_has_already():
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    faults_kept, faults_returned = (
        int(
            subprocess.run(
                [sys.executable, "-c", FAULTS, how], env=environment, capture_output=True, text=True, check=True
            ).stdout
        )
        for how in ("kept", "returned")
    )
    assert faults_kept < 1_000 < 10_000 < faults_returned
