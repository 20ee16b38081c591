"""From what a configuration names to a law: kinds that are shipped or installed, and files.

Modules are imported when they are asked for: the loop's process loads what it runs, and nothing else. A law from a file
travels as its text, so that every process runs the very same.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

from rtloop.law.memory import Layout
from rtloop.laws.contract import Law
from rtloop.laws.limited.announced import announce, is_limited
from rtloop.laws.mistakes import mistakes

GROUP = "rtloop.laws"
SHIPPED = "rtloop.laws.shipped"
BUILT_IN = {
    "coupled": f"{SHIPPED}.coupled:Coupled",
    "integral_resonant": f"{SHIPPED}.integral_resonant:IntegralResonant",
    "pid": f"{SHIPPED}.pid:Pid",
    "positive_position": f"{SHIPPED}.positive_position:PositivePosition",
    "prandtl_ishlinskii": f"{SHIPPED}.prandtl_ishlinskii:PrandtlIshlinskii",
    "repetitive": f"{SHIPPED}.repetitive:Repetitive",
    "transfer": f"{SHIPPED}.transfer:TransferController",
}


@dataclass(frozen=True, order=True)
class LawReference:
    """A law by its kind; one that is not shipped with the text of the file that defines it."""

    kind: str
    text: str = ""
    file: str = ""
    """Where the text stood, for messages."""
    axes: int = 0
    """Of a law for any number of axes, how many it has here."""

    @property
    def sha256(self) -> str | None:
        """Of the text; None for a shipped law."""
        return hashlib.sha256(self.text.encode()).hexdigest() if self.text else None


def kinds() -> dict[str, str]:
    """Every known kind and where it is defined; a third party cannot replace a built-in kind."""
    found = {point.name: point.value for point in entry_points(group=GROUP)}
    return dict(sorted({**found, **BUILT_IN}.items()))


def reference(kind: str) -> LawReference:
    """A shipped law, or an installed one. Raises ValueError for a kind that is not known or cannot be imported."""
    if kind in BUILT_IN:
        return LawReference(kind)
    known = kinds()
    if kind not in known:
        raise ValueError(f"{kind!r} is not a known law; there are {', '.join(known)}")
    module = known[kind].partition(":")[0]
    announce(kind, module)
    try:
        file = inspect.getsourcefile(import_module(module))
        return from_text(Path(file or "").read_text(encoding="utf-8"), str(file), kind)
    except (ImportError, OSError) as error:
        raise ValueError(f"law {kind!r}, {known[kind]}: cannot be imported: {error}") from error


def laws_in(text: str, file: str) -> tuple[LawReference, ...]:
    """All laws that a text defines. Raises ValueError where it cannot be run."""
    announce(Path(file).stem, file)
    return _laws_in(text, file)


def _laws_in(text: str, file: str) -> tuple[LawReference, ...]:
    return tuple(LawReference(kind, text, file) for kind in sorted(_classes(_module(text, file))))


def from_text(text: str, file: str, kind: str | None = None) -> LawReference:
    """The law that a text defines; `kind` says which, where there are several. Raises ValueError."""
    announce(kind or Path(file).stem, file)
    found = {law.kind: law for law in _laws_in(text, file)}
    if kind is None and len(found) == 1:
        return next(iter(found.values()))
    if kind not in found:
        there = f"defines {', '.join(found)}; kind says which is meant" if found else "defines no law"
        raise ValueError(f"{file}: {there}")
    return found[kind]


def law_class(law: LawReference) -> type[Law]:
    """The class of a law. Raises ValueError where its text cannot be run."""
    if law.text:
        announce(law.kind, law.file)
        return _classes(_module(law.text, law.file))[law.kind]
    module, _, name = BUILT_IN[law.kind].partition(":")
    return getattr(import_module(module), name)


def layout_of(laws: Sequence[LawReference]) -> Layout:
    """The records of a loop that knows these laws."""
    return Layout(tuple(law_class(law).records(law.axes) for law in laws))


@cache
def _module(text: str, file: str) -> ModuleType:
    """A text as a module of its own, run once. Raises ValueError with what it raises."""
    name = f"rtloop_law_{hashlib.sha256((file + text).encode()).hexdigest()[:16]}"
    module = ModuleType(name, text)
    module.__file__ = file
    sys.modules[name] = module
    try:
        # stdout belongs to the command, or to the supervisor; a limited process has none of its own
        with contextlib.nullcontext() if is_limited() else contextlib.redirect_stdout(sys.stderr):
            exec(compile(text, file, "exec"), module.__dict__)
    except Exception as error:
        del sys.modules[name]
        raise ValueError(f"{file}: cannot be run: {_said(error)}") from error
    for mistake in mistakes(text, vars(module)):
        del sys.modules[name]
        raise ValueError(f"{file}, line {mistake.line}: {mistake.what}")
    return module


def _classes(module: ModuleType) -> dict[str, type[Law]]:
    """The laws that a module itself defines, by kind."""
    own = [one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__]
    return {one.kind: one for one in own if issubclass(one, Law) and not inspect.isabstract(one)}


def _said(error: Exception) -> str:
    line = f" in line {error.lineno}" if isinstance(error, SyntaxError) else ""
    return f"{type(error).__name__}{line}: {' '.join(str(error).split())}"
