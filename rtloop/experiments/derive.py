"""Configuration of one run: the base with another schedule, and in its first line a description of the run.

The line is a comment to the configuration's reader and JSON to `read_metadata`: a recording, which holds the text under
a checksum, can be analysed from itself alone.
"""

from __future__ import annotations

import copy
import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtloop.configuration.file import Configuration, parse
from rtloop.design.toml_text import write_section
from rtloop.errors import output_errors
from rtloop.experiments.timeline import Run, hold
from rtloop.foundation.trusted import overwrite_file

METADATA_PREFIX = "rtloop experiment "


def derive_configuration(
    base: Configuration, axis: str, experiment: str, parameters: Mapping[str, object], run: Run, run_count: int,
    specification: Mapping[str, object], is_comparison: bool = False, reductions: Sequence[str] = (),
) -> Configuration:  # fmt: skip
    """Return a configuration made from `base` that executes `run`: modes, references of `axis`, changes of its plant.

    The run's schedule replaces the schedule of `base`; all other axes hold the reference 0. The first line of the
    returned configuration's text is the description that `read_metadata` returns: among others the name of the
    `experiment`, its `parameters`, the number of its runs (`run_count`) and the axis's `specification`.
    `is_comparison`: the run belongs to the second configuration (`--beside`). `reductions` has a text for each default
    that a limit reduced. Raises ConfigError if the result is no valid configuration, for example because of an
    unsuitable plant.
    """
    raw = tomllib.loads(base.text)
    first_segment, timeline = run.timeline.segments[0], run.timeline
    raw["loop"]["mode"] = first_segment.mode
    raw["schedule"] = timeline.schedule(axis)
    for axis_table in raw["axis"]:
        axis_table["reference"] = dict(timeline.references[0] if axis_table["name"] == axis else hold(0.0))
    if run.plant:
        _change_plant(raw["driver"], axis, run.plant)
    metadata = {
        "name": experiment,
        "run": run.label,
        "runs": run_count,
        "axis": axis,
        "may_trip": run.may_trip,
        "ticks": timeline.ticks,
        "middle_um": timeline.middle.um,
        "parameters": parameters,
        "asked": specification,
        "beside": is_comparison,
        "reduced": list(reductions),
        "segments": timeline.segments,
    }
    name = "-".join(filter(None, [base.name, experiment, _file_name(run.label)]))
    text = write_section(
        "", raw, [METADATA_PREFIX + json.dumps(metadata, allow_nan=False), f"derived from {base.name}"]
    )
    return parse(text, name, base.folder, f"{base.name}, experiment {experiment}")


def store_tables(run: Run, folder: Path) -> None:
    """Write the tables of samples that a run plays to `folder` as npy files, named as in `run.tables`.

    The run's references to these tables are changed in place: they name the files by absolute path. A missing folder is
    made, existing files are overwritten. Raises OutputError if a file cannot be written.
    """
    for name, samples in run.tables.items():
        with output_errors(folder / name):
            folder.mkdir(parents=True, exist_ok=True)
            with os.fdopen(overwrite_file(folder / name), "wb") as file:
                np.save(file, samples)
    references = run.timeline.references
    references[:] = [
        {**reference, "file": str((folder / reference["file"]).resolve())}
        if reference.get("file") in run.tables
        else reference
        for reference in references
    ]


def read_metadata(configuration: str) -> dict[str, Any] | None:
    """Return the description of an experiment's run from the first line of a configuration's text; None without one.

    Unchecked keys, as `derive_configuration` writes them: name (of the experiment), run (the run's label), runs (number
    of the experiment's runs), axis, may_trip, ticks, middle_um (middle of the run's motion; an absent key means 0),
    parameters, asked (the axis's specification without its defaults), beside (whether the run belongs to the second
    configuration), reduced (a text for each default that a limit reduced), segments (each a list of the fields of
    Segment).
    """
    first_line = configuration.partition("\n")[0].removeprefix("# ")
    if not first_line.startswith(METADATA_PREFIX):
        return None
    try:
        metadata = json.loads(first_line.removeprefix(METADATA_PREFIX))
    except ValueError:
        return None
    return metadata if isinstance(metadata, dict) else None


def _change_plant(driver: dict[str, Any], axis: str, changes: Mapping[str, Mapping[str, float]]) -> None:
    """Merge `changes`, values by section and key, into the axis's plant in the table [driver], in place.

    An axis without an entry in `plants` gets a copy of `plant` first.
    """
    plants = driver.setdefault("plants", {})
    plant = plants.setdefault(axis, copy.deepcopy(driver.get("plant", {})))
    for name, values in changes.items():
        plant[name] = {**plant.get(name, {}), **values}


def _file_name(label: str) -> str:
    """Return a label as part of a file's name: "-" for each character but letters, digits, "+", "."; no final "-"."""
    return "".join(letter if letter.isalnum() or letter in "+-." else "-" for letter in label).rstrip("-")
