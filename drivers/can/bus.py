"""Opening of a CAN bus, with its errors in one message."""

from __future__ import annotations

import logging

from rtloop.drivers.can.extra import can
from rtloop.drivers.can.options import BusOptions
from rtloop.drivers.errors import DriverError

BUS_ERRORS = (can.CanError, OSError)
"""Errors that python-can's interfaces raise in operation."""


def require_interface(options: BusOptions) -> None:
    """Raise ValueError, listing python-can's interfaces, if `options.interface` is not one of them."""
    interfaces = sorted(can.VALID_INTERFACES)
    if options.interface not in interfaces:
        raise ValueError(f"interface: {options.interface!r}; allowed: {', '.join(interfaces)}")


def open_bus(options: BusOptions) -> can.BusABC:
    """Open the bus of the options, without python-can's configuration files, and silence python-can's log.

    Raises DriverError, naming the bus, if python-can cannot open it: hardware, library or settings.
    """
    logging.getLogger("can").setLevel(logging.CRITICAL)  # python-can's log only repeats its errors.
    try:
        return can.Bus(ignore_config=True, **options.keywords)
    except (*BUS_ERRORS, ValueError, TypeError, NotImplementedError, ImportError) as error:
        raise DriverError(f"{options.label}: {error_text(error)}") from error


def error_text(error: BaseException) -> str:
    """Return the messages of an error and of its cause (python-can may hide the reason there), joined by ": ".

    An error without a message is named by its type; equal messages appear once.
    """
    cause = error.__cause__ or error.__context__
    texts = [str(part) or type(part).__name__ for part in (error, cause) if part is not None]
    return ": ".join(dict.fromkeys(texts))
