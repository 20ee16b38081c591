"""Real-time rights of a process on the host, each tried by the measuring process, not looked up."""

from __future__ import annotations

from rtloop.doctor.findings import Finding
from rtloop.doctor.host import Host
from rtloop.engine.plan import Pacing

SPINNING_SHARE = 0.9
LIMITS = "/etc/security/limits.d/rtloop.conf"
DEFAULT_FAIR_RUNTIME_NS = 50_000_000
"""Default of the kernel: time of the fair server in each second, in ns."""


def spinning_share(pacing: Pacing) -> float:
    """Return the fraction of a processor, 0 … 1, that the loop spends spinning."""
    return min(1.0, pacing.spin_us * 1e-6 * pacing.rate_hz)


def _grant_command(limit: str) -> str:
    """Return the shell command that grants `limit`, such as "rtprio 99", to the group rtloop."""
    return f"echo '@rtloop - {limit}' | sudo tee -a {LIMITS}, and log in again as a member of the group rtloop"


def fifo(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on SCHED_FIFO: good if the kernel granted it to the measuring process."""
    is_granted = host.grants["scheduler"] == "SCHED_FIFO"
    value = (
        f"granted, priority {host.grants['priority']}" if is_granted else f"refused: {host.refusal_reason('priority')}"
    )
    return Finding(
        "SCHED_FIFO",
        value,
        "granted",
        is_granted,
        100_000.0,
        "any busy process may take the processor from the loop for a time slice",
        _grant_command("rtprio 99"),
    )


def throttling(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on real-time throttling, which stops threads that never sleep: good if it is off, or if the
    loop sleeps; `good` is None if the host does not show the setting.

    The loop sleeps if `spinning_share` is below SPINNING_SHARE.
    """
    path = "/proc/sys/kernel/sched_rt_runtime_us"
    runtime, period = host.read(path), host.read("/proc/sys/kernel/sched_rt_period_us") or "1000000"
    if runtime is None:
        return Finding("real-time throttling", "not shown", "off if the loop spins", None)
    sleeps = spinning_share(pacing) < SPINNING_SHARE
    value = "off" if runtime == "-1" else f"{runtime} of each {period} µs"
    lost_us = 0.0 if runtime == "-1" else max(float(period) - float(runtime), 0.0)
    return Finding(
        "real-time throttling",
        value + (", the loop sleeps" if sleeps else ", the loop spins"),
        "off if the loop spins",
        sleeps or runtime == "-1",
        lost_us,
        f"a loop that spins (waits without sleep) loses the processor for {lost_us:g} of every {period} µs",
        "sudo sysctl kernel.sched_rt_runtime_us=-1",
        {path: "-1"},
    )


def fair_server(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the kernel's fair server, which takes time from a spinning loop: good if it is off, for a
    kernel before 6.12, and if the loop sleeps; else `good` is None if debugfs does not show the setting.

    The loop sleeps if `spinning_share` is below SPINNING_SHARE.
    """
    name, requirement = "fair server", "off if the loop spins"
    if host.kernel_version < (6, 12):
        return Finding(name, f"not in kernel {host.release}", requirement, True)
    if spinning_share(pacing) < SPINNING_SHARE:
        return Finding(name, "the loop sleeps", requirement, True)
    cpu = 0 if pacing.cpu is None else pacing.cpu
    path = f"/sys/kernel/debug/sched/fair_server/cpu{cpu}/runtime"
    runtime = host.read(path)
    value = "not shown: debugfs cannot be read" if runtime is None else f"{runtime} ns of each second"
    lost_ms = float(runtime or DEFAULT_FAIR_RUNTIME_NS) * 1e-6
    return Finding(
        name,
        value,
        requirement,
        None if runtime is None else runtime == "0",
        1000.0 * lost_ms,
        f"a loop that spins (waits without sleep) loses the processor for {lost_ms:g} ms of every second",
        f"echo 0 | sudo tee {path}",
        {path: "0"} if runtime else {},
    )


def real_time_groups(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on control groups, whose real-time scheduling may refuse SCHED_FIFO: good if SCHED_FIFO was
    granted, or if the kernel has no such scheduling.

    `good` is None if SCHED_FIFO was refused and the host does not show the kernel's configuration. A control group has
    no real-time runtime by default.
    """
    options, is_granted = host.kernel_options, host.grants["scheduler"] == "SCHED_FIFO"
    name, requirement = "control groups", "allow SCHED_FIFO"
    if is_granted or (options is not None and "CONFIG_RT_GROUP_SCHED=y" not in options):
        return Finding(name, "do not limit SCHED_FIFO", requirement, True)
    if options is None:
        return Finding(name, "not shown", requirement, None)
    return Finding(
        name,
        "CONFIG_RT_GROUP_SCHED=y",
        requirement,
        False,
        100_000.0,
        "the control group has no real-time runtime, so SCHED_FIFO is refused",
        "echo 950000 | sudo tee /sys/fs/cgroup/cpu/GROUP/cpu.rt_runtime_us; GROUP is the path in the line with cpu of "
        "/proc/PID/cgroup, and PID the number of the loop's process",
    )


def locked_memory(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on locked memory, which prevents page faults: good if the measuring process may lock it."""
    is_granted = bool(host.grants["mlock"])
    value = "granted" if is_granted else f"refused: {host.refusal_reason('mlock')}"
    return Finding(
        "locked memory",
        value,
        "granted",
        is_granted,
        10_000.0,
        "a page fault delays a tick by milliseconds",
        _grant_command("memlock unlimited"),
    )


def timer_slack(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the timer slack, by which wake-ups may be late: good if it is 1 ns, or under SCHED_FIFO.

    The slack has no effect under SCHED_FIFO.
    """
    slack_ns, is_fifo = host.grants["timer_slack_ns"], host.grants["scheduler"] == "SCHED_FIFO"
    value = f"{slack_ns} ns" if slack_ns else host.refusal_reason("timer_slack_ns")
    value = "without effect under SCHED_FIFO" if is_fifo else value
    return Finding(
        "timer slack",
        value,
        "1 ns",
        is_fifo or slack_ns == 1,
        50.0,
        "each wake-up may be 50 µs late",
        "grant SCHED_FIFO (above)",
    )


CONDITIONS = (fifo, throttling, fair_server, real_time_groups, locked_memory, timer_slack)
