"""Three network namespaces in a row on this computer, loop – wire – node, without other traffic.

`tc netem` acts at the wire's two ends, so that captures at loop and node see the traffic before netem and behind it.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

CLONE_NEWNET = 0x40000000
SIOCETHTOOL, ETHTOOL_STXCSUM = 0x8946, 0x17
LOOP_ADDRESS, NODE_ADDRESS = "10.77.1.1", "10.77.2.2"
WIRE_ADDRESSES = "10.77.1.2", "10.77.2.1"


class Network:
    """The namespaces `loop`, `wire` and `node`, with interfaces loop0 – wire0 and wire1 – node0."""

    def __init__(self) -> None:
        self.names = {place: f"rtloop-{os.getpid()}-{place}" for place in ("loop", "wire", "node")}

    def build(self) -> None:
        """Make namespaces, interfaces, addresses and routes; neighbours are fixed, so that no ARP packets cross."""
        for name in self.names.values():
            _run("ip", "netns", "add", name)
            self._run_in(name, "ip", "link", "set", "lo", "up")
        for end, inner, place in (("loop0", "wire0", "loop"), ("node0", "wire1", "node")):
            wire = self.names["wire"]
            _run(
                "ip",
                "link",
                "add",
                end,
                "netns",
                self.names[place],
                "type",
                "veth",
                "peer",
                "name",
                inner,
                "netns",
                wire,
            )

        addresses = {"loop0": ("loop", LOOP_ADDRESS), "node0": ("node", NODE_ADDRESS)}
        addresses |= {"wire0": ("wire", WIRE_ADDRESSES[0]), "wire1": ("wire", WIRE_ADDRESSES[1])}
        for link, (place, address) in addresses.items():
            with self.inside(place):
                _write_setting(f"/proc/sys/net/ipv6/conf/{link}/disable_ipv6", "1")
                _set_checksums_in_software(link)
            self.run(place, "ip", "address", "add", f"{address}/24", "dev", link)
            self.run(place, "ip", "link", "set", link, "up")
        with self.inside("wire"):
            _write_setting("/proc/sys/net/ipv4/ip_forward", "1")
        self.run("loop", "ip", "route", "add", "default", "via", WIRE_ADDRESSES[0])
        self.run("node", "ip", "route", "add", "default", "via", WIRE_ADDRESSES[1])
        for link, peer in (("loop0", "wire0"), ("wire0", "loop0"), ("node0", "wire1"), ("wire1", "node0")):
            place, address = addresses[peer]
            with self.inside(place):
                hardware = _hardware_address(peer)
            self.run(
                addresses[link][0],
                "ip",
                "neigh",
                "replace",
                address,
                "lladdr",
                hardware,
                "dev",
                link,
                "nud",
                "permanent",
            )

    def remove(self) -> None:
        """Remove the namespaces with their interfaces."""
        for name in self.names.values():
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    def run(self, place: str, *command: str) -> str:
        """Run a command in a namespace and return its output. Raises CalledProcessError."""
        return self._run_in(self.names[place], *command)

    def _run_in(self, name: str, *command: str) -> str:
        """Run a command in the namespace of this full name; return its output."""
        return _run("ip", "netns", "exec", name, *command)

    def start(self, place: str, *command: str) -> subprocess.Popen[str]:
        """Start a program in a namespace; return its process, with pipes for its output."""
        arguments = ["ip", "netns", "exec", self.names[place], *command]
        return subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    @contextmanager
    def inside(self, place: str) -> Iterator[None]:
        """Let this thread open its sockets in a namespace; they stay there."""
        with open("/proc/thread-self/ns/net") as own_namespace, open(f"/run/netns/{self.names[place]}") as target:
            _enter(target.fileno())
            try:
                yield
            finally:
                _enter(own_namespace.fileno())

    def disturb(self, *netem: str) -> None:
        """Let netem act in both directions; remove it without arguments."""
        for link in ("wire0", "wire1"):
            self.disturb_one(link, *netem)

    def disturb_one(self, link: str, *netem: str) -> None:
        """Let netem act on packets that leave the wire at one end: "wire0" to the loop, "wire1" to the node."""
        with suppress(subprocess.CalledProcessError):
            self.run("wire", "tc", "qdisc", "delete", "dev", link, "root")
        if netem:
            self.run("wire", "tc", "qdisc", "add", "dev", link, "root", "netem", "limit", "100000", *netem)

    def netem_counts(self, link: str) -> tuple[int, int]:
        """Return the numbers of packets that netem has sent and dropped at an end of the wire."""
        words = self.run("wire", "tc", "-s", "qdisc", "show", "dev", link).replace(",", "").split()
        return int(words[words.index("pkt") - 1]), int(words[words.index("(dropped") + 1])


@contextmanager
def network() -> Iterator[Network]:
    """Yield three connected namespaces; remove them at the end, also after a failure."""
    namespaces = Network()
    try:
        namespaces.build()
        yield namespaces
    finally:
        namespaces.remove()


def missing_requirement() -> str | None:
    """Return the reason why netem cannot run here, None if it can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if missing := [name for name in ("ip", "tc") if shutil.which(name) is None]:
        return f"{missing[0]} is not installed (iproute2)"
    trial = Network()
    try:
        trial.build()
        trial.disturb("delay", "1us")
    except subprocess.CalledProcessError as error:
        return f"{' '.join(map(str, error.cmd[4:]))}: {(error.stderr or '').strip() or error}"
    finally:
        trial.remove()
    return None


def _run(*command: str) -> str:
    """Run a command and return its output. Raises CalledProcessError."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _enter(file: int) -> None:
    """Move this thread to the network namespace of an open file."""
    if ctypes.CDLL(None, use_errno=True).setns(file, CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")


def _write_setting(path: str, text: str) -> None:
    """Write a setting of the kernel, if the kernel has it."""
    with suppress(FileNotFoundError):
        Path(path).write_text(text)


def _interface_request(link: str, number: int, content: bytes) -> bytes:
    """Make the ioctl `number` on an interface of this thread's namespace; return its result."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        return fcntl.ioctl(any_socket, number, struct.pack("16s", link.encode()) + content)


def _set_checksums_in_software(link: str) -> None:
    """Let the sender compute the UDP checksum, as a real network card does; veth omits it otherwise."""
    value = ctypes.create_string_buffer(struct.pack("II", ETHTOOL_STXCSUM, 0))
    _interface_request(link, SIOCETHTOOL, struct.pack("P", ctypes.addressof(value)) + bytes(16))


def _hardware_address(link: str) -> str:
    """Return the MAC address of an interface."""
    return _interface_request(link, 0x8927, bytes(24))[18:24].hex(":")
