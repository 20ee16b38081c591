"""Where a service keeps its socket and its shared block, which holds the last drive, so that others find them."""

from __future__ import annotations

import os
from pathlib import Path

from rtloop.config import Configuration


def runtime_folder() -> Path:
    """RUNTIME_DIRECTORY as systemd sets it, else the user's runtime folder, else one of this user in /tmp."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    if os.geteuid() == 0 and Path("/run").is_dir():
        return Path("/run/rtloop")
    user = Path(f"/run/user/{os.getuid()}")
    return user / "rtloop" if user.is_dir() else Path(f"/tmp/rtloop-{os.getuid()}")


def socket_path(configuration: Configuration) -> Path:
    """The control socket of a service."""
    return Path(configuration.service.socket or runtime_folder() / f"{configuration.name}.sock")


def block_path(configuration: Configuration) -> Path:
    """Where the shared block of a service lies, for `rtloop park`."""
    return runtime_folder() / f"{configuration.name}.block"
