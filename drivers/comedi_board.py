"""A board under comedi, through libcomedi: opening, reservation of subdevices, tables of ranges and codes.

libcomedi (comedi_open(3) and its other manual pages) returns −1 or a null pointer for a failure; comedi_errno() then
has the reason.
"""

from __future__ import annotations

import ctypes
import errno
from ctypes import c_char_p, c_double, c_int, c_uint, c_void_p
from enum import IntEnum

from rtloop.drivers.errors import DriverError, MissingLibrary


class Kind(IntEnum):
    """Types of subdevices, as comedi numbers them."""

    INPUT = 1
    OUTPUT = 2

    @property
    def prefix(self) -> str:
        """Beginning of the names of this type's channels: "ai" for inputs, "ao" for outputs."""
        return "ai" if self is Kind.INPUT else "ao"


class _Range(ctypes.Structure):
    """libcomedi's comedi_range: lowest and highest value, and the code of their unit."""

    _fields_ = (("lowest", c_double), ("highest", c_double), ("unit", c_uint))


AREFS = {"ground": 0, "common": 1, "diff": 2, "other": 3}
UNIT_VOLT = 0
_FUNCTIONS: dict[str, tuple[type[ctypes._CDataType], list[type[ctypes._CDataType]]]] = {
    "comedi_open": (c_void_p, [c_char_p]),
    "comedi_close": (c_int, [c_void_p]),
    "comedi_errno": (c_int, []),
    "comedi_strerror": (c_char_p, [c_int]),
    "comedi_get_n_subdevices": (c_int, [c_void_p]),
    "comedi_get_subdevice_type": (c_int, [c_void_p, c_uint]),
    "comedi_find_subdevice_by_type": (c_int, [c_void_p, c_int, c_uint]),
    "comedi_lock": (c_int, [c_void_p, c_uint]),
    "comedi_get_n_channels": (c_int, [c_void_p, c_uint]),
    "comedi_get_n_ranges": (c_int, [c_void_p, c_uint, c_uint]),
    "comedi_get_range": (ctypes.POINTER(_Range), [c_void_p, c_uint, c_uint, c_uint]),
    "comedi_get_maxdata": (c_uint, [c_void_p, c_uint, c_uint]),
    "comedi_data_read": (c_int, [c_void_p, c_uint, c_uint, c_uint, c_uint, c_void_p]),
    "comedi_data_write": (c_int, [c_void_p, c_uint, c_uint, c_uint, c_uint, c_uint]),
}
_HINTS = {
    errno.ENOENT: "; load the board's kernel module",
    errno.EACCES: "; add this user to the device's group",
    errno.ENODEV: "; no board is attached to this device; load the board's kernel module, or attach the board with "
    "comedi_config",
    errno.ENOTTY: "; not a comedi device",
}


class Board:
    """An open board, used through libcomedi."""

    def __init__(self, library: str, device: str) -> None:
        """Load libcomedi from `library`, a name or path, and open the board's file `device`.

        Raises MissingLibrary if the library is missing or incomplete, DriverError if the device cannot be opened.
        """
        self._device = device
        try:
            self._library = ctypes.CDLL(library)
            for name, (result, arguments) in _FUNCTIONS.items():
                function = getattr(self._library, name)
                function.restype, function.argtypes = result, arguments
        except (OSError, AttributeError) as error:
            raise MissingLibrary(f"driver 'comedi': {error}; install libcomedi0 (Debian's name of libcomedi)") from None
        self._handle: int | None = self._library.comedi_open(device.encode())
        if self._handle is None:
            raise DriverError(f"{device}: {self.error_text()}{_HINTS.get(self._library.comedi_errno(), '')}")

    @property
    def addresses(self) -> tuple[int, int, int]:
        """Addresses of the device's handle (0 after `close`), of comedi_data_read and of comedi_data_write."""
        functions = self._library.comedi_data_read, self._library.comedi_data_write
        read, write = (ctypes.cast(function, c_void_p).value or 0 for function in functions)
        return self._handle or 0, read, write

    def error_text(self) -> str:
        """Return libcomedi's message for its last failed call."""
        return self._library.comedi_strerror(self._library.comedi_errno()).decode()

    def reserve_subdevice(self, kind: Kind, number: int | None) -> int:
        """Lock subdevice `number`, or for None the first subdevice of `kind`, for this process; return its number.

        Raises DriverError if the board has no such subdevice, if subdevice `number` is not of `kind`, and if the lock
        fails, such as when another program has it.
        """
        subdevice = self._library.comedi_find_subdevice_by_type(self._handle, kind, 0) if number is None else number
        if number is None and subdevice < 0:
            raise DriverError(f"{self._device}: the board has no analogue {kind.name.lower()}s")
        if number is not None and self._library.comedi_get_subdevice_type(self._handle, number) != kind:
            numbers = range(self._library.comedi_get_n_subdevices(self._handle))
            suitable = [n for n in numbers if self._library.comedi_get_subdevice_type(self._handle, n) == kind]
            raise DriverError(
                f"{self._device}: {kind.name.lower()}_subdevice: {number} has no analogue {kind.name.lower()}s; "
                f"allowed: {', '.join(map(str, suitable)) or 'none'}"
            )
        if self._library.comedi_lock(self._handle, subdevice) < 0:
            busy = self._library.comedi_errno() == errno.EBUSY
            reason = "another program uses this subdevice; stop that program" if busy else self.error_text()
            raise DriverError(f"{self._device}: subdevice {subdevice}: {reason}")
        return subdevice

    def channel_line(self, kind: Kind, subdevice: int, channel: int, range_v: tuple[float, float], aref: str) -> tuple:
        """Return a channel's address and scale: subdevice, channel, range, aref, lowest_v, lsb_v, highest code.

        Range and aref are libcomedi's numbers. Raises DriverError for a channel or a `range_v` (lowest and highest V)
        that the board does not have.
        """
        name, count = f"{kind.prefix}{channel}", self._library.comedi_get_n_channels(self._handle, subdevice)
        if channel >= count:
            available = f"{kind.prefix}0 … {kind.prefix}{count - 1}" if count > 0 else "none"
            raise DriverError(f"{self._device}: {name} is not a channel of this board; allowed: {available}")
        ranges = self._ranges_v(subdevice, channel)
        if range_v not in ranges.values():
            available = (
                ", ".join(f"[{lowest:g}, {highest:g}]" for lowest, highest in ranges.values()) or "none in volts"
            )
            raise DriverError(f"{self._device}: {name} has no range {list(range_v)} V; allowed: {available}")
        index = next(i for i, ends in ranges.items() if ends == range_v)
        highest_code = self._library.comedi_get_maxdata(self._handle, subdevice, channel)
        lsb_v = (range_v[1] - range_v[0]) / highest_code
        return subdevice, channel, index, AREFS[aref], range_v[0], lsb_v, highest_code

    def output_code(self, line: tuple) -> int | None:
        """Return the code that the kernel driver stored for an output; None if it cannot be read or may be wrong.

        `line` is as `channel_line` returns it. Before the first write the kernel driver reports 0 for any output
        voltage. In a range with negative voltages, 0 therefore counts as unknown.
        """
        subdevice, channel, index, aref, lowest_v, *_ = line
        code = c_uint(0)
        if self._library.comedi_data_read(self._handle, subdevice, channel, index, aref, ctypes.byref(code)) < 0:
            return None
        return None if code.value == 0 and lowest_v < 0 else code.value

    def close(self) -> None:
        """Release the board and its subdevices; the outputs keep their voltages."""
        self._library.comedi_close(self._handle)
        self._handle = None

    def _ranges_v(self, subdevice: int, channel: int) -> dict[int, tuple[float, float]]:
        """Return the channel's ranges in V by libcomedi's number of the range, rounded to six decimals.

        Ranges in other units, such as mA, are left out.
        """
        ranges_v = {}
        for index in range(max(0, self._library.comedi_get_n_ranges(self._handle, subdevice, channel))):
            pointer = self._library.comedi_get_range(self._handle, subdevice, channel, index)
            if pointer and pointer.contents.unit == UNIT_VOLT:
                ranges_v[index] = (round(pointer.contents.lowest, 6), round(pointer.contents.highest, 6))
        return ranges_v
