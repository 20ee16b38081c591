"""Private names of libraries that rtloop uses: a new version without one of them fails here, by that name."""

from __future__ import annotations

import inspect
import re
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numba
import numba.np.linalg
import pytest
from llvmlite import ir
from numba.core import caching, cgutils, registry, sigutils
from numba.core.typing import templates
from numba.np import arraymath
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def _compiled() -> tuple[Any, Any]:
    """Return numba's dispatcher and C function of one kernel."""
    dispatcher: Any = numba.njit(lambda number: number + 1)
    dispatcher.compile(numba.int64(numba.int64))
    return dispatcher, numba.cfunc("int64(int64)")(dispatcher.py_func)


DISPATCHER, CFUNC = _compiled()
OVERLOAD = DISPATCHER.overloads[DISPATCHER.signatures[0]]
NAMES: dict[str, tuple[object, tuple[str, ...]]] = {
    "numba: code library (native/standalone.py)": (OVERLOAD.library, ("_final_module", "_codegen")),
    "numba: code generator (native/standalone.py)": (OVERLOAD.library._codegen, ("_tm",)),
    "numba: C function (native/standalone.py)": (CFUNC, ("_library", "native_name")),
    "numba: overload (native/c_function.py, laws/purity.py)": (OVERLOAD, ("library", "fndesc")),
    "numba: function description (native/c_function.py)": (OVERLOAD.fndesc, ("llvm_func_name",)),
    "numba.core.caching (native/compiler.py)": (caching, ("IndexDataCacheFile",)),
    "numba cache file (native/numba_cache_file.py)": (
        caching.IndexDataCacheFile, ("_load_index", "_load_data", "_open_for_write", "_index_path", "_data_path"),
    ),
    "numba.core.sigutils (native/compiler.py)": (sigutils, ("normalize_signature",)),
    "numba.core.registry (native/compiler.py)": (registry, ("cpu_target",)),
    "numba.core.typing.templates (native/compiled.py)": (templates, ("make_intrinsic_template",)),
    "numba.core.cgutils (native/atomics.py)": (cgutils, ("get_item_pointer",)),
    "numba.np.linalg (native/compiler.py)": (numba.np.linalg, ("ensure_blas",)),
    "numba.np.arraymath (native/compiler.py)": (arraymath, ("_HAVE_BLAS",)),
    "llvmlite builder (native/atomics.py)": (ir.IRBuilder, ("load_atomic", "store_atomic", "cmpxchg", "fence")),
    "uvicorn HTTP (service/api/connections.py)": (
        H11Protocol,
        ("connection_made", "connection_lost", "handle_websocket_upgrade", "on_response_complete", "cycle", "flow",
         "loop", "transport"),
    ),
    "uvicorn WebSocket (panel/web/live.py)": (
        WebSocketsSansIOProtocol, ("run_asgi", "data_received", "connections", "conn", "loop", "transport")
    ),
}  # fmt: skip


def _missing_names(owner: object, names: tuple[str, ...]) -> list[str]:
    """Return the names that `owner` lacks; of a class, also as an attribute of its instances."""
    source = inspect.getsource(owner) if inspect.isclass(owner) else ""
    return [name for name in names if not hasattr(owner, name) and not re.search(rf"self\.{name}\b", source)]


@pytest.mark.parametrize("place", NAMES)
def test_private_names_of_libraries_exist(place: str) -> None:
    owner, names = NAMES[place]
    library = place.partition(":")[0].split()[0].split(".")[0]
    assert _missing_names(owner, names) == [], f"{library} {version(library)} lacks names that rtloop uses"


@pytest.mark.parametrize("library", ["llvmlite", "numba", "uvicorn"])
def test_libraries_with_private_names_have_an_upper_bound_above_the_tested_version(library: str) -> None:
    dependencies = tomllib.loads(PYPROJECT.read_text())["project"]["dependencies"]
    (bound,) = [match[1] for text in dependencies if (match := re.fullmatch(rf"{library}>=[\d.]+,<([\d.]+)", text))]
    assert tuple(map(int, version(library).split(".")[:2])) < tuple(map(int, bound.split(".")))


def test_a_missing_name_is_reported() -> None:
    assert _missing_names(H11Protocol, ("cycle", "gone")) == ["gone"]
