"""rtloop: a hard, fast control loop from Python, with a recording that proves each tick."""

from __future__ import annotations

from importlib import import_module

from rtloop.version import __version__ as __version__

TYPE_CHECKING = False  # not from typing: with `python -m rtloop` that could still be a file of the current folder
if TYPE_CHECKING:
    from rtloop.campaigns.run import campaign as campaign
    from rtloop.client.capture.conditions import Edge as Edge
    from rtloop.client.capture.conditions import Late as Late
    from rtloop.client.capture.conditions import ModeChanged as ModeChanged
    from rtloop.client.capture.conditions import Stepped as Stepped
    from rtloop.client.capture.conditions import Tripped as Tripped
    from rtloop.client.capture.conditions import Window as Window
    from rtloop.client.connection import connect as connect
    from rtloop.recording.load import load as load
    from rtloop.workbench.check import check as check
    from rtloop.workbench.design import design as design
    from rtloop.workbench.identify import identify as identify
    from rtloop.workbench.replay import replay as replay
    from rtloop.workbench.run import run as run

_CONDITIONS = ("Edge", "Late", "ModeChanged", "Stepped", "Tripped", "Window")
_WORKBENCH = ("check", "design", "identify", "replay", "run")
_MODULES = {
    "campaign": "rtloop.campaigns.run",
    "connect": "rtloop.client.connection",
    "load": "rtloop.recording.load",
    **dict.fromkeys(_CONDITIONS, "rtloop.client.capture.conditions"),
    **{name: f"rtloop.workbench.{name}" for name in _WORKBENCH},
}
__all__ = [
    "Edge",
    "Late",
    "ModeChanged",
    "Stepped",
    "Tripped",
    "Window",
    "__version__",
    "campaign",
    "check",
    "connect",
    "design",
    "identify",
    "load",
    "replay",
    "run",
]


def __getattr__(name: str) -> object:
    """Return a public name, importing its module at the first use; AttributeError for any other name.

    The loop's process does not need these modules, and some load numpy and scipy.
    """
    if name not in _MODULES:
        raise AttributeError(f"module 'rtloop' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return __all__
