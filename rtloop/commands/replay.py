"""`rtloop replay`: a recording executed again, as it was or with the law and the rig of another configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.configuration import file as config
from rtloop.configuration.file import Configuration
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import prepare
from rtloop.configuration.text_files import read_text
from rtloop.drivers.base import Driver
from rtloop.drivers.registry import driver_class
from rtloop.errors import ConfigError
from rtloop.laws.limited.trial import try_limited
from rtloop.laws.registry import laws_in
from rtloop.recording.errors import RecordingError
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.law_comparison import LawWithCoefficients, compare_law, recorded_law, resimulate
from rtloop.recording.replay.laws import NO_TRUST, TrustedLaws, recorded_laws, require_law

Progress = Callable[[int], None]


def replay_with_other_law(files: Sequence[Path], other: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Differences between the recorded outputs and those of another configuration's law on the recorded inputs."""
    recording = _opened(files)
    law = _law(config.load(other), recording)
    return {**_about(recording, other), **compare_law(recording, law, progress)}


def replay_on_the_rig(
    files: Sequence[Path], other: Path | None, progress: Progress | None = None, trust: TrustedLaws = NO_TRUST
) -> dict[str, Any]:
    """The recorded reference through a law on a simulated rig: those of `other`, or the recorded ones."""
    recording = _opened(files)
    if other is None:
        path = recording.paths[0]
        library = _recorded_library(recording, trust)
        source = f"configuration in {path}"
        configuration = config.parse(recording.configuration, path.stem, path.parent, source, library)
    else:
        configuration = config.load(other)
    driver = _rig(configuration, recording)
    law = recorded_law(recording, trust) if other is None else _law(configuration, recording)
    return {**_about(recording, other), **resimulate(recording, law, driver, progress)}


def trust_in(files: Sequence[Path], recorded: bool) -> TrustedLaws:
    """What a replay may run: the laws in these files, and those in the recording itself.

    Raises RecordingError, and ConfigError for a law that does not come to an end, or ends the process.
    """
    texts = {str(path): read_text(path) for path in files}
    for file, text in texts.items():
        try_limited(file, laws_in, text, file)
    try:
        laws = [law for file, text in texts.items() for law in laws_in(text, file)]
    except ValueError as error:
        raise RecordingError(str(error)) from None
    return TrustedLaws(tuple(laws), recorded)


def _opened(files: Sequence[Path]) -> Recording:
    recording = load(files)
    require_law(recording)
    return recording


def _recorded_library(recording: Recording, trust: TrustedLaws) -> Library:
    """The recorded laws under the file names that the recorded configuration has. Raises RecordingError."""
    laws = recorded_laws(recording, trust)
    files = {law["name"]: str(law["file"]) for law in recording.header["law"].get("laws", ()) if "file" in law}
    folder = Path(str(recording.header.get("folder", "")))
    return Library(folder, tuple(changed(law, file=files.get(law.kind, law.file)) for law in laws))


def _about(recording: Recording, other: Path | None) -> dict[str, Any]:
    return {"recording": str(recording.paths[0]), "config": None if other is None else str(other)}


def _law(configuration: Configuration, recording: Recording) -> LawWithCoefficients:
    """The law of a configuration for the recording's axes and rate. Raises ConfigError."""
    header, faults = recording.header, []
    names = [axis.name for axis in configuration.axes]
    if names != header["axes"]:
        faults.append(f"axis: {', '.join(names)}; the recording has {', '.join(header['axes'])}")
    if configuration.loop.rate_hz != header["rate_hz"]:
        faults.append(f"loop.rate_hz: {configuration.loop.rate_hz:g}; the recording has {header['rate_hz']:g}")
    if faults:
        raise ConfigError(configuration.source, faults)
    plan = prepare(changed(configuration, schedule=())).plan
    return LawWithCoefficients(plan.laws, plan.coefficients.view(np.recarray))


def _rig(configuration: Configuration, recording: Recording) -> Driver:
    """The simulated rig of a configuration. Raises ConfigError where its driver is another one."""
    if configuration.driver_kind != "sim":
        fault = f"driver.kind: {configuration.driver_kind!r}; a new simulation needs the simulated rig, 'sim'"
        raise ConfigError(configuration.source, [fault])
    try:
        kind = driver_class(configuration.driver_kind)
        return kind(configuration.driver_options, configuration.wiring, recording.header["rate_hz"])
    except ValueError as error:
        raise ConfigError(configuration.source, [f"driver.{error}"]) from None
