"""Whom to believe: what lies in a file or folder counts only if nobody but us and root can have put it there.

A path is walked from the root, folder by folder and link by link, each held open while the next is looked at, so that
nobody can exchange one meanwhile. A folder such as /tmp, where all may make things but none may touch another's, may
stand above such a place; it is no such place itself.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

_FOLDER = os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_MOST_LINKS = 40
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class Untrusted(PermissionError):
    """Somebody else made this, or may change it."""

    def __init__(self, path: Path | str, reason: str) -> None:
        super().__init__(errno.EPERM, reason, str(path))


def open_folder(path: Path, mode: int | None = None, *, shared: bool = False) -> int:
    """An O_PATH descriptor of a folder that we or root alone may write to. Raises OSError, Untrusted.

    What is missing on the way is made with `mode`. `shared` allows the folder itself to be one such as /tmp.
    """
    fd, _, is_shared = _walk(path, mode)
    if is_shared and not shared:
        os.close(fd)
        raise Untrusted(path, "everybody may write there; a folder of its own is needed")
    return fd


def owners(folder: Path) -> set[int]:
    """Users whose files in `folder` count: we, root, and whom root gave it. Raises OSError, Untrusted."""
    fd, found, _ = _walk(folder, None, given=True)
    os.close(fd)
    return found


def open_file(path: Path, flags: int, mode: int = 0o600, *, group: bool = False) -> int:
    """A regular file of ours or root's, in a folder that counts or is shared. Raises OSError, Untrusted.

    With `group` the members of a group of ours count too.
    """
    folder = open_folder(path.parent, shared=True)
    try:
        fd = os.open(path.name, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, mode, dir_fd=folder)
    finally:
        os.close(folder)
    status = os.fstat(fd)
    ours = group and status.st_gid in (os.getegid(), *os.getgroups())
    if not stat.S_ISREG(status.st_mode):
        reason = "not a regular file"
    elif status.st_uid not in (0, os.geteuid()) and not ours:
        reason = _belongs(status)
    elif status.st_mode & (stat.S_IWOTH if ours else _OTHERS_WRITE):
        reason = "others may write to it"
    else:
        return fd
    os.close(fd)
    raise Untrusted(path, reason)


def _walk(path: Path, mode: int | None, given: bool = False) -> tuple[int, set[int], bool]:
    """Descriptor of the folder, whose files count there, and whether everybody may make some."""
    believed, links = {0, os.geteuid()}, 0
    left = list(reversed((Path.cwd() / path).parts[1:]))
    fd, by_root, shared = os.open("/", _FOLDER), True, False
    try:
        while left:
            name = left.pop()
            status = _entry(name, fd, mode)
            if stat.S_ISLNK(status.st_mode):
                links += 1
                if status.st_uid not in believed:
                    raise Untrusted(path, f"leads through a link that {_belongs(status)}")
                if links > _MOST_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
                target = Path(os.readlink(name, dir_fd=fd))
                if target.is_absolute():
                    fd, by_root = _onward(fd, "/"), True
                left += reversed([part for part in target.parts if part != "/"])
                continue
            fd = _onward(fd, name)
            status = os.fstat(fd)
            if given and by_root:
                believed.add(status.st_uid)
            shared = bool(status.st_mode & stat.S_ISVTX and status.st_mode & _OTHERS_WRITE)
            where = Path(os.readlink(f"/proc/self/fd/{fd}"))
            if status.st_uid not in believed:
                raise Untrusted(where, f"{_belongs(status)}, and what is in it is not believed")
            if status.st_mode & _OTHERS_WRITE and not shared:
                raise Untrusted(where, "others may write there; it must be its owner's alone (chmod go-w)")
            by_root = by_root and status.st_uid == 0 and not shared
    except BaseException:
        os.close(fd)
        raise
    return fd, believed, shared


def _entry(name: str, folder: int, mode: int | None) -> os.stat_result:
    """What is there, made where it is missing and `mode` is given."""
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        if mode is None:
            raise
    os.mkdir(name, mode, dir_fd=folder)
    return os.stat(name, dir_fd=folder, follow_symlinks=False)


def _onward(fd: int, name: str) -> int:
    """The folder `name` in `fd`, which is closed."""
    following = os.open(name, _FOLDER, dir_fd=fd)
    os.close(fd)
    return following


def _belongs(status: os.stat_result) -> str:
    return f"belongs to user {status.st_uid}, not to us or root"
