"""File names of new recordings."""

from __future__ import annotations

import glob
import time
from pathlib import Path

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared
from rtloop.errors import OutputError, output_errors
from rtloop.foundation import timing

ROTATED = "-[0-9][0-9][0-9][0-9]"
"""End of the names of a run's files with rotation, as a pattern."""


def recordings_folder(configuration: Configuration) -> Path:
    """Return the absolute path of recording.folder; a relative one begins at the working directory."""
    return Path(configuration.recording.folder).absolute()


def new_recording_path(prepared: Prepared, chosen_folder: Path | None) -> Path:
    """Create the folder for recordings, and return an unused path NAME-TIME.mcap or NAME-TIME-N.mcap in it.

    With rotation, the recorder writes NAME-TIME-0001.mcap and so on: these are unused, too. No file is created. The
    folder is `chosen_folder`, None for the configured one. Raises OutputError if the folder cannot be created or no N
    from 2 to 999 is free.
    """
    folder = chosen_folder or recordings_folder(prepared.configuration)
    with output_errors(f"{folder}: cannot create the folder for recordings"):
        folder.mkdir(parents=True, exist_ok=True)
    stem = f"{prepared.plan.name}-{time.strftime('%Y%m%dT%H%M%S', time.localtime(timing.unix_s()))}"
    for number in range(1, 1000):
        path = folder / (f"{stem}.mcap" if number == 1 else f"{stem}-{number}.mcap")
        name = glob.escape(path.stem)
        if not any(glob.glob(f"{name}{numbers}.mcap{ending}", root_dir=folder)
                   for numbers in ("", ROTATED) for ending in ("", ".part")):  # fmt: skip
            return path
    raise OutputError(
        f"{folder}: no name is free for the recording; {stem}.mcap and {stem}-2.mcap to {stem}-999.mcap exist "
        "already. Start again; the name then contains a later time"
    )
