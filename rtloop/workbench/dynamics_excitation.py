"""Input and output of the dynamics from a recording, for each kind of input."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData
from rtloop.design.identification.dynamics.beginning import refer_to_beginning, without_drift
from rtloop.design.identification.dynamics.prediction_error import Excitation
from rtloop.design.identification.dynamics.recorded_loop import RecordedLoop
from rtloop.design.identification.model_sections import parse_feedforward, read_feedforward
from rtloop.hysteresis.play_model import PlayModel
from rtloop.hysteresis.plays import model_output

Input = Literal["hysteresis", "command", "drive"]


def dynamics_excitation(
    run: AxisRecording,
    input_kind: Input,
    feedforward: PlayModel | None,
    loop: RecordedLoop | None,
    *,
    detrends: bool = False,
) -> Excitation:
    """Return the input to D and its output from a recording; `feedforward` is the actuator's model, for "hysteresis".

    The input is the recorded command for `input_kind` "command", the drive for "drive", and the drive through the model
    for "hysteresis". A closed `loop` limits input and output to its ticks in closed loop, and adds its external
    signals; None for a recording in open loop, whose input is relative to the level at which the stage rests.
    `detrends` subtracts the straight line of each signal. Raises UnsuitableData for ticks that are missing or late
    and, for "command", if the command was not recorded or a limit or ramp changed it in a closed loop.
    """
    if not run.is_even:
        raise UnsuitableData(
            f"{run.name}: ticks are missing or late by a period; dynamics need samples at equal intervals. Record "
            "again with --unpaced or with real-time scheduling"
        )
    if input_kind == "command" and np.isnan(run.command_um).all():
        raise UnsuitableData(
            f"{run.name}: the recording has no command signal; use --input drive or --input hysteresis"
        )
    signal = run.command_um if input_kind == "command" else run.drive_v
    if feedforward is not None:
        signal = model_output(feedforward, run.drive_v)
    full_excitation = Excitation(run.name, signal, run.position_um, run.period_s)
    if loop is None:
        excitation = refer_to_beginning(full_excitation, begins_at_0=not run.is_imported)
    else:
        if input_kind == "command":
            loop.require_commands_obeyed(run.name)
        excitation = loop.excitation(full_excitation)
    return without_drift(excitation) if detrends else excitation


def load_actuator(run: AxisRecording, hysteresis: Path | None, axis: str | None) -> PlayModel:
    """Return the actuator's model from the file `hysteresis`, or for None from the recorded configuration.

    `axis` names one of several axes; None: the first. Raises UnsuitableData for an imported recording if `hysteresis`
    is None, RecordingError for a file that cannot be read, ConfigError if [axis.feedforward] is missing or invalid.
    """
    if hysteresis is not None:
        return read_feedforward(hysteresis, axis).actuator()
    if not run.configuration:
        raise UnsuitableData(
            f"{run.name}: an imported recording has no model of the hysteresis; use --hysteresis FILE, or --input "
            "drive to take the drive as the input, without hysteresis"
        )
    return parse_feedforward(run.configuration, f"{run.name}: configuration", axis).actuator()
