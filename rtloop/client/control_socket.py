"""Control sockets of running services, found by the name of the service."""

from __future__ import annotations

import glob
from pathlib import Path

from rtloop.errors import UnavailableError
from rtloop.supervision import paths


def find_control_socket(name: str | None) -> Path:
    """Return the path of the control socket of the service `name`; None means the only service.

    The service may have died and left its socket. Raises UnavailableError if no socket matches, or if several match.
    """
    folders = paths.client_folders()
    pattern = "*" if name is None else glob.escape(name)
    sockets = [item for folder in folders for item in sorted(folder.glob(f"{pattern}.sock"))]
    folders_text = " or ".join(str(folder) for folder in folders)
    if not sockets:
        subject = "no service" if name is None else f"no service {name!r}"
        meant = "" if not name or not name.endswith(".toml") else f"; use the name of the service, {Path(name).stem!r}"
        raise UnavailableError(
            f"{subject} has a control socket in {folders_text}{meant}; start a service with `rtloop serve CONFIG`"
        )
    if len(sockets) > 1:
        names = ", ".join(item.stem for item in sockets)
        raise UnavailableError(f"several services have a control socket in {folders_text}: {names}; use --name NAME")
    return sockets[0]
