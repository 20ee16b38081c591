"""From the name of a kind to its law: one table, extended by the entry-point group `rtloop.laws`.

Modules are imported when they are asked for: the loop's process loads what it runs, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points

from rtloop.law.memory import Layout
from rtloop.laws.contract import Law

GROUP = "rtloop.laws"
BUILT_IN = {
    "prandtl_ishlinskii": "rtloop.laws.shipped.prandtl_ishlinskii:PrandtlIshlinskii",
    "transfer": "rtloop.laws.shipped.transfer:TransferController",
}


def kinds() -> dict[str, str]:
    """Every known kind and where it is defined; a third party cannot replace a built-in kind."""
    found = {point.name: point.value for point in entry_points(group=GROUP)}
    return dict(sorted({**found, **BUILT_IN}.items()))


@cache
def law_class(kind: str) -> type[Law]:
    """The class of a kind. Raises ValueError for an unknown kind, and for one that cannot be imported."""
    known = BUILT_IN if kind in BUILT_IN else kinds()
    if kind not in known:
        raise ValueError(f"{kind!r} is not a known law; there are {', '.join(known)}")
    module, _, name = known[kind].partition(":")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"law {kind!r}, {known[kind]}: cannot be imported: {error}") from error


def layout_of(laws: Sequence[str]) -> Layout:
    """The records of a loop that knows these kinds. Raises ValueError."""
    return Layout(tuple(law_class(kind).records() for kind in laws))
