"""Fixtures of the node's tests: library and programs, compiled once in each test process."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.node.bench import KEY, Bench

NODE = Path(__file__).resolve().parents[2] / "deploy/node"
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Werror"]
COMPILER = next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


@pytest.fixture(scope="session")
def compiler() -> str:
    """Return the path of the C compiler; skip the test without one."""
    if COMPILER is None:
        pytest.skip("no C compiler")
    return COMPILER


@pytest.fixture(scope="session")
def library(compiler: str, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """Return the node's library, linked with the simulated board of shim.c."""
    output = tmp_path_factory.mktemp("node") / "node.so"
    sources = [NODE / "rtloop_node.c", NODE / "rtloop_cobs.c", Path(__file__).with_name("shim.c")]
    subprocess.run([compiler, *STRICT, "-O1", "-fPIC", "-shared", f"-I{NODE}", *sources, "-o", output], check=True)
    shared = ctypes.CDLL(str(output))
    for name in ("bench_new", "bench_channels", "cobs_new"):
        getattr(shared, name).restype = ctypes.c_void_p
    for name in ("bench_receive", "cobs_encode", "cobs_receive"):
        getattr(shared, name).restype = ctypes.c_size_t
    for name in ("bench_due_us", "bench_write", "bench_extend_us", "bench_siphash"):
        getattr(shared, name).restype = ctypes.c_uint64
    shared.bench_start.restype = ctypes.c_bool
    shared.bench_crc32.restype = shared.cobs_damaged.restype = ctypes.c_uint32
    return shared


@pytest.fixture(params=[None, KEY], ids=["open", "keyed"])
def bench(library: ctypes.CDLL, request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Yield a node that has started at 1 s of its clock, without and with a key."""
    with Bench(library) as bench:
        assert bench.start(key=request.param)
        yield bench


@pytest.fixture(scope="session")
def programs(compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the compiled programs `rtloop-node` and `exchange`."""
    if shutil.which("make") is None:
        pytest.skip("no make")
    folder = tmp_path_factory.mktemp("programs")
    command = ["make", "-C", str(NODE), "all", f"BUILD={folder}", f"CC={compiler}", "CFLAGS=-O1"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return folder
