"""The C baseline, compiled when it is needed, on the very records that the compiled Python works on."""

from __future__ import annotations

import ctypes
import platform
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.hil.rig import COEFFICIENTS as RIG_COEFFICIENTS
from rtloop.hil.rig import STATE as RIG_STATE
from rtloop.kernel.layout import COEFFICIENTS, CONDITIONS, LOOP_STATE, STATE
from rtloop.kernel.memory import LawMemory
from rtloop.kernel.reference import GENERATOR
from rtloop.laws.shipped import prandtl_ishlinskii, transfer

SOURCE = Path(__file__).parent / "c"
# vectors of four are the fastest that this code was seen to run with on x86; 512 bits cost a third more
VECTORS = ("-mprefer-vector-width=256",) if platform.machine() == "x86_64" else ()
OPTIONS = ("-O3", "-march=native", *VECTORS, "-ffp-contract=off", "-std=gnu11", "-Wall", "-Wextra", "-fPIC", "-shared")


def in_one(**parts: np.dtype[Any]) -> np.dtype[Any]:
    """The records of an axis and of its laws, one behind the other, as one; a name that comes twice gets a prefix."""
    fields: list[Any] = []
    for owner, part in parts.items():
        for name, *rest in part.descr:
            taken = any(name == before for before, *_ in fields)
            fields.append((f"{owner}_{name}" if taken else name, *rest))
    return np.dtype(fields)


STRUCTS = {
    "law_coefficients": in_one(
        axis=COEFFICIENTS, plays=prandtl_ishlinskii.COEFFICIENTS, controller=transfer.COEFFICIENTS
    ),
    "law_state": in_one(axis=STATE, plays=prandtl_ishlinskii.STATE, controller=transfer.STATE),
    "loop_state": LOOP_STATE,
    "conditions": CONDITIONS,
    "rig_coefficients": RIG_COEFFICIENTS,
    "rig_state": RIG_STATE,
    "generator": GENERATOR,
}
C_TYPES = {"f8": "double", "i8": "int64_t", "u8": "uint64_t", "u1": "uint8_t"}
RUN = np.dtype(
    [
        *((name, np.int64) for name in ("law_coefficients", "law_state", "loop_state")),
        *((name, np.int64) for name in ("rig_coefficients", "rig_state", "generators", "table")),
        *((name, np.int64) for name in ("words", "head", "marks", "slots", "last_drive_v")),
        *((name, np.int64) for name in ("axes", "columns", "capacity", "tick")),
        *((name, np.float64) for name in ("period_ns", "period_us", "heartbeat_timeout_ns")),
    ]
)
"""`struct run` of loop.c."""


def struct_of(name: str, dtype: np.dtype[Any]) -> str:
    """A C struct with the layout of `dtype`, and the assertions that it has it."""
    assert dtype.fields is not None
    members, checks = [], [f'_Static_assert(sizeof(struct {name}) == {dtype.itemsize}, "{name}");']
    for field, (kind, offset, *_) in dtype.fields.items():
        dimensions = "".join(f"[{length}]" for length in kind.shape)
        members.append(f"    {C_TYPES[kind.base.str[1:]]} {field}{dimensions};")
        checks.append(f'_Static_assert(offsetof(struct {name}, {field}) == {offset}, "{name}.{field}");')
    return "\n".join([f"struct {name} {{", *members, "};", *checks])


def header() -> str:
    """All structs that Python and C share."""
    structs = (struct_of(name, dtype) for name, dtype in STRUCTS.items())
    return "\n".join(["#pragma once", "#include <stddef.h>", "#include <stdint.h>", *structs, ""])


@cache
def library() -> ctypes.CDLL:
    """The baseline, compiled and loaded. Raises FileNotFoundError without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise FileNotFoundError("cc: a C compiler is needed for the baseline")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "layout.h").write_text(header())
        target = Path(folder) / "baseline.so"
        command = [compiler, *OPTIONS, f"-I{folder}", f"-I{SOURCE}", str(SOURCE / "loop.c"), "-lm", "-o", str(target)]
        subprocess.run(command, check=True)
        return ctypes.CDLL(str(target))


def arrays_of(law: LawMemory) -> tuple[np.ndarray[Any, Any], ...]:
    """Coefficients, axes and loop, as C has them."""
    return law.coefficients, law.axes, law.state


def run_law(arrays: tuple[np.ndarray[Any, Any], ...], ticks: int, out: np.ndarray[Any, Any]) -> None:
    """`run_law` of loop.c on coefficients, state, loop state, inputs [V], references and modes (−1: as before)."""
    addresses = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
    axes, last = ctypes.c_int64(arrays[0].size), (ctypes.c_int64(ticks), ctypes.c_void_p(out.ctypes.data))
    library().run_law(*addresses[:3], axes, *addresses[3:], *last)


def run_loop(run: np.ndarray[Any, Any], until_tick: int) -> None:
    """`run_loop` of loop.c."""
    library().run_loop(ctypes.c_void_p(run.ctypes.data), ctypes.c_int64(until_tick))
