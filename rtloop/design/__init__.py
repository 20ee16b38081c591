"""Design of verified controllers from recordings and specifications.

`rtloop.design` names this package and the public function `rtloop.workbench.design.design`. Once a module of the
package is imported, Python stores the package under that name; so the package can be called, and passes the call to the
function.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType


class CallableRoom(ModuleType):
    """The package `rtloop.design` as a module that can be called as the function of the same name."""

    def __call__(self, *arguments: object, **options: object) -> object:
        """Call `rtloop.workbench.design.design`, with its arguments, result and errors."""
        return self.__wrapped__(*arguments, **options)

    @property
    def __wrapped__(self) -> Callable[..., object]:
        """Public function `rtloop.workbench.design.design`, whose signature `help` and notebooks show."""
        return import_module("rtloop.workbench.design").design


sys.modules[__name__].__class__ = CallableRoom
