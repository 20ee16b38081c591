"""A law's functions as the loop calls them: compiled for its records, and their addresses.

Shipped laws whose functions are kernels come from the cache; others are compiled where they are used, with checked
indices and divisions, so that a mistake is a status and no broken process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import from_dtype, types

from rtloop.hil.native.compiled import UNCOMPILED, checked, native_address
from rtloop.hil.native.pointers import carray
from rtloop.law.layout import CONTROL, FUNCTIONS
from rtloop.law.memory import LawRecords
from rtloop.laws.contract import Law
from rtloop.laws.registry import law_class


def functions_of(laws: Sequence[str]) -> npt.NDArray[Any]:
    """FUNCTIONS records of these kinds, compiled or loaded. Raises ValueError for one that cannot be compiled."""
    found = np.zeros(len(laws), FUNCTIONS)
    for one, kind in zip(found, laws, strict=True):
        law = law_class(kind)
        told = from_dtype(CONTROL) if law.axes else types.float64
        returns = {"output": types.float64, "update": types.void if law.axes else types.float64, "enter": types.void}
        for name, result in returns.items():
            function = getattr(law, name)
            if function is not None:
                one[name] = _address(law, function, told, result)
    return found


def _address(law: type[Law], function: Callable[..., Any], told: Any, result: Any) -> int:
    keeps = law.records()
    if UNCOMPILED:
        return native_address(_from_addresses(function, keeps, law.axes), None)
    kernel = function if law.shipped else checked(function)
    return native_address(kernel, result(from_dtype(keeps.coefficients), from_dtype(keeps.state), told))


def _from_addresses(function: Callable[..., Any], keeps: LawRecords, axes: int) -> Callable[..., Any]:
    """An uncompiled function as the loop calls it."""

    def call(coefficients: int, state: int, told: Any) -> Any:
        given = carray(told, 1, CONTROL)[0] if axes else told
        return function(carray(coefficients, 1, keeps.coefficients)[0], carray(state, 1, keeps.state)[0], given)

    return call
