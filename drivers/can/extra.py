"""python-can and cantools, or a message that says what to install."""

from __future__ import annotations

from rtloop.drivers.errors import MissingLibrary

try:
    import can
    from cantools.database import load_file
    from cantools.database.errors import UnsupportedDatabaseFormatError  # type: ignore[attr-defined]
except ImportError as error:
    raise MissingLibrary(f"CAN needs the package {error.name}: pip install 'rtloop[can]'") from None

__all__ = ["UnsupportedDatabaseFormatError", "can", "load_file"]
