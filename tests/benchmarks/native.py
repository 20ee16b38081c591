"""The C baseline, compiled on first use. It works on the same records as the compiled Python, and its functions replace
rtloop's laws, driver and clock behind the same pointers."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from enum import IntEnum, IntFlag
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rtloop import signals
from rtloop.drivers import sim
from rtloop.drivers.base import Pointers
from rtloop.engine import clock, context
from rtloop.engine.assembly import Assembly
from rtloop.engine.memory import Word
from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.engine.plan import Plan
from rtloop.hil import rig
from rtloop.kernel import interlocks, layout
from rtloop.kernel.memory import LawMemory
from rtloop.kernel.reference import GENERATOR, Generator
from rtloop.laws.shipped import prandtl_ishlinskii, transfer

SOURCE = Path(__file__).parent / "c"
# Vectors of four numbers are the fastest measured for this code on x86; 512 bits take a third more time.
VECTORS = ("-mprefer-vector-width=256",) if platform.machine() == "x86_64" else ()
OPTIONS = ("-O3", "-march=native", *VECTORS, "-ffp-contract=off", "-std=gnu11", "-Wall", "-Wextra", "-fPIC", "-shared")

STRUCTS = {
    "axis_coefficients": layout.COEFFICIENTS,
    "axis_state": layout.STATE,
    "plays_coefficients": prandtl_ishlinskii.COEFFICIENTS,
    "plays_state": prandtl_ishlinskii.STATE,
    "linear_coefficients": transfer.COEFFICIENTS,
    "linear_state": transfer.STATE,
    "loop_state": layout.LOOP_STATE,
    "conditions": layout.CONDITIONS,
    "control": layout.CONTROL,
    "functions": layout.FUNCTIONS,
    "law": layout.LAW,
    "trip": interlocks.TRIP,
    "loop": context.LOOP,
    "message": MESSAGE,
    "generator": GENERATOR,
    "clock": clock.CONTEXT,
    "sim": sim.CONTEXT,
    "rig_coefficients": rig.COEFFICIENTS,
    "rig_state": rig.STATE,
}
ENUMS: dict[str, type[IntEnum | IntFlag]] = {
    "MODE": signals.Mode, "FLAG": signals.Flag, "FAILURE": signals.Failure, "KIND": Kind, "ORIGIN": Origin,
    "WORD": Word, "GENERATOR": Generator,
}  # fmt: skip
COLUMNS = (
    *("TICK", "DEADLINE", "LATENESS", "READ", "LAW", "WRITE", "EXEC", "PERIODS_MISSED", "FLAGS", "MODE"),
    *("DRIVER_STATUS", "SAMPLE_AGE", "ENABLE", "COMMON_COUNT", "PER_AXIS_COUNT"),
    *("ADC", "POSITION", "REFERENCE", "ERROR", "COMMAND", "DEMAND", "DRIVE", "FEED"),
)
C_TYPES = {"f8": "double", "i8": "int64_t", "u8": "uint64_t", "u4": "uint32_t", "u1": "uint8_t"}
LAWS = {"prandtl_ishlinskii": "plays", "transfer": "linear"}
"""Prefix of the C functions of each law."""


def c_struct(name: str, dtype: np.dtype[Any]) -> str:
    """Return the text of a C struct with the layout of `dtype`, and static assertions of its size and offsets."""
    assert dtype.fields is not None
    members, checks = [], [f'_Static_assert(sizeof(struct {name}) == {dtype.itemsize}, "{name}");']
    for field, (kind, offset, *_) in dtype.fields.items():
        dimensions = "".join(f"[{length}]" for length in kind.shape)
        members.append(f"    {C_TYPES[kind.base.str[1:]]} {field}{dimensions};")
        checks.append(f'_Static_assert(offsetof(struct {name}, {field}) == {offset}, "{name}.{field}");')
    return "\n".join([f"struct {name} {{", *members, "};", *checks])


def _constants() -> Iterator[str]:
    """Yield lines of C that name the constants shared by Python and C."""
    for prefix, members in ENUMS.items():
        yield from (f"enum {{ {prefix}_{name} = {int(value)} }};" for name, value in members.__members__.items())
    yield from (f"enum {{ COLUMN_{name} = {getattr(signals, name)} }};" for name in COLUMNS)
    yield f"enum {{ RAISED = {signals.RAISED} }};"


def header() -> str:
    """Return the C header with all structs and constants shared by Python and C."""
    structs = (c_struct(name, dtype) for name, dtype in STRUCTS.items())
    return "\n".join(["#pragma once", "#include <stddef.h>", "#include <stdint.h>", *_constants(), *structs, ""])


@cache
def library() -> ctypes.CDLL:
    """Compile and load the baseline. Raises FileNotFoundError without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise FileNotFoundError("cc: a C compiler is needed for the baseline")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "layout.h").write_text(header())
        target = Path(folder) / "baseline.so"
        command = [compiler, *OPTIONS, f"-I{folder}", f"-I{SOURCE}", str(SOURCE / "loop.c"), "-lm", "-o", str(target)]
        subprocess.run(command, check=True)
        loaded = ctypes.CDLL(str(target))
    loaded.run_loop.restype = ctypes.c_int64
    return loaded


def _address(function: str) -> int:
    """Return the address of a C function of the baseline."""
    address = ctypes.cast(getattr(library(), function), ctypes.c_void_p).value
    assert address is not None
    return address


def law_at_rest(plan: Plan) -> LawMemory:
    """Return the memory of the plan's laws before the first tick, with the C functions in their slots."""
    functions = np.zeros(len(plan.laws), layout.FUNCTIONS)
    for record, law in zip(functions, plan.laws, strict=True):
        for name in ("output", "update", "enter"):
            record[name] = _address(f"{LAWS[law.kind]}_{name}")
    memory = LawMemory.create_at_rest(plan.layout, functions, plan.coefficients, plan.extras)
    memory.state["mode"] = int(plan.mode)
    return memory


def rig_pointers(context_address: int) -> Pointers:
    """Return the C functions of the simulated rig with the context of rtloop's driver."""
    return Pointers(context_address, _address("rig_read"), _address("rig_write"))


def unpaced_clock(clock_context: clock.Clock) -> clock.Clock:
    """Return the C function of virtual time with the context of rtloop's clock."""
    return clock.Clock(_address("unpaced_wait"), 0, clock_context.context)


def run_law(law: LawMemory, inputs: tuple[np.ndarray[Any, Any], ...], ticks: int, out: np.ndarray[Any, Any]) -> None:
    """Call `run_law` of loop.c; `inputs`: readings (V), references, modes (-1: unchanged), a record of conditions."""
    addresses = [ctypes.c_void_p(array.ctypes.data) for array in (law.records, *inputs)]
    library().run_law(*addresses, ctypes.c_int64(ticks), ctypes.c_void_p(out.ctypes.data))


def run_loop(assembly: Assembly, until_tick: int) -> int:
    """Call `run_loop` of loop.c on the context of an assembly; return the reason of its end."""
    address = assembly.loop.__array_interface__["data"][0]
    return library().run_loop(ctypes.c_void_p(address), ctypes.c_int64(until_tick))


def spin(period_ns: float, ticks: int) -> tuple[np.ndarray[Any, Any], ...]:
    """Call `spin` of spin.h; return deadlines (ns), late (0 or 1), periods skipped before each tick; each (ticks,)."""
    arrays = tuple(np.zeros(ticks) for _ in range(3))
    addresses = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    library().spin(ctypes.c_double(period_ns), ctypes.c_int64(ticks), *addresses)
    return arrays
