"""Drivers by the name of their kind: a table, extended by the entry-point group `rtloop.drivers`."""

from __future__ import annotations

from importlib import import_module

from rtloop.drivers.base import Driver
from rtloop.drivers.errors import MissingLibrary

GROUP = "rtloop.drivers"
BUILT_IN = {
    "can": "rtloop.drivers.can.driver:CanDriver",
    "comedi": "rtloop.drivers.comedi:ComediDriver",
    "serial": "rtloop.drivers.node.driver:SerialDriver",
    "shm": "rtloop.drivers.shm:ShmDriver",
    "sim": "rtloop.drivers.sim:SimDriver",
    "udp": "rtloop.drivers.node.driver:UdpDriver",
}


def kinds() -> dict[str, str]:
    """Return "module:class" of every driver, built-in and installed, by its kind, sorted by kind.

    An installed driver cannot replace a built-in one.
    """
    from importlib.metadata import entry_points  # Only a driver that is not built in needs it.

    installed = {point.name: point.value for point in entry_points(group=GROUP)}
    return dict(sorted({**installed, **BUILT_IN}.items()))


def driver_class(kind: str) -> type[Driver]:
    """Return the driver class of a kind, importing its module.

    Raises ValueError, listing the kinds, for an unknown one; MissingLibrary if its module cannot be imported, for any
    reason, or lacks the class.
    """
    location = BUILT_IN.get(kind) or kinds().get(kind)  # Searching the installed packages takes time.
    if location is None:
        raise ValueError(
            f"{kind!r} is not a known driver; allowed: {', '.join(kinds())}. A driver of your own: "
            "pip install --editable FOLDER, with the Python that runs rtloop"
        )
    module, _, name = location.partition(":")
    try:
        return getattr(import_module(module), name)
    except Exception as error:  # any code may stand in an installed module
        lacking = error.name if isinstance(error, ModuleNotFoundError) and error.name != module else None
        advice = (
            f". If {lacking} is a file of the driver's package, add it to py-modules in its pyproject.toml and install "
            "the package again"
            if lacking
            else ""
        )
        raise MissingLibrary(f"driver {kind!r}: {location} cannot be imported: {error}{advice}") from error
