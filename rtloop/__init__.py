"""rtloop: a hard, fast control loop from Python, with a recording that proves what it did."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtloop.panel.conditions import Edge as Edge
    from rtloop.panel.conditions import Late as Late
    from rtloop.panel.conditions import ModeChanged as ModeChanged
    from rtloop.panel.conditions import Stepped as Stepped
    from rtloop.panel.conditions import Tripped as Tripped
    from rtloop.panel.conditions import Window as Window
    from rtloop.panel.connection import connect as connect
    from rtloop.recording.load import load as load

__version__ = "0.2.0"
_MODULES = {
    "connect": "rtloop.panel.connection",
    "load": "rtloop.recording.load",
    **dict.fromkeys(("Edge", "Late", "ModeChanged", "Stepped", "Tripped", "Window"), "rtloop.panel.conditions"),
}
__all__ = ["Edge", "Late", "ModeChanged", "Stepped", "Tripped", "Window", "__version__", "connect", "load"]


def __getattr__(name: str) -> Any:
    """Import what is costly when it is asked for: the loop's process needs none of it."""
    if name not in _MODULES:
        raise AttributeError(f"module 'rtloop' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
