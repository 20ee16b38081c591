"""Each condition broken in turn on a host of files: only the broken condition is reported, with its remedy."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtloop.doctor import software
from rtloop.doctor.examine import check_conditions
from rtloop.doctor.host import Host, format_cpus, parse_cpus
from rtloop.doctor.remedy import apply_remedies
from rtloop.engine.plan import Pacing
from rtloop.foundation.native import cache_files
from tests.doctor.hosts import CPUS, GRANTED, host

SPINNING = Pacing(10_000.0, spin_us=95.0, cpu=3)
CLOCK = "sys/devices/system/clocksource/clocksource0/current_clocksource"
REFUSED = {"scheduler": "SCHED_OTHER", "priority": 0, "refused": ["priority: Operation not permitted"]}
BROKEN = {
    "kernel": ({"sys/kernel/realtime": "0\n"}, {}, {"version": "#1 SMP PREEMPT_DYNAMIC"}),
    "virtualisation": ({"proc/cpuinfo": "flags\t\t: fpu hypervisor avx2\n"}, {}, {}),
    "processors": ({}, {}, {"allowed_cpus": (3,)}),
    "isolated processor": ({f"{CPUS}/isolated": "\n"}, {}, {}),
    "interrupts": ({"proc/irq/25/smp_affinity_list": "0-3\n"}, {}, {}),
    "frequency governor": ({f"{CPUS}/cpu3/cpufreq/scaling_governor": "powersave\n"}, {}, {}),
    "idle states": ({}, {"pm_qos": False, "refused": ["pm_qos: Permission denied"]}, {}),
    "clock source": ({CLOCK: "hpet\n"}, {}, {}),
    "hyper-threading": ({f"{CPUS}/cpu3/topology/thread_siblings_list": "1,3\n"}, {}, {}),
    "swap": ({"proc/swaps": "Filename\tType\n/dev/sda2 partition 8000 0 -2\n"}, {"mlock": False}, {}),
    "SCHED_FIFO": ({}, REFUSED, {}),
    "real-time throttling": ({"proc/sys/kernel/sched_rt_runtime_us": "950000\n"}, {}, {}),
    "fair server": ({"sys/kernel/debug/sched/fair_server/cpu3/runtime": "50000000\n"}, {}, {}),
    "control groups": ({"boot/config-6.12.5-rt": "CONFIG_RT_GROUP_SCHED=y\n"}, REFUSED, {}),
    "locked memory": ({}, {"mlock": False, "refused": ["mlock: Cannot allocate memory"]}, {}),
    "timer slack": ({}, {**REFUSED, "timer_slack_ns": 50_000}, {}),
}
ALONGSIDE = {"swap": {"locked memory"}, "control groups": {"SCHED_FIFO"}, "timer slack": {"SCHED_FIFO"}}
"""Further conditions that are bad whenever the condition in the key is."""
MENDABLE = {
    "interrupts",
    "frequency governor",
    "clock source",
    "hyper-threading",
    "real-time throttling",
    "fair server",
}


def bad_conditions(findings) -> set[str]:
    """Return the names of bad conditions, except the cache of compiled code, which depends on this machine."""
    return {finding.condition for finding in findings if finding.good is False} - {"compiled code"}


def test_every_condition_of_a_good_host_is_good(tmp_path):
    findings = check_conditions(host(tmp_path), SPINNING)
    assert {finding.condition for finding in findings} == {*BROKEN, "compiled code", "libraries"}
    assert all(finding.good for finding in findings if finding.condition != "compiled code")


@pytest.mark.parametrize("condition", BROKEN)
def test_a_broken_condition_is_named_and_mended(condition, tmp_path):
    """The finding has cause, cost and remedy; --apply writes the files of the remedy and no other."""
    files, grants, facts = BROKEN[condition]
    broken = host(tmp_path, files, grants, **facts)
    findings = {finding.condition: finding for finding in check_conditions(broken, SPINNING)}
    finding = findings[condition]
    assert bad_conditions(findings.values()) == {condition} | ALONGSIDE.get(condition, set())
    assert finding.late_us > 0
    assert all((finding.consequence, finding.fix, finding.value))
    assert finding.value != finding.wanted
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    writes = apply_remedies(list(findings.values()), tmp_path)
    changed = {f"/{path.relative_to(tmp_path)}" for path, text in before.items() if path.read_bytes() != text}
    assert changed == {write.path for write in writes}
    assert not any(write.refused for write in writes)
    assert bool(writes) == (condition in MENDABLE)
    if condition in MENDABLE - {"hyper-threading"}:  # there the kernel removes the sibling
        assert condition not in bad_conditions(check_conditions(broken, SPINNING))


@pytest.mark.parametrize(("condition", "path", "runtime", "lost_us", "text"), [
    ("real-time throttling", "proc/sys/kernel/sched_rt_runtime_us", 950_000, 50_000, "50000 of every 1000000 µs"),
    ("real-time throttling", "proc/sys/kernel/sched_rt_runtime_us", 900_000, 100_000, "100000 of every 1000000 µs"),
    ("fair server", "sys/kernel/debug/sched/fair_server/cpu3/runtime", 50_000_000, 50_000, "50 ms of every second"),
    ("fair server", "sys/kernel/debug/sched/fair_server/cpu3/runtime", 20_000_000, 20_000, "20 ms of every second"),
])  # fmt: skip
def test_the_lost_time_is_that_of_the_hosts_setting(tmp_path, condition, path, runtime, lost_us, text):
    findings = check_conditions(host(tmp_path, {path: f"{runtime}\n"}), SPINNING)
    (finding,) = (finding for finding in findings if finding.condition == condition)
    assert (finding.late_us, finding.consequence.partition("processor for ")[2]) == (lost_us, text)


def test_a_refused_write_is_reported(tmp_path):
    (tmp_path / CLOCK).mkdir(parents=True)
    findings = check_conditions(host(tmp_path / "other", {CLOCK: "hpet\n"}), SPINNING)
    assert [write.refused for write in apply_remedies(findings, tmp_path)] == ["Is a directory"]


def test_a_sleeping_loop_is_not_throttled(tmp_path):
    files = {**BROKEN["real-time throttling"][0], **BROKEN["fair server"][0]}
    assert not bad_conditions(check_conditions(host(tmp_path, files), Pacing(10_000.0, spin_us=60.0, cpu=3)))


def test_a_condition_that_the_host_does_not_show_is_neither_good_nor_bad(tmp_path):
    findings = check_conditions(Host(GRANTED, tmp_path, "6.1.0", "#1", (0, 1)), Pacing(1000.0))
    unknown = {finding.condition for finding in findings if finding.good is None}
    assert unknown == {"interrupts", "frequency governor", "clock source", "real-time throttling"}


@given(st.sets(st.integers(0, 300)))
def test_parsing_a_formatted_list_of_processors_gives_it_back(cpus):
    assert parse_cpus(format_cpus(cpus)) == cpus


def test_lists_of_processors_are_written_as_the_kernel_does():
    assert parse_cpus("0-2,8,10-11") == {0, 1, 2, 8, 10, 11}
    assert format_cpus({0, 1, 2, 8, 10, 11}) == "0-2,8,10-11"
    assert parse_cpus("") == set()
    assert parse_cpus("0-x,y,3-,²,5") == {3, 5}


@pytest.mark.parametrize("state", ["damaged", "set aside", "whole"])
def test_damaged_files_of_the_cache_are_reported(tmp_path, monkeypatch, state):
    cache = tmp_path / "cache"
    cache.mkdir()
    monkeypatch.setattr(software, "CACHE_FOLDER", cache)
    monkeypatch.setattr(software, "CACHE_IS_PERSISTENT", True)
    cache_files.write(cache / "kernel.nbc", b"code")
    if state != "whole":
        (cache / "kernel.nbc").write_bytes(b"")
    if state == "set aside":
        cache_files.read(cache / "kernel.nbc")
    finding = software.compiled_code(host(tmp_path), Pacing(10_000.0))
    assert finding.good == (state == "whole")
    assert ("1 damaged file" in finding.value) == (state != "whole")
