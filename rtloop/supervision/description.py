"""The header of a recording: run, layout of the law, hardware, host, versions, real-time settings."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rtloop.configuration.prepare import Prepared
from rtloop.configuration.recording import event_window
from rtloop.engine.plan import Plan
from rtloop.foundation import timing
from rtloop.foundation.native.cache import cpu_identity

FORMAT, FORMAT_EVENT_WINDOW = 1, 2
PACKAGES = ("rtloop", "numpy", "numba", "llvmlite", "mcap", "zstandard")


def recording_header(prepared: Prepared, realtime: Mapping[str, object]) -> dict[str, object]:
    """Return the header of a recording of `prepared`, which begins now, as JSON values.

    Keys: format, name, created_unix_ns, axes, observed, columns, rate_hz, paced, ticks_expected, mode, configuration
    (its text), folder, configuration_sha256, law (its layout), extras, driver, realtime, versions, host, and `around`
    if the configuration has an event window. The argument `realtime` are the settings that the host granted the loop.
    """
    plan, configuration = prepared.plan, prepared.configuration
    around = configuration.recording.around
    return {
        "format": FORMAT if around is None else FORMAT_EVENT_WINDOW,
        "name": plan.name,
        "created_unix_ns": round(1e9 * timing.unix_s()),
        "axes": list(plan.axes),
        "observed": list(plan.observed),
        "columns": list(plan.columns),
        "rate_hz": plan.pacing.rate_hz,
        "paced": plan.pacing.paced,
        "ticks_expected": plan.ticks,
        "mode": plan.mode.name.lower(),
        "configuration": configuration.text,
        "folder": str(configuration.folder.absolute()),
        "configuration_sha256": hashlib.sha256(configuration.text.encode()).hexdigest(),
        "law": _law_description(plan),
        "extras": {
            "inputs": [{"name": name, "channel": plan.extra_channels[name]} for name in plan.extras.inputs],
            "outputs": [
                {**output._asdict(), "channel": plan.extra_channels[output.name]} for output in plan.extras.outputs
            ],
        },
        "driver": {
            "kind": plan.driver_kind,
            "inputs": [channel.name for channel in prepared.facts.inputs],
            "outputs": [channel.name for channel in prepared.facts.outputs],
            "wiring": {axis: list(wiring) for axis, wiring in plan.wiring.items()},
        },
        "realtime": realtime,
        "versions": {name: _package_version(name) for name in PACKAGES} | {"python": sys.version.split()[0]},
        "host": {
            "kernel": platform.release(),
            "machine": platform.machine(),
            "cpu": _cpu_name(),
            "cpus": os.cpu_count(),
        },
        **({} if around is None else {"around": event_window(around)._asdict()}),
    }


def _law_description(plan: Plan) -> dict[str, object]:
    """Return the layout of the loop's laws as JSON values: `Layout.description`.

    In its list `laws`, a user's law also has its `sha256`, its `text`, so that a replay needs no file, and its `file`;
    with helpers also `helpers`, a list of {name, text}.
    """
    layout = plan.layout.description()
    for entry, law in zip(layout["laws"], plan.laws, strict=True):
        if law.text:
            entry |= {"sha256": law.sha256, "text": law.text, "file": str(Path(law.file).absolute())}
        if law.helpers:
            entry["helpers"] = [{"name": helper.name, "text": helper.text} for helper in law.helpers]
    return layout


def _package_version(package: str) -> str:
    """Return the version of an installed package, "not installed" without one."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _cpu_name() -> str:
    """Return "MODEL (NAME)": the CPU's model, "unknown" if the system names none, and the compiler's name for it."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as info:
            model = next((line.split(":", 1)[1].strip() for line in info if line.startswith("model name")), "unknown")
    except OSError:
        model = "unknown"
    return f"{model} ({cpu_identity().split()[0]})"
