"""Frames of the DBC, packed and unpacked fast enough for every tick."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rtloop.drivers.can.bits import FD_LENGTHS, frame_duration_s
from rtloop.drivers.can.extra import UnsupportedDatabaseFormatError, can, load_file
from rtloop.drivers.can.options import BusOptions

if TYPE_CHECKING:
    from cantools.database.can.message import Message
    from cantools.database.can.signal import Signal

DBC = Path(__file__).with_name("rtloop.dbc")
_CODES = {(8, False): "B", (8, True): "b", (16, False): "H", (16, True): "h", (32, False): "I", (32, True): "i"}


class Frame:
    """A message of the DBC with signals of whole bytes, little-endian: one `struct` packs it. Values are physical."""

    def __init__(self, message: Message) -> None:
        """Read the layout of a cantools message.

        Raises ValueError for an extended identifier, for a length that CAN does not have, and for a signal that is not
        an integer of 8, 16 or 32 bits on whole bytes in Intel order.
        """
        self.name, self.identifier, self.length = str(message.name), int(message.frame_id), int(message.length)
        self.fd, self.cycle_s = bool(message.is_fd), (message.cycle_time or 0) / 1000
        if message.is_extended_frame or self.length not in FD_LENGTHS[: None if self.fd else 9]:
            raise ValueError(
                f"{self.name}: {self.length} bytes, identifier {self.identifier:#x}; "
                "allowed: an 11-bit identifier, and a length of 0 to "
                f"{'8, 12, 16, 20, 24, 32, 48 or 64' if self.fd else '8'} bytes"
            )
        signals = sorted(message.signals, key=lambda signal: signal.start)
        layout, position = "<", 0
        for signal in signals:
            code = _CODES.get((signal.length, signal.is_signed))
            if code is None or signal.byte_order != "little_endian" or signal.start % 8 or signal.is_float:
                kind = "float" if signal.is_float else "signed integer" if signal.is_signed else "unsigned integer"
                order = "Intel" if signal.byte_order == "little_endian" else "Motorola"
                raise ValueError(
                    f"{self.name}.{signal.name}: {kind}, {order} order, {signal.length} bits from bit {signal.start}; "
                    "allowed: integers of 8, 16 or 32 bits on whole bytes, Intel order"
                )
            layout += f"{(signal.start - position) // 8}x{code}"
            position = signal.start + signal.length
        self._struct = struct.Struct(f"{layout}{self.length - position // 8}x")
        self.signals = {signal.name: signal for signal in signals}
        self._scales = [(float(s.scale), float(s.offset), *_raw_range(s)) for s in signals]

    def pack(self, values: Sequence[float]) -> bytes:
        """Return the data bytes of the physical `values`, one for each signal, in the order of the signals' bits.

        A value that the signal's integer cannot hold is clipped. Raises ValueError for NaN or another number of values,
        OverflowError for infinity.
        """
        raw = []
        for value, (scale, offset, lowest, highest) in zip(values, self._scales, strict=True):
            number = round((value - offset) / scale)
            raw.append(lowest if number < lowest else highest if number > highest else number)
        return self._struct.pack(*raw)

    def unpack(self, data: bytes | bytearray) -> list[float]:
        """Return the physical values in `data`, in the order of the signals' bits.

        Raises struct.error for another number of bytes than `length`.
        """
        raw = self._struct.unpack(data)
        return [number * scale + offset for number, (scale, offset, _, _) in zip(raw, self._scales, strict=True)]

    def message(self, options: BusOptions, values: Sequence[float]) -> can.Message:
        """Return python-can's message of `values`, CAN FD or classic as this frame is in the DBC.

        `options` decide only whether a CAN FD message switches the bitrate. Raises the errors of `pack`.
        """
        return can.Message(
            arbitration_id=self.identifier,
            data=self.pack(values),
            is_extended_id=False,
            is_fd=self.fd,
            bitrate_switch=self.fd and options.switches_bitrate,
        )

    def fits(self, message: can.Message) -> bool:
        """Whether `message` is a data frame with an 11-bit identifier, and of this frame's kind (classic or FD) and
        length; the number of the identifier is not compared.
        """
        is_plain = not (message.is_remote_frame or message.is_error_frame or message.is_extended_id)
        return is_plain and message.is_fd == self.fd and len(message.data) == self.length


class Exchange(NamedTuple):
    """The frames that loop and node exchange in every tick."""

    drive: Frame
    sample: Frame
    channels: int

    @property
    def highest_sequence(self) -> int:
        """Largest sequence number, after which 1 follows; 0 is reserved for opening frames."""
        return _raw_range(self.drive.signals["Sequence"])[1]

    @property
    def channel_capacity(self) -> int:
        """Number of channels for which each frame has room; the first `channels` are used, the others carry 0."""
        return len(self.drive.signals) - 1

    def max_rate_hz(self, options: BusOptions) -> float:
        """Return the tick rate at which one drive and one sample frame per tick fill the bus."""
        rates = options.bitrate, options.data_phase_bitrate
        return 1.0 / sum(frame_duration_s(frame.length, frame.fd, *rates) for frame in (self.drive, self.sample))


def load_frames(options: BusOptions) -> dict[str, Frame]:
    """Return every frame of the DBC (`options.dbc`, by default rtloop.dbc) by its message's name.

    Raises ValueError for a file that cannot be read or is no DBC, and for a message with a layout that Frame cannot
    pack.
    """
    path = Path(options.dbc or DBC)
    try:
        database = load_file(path)
    except OSError as error:
        raise ValueError(f"dbc: {path}: {error.strerror}") from None
    except (UnsupportedDatabaseFormatError, UnicodeDecodeError) as error:
        raise ValueError(f"dbc: {path}: not a CAN database: {error}") from None
    try:
        return {message.name: Frame(message) for message in database.messages}  # type: ignore[union-attr]
    except ValueError as error:
        raise ValueError(f"dbc: {path}: {error}") from None


def choose_exchange(frames: dict[str, Frame], channels: int, options: BusOptions) -> Exchange:
    """Return the shortest pair of frames (fewest data bytes) that has room for `channels` channels.

    The names of a pair are Drive and Sample with the same ending, such as Drive2 and Sample2. The frames are CAN FD if
    `options.fd`, else classic. Raises ValueError if no pair has room, or if the signals of the chosen pair are not
    Sequence, Drive_0, … and Sequence, Age, Sample_0, ….
    """
    pairs = [
        Exchange(frame, frames[f"Sample{name.removeprefix('Drive')}"], channels)
        for name, frame in frames.items()
        if name.startswith("Drive") and frame.fd == options.fd and f"Sample{name.removeprefix('Drive')}" in frames
    ]
    pairs = [pair for pair in pairs if pair.channel_capacity >= channels]
    if not pairs:
        kind = "CAN FD" if options.fd else "classic CAN"
        raise ValueError(
            f"channels: {channels} axes; the DBC file has no pair of {kind} frames with room for {channels} axes and "
            "names such as Drive2 and Sample2 (same ending); add both frames to the file, or set driver.dbc to another"
        )
    exchange = min(pairs, key=lambda pair: pair.drive.length + pair.sample.length)
    numbers = range(exchange.channel_capacity)
    require_signals(exchange.drive, ["Sequence", *(f"Drive_{i}" for i in numbers)], options)
    require_signals(exchange.sample, ["Sequence", "Age", *(f"Sample_{i}" for i in numbers)], options)
    return exchange


def require_signals(frame: Frame, names: Sequence[str], options: BusOptions) -> None:
    """Raise ValueError, which names the DBC file of `options`, unless the signals of `frame` are exactly `names`, in
    the order of their bits.
    """
    if [*frame.signals] != [*names]:
        raise ValueError(
            f"dbc: {options.dbc}: {frame.name} has the signals {', '.join(frame.signals)}; "
            f"allowed, in the order of their bits: {', '.join(names)}"
        )


def _raw_range(signal: Signal) -> tuple[int, int]:
    """Return the smallest and the largest raw integer that a signal's bits can hold."""
    half = signal.is_signed and 1
    return -half * 2 ** (signal.length - 1), 2 ** (signal.length - half) - 1
