"""Where a service keeps its socket and its shared block, which holds the last drive, so that others find them.

What lies there is believed, and killed and driven by: nobody else may have put it there (`rtloop.foundation.trusted`).
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from rtloop.errors import HostRefusal, OutputError, UnavailableError
from rtloop.foundation.trusted import UntrustedPath, close_descriptor, open_file, open_folder

if TYPE_CHECKING:  # clients of the control API need none of it: half a second of import
    from rtloop.configuration.file import Configuration

FOLDER_MODE = 0o750
"""Members of the group get to the socket."""
SYSTEM_FOLDER = Path("/run/rtloop")
"""Of services that run for the whole machine, as the units have it."""


def runtime_folder() -> Path:
    """RUNTIME_DIRECTORY as systemd sets it, else the user's runtime folder, else one of this user in /tmp."""
    directory = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if directory:
        return Path(directory)
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


def block_path(name: str) -> Path:
    """Where the shared block of the service of a configuration lies, for `rtloop park`."""
    return runtime_folder() / f"{name}.block"


def hardware_path(name: str) -> Path:
    """Where the hardware of that service is noted."""
    return runtime_folder() / f"{name}.hardware"


def create_file(path: Path, target: str = "the shared block") -> int:
    """An empty file in place of an old one, which a process that still has it mapped keeps; `what` is for the message.

    Raises OutputError, HostRefused for a folder that is not ours alone to write.
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
        raise OutputError(f"{path}: cannot make {target}: {error.strerror}") from None


def open_block(path: Path, flags: int = os.O_RDWR) -> int | None:
    """A service's shared block; None where there is none. Raises HostRefused, UnavailableError."""
    try:
        return open_file(path, flags)
    except FileNotFoundError:
        return None
    except UntrustedPath as error:
        raise host_refusal(error) from None
    except OSError as error:
        raise UnavailableError(f"{path}: {error.strerror}") from None


def host_refusal(error: UntrustedPath) -> HostRefusal:
    """For a user: what is not believed, and why."""
    return HostRefusal(f"{error.filename}: {error.strerror}")
