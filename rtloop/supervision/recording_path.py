"""File names of new recordings."""

from __future__ import annotations

import time
from os.path import lexists
from pathlib import Path

from rtloop.configuration.file import Configuration
from rtloop.configuration.prepare import Prepared
from rtloop.errors import OutputError, output_errors


def recordings_folder(configuration: Configuration) -> Path:
    """Return the absolute path of recording.folder; a relative one begins at the working directory."""
    return Path(configuration.recording.folder).absolute()


def new_recording_path(prepared: Prepared, chosen_folder: Path | None) -> Path:
    """Create the folder for recordings, and return an unused path NAME-TIME.mcap or NAME-TIME-N.mcap in it.

    No file is created. The folder is `chosen_folder`, None for the configured one. Raises OutputError if the folder
    cannot be created or no N from 2 to 999 is free.
    """
    folder = chosen_folder or recordings_folder(prepared.configuration)
    with output_errors(f"{folder}: cannot create the folder for recordings"):
        folder.mkdir(parents=True, exist_ok=True)
    stem = f"{prepared.plan.name}-{time.strftime('%Y%m%dT%H%M%S')}"
    for number in range(1, 1000):
        path = folder / (f"{stem}.mcap" if number == 1 else f"{stem}-{number}.mcap")
        if not lexists(path) and not lexists(path.with_name(f"{path.name}.part")):
            return path
    raise OutputError(
        f"{folder}: no name is free for the recording; {stem}.mcap and {stem}-2.mcap to {stem}-999.mcap exist "
        "already. Start again; the name then contains a later time"
    )
