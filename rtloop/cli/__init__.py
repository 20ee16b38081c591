"""The command line: one file a command, with its options, its work and its printing.

Commands import numpy and the rooms below inside their functions, so that `rtloop --help` stays quick; they may import
every room. Shared options are in `options`, errors and exit codes in `exit_codes`, tables, progress and files in
`output`. Begin reading with `run`.
"""

from __future__ import annotations

import gc
import os

import click

from rtloop.cli import (
    archive,
    auto,
    campaign,
    campaign_compare,
    campaign_search,
    check,
    compensation,
    ctl,
    demo,
    design,
    doctor,
    drivers,
    dynamics,
    epics,
    experiment,
    export,
    identify,
    import_file,
    info,
    init,
    laws,
    learn,
    panel,
    recover,
    replay,
    response,
    retune,
    robust,
    run,
    schema,
    service,
    verify,
)
from rtloop.cli.program import Program
from rtloop.foundation.heap import keep_freed_memory
from rtloop.version import __version__

GARBAGE_AFTER = 100_000
"""New objects before garbage is looked for. A start makes hundreds of thousands and hardly any garbage: looking at
every 700 took a fifth of it."""
# matrices here have tens of rows: a library's threads wait for each other longer than they compute, on the loop's cores
if not os.environ.get("OPENBLAS_NUM_THREADS", "").isdigit():
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
# pydantic would read the metadata of all installed packages, in each process, for plug-ins that no option needs
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")


@click.group(cls=Program, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="rtloop")
def main() -> None:
    """Close a hard, fast control loop from Python, and record every tick so that the run can be verified.

    \b
    Start here:
      rtloop demo                          a loop in the browser; needs no file
      rtloop init                          files to begin with, in this folder
      rtloop check paper.toml              what would run, its margins, its limits
      rtloop run paper.toml --duration 10  run it on the simulated rig, and record it
      rtloop info recordings/FILE.mcap     what a recording holds

    Exit codes: 0 good; 1 fault, trip, loss or difference; 2 usage; 66 input file; 69 hardware or service not
    available; 73 cannot write; 77 refused by the host; 78 configuration.
    """
    gc.set_threshold(GARBAGE_AFTER)
    keep_freed_memory()


for _group, _commands in (
    (main, (run.run, check.check, drivers.drivers, laws.laws, laws.law, doctor.doctor, info.info, replay.replay)),
    (main, (recover.cut, recover.recover, export.export, export.plot, import_file.import_command)),
    (main, (service.serve, service.park, service.hil, ctl.ctl, panel.panel, epics.epics)),
    (main, (experiment.experiment, campaign.campaign, archive.archive)),
    (main, (identify.identify, design.design)),
    (main, (init.init, demo.demo, schema.schema)),
    (campaign.campaign, (campaign_search.search, campaign_search.boundary, campaign_compare.compare)),
    (ctl.ctl, (learn.learn, retune.retune, response.service_response, response.service_resonance)),
    (identify.identify, (dynamics.dynamics, response.recording_response, response.recording_resonance)),
    (design.design, (verify.verify, robust.robust, robust.shape, compensation.compensation, auto.auto)),
):
    for _command in _commands:
        _group.add_command(_command)
