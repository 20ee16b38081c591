"""What can go wrong with a backend."""


class DriverError(Exception):
    """The hardware, its library or its device is not available or has failed."""


class MissingLibrary(DriverError):
    """A package or library that a driver needs is not installed; the message says what to install."""
