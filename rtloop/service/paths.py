"""Where a service keeps its socket and its shared block, which holds the last drive, so that others find them."""

from __future__ import annotations

import os
from pathlib import Path

from rtloop.config import Configuration

SYSTEM_FOLDER = Path("/run/rtloop")
"""Of services that run for the whole machine, as the units have it."""


def runtime_folder() -> Path:
    """RUNTIME_DIRECTORY as systemd sets it, else the user's runtime folder, else one of this user in /tmp."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    if os.geteuid() == 0 and SYSTEM_FOLDER.parent.is_dir():
        return SYSTEM_FOLDER
    user = Path(f"/run/user/{os.getuid()}")
    return user / "rtloop" if user.is_dir() else Path(f"/tmp/rtloop-{os.getuid()}")


def client_folders() -> list[Path]:
    """Where a user's control sockets may be: those of the system's services, which take the group, and the user's."""
    return list(dict.fromkeys((SYSTEM_FOLDER, runtime_folder())))


def socket_path(configuration: Configuration) -> Path:
    """The control socket of a service."""
    return Path(configuration.service.socket or runtime_folder() / f"{configuration.name}.sock")


def block_path(configuration: Configuration) -> Path:
    """Where the shared block of a service lies, for `rtloop park`."""
    return runtime_folder() / f"{configuration.name}.block"
