"""The simulated node as a process on a UDP port or a pseudo-terminal."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import pty
import select
import socket
import termios
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Sequence
from pathlib import Path

from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.cobs import FrameReader, encode
from rtloop.drivers.node.keys import read_key
from rtloop.drivers.node.options import NodeOptions, SerialOptions, UdpOptions
from rtloop.drivers.node.simulated import SimulatedNode
from rtloop.foundation.trusted import close_descriptor

IDLE_S, RAMP_S = 0.002, 0.0005
LARGEST_DATAGRAM = 65_536
US_PER_S = 1e6


class Port(ABC):
    """A node's end of a line: `receive` gives frames with the address that they came from."""

    @abstractmethod
    def receive(self, timeout_s: float) -> tuple[bytes, Hashable] | None:
        """Return the next frame and its sender; None if none comes within `timeout_s`."""

    @abstractmethod
    def send(self, frame: bytes, receiver: Hashable) -> None:
        """Send a frame; one that the system does not take is lost."""

    @abstractmethod
    def close(self) -> None:
        """Close the node's end of the line."""


class UdpPort(Port):
    """A UDP socket that waits for loops."""

    def __init__(self, options: UdpOptions) -> None:
        """Open the socket at `host` and `port`. Raises DriverError if the system refuses."""
        try:
            family, _, _, _, address = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            try:
                self._socket.bind(address)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise DriverError(
                f"{options.label}: {error.strerror or error}; allowed: an address of this computer and a free port"
            ) from None

    def receive(self, timeout_s: float) -> tuple[bytes, Hashable] | None:
        """Return the next datagram and its sender; None if none comes within `timeout_s`."""
        self._socket.settimeout(timeout_s)
        try:
            return self._socket.recvfrom(LARGEST_DATAGRAM)
        except TimeoutError:
            return None

    def send(self, frame: bytes, receiver: Hashable) -> None:
        """Send a datagram; one that the system does not take is lost."""
        with contextlib.suppress(OSError):
            self._socket.sendto(frame, receiver)  # type: ignore[arg-type]

    def close(self) -> None:
        """Close the socket of the node."""
        self._socket.close()


class TerminalPort(Port):
    """A pseudo-terminal with a link to it at `device`."""

    def __init__(self, options: SerialOptions) -> None:
        """Make the terminal and a link to it at `device`, in place of an older link.

        Raises DriverError if `device` is a file, or the link cannot be made.
        """
        self._fd, self._end = pty.openpty()  # The open end keeps the terminal while no loop has it open.
        tty.setraw(self._end)
        os.set_blocking(self._fd, False)
        self._link, self._reader = Path(options.device), FrameReader()
        try:
            if self._link.is_symlink():
                self._link.unlink()
            self._link.symlink_to(os.ttyname(self._end))
        except OSError as error:
            close_descriptor(self._fd)
            close_descriptor(self._end)
            raise DriverError(
                f"{options.label}: {error.strerror}; allowed for driver.device: a path at which no file exists, in a "
                "folder that you may write to"
            ) from None

    def receive(self, timeout_s: float) -> tuple[bytes, Hashable] | None:
        """Return the next frame, with the sender None; None if none is complete after a wait of at most `timeout_s`."""
        if (frame := self._reader.next_frame()) is not None:
            return frame, None
        if not select.select([self._fd], [], [], timeout_s)[0]:
            fcntl.ioctl(self._end, termios.TIOCNXCL)  # A loop that was killed has left the terminal to itself alone.
            return None
        try:
            self._reader.feed(os.read(self._fd, LARGEST_DATAGRAM))
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):
                raise
        frame = self._reader.next_frame()
        return None if frame is None else (frame, None)

    def send(self, frame: bytes, receiver: Hashable) -> None:
        """Send a frame; one that the line does not take is lost."""
        with contextlib.suppress(OSError):
            os.write(self._fd, encode(frame))

    def close(self) -> None:
        """Remove the link and close the terminal."""
        with contextlib.suppress(OSError):
            self._link.unlink()
        close_descriptor(self._fd)
        close_descriptor(self._end)


@contextlib.contextmanager
def open_port(options: NodeOptions) -> Iterator[Port]:
    """Yield the node's end of the options' line and close it at the end. Raises DriverError if it cannot be opened."""
    port = UdpPort(options) if isinstance(options, UdpOptions) else TerminalPort(_serial(options))
    try:
        yield port
    finally:
        port.close()


def _serial(options: NodeOptions) -> SerialOptions:
    """Return `options` if they describe a serial line. Raises TypeError for other options."""
    if isinstance(options, SerialOptions):
        return options
    raise TypeError(f"options: the type is {type(options).__name__}; allowed: UdpOptions, SerialOptions")


def step(node: SimulatedNode, port: Port, start_s: float) -> None:
    """Wait for a frame, at most IDLE_S, or RAMP_S during a ramp; advance the node to the present time; send its answer.

    `start_s` is the time of `time.monotonic` at which the node started.
    """
    received = port.receive(RAMP_S if node.is_ramping else IDLE_S)
    now_us = (time.monotonic() - start_s) * US_PER_S
    if received is None:
        node.poll(now_us)
    elif (answer := node.receive(*received, now_us)) is not None:
        port.send(answer, received[1])


def serve(
    options: NodeOptions,
    axes: Sequence[str],
    is_stopped: Callable[[], bool],
    on_ready: Callable[[], None] = lambda: None,
) -> str:
    """Run a simulated node on the options' line until `is_stopped()`; return a sentence with the numbers of samples,
    refused and ignored frames, and parkings.

    `on_ready` is called when the line is open. Raises ValueError if rig and axes do not fit together, DriverError if
    the line cannot be opened, or for a key that cannot be read.
    """
    node = SimulatedNode(options, axes, key=read_key(options.key))
    with open_port(options) as port:
        on_ready()
        start_s = time.monotonic()
        while not is_stopped():
            step(node, port, start_s)
    return (
        f"{node.samples} samples sent, {node.refused} frames refused, "
        f"{node.old + node.invalid + node.foreign} frames ignored, "
        f"outputs parked {node.watchdog_parkings} times by the watchdog"
    )
