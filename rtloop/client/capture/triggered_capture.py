"""Captures of a running loop from Python: of a span that begins now, lies about a tick, or about the next trigger."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtloop.client import Client
from rtloop.client.capture.conditions import Condition
from rtloop.client.capture.tick_capture import capture_ticks, current_run
from rtloop.client.capture.trigger import Mode, Settings, Trigger
from rtloop.client.ticks.reader import MAX_TICKS, Reader
from rtloop.errors import RtloopError, UnavailableError
from rtloop.foundation import timing
from rtloop.recording.load import Recording, load

POLL_S = 0.005


def capture_span(
    client: Client,
    seconds: float,
    condition: Condition | None,
    center_tick: int | None,
    pre_percent: float,
    timeout_s: float,
    folder: Path | str | None,
) -> Recording:
    """Save a span of `seconds` of the running loop as a recording and return it, as `Connection.capture` does.

    `pre_percent` of the span lies before the first tick that meets `condition`, or before `center_tick`; without both,
    the span begins now. The call returns once the span's last tick is written. Raises ValueError if both are given, for
    values out of range and an unknown signal; RtloopError for a tick or trigger later than `timeout_s`; RecordingError
    for ticks that are not in the run; OutputError if the file cannot be written; UnavailableError if the run is not
    recorded, or the loop is started again meanwhile.
    """
    _require(
        condition is None or center_tick is None, "capture: both a trigger and `at` are given; allowed: one of them"
    )
    _require(0 < seconds < float("inf"), f"capture seconds: {seconds}; allowed: finite numbers above 0")
    _require(timeout_s >= 0, f"capture timeout_s: {timeout_s}; allowed: 0 or more")
    run, configuration = current_run(client), client.get("/configuration")
    settings = Settings(max(round(seconds * configuration["rate_hz"]), 1), Mode.SINGLE, pre_percent)
    if center_tick is not None and (wait_s := (center_tick - run.tick) / run.rate_hz) > timeout_s:
        raise RtloopError(
            f"capture at: the loop reaches tick {center_tick} in {wait_s:.1f} s; allowed: within timeout_s = "
            f"{timeout_s:g} s; use a nearer tick, or a larger timeout_s"
        )
    if condition is not None:
        first = _await_trigger(configuration, run.tick + 1, settings, condition, timeout_s)
    else:
        first = run.tick + 1 if center_tick is None else center_tick - settings.pre_ticks
    output_folder = None if folder is None else Path(folder)
    return load(capture_ticks(client, run.file, max(first, 0), first + settings.ticks, output_folder)["output"])


def _await_trigger(
    configuration: Mapping[str, Any], begin: int, settings: Settings, condition: Condition, timeout_s: float
) -> int:
    """Wait for the first tick from `begin` on that meets the condition; return the first tick of the span about it,
    which has the length and position that `settings` state.

    The result may be a tick before `begin`, or below 0. `configuration` is the response of `/configuration`. Raises
    ValueError for an unknown signal, RtloopError without a trigger within `timeout_s`, UnavailableError if the loop
    is started again.
    """
    names = [column["name"] for column in configuration["columns"]]
    _require(condition.source in names, f"trigger source: {condition.source!r}; allowed: {', '.join(names)}")
    reader = Reader(Path(configuration["block"]), lambda: names)
    trigger = Trigger(settings, lambda: deepcopy(condition))
    deadline_s = timing.monotonic_s() + timeout_s
    while True:
        stretch = reader.read()
        if stretch is not None and stretch.run > 0:
            raise UnavailableError("capture: the loop was started again before the trigger; start the capture again")
        if stretch is not None and stretch.end > begin:
            skipped = max(begin - stretch.first, 0)
            sweeps = trigger.feed(replace(stretch, first=stretch.first + skipped, rows=stretch.rows[skipped:]))
            if sweep := sweeps[0] if sweeps else trigger.open_sweep:
                return sweep.first
        if stretch is None or len(stretch) < MAX_TICKS:  # Else more ticks wait, which came before the deadline.
            if timing.monotonic_s() > deadline_s:
                raise RtloopError(
                    f"capture: no trigger within {timeout_s:g} s; use a larger timeout_s, or another trigger"
                )
            timing.sleep(POLL_S)


def _require(condition: bool, message: str) -> None:
    """Raise ValueError with `message` unless `condition` is True."""
    if not condition:
        raise ValueError(message)
