"""Closed-loop response computed from a recording, in the form of a measurement on a running loop."""

from __future__ import annotations

import tomllib
from contextlib import suppress
from pathlib import Path

from rtloop.analysis.measured.measurement import SIGNALS, TICK_DRIVEN, LoopMeasurement, measure_loop
from rtloop.analysis.perturbation import resonance_hz
from rtloop.configuration.axis import AxisOptions
from rtloop.configuration.checks import loop_delay_ticks, promised_loop
from rtloop.design.identification.axis_recording import UnsuitableData, select_axis
from rtloop.drivers.base import Wiring
from rtloop.drivers.errors import DriverError
from rtloop.drivers.registry import driver_class
from rtloop.foundation.arrays import Real
from rtloop.recording.load import Recording, load


def recorded_measurement(path: Path, axis: str | None = None, near_hz: float | None = None) -> LoopMeasurement:
    """Measure a closed loop's response in a recording, from the longest multisine in the reference of an axis (None:
    the only one).

    The model comes from the recorded configuration; a user's law has no model. The lightly damped mode is searched near
    `near_hz`; None means near the model's resonance, or without one where the plant's response is largest. Raises
    RecordingError for a bad file and as `select_axis`; UnsuitableData for an imported recording and for signals that
    `measure_loop` refuses.
    """
    recording = load(path)
    if "imported" in recording.header:
        raise UnsuitableData(
            f"{path}: an imported recording has no configuration of its closed loop, which a response needs; use "
            "`rtloop identify hysteresis` or `rtloop identify dynamics`"
        )
    axis = select_axis(recording, axis, path)
    rate_hz = float(recording.header["rate_hz"])
    names = {name: f"{axis}_{name}" for name in SIGNALS}
    if recording.header["driver"]["kind"] != TICK_DRIVEN:
        names["periods_missed"] = "periods_missed"
    if f"{axis}_feed_um" in recording:
        names["feed_um"] = f"{axis}_feed_um"
    # all in one pass: a recording may still be growing
    signals: dict[str, Real] = dict(zip(names, recording.read(*names.values()), strict=True))
    configuration = tomllib.loads(recording.configuration)
    axis_table = next(table for table in configuration["axis"] if table["name"] == axis)
    model, model_resonance, taps = None, None, axis_table.get("prefilter", {}).get("command_taps", ())
    with suppress(ValueError):  # the recording has no linearisation of a user's law
        options = AxisOptions.model_validate(axis_table)
        model = promised_loop(options, rate_hz, loop_delay_ticks(options.model, recorded_driver_delay_ticks(recording)))
        model_resonance = options.model and resonance_hz(options.model.transfer())
    near_hz = near_hz or (model_resonance[0] if model_resonance else None)
    try:
        return measure_loop(signals, rate_hz, near_hz, model, taps)
    except ValueError as fault:
        raise UnsuitableData(f"{path}: {fault}") from None


def recorded_driver_delay_ticks(recording: Recording) -> int:
    """Return the ticks of delay that the driver of a recording adds.

    0 for a driver that is not installed here or refuses the recorded options.
    """
    table = tomllib.loads(recording.configuration)["driver"]
    kind, channels = table.pop("kind"), table.pop("channels", {})
    if kind == TICK_DRIVEN:
        return int(table.get("latency_ticks", 0))
    wiring = {axis: Wiring(channel["input"], channel["output"]) for axis, channel in channels.items()}
    try:
        driver = driver_class(kind)
        return driver(
            driver.options_model.model_validate(table), wiring, float(recording.header["rate_hz"])
        ).facts.delay_ticks
    except (DriverError, ValueError, KeyError):
        return 0
