"""Paths of a service's files in the runtime folder: control socket, shared block (with the last drive), hardware note.

`rtloop park` kills processes and drives outputs by these files, so other users must not be able to write them
(`rtloop.foundation.trusted`).
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rtloop.errors import HostRefusal, OutputError, UnavailableError
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, open_file, open_folder

if TYPE_CHECKING:  # The import takes half a second, and clients of the control API do not need it.
    from rtloop.configuration.file import Configuration

FOLDER_MODE = 0o750
"""Members of the folder's group can reach the socket."""
SYSTEM_FOLDER = Path("/run/rtloop")
"""Runtime folder of the machine's services, as in the systemd units."""


def runtime_folder() -> Path:
    """Return RUNTIME_DIRECTORY (set by systemd), else SYSTEM_FOLDER for root, else the user's runtime folder, else a
    folder of this user in /tmp. The folder is not made here.
    """
    directory = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if directory:
        return Path(directory)
    if os.geteuid() == 0 and SYSTEM_FOLDER.parent.is_dir():
        return SYSTEM_FOLDER
    user = Path(f"/run/user/{os.getuid()}")
    return user / "rtloop" if user.is_dir() else Path(f"/tmp/rtloop-{os.getuid()}")


def client_folders() -> list[Path]:
    """Return the folders that may contain control sockets for this user: SYSTEM_FOLDER, then the `runtime_folder`."""
    return list(dict.fromkeys((SYSTEM_FOLDER, runtime_folder())))


def socket_path(configuration: Configuration) -> Path:
    """Return the path of a service's control socket: service.socket, else NAME.sock in the runtime folder."""
    return Path(configuration.service.socket or runtime_folder() / f"{configuration.name}.sock")


def block_path(name: str) -> Path:
    """Return the path of the shared block of the service `name`: NAME.block in the runtime folder."""
    return runtime_folder() / f"{name}.block"


def hardware_path(name: str) -> Path:
    """Return the path of the hardware note of the service `name`: NAME.hardware in the runtime folder."""
    return runtime_folder() / f"{name}.hardware"


def create_file(path: Path, target: str = "the shared memory of the loop") -> int:
    """Create an empty file in place of an old one, and its folder, and return its descriptor, open to read and write.

    A process that has mapped the old file keeps it. `target` names the file in messages. Raises OutputError if the
    system refuses, HostRefusal for a folder that another user owns or may change.
    """
    try:
        folder = open_folder(path.parent, FOLDER_MODE)
        try:
            with suppress(FileNotFoundError):
                os.unlink(path.name, dir_fd=folder)
            return os.open(path.name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600, dir_fd=folder)
        finally:
            close_descriptor(folder)
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise OutputError(f"{path}: cannot create {target}: {error.strerror}") from None


def open_block(path: Path, flags: int = os.O_RDWR) -> int | None:
    """Open a service's shared block with the `flags` of os.open. Returns its descriptor, None if there is no file.

    Raises HostRefusal for a file that another user may have written, UnavailableError if the system refuses.
    """
    try:
        return open_file(path, flags)
    except FileNotFoundError:
        return None
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise UnavailableError(f"{path}: {error.strerror}") from None


def host_refusal(error: UntrustedPath) -> HostRefusal:
    """Return, without raising it, the error for users in place of an UntrustedPath, with its path and reason."""
    return HostRefusal(f"{error.filename}: {error.strerror}")
