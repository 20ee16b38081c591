"""Long campaigns: linear predictions against simulated rigs, coverage of intervals, efficiency and memory.

make soak NAME=campaign FLAGS="prediction promise coverage efficiency memory"
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtloop.campaigns.campaign_file import load_campaign
from rtloop.campaigns.case import CaseRunner
from rtloop.campaigns.summary import clopper_pearson
from rtloop.configuration.file import load
from rtloop.configuration.prepare import prepare
from rtloop.configuration.rig import plant_dynamics
from rtloop.hil.options import DynamicsOptions
from tests.campaigns.bad_recordings import dask_cluster
from tests.campaigns.campaign_files import ROOT, rtloop

PAPER = ROOT / "deploy/paper.toml"
IDEAL = {
    'truth = "residual"': 'truth = "nominal"',
    "noise_um = 0.010": "noise_um = 0.0",
    "resolution_um = 0.010": "resolution_um = 0.0",
    "[driver.plant.sensor]": "[driver.plant.adc]\nbits = 0\n[driver.plant.dac]\nbits = 0\n[driver.plant.sensor]",
    'dead_band = "none"': 'dead_band = "exact"',
    '"paper-spec.toml"': f'"{ROOT / "deploy/paper-spec.toml"}"',
}
"""Replacements that leave the paper's configuration without noise, rounding and residual hysteresis: a linear loop."""
STABLE = """
configuration = "ideal.toml"
keep_worst = 0
{keys}
[uncertain]
"driver.plant.dynamics.resonance_shift" = {{ uniform = [-0.1, 0.1] }}
{uncertain}
[[experiment]]
kind = "steps"
levels_um = [5.0]
dwell_s = {dwell_s}
[limits]
"steps.static_error_percent" = 1e9
"steps.settling_ms" = 1e9
"steps.overshoot_percent" = 1e9
"""
"""Campaign on ideal.toml whose limits only an unstable loop exceeds."""
QUICK_WORKERS = {"DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False", "MALLOC_TRIM_THRESHOLD_": "134217728"}
"""Settings of Dask's workers that docs/campaigns.md names: no profiler, and freed memory stays with the process."""
SPREAD = """
"driver.plant.dynamics.damping_factor" = { log_uniform = [0.5, 2.0] }
"driver.plant.dynamics.gain_factor" = { uniform = [0.95, 1.05] }
"""
"""Uncertain keys beside the resonance, for the comparison rig by rig."""


def prediction(folder: Path) -> list[str]:
    """Compare stability on ideal rigs with the linear prediction: the boundary along one key, and rig by rig."""
    _write_ideal(folder)
    campaign = folder / "stable.toml"
    campaign.write_text(STABLE.format(keys="", uncertain="", dwell_s=20.0))
    key = "driver.plant.dynamics.resonance_shift"
    boundary = _run_json("campaign", "boundary", campaign, key, "--tolerance", 1e-5, folder=folder)
    report = _run_json("design", "verify", folder / "ideal.toml", folder=folder)
    low, high = report["axes"][0]["robustness_percent"]["resonance"]["running"]
    print(f"resonance until unstable: {100 * boundary['low']:.3f} … {100 * boundary['high']:.3f} % on simulated rigs, "
          f"{low:.3f} … {high:.3f} % linear", flush=True)  # fmt: skip
    faults = []
    if abs(100 * boundary["low"] - low) > 0.02 or abs(100 * boundary["high"] - high) > 0.02:
        faults.append("the boundary on rigs is not the linear one")
    campaign.write_text(STABLE.format(keys="rigs = 1000", uncertain=SPREAD, dwell_s=4.0))
    runner = CaseRunner(load_campaign(campaign))
    growths = [(_growth_per_s(runner, rig), runner.run(rig).has_passed) for rig in range(1, 1001)]
    linear, simulated = (
        sum(passed) for passed in zip(*((growth < 0, passed) for growth, passed in growths), strict=True)
    )
    differing_growths = [growth for growth, passed in growths if (growth < 0) != passed]
    print(f"of 1000 rigs {simulated} pass, {linear} by linear theory; {len(differing_growths)} differ, "
          f"whose modes grow by at most {max(map(abs, differing_growths), default=0.0):.3f} 1/s",
          flush=True)  # fmt: skip
    estimate = clopper_pearson(simulated, 1000)
    if not estimate.low <= linear / 1000 <= estimate.high:
        faults.append(f"linear yield {linear / 1000} outside {estimate.low:.4f} … {estimate.high:.4f}")
    if any(abs(growth) > 2.0 for growth in differing_growths):
        faults.append("a rig far from the boundary has the wrong verdict")
    return faults


def _growth_per_s(runner: CaseRunner, rig: int) -> float:
    """Return the growth rate in 1/s of the fastest mode of the linear loop on a rig; negative if it is stable."""
    values = runner.sample_values(rig)
    configuration = load(runner.campaign.folder / "ideal.toml")
    dynamics = DynamicsOptions(**{key.rpartition(".")[2]: value for key, value in values.items() if "dynamics" in key})
    (check,) = prepare(configuration, paced=False).checks
    loop = check.loop(plant_dynamics(dynamics), 0)
    return float(np.log(np.max(np.abs(loop.poles))) * configuration.loop.rate_hz)


def promise(folder: Path) -> list[str]:
    """Run the shipped robust configuration on 5,000 rigs: its limits hold on at least 99.9 %."""
    report = _run_json(
        "campaign", "run", ROOT / "deploy/campaign.toml", "--config", ROOT / "deploy/robust.toml", "--rigs", 5000,
        "--out", folder / "robust", folder=folder,
    )  # fmt: skip
    estimate = report["yield_of_rigs"]
    print(
        f"deploy/robust.toml: {estimate['passed']} of {estimate['rigs']} rigs pass, a yield of at least "
        f"{100 * estimate['low']:.3f} %"
    )
    for rig in report["worst_rigs"]:
        print(f"  worst: rig {rig['rig']}, {rig['ratio']:.3f} of its limit {rig['missed']} {rig['values']}")
    return [] if estimate["share"] >= 0.999 else [f"yield {estimate['share']}"]


def coverage(folder: Path) -> list[str]:
    """Run 200 campaigns of 200 rigs with a known probability of failure; 93 to 97 % of the intervals cover it."""
    _write_ideal(folder)
    campaign = folder / "offset.toml"
    key = "driver.plant.sensor.offset_um"
    campaign.write_text(
        STABLE.format(keys="rigs = 200", uncertain="", dwell_s=0.03)
        .replace(
            '"driver.plant.dynamics.resonance_shift" = { uniform = [-0.1, 0.1] }',
            f'"{key}" = {{ uniform = [0.0, 1.0] }}',
        )
        .replace('"steps.static_error_percent" = 1e9', '"steps.static_error_percent" = 18.0')
    )
    boundary = _run_json("campaign", "boundary", campaign, key, folder=folder)
    probability, covered = boundary["high"], 0
    loaded = load_campaign(campaign)
    for seed in range(200):
        options = loaded.options.model_copy(update={"seed": seed})
        runner = CaseRunner(replace(loaded, options=options))
        passed = sum(runner.run(rig).has_passed for rig in range(1, 201))
        estimate = clopper_pearson(passed, 200)
        covered += estimate.low <= probability <= estimate.high
    print(f"a yield of {probability:.4f} lies in {covered} of 200 intervals", flush=True)
    return [] if 186 <= covered <= 194 else [f"{covered} of 200 intervals cover the yield; allowed: 186 … 194"]


def efficiency(folder: Path) -> list[str]:
    """Time one process against two, and two Dask workers against two processes, in three rounds after a warm-up."""
    rigs, durations_s = 4000, {"1 process": [], "2 processes": [], "Dask, 2 workers": []}
    with dask_cluster(folder, 2, QUICK_WORKERS) as address:
        choices = {
            "1 process": ("--jobs", 1),
            "2 processes": ("--jobs", 2),
            "Dask, 2 workers": ("--scheduler", address),
        }
        for round_number in range(4):
            for name, options in choices.items():
                durations_s[name].append(_rigs_s(folder / f"{name} {round_number}", rigs, options))
    one_s, two_s, dask_s = (np.array(values[1:]) for values in durations_s.values())
    for name, values in durations_s.items():
        print(f"{rigs} rigs with {name}: {np.median(values[1:]):.2f} s", flush=True)
    print(
        f"2 processes are {np.median(one_s / two_s):.2f} × as fast as 1, "
        f"Dask {np.median(two_s / dask_s):.2f} × as 2 processes"
    )
    runner = CaseRunner(load_campaign(ROOT / "deploy/campaign.toml"))
    for rig in range(20):
        runner.run(rig)
    begin_s = time.process_time()
    for rig in range(200):
        runner.run(rig)
    print(f"a rig costs {5 * (time.process_time() - begin_s):.2f} ms of processor with its ticks", flush=True)
    return ["two processes are less than 1.8 × as fast"] * bool(np.median(one_s / two_s) < 1.8) + [
        "Dask is less than 0.9 × as fast as processes"
    ] * bool(np.median(two_s / dask_s) < 0.9)


def _rigs_s(folder: Path, rigs: int, options: tuple[object, ...]) -> float:
    """Return the seconds between the nominal rig's result and the last one of a campaign."""
    campaign = ROOT / "deploy/campaign.toml"
    process = rtloop("campaign", "run", campaign, "--rigs", rigs, "--out", folder, *options, folder=folder.parent)
    process.communicate(timeout=3600)
    files = sorted((folder / "results").glob("*.parquet"))
    return max(path.stat().st_mtime for path in files) - files[0].stat().st_mtime


def memory(folder: Path) -> list[str]:
    """Run 100,000 rigs and read the largest memory of the coordinator."""
    campaign = folder / "many.toml"
    _write_ideal(folder)
    campaign.write_text(STABLE.format(keys="rigs = 100_000", uncertain="", dwell_s=0.002))
    process = subprocess.Popen(
        [sys.executable, "-m", "rtloop", "campaign", "run", str(campaign), "--out", str(folder / "many")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    begin_s, peak_mib = time.monotonic(), 0.0
    while process.poll() is None:
        with suppress(OSError):
            for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
                if line.startswith("VmHWM"):
                    peak_mib = max(peak_mib, int(line.split()[1]) / 1024)
        time.sleep(0.5)
    print(
        f"100,000 rigs in {time.monotonic() - begin_s:.0f} s; the coordinator needs {peak_mib:.0f} MiB at most",
        flush=True,
    )
    print(process.communicate()[0].splitlines()[0])
    return [] if peak_mib <= 300 else [f"{peak_mib:.0f} MiB; allowed: 300 MiB"]


def _write_ideal(folder: Path) -> None:
    """Write ideal.toml: the paper's configuration with the replacements of IDEAL."""
    text = PAPER.read_text()
    for old, new in IDEAL.items():
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "ideal.toml").write_text(text)


def _run_json(*arguments: object, folder: Path) -> dict:
    """Run an `rtloop` command and return its JSON. Raises AssertionError without output."""
    process = rtloop(*arguments, "--json", folder=folder)
    output, errors = process.communicate(timeout=3600)
    assert output, errors
    return json.loads(output)


PARTS: dict[str, Callable[[Path], list[str]]] = {
    function.__name__: function for function in (prediction, promise, coverage, efficiency, memory)
}
"""Parts of this test by name. Each works in a folder and returns a sentence for each bound that it misses."""


def main() -> int:
    """Run the named parts, or all; return 1 if a bound is missed."""
    parser = argparse.ArgumentParser(prog="campaign", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    faults = []
    for name in parser.parse_args().parts:
        with tempfile.TemporaryDirectory() as folder:
            print(f"== {name}", flush=True)
            faults += [f"{name}: {fault}" for fault in PARTS[name](Path(folder))]
    print("\n".join(faults) or "every bound holds")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
