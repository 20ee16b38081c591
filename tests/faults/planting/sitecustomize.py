"""Plants one mistake into every Python process that has this folder on its path: see `tests.faults.mutants`.

The mistake replaces one text of one module; environment variables name the module and both texts.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType

MODULE, OLD, NEW = (os.environ.get(f"RTLOOP_PLANTED_{part}", "") for part in ("MODULE", "OLD", "NEW"))


class _PlantingLoader(SourceFileLoader):
    """Loader that replaces OLD by NEW in the source of a module."""

    def get_code(self, fullname: str) -> CodeType:
        text = self.get_source(fullname) or ""
        if text.count(OLD) != 1:
            raise ImportError(f"{fullname}: the text to be replaced occurs {text.count(OLD)} times, not once: {OLD!r}")
        return compile(text.replace(OLD, NEW), self.path, "exec")


class _Finder:
    """Finder of MODULE alone, which is loaded by a _PlantingLoader."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name != MODULE:
            return None
        spec = PathFinder.find_spec(name, path, target)  # type: ignore[arg-type]
        if spec is not None:
            spec.loader = _PlantingLoader(name, str(spec.origin))
        return spec


if MODULE:
    sys.meta_path.insert(0, _Finder)  # type: ignore[arg-type]
