"""rtloop: a hard, fast control loop from Python, with a recording that proves what it did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rtloop.recording.load import load as load
    from rtloop.service.client.connection import connect as connect

__version__ = "0.2.0"
__all__ = ["__version__", "connect", "load"]


def __getattr__(name: str) -> Any:
    """Import what is costly when it is asked for: the loop's process needs none of it."""
    if name == "load":
        from rtloop.recording.load import load

        return load
    if name == "connect":
        from rtloop.service.client.connection import connect

        return connect
    raise AttributeError(f"module 'rtloop' has no attribute {name!r}")
