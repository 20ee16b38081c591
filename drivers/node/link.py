"""Lines to a node for Python: a UDP socket or a serial line that sends and receives whole frames.

The compiled exchange uses the same file descriptor once the node is open.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import socket
import termios
import time
import tty
from abc import ABC, abstractmethod

from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.cobs import FrameReader, encode
from rtloop.drivers.node.options import NodeOptions, SerialOptions, UdpOptions
from rtloop.foundation.trusted import close_descriptor, open_device

BUFFER_BYTES = 1 << 18
BUSY_POLL_US = 50
SO_BUSY_POLL = 46
"""Option of Linux, which Python does not name: the network card is polled while a receive waits for a datagram."""
LARGEST_DATAGRAM = 65_536
POLL_S = 0.02
USED = "another program uses this line; stop that program (`fuser -v DEVICE` lists it)"


class Link(ABC):
    """An open line to a node; `fd` is its file descriptor, which does not block."""

    fd: int
    strangers_fd: int | None = None
    """A second socket of the same port, which gets the datagrams of all other senders; None for a serial line."""

    @abstractmethod
    def send(self, frame: bytes) -> None:
        """Send a frame; one that the system does not take now is lost. Raises OSError if the line is broken."""

    @abstractmethod
    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next frame of the node, None if none comes within `timeout_s`.

        Raises OSError if the line is broken.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the line and its file descriptor."""


class UdpLink(Link):
    """A line to a node: a UDP socket that is connected to it, and one of the same port for all other senders.

    The system looks up a connected socket's route once, and a flood of strangers does not fill it.
    """

    def __init__(self, options: UdpOptions) -> None:
        """Resolve the node's name, open both sockets, and connect the first one to the node.

        Raises DriverError for a name without an address, and if the system refuses.
        """
        try:
            family, _, _, _, self._address = socket.getaddrinfo(options.host, options.port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise DriverError(f"{options.label}: {error.strerror or error}; check driver.host") from None
        self._socket, self._strangers = (socket.socket(family, socket.SOCK_DGRAM) for _ in range(2))
        step = f"bind {options.bind!r}"
        try:
            self._bind(options.bind or ("::" if family == socket.AF_INET6 else ""))
            step = f"connect {options.host!r}"
            self._connect()
        except OSError as error:
            self.close()
            raise DriverError(f"{options.label}: {step}: {error.strerror or error}") from None
        self.fd, self.strangers_fd = self._socket.fileno(), self._strangers.fileno()

    def _bind(self, host: str) -> None:
        """Bind both sockets to one free port of this computer's address `host`; other users' sockets never share it.

        Linux compares the user for SO_REUSEPORT, and not for SO_REUSEADDR. Raises OSError if the system refuses.
        """
        self._socket.setblocking(False)
        self._strangers.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        with contextlib.suppress(OSError):  # Some systems allow it to root alone.
            self._socket.setsockopt(socket.SOL_SOCKET, SO_BUSY_POLL, BUSY_POLL_US)
        self._socket.bind((host, 0))  # Alone at its port: sockets share one only if both allow it, here from now on.
        for shared in (self._socket, self._strangers):
            shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        self._strangers.bind(self._socket.getsockname())
        for shared in (self._socket, self._strangers):
            shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)

    def _connect(self) -> None:
        """Connect the first socket to the node, and discard the datagrams that others have sent to it.

        Raises OSError if the system refuses.
        """
        self._socket.connect(self._address)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._socket.recv(LARGEST_DATAGRAM)  # What strangers sent before the socket was connected.

    def send(self, frame: bytes) -> None:
        """Send a frame as one datagram; it is lost if the system's queue is full.

        Raises OSError for an address without a route.
        """
        for _ in range(2):  # The first call may report that an earlier datagram was refused, in place of sending.
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                self._socket.send(frame)
                break

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next datagram of the node's address, None if none comes within `timeout_s`.

        Raises OSError if the socket fails; a node that does not listen yet is no failure.
        """
        deadline_s = time.monotonic() + timeout_s
        while True:
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):  # Nobody listens there, perhaps yet.
                return self._socket.recv(LARGEST_DATAGRAM)
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not _wait_readable(self.fd, remaining_s):
                return None

    def close(self) -> None:
        """Close both sockets of the line."""
        self._socket.close()
        self._strangers.close()


class SerialLink(Link):
    """A serial line to a node, for this process alone."""

    def __init__(self, options: SerialOptions) -> None:
        """Wait up to `wait_s` for the terminal to exist, open it for raw bytes and discard the bytes received.

        Raises DriverError if it cannot be opened, is no terminal, or is locked by another program, and for a `baud`
        that the system does not know.
        """
        deadline_s = time.monotonic() + options.wait_s
        while not os.path.exists(options.device) and time.monotonic() < deadline_s:
            time.sleep(POLL_S)
        try:
            self.fd = open_device(options.device)
        except OSError as error:
            remedy = "plug the node in, or start a simulated node with `rtloop hil serve CONFIG --serial`"
            fault = USED if error.errno == errno.EBUSY else f"{error.strerror or error}; {remedy}"
            raise DriverError(f"{options.label}: {fault}") from None
        try:
            fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.ioctl(self.fd, termios.TIOCEXCL)  # The lock is advice; this refuses every program but root's.
            _set_raw(self.fd, options)
        except (OSError, termios.error) as error:
            close_descriptor(self.fd)
            number = error.args[0] if error.args else 0
            is_locked = number in (errno.EAGAIN, errno.EWOULDBLOCK)
            reason = USED if is_locked else str(error.args[-1])
            raise DriverError(f"{options.label}: {reason}") from None
        self._reader = FrameReader()

    def send(self, frame: bytes) -> None:
        """Send a frame encoded in COBS. If the line does not take all bytes now, the frame is lost.

        Raises OSError if the line is gone.
        """
        with contextlib.suppress(BlockingIOError):
            os.write(self.fd, encode(frame))

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next frame, None if none comes within `timeout_s`. Raises OSError if the line is gone."""
        deadline_s = time.monotonic() + timeout_s
        while (frame := self._reader.next_frame()) is None:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not _wait_readable(self.fd, remaining_s):
                return None
            with contextlib.suppress(BlockingIOError):
                data = os.read(self.fd, LARGEST_DATAGRAM)
                if not data:
                    raise OSError(errno.EIO, "the line is closed")
                self._reader.feed(data)
        return frame

    def close(self) -> None:
        """Close the line and its file descriptor, and let other programs open the terminal again."""
        with contextlib.suppress(OSError):  # The terminal may be gone.
            fcntl.ioctl(self.fd, termios.TIOCNXCL)
        close_descriptor(self.fd)


def open_link(options: NodeOptions) -> Link:
    """Return an open line of the kind that the options describe, UdpLink or SerialLink.

    Raises DriverError as these do, TypeError for other options.
    """
    if isinstance(options, UdpOptions):
        return UdpLink(options)
    if isinstance(options, SerialOptions):
        return SerialLink(options)
    raise TypeError(f"options: the type is {type(options).__name__}; allowed: UdpOptions, SerialOptions")


def _wait_readable(fd: int, timeout_s: float) -> bool:
    """Wait until bytes can be read from `fd`, for at most `timeout_s`; return whether they can."""
    return bool(select.select([fd], [], [], timeout_s)[0])


def _set_raw(fd: int, options: SerialOptions) -> None:
    """Set a terminal to raw bytes and the options' rate, and discard the bytes that it has received.

    Raises termios.error for a file that is no terminal, OSError for a rate that the system has no name for.
    """
    tty.setraw(fd, termios.TCSANOW)
    if options.baud is not None:
        speed = getattr(termios, f"B{options.baud}", None)
        if speed is None:
            raise OSError(errno.EINVAL, f"baud: {options.baud}; allowed: a rate that the system knows, such as 921600")
        attributes = termios.tcgetattr(fd)
        attributes[4] = attributes[5] = speed
        termios.tcsetattr(fd, termios.TCSANOW, attributes)
    termios.tcflush(fd, termios.TCIFLUSH)
