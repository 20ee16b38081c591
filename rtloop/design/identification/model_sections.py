"""Identified models as sections of a configuration, with where they come from, and back."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from pydantic import ValidationError

from rtloop.configuration.axis import ModelOptions
from rtloop.configuration.file import describe
from rtloop.configuration.text_files import parse_toml, read_text
from rtloop.design.identification.axis_recording import AxisRecording, UnsuitableData
from rtloop.design.identification.dynamics.dynamics_fit import DynamicsFit
from rtloop.design.identification.hysteresis.recording_set import HysteresisFit
from rtloop.design.toml_text import write_section, zpk_values
from rtloop.errors import ConfigError, OutputError
from rtloop.foundation.options import Options
from rtloop.foundation.trusted import make_file
from rtloop.hysteresis.play_model import PlayModel
from rtloop.laws.shipped.options import PrandtlIshlinskiiOptions
from rtloop.recording.errors import RecordingError
from rtloop.values import count_text
from rtloop.version import __version__

SAMPLED_TOGETHER = "because drive and position of a row count as sampled at the same time"
"""Reason for the delay that dynamics from an imported recording have."""
Section = TypeVar("Section", bound=Options)


def feedforward_section(model: PlayModel, comments: Sequence[str]) -> str:
    """Return [axis.feedforward] as TOML below `comments`, lines without #.

    Raises UnsuitableData for weights without an inverse.
    """
    return write_section("axis.feedforward", feedforward_values(model), comments)


def feedforward_values(model: PlayModel) -> dict[str, list[float]]:
    """Return [axis.feedforward] as {"thresholds_v", "weights_um_per_v"}, two lists of numbers.

    Raises UnsuitableData for weights that have no inverse.
    """
    try:
        model.remove_dead_band().inverse()
    except ValueError as fault:
        raise UnsuitableData(f"{fault}; use --weights invertible, or fewer --operators") from None
    return {"thresholds_v": model.thresholds.tolist(), "weights_um_per_v": model.weights.tolist()}


def model_section(fit: DynamicsFit, comment_lines: Sequence[str]) -> str:
    """Return [axis.model] as TOML below `comment_lines`, without #: zeros, poles, gain and delay."""
    return write_section("axis.model", model_values(fit), comment_lines)


def model_values(fit: DynamicsFit) -> dict[str, object]:
    """Return [axis.model] as {"form": "zpk", "gain", "zeros", "poles", "delay_ticks"}, each root in rad/s as a pair
    [real, imaginary].
    """
    return {**zpk_values(fit.transfer), "delay_ticks": fit.delay_ticks}


def hysteresis_provenance(fit: HysteresisFit, runs: Sequence[AxisRecording]) -> list[str]:
    """Return three comment lines, without #, on the origin of the hysteresis model: recordings, plays, errors."""
    return [
        f"Hysteresis, identified by rtloop {__version__} from {describe_sources(runs)}",
        f"{fit.model.thresholds.size} play operators (thresholds: {fit.placement}, weights: {fit.weights}); "
        f"drive up to {fit.drive_v:.6g} V",
        f"error {fit.rms_error_um:.3g} µm rms, at most {100 * fit.max_error_um / fit.range_um:.3g} % of the range of "
        f"{fit.range_um:.4g} µm; loop height over range h/H: measured {fit.measured_loop.percent:.2f} %, model "
        f"{fit.model_loop.percent:.2f} %",
    ]


def dynamics_provenance(fit: DynamicsFit, run: AxisRecording, input_kind: str) -> list[str]:
    """Return four comment lines, without #, on the origin of the dynamics: recording, fit, modes, static gain.

    `input_kind` is the input of the identification: "hysteresis", "command" or "drive".
    """
    modes = (
        f"{mode.frequency_hz:.2f} ± {mode.frequency_std_hz:.2g} Hz (1σ; ζ {mode.damping:.5f})"
        if math.isfinite(mode.frequency_std_hz)
        else "a mode that decays within one sample"
        for mode in fit.modes
    )
    return [
        f"Dynamics, identified by rtloop {__version__} from {describe_sources([run])}, input: {input_kind}",
        f"{fit.method}: order {fit.model.order} at {1 / run.period_s:g} Hz, prediction error "
        f"one step ahead {fit.rms_error_um:.3g} µm rms, fit {fit.fit_percent:.2f} %",
        f"modes: {', '.join(modes)}; behind {count_text(fit.delay_ticks, 'sample')} of delay"
        + (f", {SAMPLED_TOGETHER}" if run.is_sampled_together else ""),
        f"normalised to D(0) = 1; {static_gain_text(fit.static_gain, input_kind)}",
    ]


def static_gain_text(gain: float, input_kind: str, spread: str = "") -> str:
    """Return a clause with the static gain of the dynamics, and its place in a configuration.

    The place depends on the input of the identification, `input_kind`: "hysteresis", "command" or "drive". With "drive"
    and a gain not above 0, the clause tells to change a sign. `spread` follows the number, such as " ± 0.1 (1σ)".
    """
    number = f"the identified static gain of {gain:.6g}{spread}"
    if input_kind == "hysteresis":
        return f"{number} is already included in the weights of the hysteresis"
    if input_kind == "command":
        return f"multiply weights_um_per_v of [axis.feedforward] by {number}"
    if gain <= 0:
        return f"{number} µm/V is negative: change the sign of the channel's um_per_v"
    return f"{number} µm/V is the only weight of [axis.feedforward], which then has no hysteresis"


def left_out_text(frequencies_hz: Sequence[float]) -> str:
    """Return a sentence on modes that were left out of the dynamics (`DynamicsFit.left_out_hz`)."""
    modes = ", ".join(f"{frequency_hz:.3g} Hz" for frequency_hz in frequencies_hz)
    return (
        f"left out of the model: {count_text(len(frequencies_hz), 'mode')} at {modes}, whose poles this recording does "
        "not tell from zeros; hysteresis or creep that the model of the actuator lacks is the likely cause"
    )


def proportional_actuator(gain_um_per_v: float) -> PlayModel | None:
    """Return an actuator without hysteresis, a play of threshold 0; None for a gain that is not above 0."""
    return PlayModel(np.zeros(1), np.array([gain_um_per_v])) if gain_um_per_v > 0 else None


def describe_sources(runs: Sequence[AxisRecording]) -> str:
    """Return the file names of recordings, each with the first 16 digits of its SHA-256, as text."""
    return ", ".join(f"{Path(run.name).name} (SHA-256 {run.digest[:16]}…)" for run in runs)


def scale_hysteresis(model: PlayModel, gain: float) -> PlayModel:
    """Return the hysteresis with its weights times `gain`, the static gain of the dynamics, so that D(0) can be 1."""
    return PlayModel(model.thresholds, gain * model.weights)


class PlantSections(NamedTuple):
    """Sections of an axis in a file: its dynamics, and the actuator's hysteresis, None where the file has none."""

    model: ModelOptions
    feedforward: PrandtlIshlinskiiOptions | None


def read_identified(path: Path, axis: str | None = None) -> PlantSections:
    """Read [axis.model] and [axis.feedforward] (None where there is none) from a file: one that `rtloop identify`
    wrote, or a configuration, of its axis `axis` (None: first).

    Raises InputFileError for a file that cannot be read; ConfigError for text that is no TOML, a missing axis or
    [axis.model], and invalid options.
    """
    source, table = str(path), _axis_table(read_text(path), str(path), axis)
    if "model" not in table:
        raise _missing_section(source, "model", axis)
    feedforward = _validated(PrandtlIshlinskiiOptions, table, "feedforward", source) if "feedforward" in table else None
    return PlantSections(_validated(ModelOptions, table, "model", source), feedforward)


def read_feedforward(path: Path, axis: str | None = None) -> PrandtlIshlinskiiOptions:
    """Read [axis.feedforward] from a file: an identified section, or axis `axis` (None: first) of a configuration.

    Raises RecordingError for a file that cannot be read, ConfigError like `parse_feedforward`.
    """
    return parse_feedforward(read_text(path, RecordingError), str(path), axis)


def parse_feedforward(content: str, source: str, axis: str | None = None) -> PrandtlIshlinskiiOptions:
    """Read [axis.feedforward] from TOML text, as `read_feedforward` does from a file; `source` names it in errors.

    Raises ConfigError for text that is no TOML, a missing axis or section, and invalid options.
    """
    table = _axis_table(content, source, axis)
    if "feedforward" not in table:
        raise _missing_section(source, "feedforward", axis)
    return _validated(PrandtlIshlinskiiOptions, table, "feedforward", source)


def _axis_table(content: str, source: str, axis: str | None) -> dict[str, object]:
    """Return the table of an axis in TOML text: [axis], whatever `axis` is, or, from a list [[axis]], the table with
    the name `axis` (None: the first); {} if there is none.

    Raises ConfigError for text that is no TOML.
    """
    try:
        table: object = parse_toml(content).get("axis")
    except ValueError as error:
        raise ConfigError(source, [str(error)]) from None
    if isinstance(table, list):
        table = next((entry for entry in table if isinstance(entry, dict) and axis in (None, entry.get("name"))), None)
    return table if isinstance(table, dict) else {}


def _missing_section(source: str, section: str, axis: str | None) -> ConfigError:
    """Return the error for a file `source` without [axis.`section`]."""
    return ConfigError(
        source, [f"axis.{section}: missing{f' for axis {axis!r}' if axis else ''}; this section is required"]
    )


def _validated(model: type[Section], table: Mapping[str, object], section: str, source: str) -> Section:
    """Return `table[section]`, which must exist, as options of the class `model`.

    Raises ConfigError, which names the file `source`, for invalid options.
    """
    try:
        return model.model_validate(table[section])
    except ValidationError as error:
        raise ConfigError(source, describe(error, f"axis.{section}", table[section])) from None


def require_new(path: Path | None) -> None:
    """Raise OutputError if `path` exists; None means that no file is to be written.

    A command calls this before its computation, so that no result is lost.
    """
    if path is not None and os.path.lexists(path):
        raise OutputError(f"{path}: exists already and is not overwritten; use another name, or remove the file")


def write_new_file(path: Path, content: str) -> None:
    """Write a text file under a temporary name and rename it to `path`, so that `path` is complete or does not exist.

    Raises OutputError if `path` exists, with nothing written, or cannot be written.
    """
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        require_new(path)
        with os.fdopen(make_file(part), "w", encoding="utf-8") as file:
            file.write(content)
        os.replace(part, path)
    except OSError as error:
        with suppress(OSError):
            os.unlink(part)
        raise OutputError(f"{path}: {error.strerror or error}") from None
