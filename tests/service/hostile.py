"""Hostile control requests: valid requests with one value replaced by a huge, tiny, nested or mistyped one."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Iterator
from typing import Any

from tests.service.http import GOOD_CONTROLLER

HUGE = 10**400
HOSTILE: tuple[Any, ...] = (
    HUGE, -HUGE, 10**4000, 2**63, 2**64, 1e308, -1e308, 5e-324, -5e-324, 1e150, float("nan"), float("inf"),
    float("-inf"), True, None, "", "x" * 10_000, "\x00", [], [[]], {}, [1e308] * 3, [[1e308, 5e-324]],
    [5e-324] * 30, [1.0] * 20_000, [[1.0] * 150] * 150, [0.0, [0.0, [0.0, [0.0, [0.0, [0.0, [0.0]]]]]]],
    {"kind": {"kind": {"kind": {}}}}, "1" * 5000,
)  # fmt: skip
AXIS = {"axis": "x"}
BODIES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("/mode", {"mode": "off"}),
    ("/setpoint", AXIS | {"value": 1.0}),
    ("/waveform", AXIS | {"samples": [0.0, 1.0], "hold_ticks": 2, "repeat": False}),
    ("/reference", AXIS | {"reference": {"kind": "hold", "value": 1.0}}),
    ("/reference", AXIS | {"reference": {"kind": "steps", "levels": [1.0, 2.0], "dwell_s": 0.1, "repeat": True}}),
    ("/reference", AXIS | {"reference": {"kind": "sine", "amplitude": 1.0, "frequency_hz": 1.0, "phase_deg": 5.0}}),
    ("/reference", AXIS | {"reference": {"kind": "chirp", "amplitude": 1.0, "start_hz": 1.0, "end_hz": 9.0,
                                         "duration_s": 2.0, "offset": 0.0, "logarithmic": True}}),
    ("/reference", AXIS | {"reference": {"kind": "input", "channel": "adc0", "per_v": 1.0, "offset": 0.0}}),
    ("/reference", AXIS | {"reference": {"kind": "table", "file": "wave.csv", "hold_ticks": 1, "repeat": True}}),
    ("/tune", AXIS | {"section": "controller", "values": {"gain": 0.016, "prewarp_hz": 50.0, "tracking_s": 0.001}}),
    ("/tune", AXIS | {"section": "limits", "values": {"drive_v": 9.0, "bump_s": 0.02, "command_um": 42.0}}),
    ("/tune", AXIS | {"section": "interlocks", "values": {"position_um": 60.0, "frozen_ticks": 2000,
                                                          "swing_ticks": 25, "late_us": 1000.0}}),
    ("/tune", AXIS | {"section": "prefilter", "values": {"taps": [1.0], "sections": [[1.0, 0.0, 0.0, 0.1, 0.1]]}}),
    ("/tune", AXIS | {"section": "model", "values": {"gain": 4.3, "delay_ticks": 1}}),
    ("/controller", AXIS | {"controller": GOOD_CONTROLLER | {"prewarp_hz": 20.0}}),
    ("/controller", AXIS | {"controller": {"form": "transfer_function", "numerator": [60.0], "method": "foh",
                                           "denominator": [1.0, 0.5]}}),
    ("/controller", AXIS | {"controller": {"form": "state_space", "a": [[-0.5]], "b": [1.0], "c": [60.0], "d": 0.0,
                                           "method": "zoh"}}),
)  # fmt: skip
"""Path and body of valid requests."""
EXPENSIVE = {"/controller": {"axis": "x", "controller": {"form": "state_space", "d": 0.0, "b": [1.0] * 600,
                                                         "c": [1.0] * 600, "a": [[0.5] * 600] * 600}}}  # fmt: skip
"""Path and body of a request within the size limit whose controller of order 600 would take minutes to build."""


def hostile_requests(seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield path and JSON body of `count` hostile requests; equal seeds give equal requests."""
    generator = random.Random(seed)
    for _ in range(count):
        path, body = generator.choice(BODIES)
        place = generator.choice([place for place in _places(body) if place])
        yield path, json.dumps(_replace(body, place, generator.choice(HOSTILE))).encode()


def requests_with_each_value(values: tuple[Any, ...]) -> Iterator[tuple[str, bytes]]:
    """Yield path and JSON body of each valid request with each of `values` at each key path of the body."""
    for path, body in BODIES:
        for place in _places(body):
            for value in values if place else ():
                yield path, json.dumps(_replace(body, place, value)).encode()


def _places(node: Any, parent: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the key path of `node` and of every node below it; `parent` is the key path of `node` itself."""
    yield parent
    if isinstance(node, dict | list):
        for key in node if isinstance(node, dict) else range(len(node)):
            yield from _places(node[key], (*parent, key))


def _replace(body: Any, place: tuple[Any, ...], value: Any) -> Any:
    """Return a copy of `body` with `value` at the key path `place`."""
    changed = node = copy.deepcopy(body)
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = value
    return changed
