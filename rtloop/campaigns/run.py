"""`rtloop.campaign`: a campaign from Python, and the run that the command line shares."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rtloop.campaigns.campaign_file import Campaign, load_campaign
from rtloop.campaigns.case import NOMINAL, CaseRunner
from rtloop.campaigns.coordinator import Coordinator, Progress
from rtloop.campaigns.recorded_case import record_rig
from rtloop.campaigns.store import arrow, open_store, read_columns, read_tables
from rtloop.campaigns.summary import summarise_campaign
from rtloop.campaigns.unit import split_into_units
from rtloop.campaigns.workers import DaskWorkers, ProcessWorkers, Workers

if TYPE_CHECKING:
    from distributed import Client


def campaign(
    file: str | Path,
    *,
    configuration: str | Path | None = None,
    out: str | Path | None = None,
    rigs: int | None = None,
    jobs: int | None = None,
    scheduler: str | Client | None = None,
) -> Any:
    """Run a campaign, record its worst rigs, and return its results: a row for each rig by rising number.

    The nominal rig has the number 0; recordings are in the folder `worst` of `out`. The results are a DataFrame of
    pandas, or without pandas a dict of arrays (rigs,) by column: rig, status, missed, ratio, the seed and the values of
    the keys, the figures, and the causes of each experiment's trip.

    `file` is a CAMPAIGN.toml, `configuration` replaces its configuration, `rigs` its number of rigs. Results that `out`
    (campaigns/NAME by default) has already are not run again. `jobs` worker processes (None: one for each processor)
    run the rigs, or the workers of `scheduler`, an address or a `dask.distributed.Client`. A script that calls this
    function must do so below `if __name__ == "__main__":`, because worker processes import it. Raises ConfigError,
    InputFileError and RecordingError for the files that it reads, OutputError, MissingExtra without pyarrow or dask,
    UnavailableError for a folder in use and a scheduler that cannot be used, OtherVersion for workers with other
    packages, LoopFault if the nominal rig kills its workers. Results that came before an error stay in `out`.
    """
    loaded = load_campaign(Path(file), rigs, None if configuration is None else Path(configuration))
    folder = default_folder(loaded) if out is None else Path(out)
    workers = ProcessWorkers(jobs) if scheduler is None else DaskWorkers(scheduler)
    try:
        run_campaign(loaded, folder, workers)
    finally:
        workers.close()
    table = arrow().concat_tables(list(read_tables(folder)))
    try:
        return table.to_pandas(use_threads=False)
    except ImportError:
        return read_columns(folder)


def run_campaign(
    campaign: Campaign,
    folder: Path,
    workers: Workers,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    is_stop_requested: Callable[[], bool] = lambda: False,
) -> bool:
    """Run the rigs of a campaign that have no result in `folder`, then record the worst ones in its folder `worst`.

    Returns whether all rigs have results; only then the worst ones are recorded: at most `keep_worst` rigs, of those
    with a ratio above 0. After a request to stop, the rigs that were submitted end and no other one starts. Raises as
    `CaseRunner`, `Store`, `Coordinator.run` and `record_rig`; results that came before stay.
    """
    runner = CaseRunner(campaign)
    with open_store(folder, campaign, runner.sample_values(NOMINAL)) as store:
        store.require_no_further_rigs()
        units = split_into_units(campaign, runner.rate_hz)
        is_complete = Coordinator(campaign, runner, store, workers).run(units, on_progress, is_stop_requested)
        if is_complete and campaign.options.keep_worst:
            for rig in summarise_campaign(folder, campaign.options.keep_worst).worst_rigs:
                if rig.ratio > 0:
                    record_rig(runner, rig.rig, folder / "worst")
    return is_complete


def default_folder(campaign: Campaign) -> Path:
    """Return the folder of a campaign's results where none is chosen: campaigns/NAME in the working directory."""
    return Path("campaigns") / campaign.name
