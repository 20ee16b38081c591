"""`rtloop ctl response`, `identify response`, and both with `resonance`: a closed loop as it was measured."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtloop.client import Client
from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.model_sections import write_new_file
from rtloop.design.identification.plot_response import plot_response
from rtloop.design.identification.recorded_response import recorded_measurement
from rtloop.terminal.machine import echo_json
from rtloop.terminal.response import print_resonance, print_response

TIMES, MORE_S = 3.0, 60.0
"""Of the stated duration, and besides: how long an answer may take."""


def show_measured(client: Client, body: Mapping[str, Any], out: Path | None, plot: Path | None, as_json: bool) -> int:
    """Have a running service measure; at Ctrl-C what was held is held again. Raises RtloopError."""
    asked = {name: value for name, value in body.items() if value is not None}
    content = client.measure("/response", asked, TIMES * body["duration_s"] + MORE_S)
    return _show(content, bool(body.get("resonance_only")), out, plot, as_json)


def show_recorded(
    run: Path, axis: str | None, near_hz: float | None, out: Path | None, plot: Path | None, as_json: bool,
    resonance_only: bool = False,
) -> int:  # fmt: skip
    """Of a recording. Raises RtloopError."""
    return _show(recorded_measurement(run, axis, near_hz).for_json(), resonance_only, out, plot, as_json)


def _show(content: dict[str, Any], resonance_only: bool, out: Path | None, plot: Path | None, as_json: bool) -> int:
    if resonance_only and content["resonance"] is None:
        raise UnsuitableData("no light mode stands out in the band; --near-hz says where one is expected")
    if out is not None:
        write_new_file(out, json.dumps(content) + "\n")
    if plot is not None:
        plot_response(content, plot)
    if as_json:
        echo_json({"resonance": content["resonance"]} if resonance_only else content)
    elif resonance_only:
        print_resonance(content)
    else:
        print_response(content, [file for file in (out, plot) if file])
    return 0
