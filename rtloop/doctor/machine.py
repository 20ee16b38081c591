"""Conditions between a timer and the loop: kernel, processors, interrupts, power management."""

from __future__ import annotations

from rtloop.doctor.findings import Finding
from rtloop.doctor.host import Host, format_cpus, parse_cpus
from rtloop.engine.plan import Pacing

EXACT_CLOCKS = ("tsc", "arch_sys_counter")
SHORT_IDLE_US = 10.0
CPUS = "/sys/devices/system/cpu"


def loop_cpus(host: Host, pacing: Pacing) -> set[int]:
    """Return the numbers of the processors on which the loop may run: loop.cpu, else all that this process may use."""
    return set(host.allowed_cpus) if pacing.cpu is None else {pacing.cpu}


def kernel(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the kernel: good if it is built with PREEMPT_RT."""
    is_realtime = host.read("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in host.version
    return Finding(
        "kernel",
        f"{host.release} {'PREEMPT_RT' if is_realtime else 'without PREEMPT_RT'}",
        "PREEMPT_RT",
        is_realtime,
        10_000.0,
        "kernel work that cannot be interrupted delays a tick by milliseconds",
        "sudo apt install linux-image-rt-amd64, and restart",
    )


def virtualisation(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on a hypervisor, which may stop the whole machine: good if none is seen."""
    flags = next((line for line in (host.read("/proc/cpuinfo") or "").splitlines() if line.startswith("flags")), "")
    is_virtual = "hypervisor" in flags.split()
    value = (
        f"virtual machine, {host.stolen_s():.1f} s of processor time taken by the hypervisor since this machine started"
        if is_virtual
        else "none seen"
    )
    return Finding(
        "virtualisation",
        value,
        "none",
        not is_virtual,
        300_000.0,
        "the hypervisor may stop the whole machine for hundreds of ms",
        "no setting helps; use a machine without a hypervisor",
    )


def processors(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the number of processors that this process may use: good for two or more.

    With two, the loop need not share a processor with the recorder and the service.
    """
    count = len(host.allowed_cpus)
    return Finding(
        "processors",
        format_cpus(set(host.allowed_cpus)),
        "two or more",
        count >= 2,
        10_000.0,
        "recorder, service and loop share one processor",
        "sudo taskset -cp 0-N $$, where N is the number of the last processor; or a machine with more processors",
    )


def isolation(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the loop's processor: good if loop.cpu is set, and isolated from other processes."""
    isolated = parse_cpus(host.read(f"{CPUS}/isolated") or "")
    cpu = max(host.allowed_cpus) if pacing.cpu is None else pacing.cpu
    isolated_text = f"isolated: {format_cpus(isolated) or 'none'}"
    value = f"{isolated_text}; loop.cpu: {'not set' if pacing.cpu is None else pacing.cpu}"
    return Finding(
        "isolated processor",
        value,
        "loop.cpu is isolated",
        pacing.cpu in isolated,
        1000.0,
        "kernel threads and other real-time processes run between the ticks",
        f"on the kernel's command line: isolcpus=domain,managed_irq,{cpu} rcu_nocbs={cpu}; "
        f"in [loop] of the configuration: cpu = {cpu}",
    )


def interrupts(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on devices' interrupts: good if none may come to the loop's processors.

    `good` is None if the host lists no interrupt.
    """
    loop_processors, allowed_processors = loop_cpus(host, pacing), set(host.allowed_cpus)
    affinities = {path: parse_cpus(host.read(path) or "") for path in host.paths("/proc/irq/[0-9]*/smp_affinity_list")}
    shared_paths = [path for path, cpus in affinities.items() if cpus & loop_processors]
    other_processors = format_cpus(allowed_processors - loop_processors)
    name, requirement = "interrupts", "none on loop.cpu"
    if not affinities:
        return Finding(name, "not shown", requirement, None)
    value = f"{len(shared_paths)} of {len(affinities)} may interrupt processor {format_cpus(loop_processors)}"
    return Finding(
        name,
        value,
        requirement,
        not shared_paths,
        50.0,
        "each interrupt delays a tick by 5 to 50 µs",
        f"for f in /proc/irq/*/smp_affinity_list; do echo {other_processors or 0} | sudo tee $f; done",
        {path: other_processors for path in shared_paths} if other_processors else {},
    )


def frequency(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the frequency governors of the loop's processors: good if all are "performance".

    `good` is None if the host shows no governor.
    """
    paths = {f"{CPUS}/cpu{cpu}/cpufreq/scaling_governor" for cpu in loop_cpus(host, pacing)}
    governors = {path: text for path in paths if (text := host.read(path))}
    name, requirement = "frequency governor", "performance"
    if not governors:
        return Finding(name, "not shown: the firmware or the hypervisor sets the frequency", requirement, None)
    slow_paths = sorted(path for path, text in governors.items() if text != requirement)
    return Finding(
        name,
        ", ".join(sorted(set(governors.values()))),
        requirement,
        not slow_paths,
        200.0,
        "the first ticks after an idle phase run on a slow processor",
        "sudo cpupower frequency-set -g performance",
        dict.fromkeys(slow_paths, requirement),
    )


def idle_states(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on idle states: good if the measuring process may prevent deep ones, or if a processor wakes
    from each idle state within SHORT_IDLE_US.

    The times to wake are read for processor 0; also good if the host shows no idle state.
    """
    is_held_off = bool(host.grants["pm_qos"])
    latencies = [float(host.read(path) or 0) for path in host.paths(f"{CPUS}/cpu0/cpuidle/state*/latency")]
    longest_us = max(latencies, default=0.0)
    value = (
        "deep idle states prevented"
        if is_held_off
        else f"a processor needs up to {longest_us:g} µs to wake; /dev/cpu_dma_latency: {host.refusal_reason('pm_qos')}"
    )
    return Finding(
        "idle states",
        value,
        "/dev/cpu_dma_latency held at 0 µs",
        is_held_off or longest_us <= SHORT_IDLE_US,
        max(longest_us, 1.0),
        "waking from a deep idle state delays a tick",
        'echo "KERNEL==\\"cpu_dma_latency\\", GROUP=\\"$(id -gn)\\", MODE=\\"0660\\"" | '
        "sudo tee /etc/udev/rules.d/61-rtloop-latency.rules && sudo udevadm trigger",
    )


def clock_source(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on the kernel's clock: good if it is in EXACT_CLOCKS; `good` is None if it is not shown."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    path = f"{folder}/current_clocksource"
    source = host.read(path)
    clocks = (host.read(f"{folder}/available_clocksource") or "").split()
    exact_clock = next((clock for clock in EXACT_CLOCKS if clock in clocks), None)
    is_exact = None if source is None else source in EXACT_CLOCKS
    return Finding(
        "clock source",
        source or "not shown",
        "tsc",
        is_exact,
        5.0,
        "each of the three clock readings in a tick costs a µs or more",
        f"echo {exact_clock or 'tsc'} | sudo tee {path}",
        {path: exact_clock} if exact_clock else {},
    )


def siblings(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on hyper-threading: good if no core on which the loop may run has a second thread.

    Also good if the host does not show the threads of a core.
    """
    shared_cores = {
        text
        for cpu in loop_cpus(host, pacing)
        if len(parse_cpus(text := host.read(f"{CPUS}/cpu{cpu}/topology/thread_siblings_list") or "")) > 1
    }
    value = "; ".join(f"processors {text} share a core" for text in sorted(shared_cores)) or "none"
    return Finding(
        "hyper-threading",
        value,
        "off on loop.cpu",
        not shared_cores,
        20.0,
        "the other thread of the core makes a tick take up to twice as long",
        f"echo off | sudo tee {CPUS}/smt/control",
        {f"{CPUS}/smt/control": "off"},
    )


def swap(host: Host, pacing: Pacing) -> Finding:
    """Return the finding on swap: good if the host has no swap, or if the measuring process may lock its memory."""
    swap_files = [line.split()[0] for line in (host.read("/proc/swaps") or "").splitlines()[1:]]
    is_harmless = not swap_files or bool(host.grants["mlock"])
    value = (
        f"{', '.join(swap_files)}{', memory of the loop is locked' if is_harmless else ''}" if swap_files else "none"
    )
    return Finding(
        "swap",
        value,
        "none, or locked memory",
        is_harmless,
        10_000.0,
        "reading back a page of the loop that was swapped out takes milliseconds",
        "sudo swapoff -a",
    )


CONDITIONS = (
    kernel,
    virtualisation,
    processors,
    isolation,
    interrupts,
    frequency,
    idle_states,
    clock_source,
    siblings,
    swap,
)
