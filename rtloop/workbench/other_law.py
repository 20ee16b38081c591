"""Another law on a recording: on the recorded inputs, or in closed loop with a simulated rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtloop.configuration.file import Configuration, parse
from rtloop.configuration.laws import Library
from rtloop.configuration.prepare import prepare
from rtloop.configuration.text_files import read_text
from rtloop.drivers.base import Driver
from rtloop.drivers.registry import driver_class
from rtloop.errors import ConfigError
from rtloop.laws.helpers import read_helpers
from rtloop.laws.limited.trial import try_limited
from rtloop.laws.registry import LawReference, laws_in
from rtloop.recording.errors import RecordingError
from rtloop.recording.file.run_readers import ReportTicks
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.law_comparison import LawWithCoefficients, compare_law, recorded_law, resimulate
from rtloop.recording.replay.laws import NO_TRUST, TrustedLaws, recorded_laws, require_law
from rtloop.workbench.arguments import FileName, load_configuration


def replay_with_other_law(
    files: Sequence[Path], config: FileName | Configuration, progress: ReportTicks | None = None
) -> dict[str, object]:
    """Compare the recorded outputs with the outputs of the law in `config` on the recorded inputs, from rest.

    Returns {recording, config, ticks, problems, signals: {name: {max, at_tick, rms}}, trip}: `max` and `rms` are those
    of |difference|, in the signal's unit; `trip` is {tick, causes} of the first trip of the law, or None. `progress`
    receives the number of ticks so far. The schedule of `config` is ignored. Raises RecordingError, InputFileError for
    a configuration that cannot be read, ConfigError for one that is invalid or has other axes or another rate than the
    recording, DriverError if the library of its driver is missing.
    """
    recording, configuration = _load_recording(files), load_configuration(config, "replay")
    differences = compare_law(recording, _configured_law(configuration, recording), progress)
    return {"recording": str(recording.paths[0]), "config": configuration.source, **differences}


def replay_on_the_rig(
    files: Sequence[Path],
    config: FileName | Configuration | None,
    progress: ReportTicks | None = None,
    trust: TrustedLaws | None = None,
) -> dict[str, object]:
    """Run the recorded reference through law and simulated rig of `config`; None: of the recorded configuration.

    Returns {recording, config (None: the recorded one), ticks, problems, trips: {recorded, resimulated}, axes: [{name,
    recorded, resimulated}, …]}: `trips` are the first trips {tick, causes} or None, `axes` the tracking figures of
    both runs. `progress` receives the number of ticks so far.
    `trust` names recorded laws that may run; None: none but installed ones. Raises RecordingError, also for a recorded
    law that is not trusted; InputFileError for a configuration that cannot be read; ConfigError for one that is
    invalid, has other axes or another rate than the recording, or has another driver than the simulated rig.
    """
    recording, trust = _load_recording(files), trust or NO_TRUST
    path = recording.paths[0]
    if config is None:
        library = _recorded_library(recording, trust)
        source = f"configuration in {path}"
        configuration = parse(recording.configuration, path.stem, path.parent, source, library)
        driver, law = _make_rig(configuration, recording), recorded_law(recording, trust)
    else:
        configuration = load_configuration(config, "replay")
        driver, law = _make_rig(configuration, recording), _configured_law(configuration, recording)
    figures = resimulate(recording, law, driver, progress)
    return {"recording": str(path), "config": None if config is None else configuration.source, **figures}


def make_trust(files: Sequence[Path], trusts_recorded: bool) -> TrustedLaws:
    """Return the laws whose code a replay may run: those in `files`, with `trusts_recorded` also the recorded ones.

    The files run first in the limited process, which is killed if a law does not return. A file without a law adds
    none. Raises InputFileError for an unreadable file, RecordingError for one that cannot be run or has a mistake in a
    law, ConfigError for a law that does not end, ends the process, prints too much, leaves a thread or process, or
    closes or replaces a standard stream.
    """
    laws: list[LawReference] = []
    for path in files:
        file, text = str(path), read_text(path)
        try:
            helpers = read_helpers(text, file)
            try_limited(file, laws_in, text, file, helpers)
            laws += laws_in(text, file, helpers)
        except ValueError as error:
            raise RecordingError(str(error)) from None
    return TrustedLaws(tuple(laws), trusts_recorded)


def _load_recording(files: Sequence[Path]) -> Recording:
    """Load a recording. Raises RecordingError if it is unreadable, or has no law, as an import."""
    recording = load(files)
    require_law(recording)
    return recording


def _recorded_library(recording: Recording, trust: TrustedLaws) -> Library:
    """Return a library of the recorded laws, under the file names in the configuration.

    Raises RecordingError for a law that is neither installed nor trusted.
    """
    laws = recorded_laws(recording, trust)
    files = {law["name"]: str(law["file"]) for law in recording.header["law"].get("laws", ()) if "file" in law}
    folder = Path(str(recording.header.get("folder", "")))
    return Library(folder, tuple(replace(law, file=files.get(law.kind, law.file)) for law in laws))


def _configured_law(configuration: Configuration, recording: Recording) -> LawWithCoefficients:
    """Return the law of a configuration, with its coefficients.

    Raises ConfigError if it is invalid, or its axes or rate differ from the recording's; DriverError if its driver's
    library is missing.
    """
    header, faults = recording.header, []
    names = [axis.name for axis in configuration.axes]
    if names != header["axes"]:
        faults.append(f"axis: value is {', '.join(names)}; allowed: the recording's axes, {', '.join(header['axes'])}")
    if configuration.loop.rate_hz != header["rate_hz"]:
        faults.append(
            f"loop.rate_hz: value is {configuration.loop.rate_hz:g} Hz; allowed: the recording's rate, "
            f"{header['rate_hz']:g} Hz"
        )
    if faults:
        raise ConfigError(configuration.source, faults)
    plan = prepare(replace(configuration, schedule=())).plan
    return LawWithCoefficients(plan.laws, plan.coefficients.view(np.recarray))


def _make_rig(configuration: Configuration, recording: Recording) -> Driver:
    """Return the simulated rig of a configuration, not opened, at the recording's rate.

    Raises ConfigError for a driver of another kind and for invalid options.
    """
    if configuration.driver_kind != "sim":
        fault = (
            f"driver.kind: value is {configuration.driver_kind!r}; allowed with --resimulate: 'sim', the simulated rig"
        )
        raise ConfigError(configuration.source, [fault])
    try:
        kind = driver_class(configuration.driver_kind)
        return kind(configuration.driver_options, configuration.wiring, recording.header["rate_hz"])
    except ValueError as error:
        raise ConfigError(configuration.source, [f"driver.{error}"]) from None
