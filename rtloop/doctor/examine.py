"""The examination of a host: the lateness of the loop's clock is measured, then every condition is checked."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtloop.doctor import machine, node_conditions, permissions, software
from rtloop.doctor.findings import Finding
from rtloop.doctor.host import Host
from rtloop.doctor.node_line import NetworkLine, SerialLine
from rtloop.engine import latency
from rtloop.engine.plan import Pacing
from rtloop.errors import RtloopError
from rtloop.foundation.children import child_environment, python_command

START_S = 60.0
"""Longest start of the measuring process, which compiles the loop the first time."""


@dataclass(frozen=True)
class Latency:
    """Lateness in µs and missed periods of each tick (ticks,), and the seconds that a hypervisor stole meanwhile."""

    pacing: Pacing
    lateness_us: npt.NDArray[np.float64]
    missed: npt.NDArray[np.float64]
    stolen_s: float

    @property
    def period_us(self) -> float:
        """The loop's period in µs."""
        return 1e6 / self.pacing.rate_hz

    def quantile_us(self, share: float) -> float:
        """Return the lateness in µs that the fraction `share` (0 … 1) of the ticks does not exceed."""
        return float(np.quantile(self.lateness_us, share))

    @property
    def quantiles_us(self) -> dict[str, float]:
        """Quantiles of the lateness in µs: p50, p99, p999 and max."""
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
        return {name: self.quantile_us(share) for name, share in shares.items()}

    @property
    def late_share(self) -> float:
        """Fraction 0 … 1 of ticks that are late by more than a period: the median over windows of 1 s.

        One stall does not count. A measurement of less than 1 s is one window.
        """
        late = self.lateness_us > self.period_us
        window = max(1, round(self.pacing.rate_hz))
        windows = late[: late.size // window * window].reshape(-1, window) if late.size >= window else late[None, :]
        return float(np.median(windows.mean(axis=1)))


@dataclass(frozen=True)
class Examination:
    """Measured latency and the findings on every condition of a host."""

    latency: Latency
    findings: tuple[Finding, ...]


def examine(
    pacing: Pacing, seconds: float, root: Path = Path("/"), line: NetworkLine | SerialLine | None = None
) -> Examination:
    """Measure the lateness of the loop's clock for `seconds` in another process, then check every condition of the host
    below `root`, and the `line` to a node unless it is None. Returns the measured lateness and all findings.

    Raises RtloopError if that process fails, or does not end within START_S + 3 `seconds`.
    """
    before_s = Host({}, root).stolen_s()
    timeout_s = START_S + 3 * seconds
    try:
        process = subprocess.run(
            python_command("rtloop.engine.latency"),
            env=child_environment(),
            input=latency.encode_request(pacing, max(1, round(seconds * pacing.rate_hz))),
            capture_output=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise RtloopError(
            f"the measurement of the loop's lateness on this computer did not end within {timeout_s:.0f} s"
        ) from None
    if process.returncode != 0:
        lines = process.stderr.decode(errors="replace").strip().splitlines() or [f"exit code {process.returncode}"]
        raise RtloopError(f"the measurement of the loop's lateness on this computer failed: {lines[-1]}")
    grants, lateness_us, missed = latency.decode_results(process.stdout)
    host = Host(grants, root)
    measurement = Latency(pacing, lateness_us, missed, host.stolen_s() - before_s)
    return Examination(measurement, check_conditions(host, pacing, line))


def check_conditions(host: Host, pacing: Pacing, line: NetworkLine | SerialLine | None = None) -> tuple[Finding, ...]:
    """Return the finding on each condition of a host for a loop with this pacing.

    The conditions are the CONDITIONS of `machine`, then of `permissions`, then of `software`, then the conditions of
    the `line` to a node unless it is None.
    """
    checks = (*machine.CONDITIONS, *permissions.CONDITIONS, *software.CONDITIONS)
    return (*(check(host, pacing) for check in checks), *node_conditions.check_line(line, host, pacing))
