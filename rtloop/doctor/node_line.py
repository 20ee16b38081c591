"""The line to a node, found without sending or opening anything: a network interface, or a terminal."""

from __future__ import annotations

import ctypes
import fcntl
import socket
import struct
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import build_driver

SIOCGIFADDR, SIOCETHTOOL = 0x8915, 0x8946
ETHTOOL_GCOALESCE, ETHTOOL_GFLAGS = 0x0E, 0x25
FLAG_LRO = 1 << 15
COALESCE_WORDS, RX_USECS, ADAPTIVE_RX = 23, 1, 11
"""Words of struct ethtool_coalesce (linux/ethtool.h), and the places of two of them."""


@dataclass(frozen=True)
class NetworkLine:
    """The interface that leads to a node; each fact is None where the system does not tell it.

    `interface` is "" without a route to `host`. `rx_usecs` is the time in µs for which the card collects packets before
    it interrupts, `is_adaptive` whether the card chooses this time itself, `collects` whether it joins packets (LRO).
    `key_fault` says what is wrong with the node's key, "" for nothing.
    """

    host: str
    interface: str = ""
    rx_usecs: int | None = None
    is_adaptive: bool | None = None
    collects: bool | None = None
    key_fault: str = ""


@dataclass(frozen=True)
class SerialLine:
    """The terminal of a node: its path with links resolved; `key_fault` as for a NetworkLine."""

    device: str
    key_fault: str = ""


def find_line(configuration: Configuration) -> NetworkLine | SerialLine | None:
    """Return the network or serial line to the node of a configuration; None for drivers other than "udp", "serial"."""
    options = vars(configuration.driver_options)
    if configuration.driver_kind == "udp":
        line = find_network_line(str(options["host"]), int(options["port"]), options["bind"])
    elif configuration.driver_kind == "serial":
        line = SerialLine(str(Path(options["device"]).resolve()))
    else:
        return None
    return replace(line, key_fault="; ".join(build_driver(configuration).cautions()))


def find_network_line(host: str, port: int, bind: str | None) -> NetworkLine:
    """Return the NetworkLine by which the system would send to a node at `host` and `port`: interface and settings.

    `bind` is the address of this computer from which it would send, None: any. No datagram is sent to the node.
    `interface` is "" without a route, also for an unknown `host` or `bind`.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            if bind is not None:
                probe.bind((bind, 0))
            probe.connect(address)  # chooses the route of a datagram, without one
            interface = _interface_of(probe.getsockname()[0], str(address[0]))
    except OSError:
        return NetworkLine(host)
    return NetworkLine(host, interface, *_coalescing(interface), _joins_packets(interface))


def _interface_of(own_address: str, node_address: str) -> str:
    """Return the name of the interface that has `own_address`, an address of this computer; "" if none has it.

    "lo" if the node has the same address: the node is on this computer, and is reached by the loopback interface.
    Raises OSError if the system does not list its addresses.
    """
    if own_address == node_address:
        return "lo"
    if ":" in own_address:
        packed = socket.inet_pton(socket.AF_INET6, own_address.partition("%")[0]).hex()
        lines = Path("/proc/net/if_inet6").read_text(encoding="ascii").splitlines()
        return next((line.split()[5] for line in lines if line.startswith(packed)), "")
    packed_v4 = socket.inet_aton(own_address)
    for _, name in socket.if_nameindex():
        with suppress(OSError):  # an interface without an address
            if _interface_request(name, SIOCGIFADDR, bytes(24))[20:24] == packed_v4:
                return name
    return ""


def _coalescing(interface: str) -> tuple[int | None, bool | None]:
    """Return an interface's (`rx_usecs`, `is_adaptive`) as in NetworkLine; (None, None) if its driver does not tell."""
    words = _ask_card(interface, ETHTOOL_GCOALESCE, COALESCE_WORDS)
    return (None, None) if words is None else (words[RX_USECS], bool(words[ADAPTIVE_RX]))


def _joins_packets(interface: str) -> bool | None:
    """Return whether an interface's card joins packets (LRO); None where its driver does not tell."""
    words = _ask_card(interface, ETHTOOL_GFLAGS, 2)
    return None if words is None else bool(words[1] & FLAG_LRO)


def _ask_card(interface: str, command: int, words: int) -> tuple[int, ...] | None:
    """Return the answer of the interface's driver to the ethtool `command`; None if the driver refuses.

    The answer is the struct of this command: `words` numbers of 32 bits, the first of them `command`.
    """
    answer = ctypes.create_string_buffer(struct.pack(f"{words}I", command, *[0] * (words - 1)), 4 * words)
    try:
        _interface_request(interface, SIOCETHTOOL, struct.pack("P", ctypes.addressof(answer)).ljust(24, b"\0"))
    except OSError:
        return None
    return struct.unpack(f"{words}I", answer.raw)


def _interface_request(interface: str, number: int, content: bytes) -> bytes:
    """Return the kernel's answer to ioctl `number` about a network interface: a struct ifreq (40 bytes).

    The request is the name of `interface`, 16 bytes, and `content`, 24 bytes. Raises OSError if the kernel refuses.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        return fcntl.ioctl(any_socket, number, struct.pack("16s", interface.encode()) + content)
