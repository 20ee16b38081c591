"""Opening a bus, and what is wrong with one, in one message."""

from __future__ import annotations

import logging

from rtloop.drivers.can.extra import can
from rtloop.drivers.can.options import BusOptions
from rtloop.drivers.errors import DriverError

BUS_ERRORS = (can.CanError, OSError)
"""What python-can's interfaces raise while they work."""


def require_interface(options: BusOptions) -> None:
    """Raises ValueError for an interface that python-can does not have."""
    interfaces = sorted(can.VALID_INTERFACES)
    if options.interface not in interfaces:
        raise ValueError(f"interface: {options.interface!r}; python-can has {', '.join(interfaces)}")


def open_bus(options: BusOptions) -> can.BusABC:
    """The bus of the options, and of nothing else that python-can might read. Raises DriverError."""
    logging.getLogger("can").setLevel(logging.CRITICAL)  # it says once more what its errors say
    try:
        return can.Bus(ignore_config=True, **options.keywords)
    except (*BUS_ERRORS, ValueError, TypeError, NotImplementedError, ImportError) as error:
        raise DriverError(f"{options.label}: {error_text(error)}") from error


def error_text(error: BaseException) -> str:
    """The message of an error, and of the one behind it where python-can hides the cause there."""
    cause = error.__cause__ or error.__context__
    texts = [str(part) or type(part).__name__ for part in (error, cause) if part is not None]
    return ": ".join(dict.fromkeys(texts))
