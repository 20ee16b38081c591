"""python-can and cantools. Raises MissingLibrary, with the command that installs them, if one is missing."""

from __future__ import annotations

from rtloop.drivers.errors import MissingLibrary

try:
    import can
    from cantools.database import load_file
    from cantools.database.errors import UnsupportedDatabaseFormatError  # type: ignore[attr-defined]
except ImportError as error:
    raise MissingLibrary(f"CAN needs the package {error.name}: pip install 'rtloop[can]'") from None

__all__ = ["UnsupportedDatabaseFormatError", "can", "load_file"]
