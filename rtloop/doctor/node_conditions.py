"""Conditions of the line between loop and node: network card and cable, or terminal."""

from __future__ import annotations

from rtloop.doctor.findings import Finding
from rtloop.doctor.host import Host, format_cpus, parse_cpus
from rtloop.doctor.machine import loop_cpus
from rtloop.doctor.node_line import NetworkLine, SerialLine
from rtloop.engine.plan import Pacing

MIN_SPEED_MBIT = 100
WIRELESS_US, LOST_LINE_US = 10_000.0, 1e6
INTERRUPT_US = 50.0
LOW_LATENCY_FLAG = 1 << 13
"""ASYNC_LOW_LATENCY in the flags of a serial port (linux/tty_flags.h)."""
US_PER_MS = 1e3


def check_line(line: NetworkLine | SerialLine | None, host: Host, pacing: Pacing) -> tuple[Finding, ...]:
    """Return the findings on the line to a node; () for None.

    A network line has only the findings of `key` and `route` if the node is on this computer, or if its route is bad.
    """
    if line is None:
        return ()
    if isinstance(line, SerialLine):
        return (key(line), latency_timer(line, host), low_latency(line, host))
    interface = route(line, host)
    if interface.good is False or line.interface == "lo":
        return (key(line), interface)
    return (
        key(line),
        interface,
        cable(line, host),
        coalescing(line),
        packet_merging(line),
        card_interrupts(line, host, pacing),
    )


def key(line: NetworkLine | SerialLine) -> Finding:
    """Return the finding on the node's key: good if the configuration names one that can be used."""
    return Finding(
        "node's key", line.key_fault or "a file of this user", "a key that this user alone can read",
        not line.key_fault, 0.0, "others can drive the node", "(umask 077; openssl rand -hex 16 > node.key)",
    )  # fmt: skip


def route(line: NetworkLine, host: Host) -> Finding:
    """Return the finding on the route to the node: good if an interface that is neither wireless nor down leads to it.

    The loopback interface is good, too.
    """
    name, required, net = line.interface, "a cable to the node", f"/sys/class/net/{line.interface}"
    if not name:
        return Finding(
            "node's network", f"no route to {line.host}", required, False, LOST_LINE_US,
            "no drive reaches the node",
            "sudo ip address add 192.168.10.1/24 dev INTERFACE; check driver.host and driver.bind",
        )  # fmt: skip
    if name == "lo":
        return Finding("node's network", "loopback: the node is on this computer", required, True)
    value = f"{name} to {line.host}"
    if host.paths(f"{net}/wireless") or host.paths(f"{net}/phy80211"):
        return Finding(
            "node's network", f"{value}, wireless", required, False, WIRELESS_US,
            "a wireless network delays frames by milliseconds, and loses some",
            "connect the node by a cable, and set driver.bind to the address of its interface",
        )  # fmt: skip
    state = host.read(f"{net}/operstate")
    return Finding(
        "node's network", value + (f", {state}" if state == "down" else ""), required, state != "down", LOST_LINE_US,
        "no drive reaches the node", f"plug the cable in; sudo ip link set {name} up",
    )  # fmt: skip


def cable(line: NetworkLine, host: Host) -> Finding:
    """Return the finding on the cable: good at MIN_SPEED_MBIT or more and full duplex; `good` is None if not shown."""
    net = f"/sys/class/net/{line.interface}"
    speed, duplex = host.read(f"{net}/speed"), host.read(f"{net}/duplex")
    required = f"{MIN_SPEED_MBIT} Mbit/s or more, full duplex"
    if not speed or not speed.isdecimal() or not duplex or duplex == "unknown":
        return Finding("node's cable", "not shown", required, None)
    is_good = int(speed) >= MIN_SPEED_MBIT and duplex == "full"
    return Finding(
        "node's cable", f"{speed} Mbit/s, {duplex} duplex", required, is_good, 1000.0,
        "at half duplex frames collide, and a slow cable holds each frame for longer",
        f"sudo ethtool -s {line.interface} autoneg on, or another cable",
    )  # fmt: skip


def coalescing(line: NetworkLine) -> Finding:
    """Return the finding on interrupt coalescing: good if the card interrupts at once at each packet.

    `good` is None if the card's driver does not tell.
    """
    required = "0 µs, not adaptive"
    if line.rx_usecs is None:
        return Finding("interrupt coalescing", "not shown", required, None)
    return Finding(
        "interrupt coalescing", f"{line.rx_usecs} µs{', adaptive' if line.is_adaptive else ''}", required,
        line.rx_usecs == 0 and not line.is_adaptive, max(float(line.rx_usecs), 1.0),
        "the node's answer waits, because the card collects several packets for one interrupt",
        f"sudo ethtool -C {line.interface} adaptive-rx off rx-usecs 0",
    )  # fmt: skip


def packet_merging(line: NetworkLine) -> Finding:
    """Return the finding on large receive offload (LRO), with which the card waits to join packets: good if it is off.

    `good` is None if the card's driver does not tell.
    """
    if line.collects is None:
        return Finding("large receive offload", "not shown", "off", None)
    return Finding(
        "large receive offload", "on" if line.collects else "off", "off", not line.collects, 20.0,
        "a packet waits, because the card may join it with later packets", f"sudo ethtool -K {line.interface} lro off",
    )  # fmt: skip


def card_interrupts(line: NetworkLine, host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the card's interrupts: good if none may come to the loop's processors.

    `good` is None if the host lists no interrupt of the card.
    """
    loop_processors, allowed = loop_cpus(host, pacing), set(host.allowed_cpus)
    numbers = _interrupt_numbers(host.read("/proc/interrupts") or "", line.interface)
    numbers |= {path.rpartition("/")[2] for path in host.paths(f"/sys/class/net/{line.interface}/device/msi_irqs/*")}
    paths = [f"/proc/irq/{number}/smp_affinity_list" for number in sorted(numbers, key=int)]
    affinities = {path: parse_cpus(text) for path in paths if (text := host.read(path)) is not None}
    required, others = "none on loop.cpu", format_cpus(allowed - loop_processors)
    if not affinities:
        return Finding("card's interrupts", "not shown", required, None)
    shared = [path for path, cpus in affinities.items() if cpus & loop_processors]
    return Finding(
        "card's interrupts",
        f"{len(shared)} of {len(affinities)} may interrupt processor {format_cpus(loop_processors)}",
        required, not shared, INTERRUPT_US, "the card interrupts the loop while the loop computes a tick",
        "; ".join(f"echo {others or 0} | sudo tee {path}" for path in shared or affinities),
        dict.fromkeys(shared, others) if others else {},
    )  # fmt: skip


def _interrupt_numbers(table: str, interface: str) -> set[str]:
    """Return the numbers of an interface's interrupts in `table`, the text of /proc/interrupts.

    For eth1, these are the interrupts of the names eth1, eth1-rx-0, …
    """
    numbers = set[str]()
    for line in table.splitlines():
        number, _, rest = line.strip().partition(":")
        words = rest.replace(",", " ").split()
        if number.isdecimal() and any(word == interface or word.startswith(f"{interface}-") for word in words):
            numbers.add(number)
    return numbers


def latency_timer(line: SerialLine, host: Host) -> Finding:
    """Return the finding on the latency timer of an FTDI adapter: good if it hands on received bytes after 1 ms.

    `good` is None for a line without such a timer.
    """
    path = f"/sys/bus/usb-serial/devices/{_terminal(line)}/latency_timer"
    milliseconds = host.read(path)
    if milliseconds is None or not milliseconds.isdecimal():
        return Finding("latency timer", f"{line.device}: none", "1 ms", None)
    return Finding(
        "latency timer", f"{line.device}: {milliseconds} ms", "1 ms", milliseconds == "1",
        int(milliseconds) * US_PER_MS,
        "the USB adapter holds the node's answer until its timer ends", f"echo 1 | sudo tee {path}", {path: "1"},
    )  # fmt: skip


def low_latency(line: SerialLine, host: Host) -> Finding:
    """Return the finding on a serial port's flag low_latency, with which the kernel hands on received bytes at once.

    `good` is whether the flag is set, None if the flags cannot be read.
    """
    try:
        flags = int(host.read(f"/sys/class/tty/{_terminal(line)}/flags") or "", 0)
    except ValueError:
        return Finding("low latency", "not shown", "low_latency", None)
    is_set = bool(flags & LOW_LATENCY_FLAG)
    return Finding(
        "low latency", "low_latency" if is_set else "not set", "low_latency", is_set, 1000.0,
        "received bytes reach the loop late, because the kernel puts them into a work queue first",
        f"sudo setserial {line.device} low_latency",
    )  # fmt: skip


def _terminal(line: SerialLine) -> str:
    """Return the name of a terminal in /sys, the last part of its path: ttyUSB0 for /dev/ttyUSB0."""
    return line.device.rpartition("/")[2]
