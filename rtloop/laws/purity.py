"""Forbidden calls of a compiled law: functions that allocate memory, wait, or differ between processors."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from numba.core.typing.templates import Signature

    from rtloop.foundation.native.compiled import Kernel

_DEFINED = re.compile(r'^define [^@]*@"?([^"(]+)"?\(.*?^\}', re.MULTILINE | re.DOTALL)
_CALLED = re.compile(r'\b(?:call|invoke)\b[^@\n]*@"?([^"(]+)"?\(')
_CALLED_BY_ADDRESS = re.compile(r'\b(?:call|invoke)\b[^@"\n]*?(?:%"?[\w.$-]+"?\(|inttoptr \()')
ADDRESS = "a function by its address"
LIBM = (
    "differs between processors in its last bits, so that a replay might differ (`libm = True` in the class allows it)"
)
MEMORY = "allocates memory for a list, an array or a text, and may therefore wait"
UNKNOWN = "is outside the law and may wait"
_MATHEMATICS = {
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "sincos"),
    *("exp", "exp2", "exp10", "log", "log2", "log10", "pow", "powi", "ldexp", "frexp"),
}
"""LLVM intrinsics that become calls of the processor's mathematical library."""
_LIBRARY = _MATHEMATICS | {
    *("asinh", "acosh", "atanh", "atan2", "expm1", "log1p", "logb", "cbrt", "hypot", "erf", "erfc", "gamma"),
    *("lgamma", "tgamma", "fmod", "remainder", "modf", "fma", "nextafter", "copysign", "fabs", "sqrt"),
    *("floor", "ceil", "round", "rint", "trunc", "nearbyint"),
}
"""Mathematical functions of the C library; each also exists for numbers of 32 bits, with the suffix `f`."""


def foreign_calls(kernel: Kernel, signature: Signature, libm: bool = False) -> dict[str, str]:
    """Return the reason for each forbidden call of a kernel compiled for `signature`, by the called function's name.

    {} if there is none; `libm` allows the mathematical library.
    """
    overload = kernel.overloads[signature.args]
    text = overload.library.get_llvm_str()
    bodies = {match.group(1): match.group(0) for match in _DEFINED.finditer(text)}
    pending, visited, outside = [overload.fndesc.llvm_func_name], set[str](), set[str]()
    while pending:
        name = pending.pop()
        if name in visited:
            continue
        visited.add(name)
        if _CALLED_BY_ADDRESS.search(bodies[name]):
            outside.add(ADDRESS)
        for called in _CALLED.findall(bodies[name]):
            if called in bodies:
                pending.append(called)
            else:
                outside.add(called)
    reasons = {name: _reason(name) for name in sorted(outside)}
    return {name: reason for name, reason in reasons.items() if reason and not (libm and reason == LIBM)}


def _reason(name: str) -> str:
    """Return the reason for which a law may not call a function of this name; "" for an allowed one."""
    if name.startswith("llvm."):
        function = name.split(".")[1]
        return LIBM if function in _MATHEMATICS else ""
    if name.startswith(("NRT_", "numba_runtime")):
        return MEMORY
    if name.startswith(("Py", "numba_")):
        return "needs Python's interpreter, which can delay a tick"
    return LIBM if name in _LIBRARY or name.removesuffix("f") in _LIBRARY else UNKNOWN
