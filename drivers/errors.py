"""Errors of drivers and of their hardware."""


class DriverError(Exception):
    """The hardware, its library or its device is not available or has failed."""


class MissingLibrary(DriverError):
    """A package or library that a driver needs is not installed; the message says what to install."""
