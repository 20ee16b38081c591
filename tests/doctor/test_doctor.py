"""`rtloop doctor` on this host; and the verdict on constructed measurements."""

from __future__ import annotations

import ctypes
import json
import math
import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from rtloop.analysis.closed_loop import continuous_loop
from rtloop.analysis.margins import delay_margin
from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.doctor import examine
from rtloop.doctor.examine import Examination, Latency, check_conditions
from rtloop.doctor.findings import Finding
from rtloop.doctor.verdict import AxisDelay, axis_delays, reasons_unsuitable
from rtloop.engine.plan import Pacing
from rtloop.errors import RtloopError
from rtloop.linear.transfer import Transfer
from tests.doctor.hosts import host
from tests.recording.real_loop import ROOT, changed_configuration

pytestmark = pytest.mark.system

CAP_IPC_LOCK, CAP_SYS_NICE, PR_CAPBSET_DROP = 14, 23, 24


def test_a_measurement_of_the_clock_that_does_not_end_is_a_fault_in_a_sentence(monkeypatch):
    monkeypatch.setattr(examine, "START_S", -0.6)
    with pytest.raises(
        RtloopError, match=r"^the measurement of the loop's lateness on this computer did not end within \d+ s$"
    ):
        examine.examine(Pacing(1000.0), 0.3)


@pytest.fixture(autouse=True)
def run_folder(tmp_path, monkeypatch):
    """Set and return the folder of runtime files."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "run"))
    return tmp_path / "run"


def doctor(*arguments: str, before=None) -> tuple[int, dict, str]:
    """Run `rtloop doctor` in a process that first calls `before`; return exit code, report and stderr."""
    result = subprocess.run(
        [sys.executable, "-m", "rtloop", "doctor", "--json", *arguments],
        capture_output=True, text=True, preexec_fn=before, check=False,
    )  # fmt: skip
    return result.returncode, json.loads(result.stdout), result.stderr


def drop_privileges() -> None:
    """Drop the real-time rights of this process."""
    libc = ctypes.CDLL(None)
    for capability in (CAP_IPC_LOCK, CAP_SYS_NICE) if os.getuid() == 0 else ():
        libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))


def test_the_report_on_this_host_is_complete(tmp_path, run_folder):
    code, report, messages = doctor("deploy/paper.toml", "--seconds", "0.3", "--png", str(tmp_path / "late.png"))
    assert code == (0 if report["suitable"] else 1)
    assert report["suitable"] == (not report["reasons"])
    assert report["ticks"] == sum(entry["count"] for entry in report["lateness_histogram"]) == 3000
    assert 0 <= report["lateness_us"]["p50"] <= report["lateness_us"]["p99"] <= report["lateness_us"]["max"]
    assert [axis["axis"] for axis in report["axes"]] == ["x"]
    assert (report["applied"], messages) == ([], "")
    stored = json.loads((run_folder / "paper.host.json").read_text())
    assert (stored["rate_hz"], stored["lateness_us"]) == (10_000, pytest.approx(report["lateness_us"]["p99"]))
    assert (tmp_path / "late.png").read_bytes().startswith(b"\x89PNG")


def test_refused_rights_are_reported():
    code, report, _ = doctor("--seconds", "0.1", before=drop_privileges)
    findings = {finding["condition"]: finding for finding in report["findings"]}
    assert (code, report["suitable"]) == (1, False)
    assert findings["SCHED_FIFO"]["value"] == "refused: Operation not permitted"
    assert findings["locked memory"]["good"] is False
    assert sum(reason.startswith("SCHED_FIFO: refused") for reason in report["reasons"]) == 1


def test_the_text_has_every_condition_and_the_verdict():
    """Each condition has a row; each bad one has its remedy; the ticks of the histogram are all there."""
    report = doctor("deploy/paper.toml", "--seconds", "0.1")[1]
    process = subprocess.run(
        [sys.executable, "-m", "rtloop", "doctor", "deploy/paper.toml", "--seconds", "0.1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    text = " ".join(process.stdout.split())
    bad = [finding for finding in report["findings"] if finding["good"] is False]
    for finding in report["findings"]:
        assert finding["condition"] in text
    for finding in bad:
        assert " ".join(finding["fix"].split()) in text, finding
    verdicts = {0: "suitable for paper at 10 kHz", 1: "not suitable for paper at 10 kHz (period 100 µs), because:"}
    assert verdicts[process.returncode] in text
    assert ("not suitable" in text) == (process.returncode == 1)
    assert "the loop's clock, 0.1 s at 10000 Hz" in text
    assert "axis x: at the crossover with the least delay margin" in text


def test_a_missing_configuration_ends_with_66():
    code, report, _ = doctor("no-such.toml")
    assert code == report["exit_code"] == 66


def latency(values_us, rate_hz: float = 10_000.0) -> Latency:
    """Return a measurement with these latenesses (µs), one a tick."""
    values_us = np.asarray(values_us, float)
    return Latency(Pacing(rate_hz, cpu=3), values_us, np.floor(values_us * rate_hz * 1e-6), 0.0)


QUIET_US, PERIODS_US = np.full(50_000, 5.0), np.arange(50_000)
REASONS = {
    "quiet": (QUIET_US, ()),
    "one stall": (
        np.where(PERIODS_US == 1234, 70_000.0, QUIET_US),
        ("measured: a tick was 70000 µs late, and 700 periods were missed",),
    ),
    "steady lateness": (
        np.where(PERIODS_US % 500 == 0, 150.0, QUIET_US),
        ("measured: 0.20 % of the ticks were late by more than a period",),
    ),
}


@pytest.mark.parametrize("case", REASONS)
def test_a_stall_and_steady_lateness_are_told_apart_on_a_good_host(case, tmp_path):
    values_us, reasons = REASONS[case]
    findings = check_conditions(host(tmp_path), Pacing(10_000.0, cpu=3))
    assert reasons_unsuitable(Examination(latency(values_us), findings)) == list(reasons)


@pytest.mark.parametrize(("rate_hz", "reasons"), [(10_000.0, ["kernel"]), (10.0, [])])
def test_conditions_count_against_the_period(rate_hz, reasons, tmp_path):
    """A kernel without PREEMPT_RT, late by milliseconds, is a reason at 10 kHz and none at 10 Hz."""
    plain = host(tmp_path, {"sys/kernel/realtime": "0"}, version="#1 SMP PREEMPT_DYNAMIC")
    examination = Examination(latency(QUIET_US, rate_hz), check_conditions(plain, Pacing(10_000.0, cpu=3)))
    assert [reason.partition(":")[0] for reason in reasons_unsuitable(examination)] == reasons


@pytest.mark.parametrize(("is_good", "count"), [(None, 0), (True, 0), (False, 1)])
def test_only_a_condition_that_is_known_to_be_bad_is_a_reason(is_good, count):
    finding = Finding("kernel", "unknown", "PREEMPT_RT", is_good, 5000.0, "late ticks", "")
    assert len(reasons_unsuitable(Examination(latency(QUIET_US), (finding,)))) == count


def test_a_delay_beyond_the_margin_of_a_loop_is_a_reason():
    delays = [AxisDelay("x", 95.0, 100.0, 0.1, 0.2, 99.0), AxisDelay("y", 95.0, 100.0, 0.1, 0.2, 101.0)]
    reasons = reasons_unsuitable(Examination(latency(QUIET_US), ()), delays)
    assert [reason.partition(":")[0] for reason in reasons] == ["axis y"]


def test_the_papers_loop_bears_two_milliseconds():
    """The paper's C(z) has a phase margin of 73.05° at 95.09 Hz, without a sample of delay."""
    prepared = prepare(parse(changed_configuration(), "paper", ROOT, "paper"))
    (delay,) = axis_delays(prepared, latency(np.linspace(0, 100, 10_001)))
    assert delay.crossover_hz == pytest.approx(95.09, abs=0.01)
    assert delay.tolerated_us == pytest.approx(73.05 / 360 / 95.09 * 1e6, rel=1e-3)
    assert delay.p50_deg == pytest.approx(360 * 95.09 * 50e-6, rel=1e-3)
    assert delay.p99_deg == pytest.approx(360 * 95.09 * 99e-6, rel=1e-3)


@pytest.mark.parametrize("gain", [1.5, 4.0, 7.9])
def test_tolerated_delay_of_three_equal_poles(gain):
    """L = k/(s+1)³: |L| = 1 at ω = √(k^⅔ − 1), where the phase is −3 arctan ω."""
    w = math.sqrt(gain ** (2 / 3) - 1)
    loop = continuous_loop(Transfer.from_zpk([], [], gain), Transfer.from_zpk([], [-1.0] * 3, 1.0))
    assert delay_margin(loop) == pytest.approx(((math.pi - 3 * math.atan(w)) / w, w / (2 * math.pi)), rel=1e-6)


def test_tolerated_delay_at_the_tightest_of_several_crossovers():
    """A resonance at 600 Hz, where |L| crosses 1 again, tolerates less delay than the slow crossover."""
    w0, zeta, k = 2 * math.pi * 600, 0.01, 100.0
    pair = [complex(-zeta * w0, s * w0 * math.sqrt(1 - zeta**2)) for s in (1, -1)]
    loop = continuous_loop(Transfer.from_zpk([], [0.0], k), Transfer.from_zpk([], pair, w0**2))
    w = np.linspace(1, 2 * w0, 4_000_001)
    response = k / (1j * w) * w0**2 / (w0**2 - w**2 + 2j * zeta * w0 * w)
    crossings = np.flatnonzero(np.diff(np.sign(np.abs(response) - 1)))
    delays_s = np.radians((np.degrees(np.angle(response[crossings])) % 360 - 180) % 360) / w[crossings]
    tightest = np.argmin(delays_s)
    assert len(crossings) == 3
    assert delay_margin(loop) == pytest.approx((delays_s[tightest], w[crossings[tightest]] / (2 * math.pi)), rel=1e-3)


def test_no_crossover_bears_any_delay():
    loop = continuous_loop(Transfer.from_zpk([], [], 0.5), Transfer.from_zpk([], [-1.0], 1.0))
    assert delay_margin(loop)[0] == math.inf
