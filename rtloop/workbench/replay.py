"""`rtloop.replay`: execute a recording again and compare every output, or run another law on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, overload

from rtloop.recording.file.run_readers import RecordingPaths, ReportTicks
from rtloop.recording.load import Recording, load
from rtloop.recording.replay.laws import NO_TRUST
from rtloop.recording.replay.spans import replay_on_cores
from rtloop.workbench.arguments import FileName, as_paths, recording_paths, require_count
from rtloop.workbench.replay_results import LawComparison, ReplayResult, Resimulation

if TYPE_CHECKING:
    from rtloop.configuration.file import Configuration


@overload
def replay(
    recording: Recording | RecordingPaths,
    *,
    config: None = None,
    resimulate: Literal[False] = False,
    law: FileName | Sequence[FileName] = (),
    trust_recorded_law: bool = False,
    jobs: int = 1,
    progress: ReportTicks | None = None,
) -> ReplayResult: ...
@overload
def replay(
    recording: Recording | RecordingPaths,
    *,
    config: FileName | Configuration,
    resimulate: Literal[False] = False,
    law: FileName | Sequence[FileName] = (),
    trust_recorded_law: bool = False,
    jobs: int = 1,
    progress: ReportTicks | None = None,
) -> LawComparison: ...
@overload
def replay(
    recording: Recording | RecordingPaths,
    *,
    config: FileName | Configuration | None = None,
    resimulate: Literal[True],
    law: FileName | Sequence[FileName] = (),
    trust_recorded_law: bool = False,
    jobs: int = 1,
    progress: ReportTicks | None = None,
) -> Resimulation: ...
@overload
def replay(
    recording: Recording | RecordingPaths,
    *,
    config: FileName | Configuration | None = None,
    resimulate: bool = False,
    law: FileName | Sequence[FileName] = (),
    trust_recorded_law: bool = False,
    jobs: int = 1,
    progress: ReportTicks | None = None,
) -> ReplayResult | LawComparison | Resimulation: ...
def replay(
    recording: Recording | RecordingPaths,
    *,
    config: FileName | Configuration | None = None,
    resimulate: bool = False,
    law: FileName | Sequence[FileName] = (),
    trust_recorded_law: bool = False,
    jobs: int = 1,
    progress: ReportTicks | None = None,
) -> ReplayResult | LawComparison | Resimulation:
    """Execute a recording again and compare every output of every tick, byte by byte; return a ReplayResult.

    With `config`, run the law of this configuration on the recorded inputs, from rest; return a LawComparison. With
    `resimulate`, run the recorded reference in closed loop with the simulated rig of `config`, or the recorded one;
    return a Resimulation. `law` are files with recorded laws that are not installed; `trust_recorded_law` runs the
    recorded text of laws. `jobs` processes replay at once, as forks of this process; the other two results use one.
    `progress` receives the number of ticks so far. Raises RecordingError for a recording that cannot be replayed,
    ConfigError for a configuration that does not fit, InputFileError for a file that cannot be read, DriverError if the
    library of the configuration's driver is missing.

    >>> result = rtloop.replay("run.mcap")
    >>> result.identical, result.ticks, result.first_difference
    (True, 7000, None)
    """
    require_count(jobs, "replay: jobs", 1)
    files, law_files = recording_paths(recording, "replay: recording"), as_paths(law, "replay: law")
    trust = NO_TRUST
    if law_files or trust_recorded_law or resimulate or config is not None:  # A usual replay needs no configuration.
        from rtloop.workbench.other_law import make_trust, replay_on_the_rig, replay_with_other_law

        trust = make_trust(law_files, trust_recorded_law)
        if resimulate:
            return Resimulation(replay_on_the_rig(files, config, progress, trust))
        if config is not None:
            return LawComparison(replay_with_other_law(files, config, progress))
    loaded = load(files)
    return ReplayResult(files[0], loaded, replay_on_cores(loaded, progress, trust, jobs))
