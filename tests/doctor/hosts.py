"""Simulated hosts made of files: a host in good condition, whose files and grants tests replace."""

from __future__ import annotations

from pathlib import Path

from rtloop.doctor.host import Host

CPUS = "sys/devices/system/cpu"
FILES = {
    "sys/kernel/realtime": "1\n",
    "proc/cpuinfo": "processor\t: 0\nflags\t\t: fpu tsc avx2\n",
    "proc/stat": "cpu  100 0 50 900 0 0 0 250 0 0\ncpu0 50 0 25 450 0 0 0 125 0 0\n",
    "proc/sys/kernel/sched_rt_runtime_us": "-1\n",
    "proc/sys/kernel/sched_rt_period_us": "1000000\n",
    "proc/swaps": "Filename\tType\tSize\tUsed\tPriority\n",
    "proc/irq/24/smp_affinity_list": "0-2\n",
    "proc/irq/25/smp_affinity_list": "1\n",
    f"{CPUS}/isolated": "3\n",
    f"{CPUS}/cpu3/cpufreq/scaling_governor": "performance\n",
    f"{CPUS}/cpu0/cpuidle/state0/latency": "0\n",
    f"{CPUS}/cpu0/cpuidle/state1/latency": "120\n",
    f"{CPUS}/cpu3/topology/thread_siblings_list": "3\n",
    f"{CPUS}/smt/control": "on\n",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc\n",
    "sys/devices/system/clocksource/clocksource0/available_clocksource": "tsc hpet acpi_pm\n",
    "sys/kernel/debug/sched/fair_server/cpu3/runtime": "0\n",
    "boot/config-6.12.5-rt": "CONFIG_PREEMPT_RT=y\n# CONFIG_RT_GROUP_SCHED is not set\n",
}
GRANTED = {
    "scheduler": "SCHED_FIFO", "priority": 80, "mlock": True, "affinity": [3], "timer_slack_ns": 1, "pm_qos": True,
    "refused": [],
}  # fmt: skip


def host(root: Path, files: dict[str, str] | None = None, granted: dict[str, object] | None = None, **facts) -> Host:
    """Return the good host below `root`, with `files`, `granted` and `facts` replaced."""
    for path, text in (FILES | (files or {})).items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text, encoding="utf-8")
    facts = {"release": "6.12.5-rt", "version": "#1 SMP PREEMPT_RT", "allowed_cpus": (0, 1, 2, 3)} | facts
    return Host(GRANTED | (granted or {}), root, **facts)
