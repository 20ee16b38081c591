"""Registry of laws: finds the law that a configuration names, by kind (shipped or installed) or in a file.

Modules are imported on demand: the loop's process loads only the laws that it runs. A law from a file is passed on as
its text, with the texts of its helpers, so that every process runs the same code."""

from __future__ import annotations

import builtins
import contextlib
import hashlib
import inspect
import re
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from rtloop.kernel.memory import Layout
from rtloop.laws.contract import Law
from rtloop.laws.helpers import Helper
from rtloop.laws.limited.announcement import announce, is_limited
from rtloop.laws.options import LawOptions

GROUP = "rtloop.laws"
SHIPPED = "rtloop.laws.shipped"
MODULE_PREFIX = "rtloop_law_"
"""Prefix of the names of the modules of laws that are not shipped."""
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
    """A law by its kind; one that is not shipped carries the text of the file that defines it."""

    kind: str
    text: str = ""
    file: str = ""
    """Path of the text's file, for messages."""
    axes: int = 0
    """Number of axes in this loop, for a law whose class leaves it open."""
    helpers: tuple[Helper, ...] = ()
    """Files beside the law's that it imports."""

    @property
    def sha256(self) -> str | None:
        """SHA-256 of the text, with helpers of the text and then their names and texts; None for a shipped law."""
        parts = [self.text, *(part for helper in self.helpers for part in (helper.name, helper.text))]
        return hashlib.sha256("\0".join(parts).encode()).hexdigest() if self.text else None

    def restore_options(self, values: Mapping[str, object]) -> LawOptions:
        """Return the law's options with `values`, bound to this law.

        Raises ValueError for values that are not allowed, and the errors of `law_class`.
        """
        options = law_class(self).options_model.model_validate(values)
        options.bind(self)
        return options


def kinds() -> dict[str, str]:
    """Return "module:class" of every law, shipped and installed, by its kind, sorted by kind.

    An installed law cannot replace a shipped one.
    """
    from importlib.metadata import entry_points  # Only a law that is not shipped needs it.

    installed = {point.name: point.value for point in entry_points(group=GROUP)}
    return dict(sorted({**installed, **BUILT_IN}.items()))


def find_law(kind: str) -> LawReference:
    """Return a shipped or installed law; the module of an installed one is run.

    Raises ValueError for an unknown kind, for a module that cannot be imported or read, and for a module whose text
    fails when it is run alone, has a mistake or does not define the kind.
    """
    if kind in BUILT_IN:
        return LawReference(kind)
    locations = kinds()
    if kind not in locations:
        raise ValueError(f"{kind!r} is not a known law; allowed: {', '.join(locations)}")
    module = locations[kind].partition(":")[0]
    announce(kind, module)
    try:
        file = inspect.getsourcefile(import_module(module))
        text = Path(file or "").read_text(encoding="utf-8")
    except Exception as error:  # any code may stand in an installed module
        raise ValueError(f"law {kind!r}: {locations[kind]} cannot be imported: {error}") from error
    return law_from_text(text, str(file), kind)


def laws_in(text: str, file: str, helpers: tuple[Helper, ...] = ()) -> tuple[LawReference, ...]:
    """Return all laws that a text defines, sorted by kind; the text is run once in a process. `file` is for messages,
    `helpers` are the texts that it imports.

    Raises ValueError if the text cannot be run or has a mistake.
    """
    announce(Path(file).stem, file)
    return _laws_in(text, file, helpers)


def _laws_in(text: str, file: str, helpers: tuple[Helper, ...]) -> tuple[LawReference, ...]:
    """Return all laws that a text defines, like `laws_in`, but do not name the law to the parent process."""
    classes = _law_classes(_module(text, file, helpers))
    return tuple(LawReference(kind, text, file, helpers=helpers) for kind in sorted(classes))


def law_from_text(text: str, file: str, kind: str | None = None, helpers: tuple[Helper, ...] = ()) -> LawReference:
    """Return the law that a text with these `helpers` defines; `kind` selects one of several. The text is run once in a
    process.

    Raises ValueError if the text defines no law, no law `kind`, or several laws while `kind` is None, and if it cannot
    be run or has a mistake.
    """
    announce(kind or Path(file).stem, file)
    laws = {law.kind: law for law in _laws_in(text, file, helpers)}
    if kind is None and len(laws) == 1:
        return next(iter(laws.values()))
    if kind not in laws:
        if laws:
            raise ValueError(f"{file}: defines the laws {', '.join(laws)}; set kind to one of them")
        from rtloop.laws.mistakes import missing_law

        mistake = missing_law(text, vars(_module(text, file, helpers)))
        place, message = ("", "defines no law") if mistake is None else (f", line {mistake.line}", mistake.message)
        raise ValueError(f"{file}{place}: {message}")
    return laws[kind]


def law_class(law: LawReference) -> type[Law]:
    """Return the class of a law; its text is run once in a process, a text that fails at each call.

    Raises ValueError if the text cannot be run, has a mistake or does not define this kind; KeyError if the law has no
    text and is not shipped.
    """
    if law.text:
        announce(law.kind, law.file)
        classes = _law_classes(_module(law.text, law.file, law.helpers))
        if law.kind not in classes:
            raise ValueError(f"{law.file}: does not define the law {law.kind!r}")
        return classes[law.kind]
    module, _, name = BUILT_IN[law.kind].partition(":")
    return getattr(import_module(module), name)


def plain_functions(law: LawReference) -> list[FunctionType]:
    """Return the functions, outside classes, of the text of a law that is not shipped, and of the helpers that it has
    imported. Raises ValueError as `law_class`.
    """
    module = _module(law.text, law.file, law.helpers)
    names = [module.__name__, *(f"{module.__name__}.{helper.name}" for helper in law.helpers)]
    values = [value for name in names if name in sys.modules for value in vars(sys.modules[name]).values()]
    return [value for value in values if isinstance(value, FunctionType) and value.__module__ in names]


def law_layout(laws: Sequence[LawReference]) -> Layout:
    """Return the record types of a loop with these laws. Raises the errors of `law_class`."""
    return _layout(tuple(laws))


@cache
def _layout(laws: tuple[LawReference, ...]) -> Layout:
    """Return the record types of a loop with these laws, which a process computes once."""
    return Layout(tuple(law_class(law).records(law.axes) for law in laws))


@cache
def _module(text: str, file: str, helpers: tuple[Helper, ...]) -> ModuleType:
    """Return a text as a module, run once in a process with the `helpers` that it imports; its output goes to stderr.

    Raises ValueError with the error of the text or of a helper, or with all mistakes of the text.
    """
    name = MODULE_PREFIX + hashlib.sha256(repr((file, text, helpers)).encode()).hexdigest()[:16]
    importer = _HelperImporter(name, helpers)
    try:
        # stdout belongs to the command, or to the supervisor; a limited process has none of its own
        with contextlib.nullcontext() if is_limited() else contextlib.redirect_stdout(sys.stderr):
            module = importer.run(name, text, file)
    except Exception as error:
        message = _message(error)
        importer.forget()
        raise ValueError(f"{_location(error, [file, *(helper.file for helper in helpers)])}: {message}") from error
    from rtloop.laws.mistakes import find_mistakes  # Only user laws have mistakes.

    lines: dict[str, int] = {}
    for mistake in find_mistakes(text, vars(module)):
        lines.setdefault(mistake.message, mistake.line)
    if lines:
        importer.forget()
        raise ValueError(f"{file}, " + "; ".join(f"line {line}: {message}" for message, line in lines.items()))
    return module


class _HelperImporter:
    """Import statement of one law and of its helpers: a helper's name means this law's helper, in no other module."""

    def __init__(self, law: str, helpers: Sequence[Helper]) -> None:
        """`law` is the name of the law's module, with which the names of its helpers' modules begin."""
        self._law, self._helpers = law, {helper.name: helper for helper in helpers}
        self._loaded: dict[str, ModuleType | None] = {}
        """Modules by name in `sys.modules`; None while the text runs for the first time."""

    def run(self, name: str, text: str, file: str) -> ModuleType:
        """Run a text as the module `name` of `sys.modules`, and return it. Raises what the text raises."""
        self._loaded[name] = None
        module = sys.modules[name] = ModuleType(name, text)
        if file:
            module.__file__ = file
        module.__dict__["__builtins__"] = {**vars(builtins), "__import__": self._import}
        # optimize: an `assert` of the law stays one of its steps, whatever `python -O` or PYTHONOPTIMIZE says
        exec(compile(text, file, "exec", dont_inherit=True, optimize=0), module.__dict__)
        self._loaded[name] = module
        return module

    def forget(self) -> None:
        """Remove the modules of the law from `sys.modules`."""
        for name in self._loaded:
            sys.modules.pop(name, None)

    def _import(self, name: str, *context: Any) -> Any:
        """Return a helper of the law, run at its first import; any other module as Python does."""
        helper = None if context[3:] and context[3] else self._helpers.get(name)
        if helper is None:
            return builtins.__import__(name, *context)
        module_name = f"{self._law}.{name}"
        if module_name not in self._loaded:
            return self.run(module_name, helper.text, helper.file)
        if (module := self._loaded[module_name]) is None:
            raise ImportError(f"{name} is imported while it is being imported itself; let one of the two files not "
                              "import the other")  # fmt: skip
        return module


def _law_classes(module: ModuleType) -> dict[str, type[Law]]:
    """Return the laws that a module itself defines, without abstract classes, by kind."""
    classes = [law for law in vars(module).values() if isinstance(law, type) and law.__module__ == module.__name__]
    return {law.kind: law for law in classes if issubclass(law, Law) and not inspect.isabstract(law)}


def _location(error: Exception, files: Sequence[str]) -> str:
    """Return the file, of a law or a helper in `files`, in which an exception was raised, with its line if it is known.

    `files` begins with the law's file.
    """
    if isinstance(error, SyntaxError):
        file, line = error.filename or files[0], error.lineno
    else:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename in files]
        file, line = (frames[-1].filename, frames[-1].lineno) if frames else (files[0], None)
    return file if line is None else f"{file}, line {line}"


def _message(error: Exception) -> str:
    """Return type and words of an exception on one line.

    If a name cannot be imported from a module, the path of this module is left out, and a similar name is suggested.
    """
    words = error.msg if isinstance(error, SyntaxError | ImportError) else str(error)
    text = f"{type(error).__name__}: {' '.join(str(words).split())}"
    absent = re.search(r"cannot import name '(\w+)' from '([\w.]+)'", text)
    if absent is None:
        return text
    from difflib import get_close_matches

    near = get_close_matches(absent[1], vars(sys.modules[absent[2]]), 1)
    sentence = re.sub(rf"{MODULE_PREFIX}\w+\.", "", absent[0])
    return f"{type(error).__name__}: {sentence}" + (f"; did you mean {near[0]}?" if near else "")
