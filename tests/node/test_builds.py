"""The node's library suits firmware: it needs only copying from the C library, works with C++ and on a Cortex-M."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.node.conftest import NODE

pytestmark = pytest.mark.system


def test_the_library_needs_no_more_of_the_c_library_than_copying(compiler: str, tmp_path: Path):
    if (nm := shutil.which("nm")) is None:
        pytest.skip("no nm")
    for name in ("rtloop_node", "rtloop_cobs"):
        flags = ["-std=c11", "-Os", "-ffreestanding", "-fno-stack-protector", "-fno-pic"]
        subprocess.run([compiler, *flags, "-c", NODE / f"{name}.c", "-o", tmp_path / f"{name}.o"], check=True)
        symbols = subprocess.run(
            [nm, "-u", tmp_path / f"{name}.o"], capture_output=True, text=True, check=True
        ).stdout.split()
        assert {symbol for symbol in symbols if symbol != "U"} <= {"memcpy", "memset"}


def test_a_program_in_cpp_can_call_the_library(compiler: str, tmp_path: Path):
    if (cpp := shutil.which("c++")) is None:
        pytest.skip("no C++ compiler")
    source = tmp_path / "firmware.cpp"
    source.write_text(
        """
        #include "rtloop_cobs.h"
        #include "rtloop_node.h"
        int main() { static rtloop_node node; static rtloop_cobs line; rtloop_node_poll(&node, 1);
                     return (int)rtloop_cobs_receive(&line, 0); }
        """,
        encoding="utf-8",
    )
    objects = [tmp_path / f"{name}.o" for name in ("rtloop_node", "rtloop_cobs")]
    for output in objects:
        command = [compiler, "-std=c11", "-c", NODE / f"{output.stem}.c", "-o", output]
        subprocess.run(command, check=True)
    command = [cpp, "-Wall", "-Wextra", "-Werror", f"-I{NODE}", source, *objects, "-o", tmp_path / "firmware"]
    subprocess.run(command, check=True)


def test_the_example_for_a_microcontroller_links(tmp_path: Path):
    if shutil.which("arm-none-eabi-gcc") is None or shutil.which("make") is None:
        pytest.skip("no arm-none-eabi-gcc, or no make")
    command = ["make", "-s", "-C", str(NODE), "arm", f"BUILD={tmp_path}"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    text_bytes, _, memory_bytes, *_ = result.stdout.splitlines()[-1].split()
    assert int(text_bytes) < 5120  # the library, the example and memcpy
    assert int(memory_bytes) < 8192
