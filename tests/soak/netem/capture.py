"""Packets on an interface as the kernel saw them, and the datagrams that a socket receives from them."""

from __future__ import annotations

import socket
import struct
from typing import NamedTuple

ALL_PACKETS = 3
SO_RCVBUFFORCE, SOL_PACKET, PACKET_STATISTICS = 33, 263, 6
ROOM_BYTES = 1 << 27
TO_US, FROM_US = 0, 4
"""Types of a packet in an AF_PACKET address: for this host, and sent by it."""
UDP = 17


class Datagram(NamedTuple):
    """A UDP datagram that a socket would receive, with its source and destination ports."""

    content: bytes
    source: int
    destination: int


class Capture:
    """Packets of an interface of this thread's namespace; the kernel stores them until `end`."""

    def __init__(self, link: str) -> None:
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(ALL_PACKETS))
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, ROOM_BYTES)
        self._socket.bind((link, ALL_PACKETS))
        self._socket.setblocking(False)
        self.sent: list[bytes] = []
        self.received: list[bytes] = []
        self.lost: list[bytes] = []
        """Packets whose hardware address was damaged: the host drops them."""

    def end(self) -> None:
        """Read all packets into the lists. Raises AssertionError if the kernel had no room for one."""
        try:
            while True:
                packet, address = self._socket.recvfrom(65_536)
                (self.sent if address[2] == FROM_US else self.received if address[2] == TO_US else self.lost).append(
                    packet
                )
        except BlockingIOError:
            pass
        statistics = self._socket.getsockopt(SOL_PACKET, PACKET_STATISTICS, 8)
        self._socket.close()
        assert struct.unpack("II", statistics)[1] == 0, "packets that the capture had no room for"


def parse_datagram(packet: bytes) -> Datagram | None:
    """Return the datagram of an IPv4 packet, None if a checksum or a length is wrong, as the kernel judges it."""
    if len(packet) < 28 or packet[0] != 0x45 or packet[9] != UDP or _ones_sum(packet[:20]) != 0xFFFF:
        return None
    length, fragment = struct.unpack_from(">H2xH", packet, 2)
    source, destination, udp_length, check = struct.unpack_from(">HHHH", packet, 20)
    if length > len(packet) or fragment & 0x3FFF or not 8 <= udp_length <= length - 20:
        return None
    part = packet[20 : 20 + udp_length]
    if check and _ones_sum(packet[12:20] + struct.pack(">HH", UDP, udp_length) + part) != 0xFFFF:
        return None
    return Datagram(part[8:], source, destination)


def _ones_sum(data: bytes) -> int:
    """Return the sum of 16-bit words in ones' complement (RFC 1071); 0xFFFF for data with a right checksum."""
    data += b"\0" * (len(data) % 2)
    total = sum(struct.unpack(f">{len(data) // 2}H", data))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total
