"""Which stretch of a run is captured: what comes, what lies about a tick, or about the next trigger."""

from __future__ import annotations

import time
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtloop.errors import RtloopError, UnavailableError
from rtloop.panel.capture import capture, current_run
from rtloop.panel.conditions import Condition
from rtloop.panel.reader import MAX_TICKS, Reader
from rtloop.panel.trigger import Mode, Settings, Trigger
from rtloop.recording.load import Recording, load
from rtloop.service.client import Client

POLL_S = 0.005


def capture_stretch(
    client: Client,
    seconds: float,
    condition: Condition | None,
    center_tick: int | None,
    pre_percent: float,
    timeout_s: float,
    folder: Path | str | None,
) -> Recording:
    """As `Connection.capture` says it."""
    _require(condition is None or center_tick is None, "capture: trigger and at; one of them is allowed")
    _require(0 < seconds < float("inf"), f"capture seconds: {seconds}; a finite number above 0 is needed")
    _require(timeout_s >= 0, f"capture timeout_s: {timeout_s}; 0 or more is needed")
    run, configuration = current_run(client), client.get("/configuration")
    settings = Settings(max(round(seconds * configuration["rate_hz"]), 1), Mode.SINGLE, pre_percent)
    if condition is not None:
        first = _await_trigger(configuration, run.tick + 1, settings, condition, timeout_s)
    else:
        first = run.tick + 1 if center_tick is None else center_tick - settings.pre_ticks
    begin, output_folder = max(first, 0), None if folder is None else Path(folder)
    return load(capture(client, run.file, begin, first + settings.ticks, output_folder)["output"])


def _await_trigger(
    configuration: Mapping[str, Any], begin: int, settings: Settings, condition: Condition, timeout_s: float
) -> int:
    """The first tick of the stretch about the first one from `begin` on that meets a condition.

    `said` is the configuration as it runs. Raises RtloopError where none comes, or the loop ends.
    """
    names = [column["name"] for column in configuration["columns"]]
    _require(condition.source in names, f"trigger source: {condition.source!r}; {', '.join(names)} are allowed")
    reader, trigger = (
        Reader(Path(configuration["block"]), lambda: names),
        Trigger(settings, lambda: deepcopy(condition)),
    )
    deadline_s = time.monotonic() + timeout_s
    while True:
        stretch = reader.read()
        if stretch is not None and stretch.run > 0:
            raise UnavailableError("capture: the loop was started anew before a trigger came")
        if stretch is not None and stretch.end > begin:
            skipped_rows = max(begin - stretch.first, 0)
            if sweeps := trigger.feed(
                replace(stretch, first=stretch.first + skipped_rows, rows=stretch.rows[skipped_rows:])
            ):
                return sweeps[0].first
            if trigger.open_sweep is not None:
                return trigger.open_sweep.first
        if stretch is None or len(stretch) < MAX_TICKS:  # else there are more, and they came before now
            if time.monotonic() > deadline_s:
                raise RtloopError(f"capture: no trigger within {timeout_s:g} s; timeout_s allows longer")
            time.sleep(POLL_S)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)
