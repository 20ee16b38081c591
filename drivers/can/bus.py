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
    """Open and return the bus that `options` describe, without python-can's configuration files.

    python-can then logs critical errors only. Raises DriverError, which names the bus, if python-can cannot open it
    because of hardware, library or settings.
    """
    logging.getLogger("can").setLevel(logging.CRITICAL)  # python-can's log only repeats its errors.
    try:
        return can.Bus(ignore_config=True, **options.keywords)
    except (*BUS_ERRORS, ValueError, TypeError, NotImplementedError, ImportError) as error:
        raise DriverError(f"{options.label}: {error_text(error)}") from error


def error_text(error: BaseException) -> str:
    """Return the messages of an error and of the error that caused it, joined by ": ".

    python-can may put the reason into the message of the cause. The type stands for an error without a message; equal
    messages appear once.
    """
    cause = error.__cause__ or error.__context__
    texts = [str(part) or type(part).__name__ for part in (error, cause) if part is not None]
    return ": ".join(dict.fromkeys(texts))
