"""Opening of files: a file or folder is trusted only if this user and root alone can have written it.

A path is resolved from the root, folder by folder and link by link. Each folder is held open while the next is checked:
no other user can replace one meanwhile. A sticky folder such as /tmp, where every user may make files of their own, may
be part of the path of a trusted folder; it is not trusted itself.

Recordings and reports lie where others may write too, such as a folder of a group. There, `make_file`, `replace_file`
and `overwrite_file` never write to another user's file, and `open_user_file`, `open_without_link` and `open_own` never
wait for a pipe or a device. The product opens its files by this module; a test finds other calls.

"Own" means: belongs to this user or root. Every UntrustedPath is an OSError.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HAS_OWNERS = hasattr(os, "O_PATH") and hasattr(os, "geteuid")
"""Whether the system has the calls of Linux that hold a folder. Elsewhere recordings are only read and exported, and a
path is opened without these checks: no outputs are driven there."""
_PLAIN = getattr(os, "O_BINARY", 0)
_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)
_CLOEXEC = getattr(os, "O_CLOEXEC", 0) | _PLAIN
_NONBLOCK = getattr(os, "O_NONBLOCK", 0)
_FOLDER = getattr(os, "O_PATH", 0) | getattr(os, "O_DIRECTORY", 0) | _NOFOLLOW | _CLOEXEC
_READ = os.O_RDONLY | _NONBLOCK | getattr(os, "O_NOCTTY", 0) | _CLOEXEC
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | _NOFOLLOW | _CLOEXEC
_OVERWRITE = os.O_WRONLY | _NONBLOCK | getattr(os, "O_NOCTTY", 0) | _CLOEXEC
_MAX_LINKS = 40
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class UntrustedPath(PermissionError):
    """A path that another user owns, or may change."""

    def __init__(self, path: Path | str, reason: str) -> None:
        """Store the path as `filename`, the reason as `strerror`, and EPERM as `errno`."""
        super().__init__(errno.EPERM, reason, str(path))


def close_descriptor(fd: int) -> None:
    """Close a descriptor that was not written to. An error is ignored: Linux frees the descriptor anyway."""
    with suppress(OSError):
        os.close(fd)


def open_folder(path: Path, mode: int | None = None, *, shared: bool = False) -> int:
    """Return an O_PATH descriptor of a folder to which this user and root alone may write.

    Missing folders of the path are made with `mode`, unless it is None. `shared` allows a sticky folder such as /tmp.
    Raises UntrustedPath if another user owns, or may change, a folder or link of the path, OSError if the system
    refuses.
    """
    fd, _, is_shared = _walk_path(path, mode)
    if is_shared and not shared:
        close_descriptor(fd)
        raise UntrustedPath(
            path, "every user may write to this folder; use a folder to which only the user who runs rtloop may write"
        )
    return fd


def trusted_owners(folder: Path) -> set[int]:
    """Return the user ids whose files in `folder` are trusted: this user and root, and possibly a third user.

    The third user owns `folder` or a folder above it, while root owns all folders further above, which are not sticky.

    Raises UntrustedPath if another user owns, or may change, a folder or link of the path, OSError if the system
    refuses.
    """
    fd, owner_ids, _ = _walk_path(folder, None, trusts_grants=True)
    close_descriptor(fd)
    return owner_ids


def open_file(path: Path, flags: int, mode: int = 0o600, *, group: bool = False) -> int:
    """Return a descriptor, not blocking, of a regular file of this user or root in a trusted or sticky folder.

    `flags` are as of os.open; a new file has `mode`. With `group`, members of this process's groups may own it and
    write to it, too. Raises UntrustedPath if another user owns or may change the file or its folder, and for a link or
    anything but a regular file, OSError if the system refuses.
    """
    folder = open_folder(path.parent, shared=True)
    try:
        fd = os.open(path.name, flags | _NOFOLLOW | _NONBLOCK | _CLOEXEC, mode, dir_fd=folder)
    except OSError as error:
        raise _explain_open_error(error, path) from None
    finally:
        close_descriptor(folder)
    status = os.fstat(fd)
    is_group_file = group and status.st_gid in (os.getegid(), *os.getgroups())
    if not stat.S_ISREG(status.st_mode):
        reason = "not a regular file"
    elif not _is_own(status) and not is_group_file:
        reason = _foreign_owner_text(status)
    elif status.st_mode & (stat.S_IWOTH if is_group_file else _OTHERS_WRITE):
        reason = "other users may write to this file; take this permission from them (chmod)"
    else:
        return fd
    close_descriptor(fd)
    raise UntrustedPath(path, reason)


def open_user_file(path: Path | str) -> int:
    """Return a descriptor, for reading, of a regular file that the user named; links are followed.

    Raises OSError if it cannot be opened or is not a regular file.
    """
    return _require_regular(os.open(path, _READ), path)


def open_without_link(path: Path | str) -> int:
    """Return a descriptor, for reading, of a regular file of any owner.

    Raises UntrustedPath if `path` itself is a link, OSError if it cannot be opened or is not a regular file; links
    among its folders are followed.
    """
    try:
        fd = os.open(path, _READ | _NOFOLLOW)
    except OSError as error:
        raise _explain_open_error(error, path) from None
    return _require_regular(fd, path)


def open_device(path: Path | str) -> int:
    """Open a character device, such as a terminal, for reading and writing; the descriptor does not block.

    Links are followed. Raises OSError if it cannot be opened, UntrustedPath if it is no such device.
    """
    fd = os.open(path, os.O_RDWR | _NONBLOCK | getattr(os, "O_NOCTTY", 0) | _CLOEXEC)
    if not stat.S_ISCHR(os.fstat(fd).st_mode):
        close_descriptor(fd)
        raise UntrustedPath(path, "not a serial port or other character device")
    return fd


def open_own(path: Path | str) -> int:
    """Return a descriptor, for reading, of a regular file that belongs to this user or root.

    Raises UntrustedPath for another user's file or a link, OSError if it cannot be opened or is not a regular file.
    """
    fd = open_without_link(path)
    if not _is_own(status := os.fstat(fd)):
        close_descriptor(fd)
        raise UntrustedPath(path, _foreign_owner_text(status))
    return fd


def is_own(path: Path) -> bool:
    """Whether `path` is a regular file, no link, of this user or root; False if it does not exist.

    Raises OSError if its folder cannot be searched.
    """
    try:
        status = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return stat.S_ISREG(status.st_mode) and _is_own(status)


def make_file(path: Path, mode: int = 0o666) -> int:
    """Make a new file and return its descriptor, for reading and writing; its folder may be writable for others.

    Raises FileExistsError if the name is used, UntrustedPath if the path leads through another user's link, OSError if
    the system refuses.
    """
    if not HAS_OWNERS:
        return os.open(path, _NEW, mode)
    with _open_parent(path) as folder:
        return os.open(path.name, _NEW, mode, dir_fd=folder)


def replace_file(path: Path, mode: int = 0o666) -> int:
    """Make a new file like `make_file` does; a regular file of this user or root with this name is removed first.

    Raises BlockingIOError if a process has locked that file, UntrustedPath if it is another user's or not a regular
    file, or if the path leads through another user's link, OSError if the system refuses.
    """
    if not HAS_OWNERS:
        path.unlink(missing_ok=True)
        return os.open(path, _NEW, mode)
    import fcntl  # Linux alone gets here.

    with _open_parent(path) as folder:
        try:
            return os.open(path.name, _NEW, mode, dir_fd=folder)
        except FileExistsError:
            status = os.stat(path.name, dir_fd=folder, follow_symlinks=False)
        if not _is_own(status):
            raise UntrustedPath(path, f"{_foreign_owner_text(status)}; remove the file")
        if not stat.S_ISREG(status.st_mode):
            raise UntrustedPath(path, "not a regular file; remove it, or use another path")
        abandoned = os.open(path.name, _READ | _NOFOLLOW, dir_fd=folder)
        try:
            fcntl.flock(abandoned, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.unlink(path.name, dir_fd=folder)
        finally:
            close_descriptor(abandoned)
        return os.open(path.name, _NEW, mode, dir_fd=folder)


def overwrite_file(path: Path, mode: int = 0o666) -> int:
    """Return a descriptor, for writing, of a new file, or of an emptied file, FIFO or device of this user or root.

    Links of this user or root are followed. Raises UntrustedPath for another user's file or link, and for a file with
    more than one name in a folder where others may write, OSError if the system refuses.
    """
    if not HAS_OWNERS:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | _CLOEXEC, mode)
    for _ in range(_MAX_LINKS):
        with _open_parent(path) as folder:
            try:
                return os.open(path.name, _NEW, mode, dir_fd=folder)
            except FileExistsError:
                status = os.stat(path.name, dir_fd=folder, follow_symlinks=False)
            if not _is_own(status):
                raise UntrustedPath(path, _foreign_owner_text(status))
            if not stat.S_ISLNK(status.st_mode):
                return _empty_file(os.open(path.name, _OVERWRITE | _NOFOLLOW, dir_fd=folder), path, os.fstat(folder))
            if status.st_dev == os.stat("/proc/self").st_dev:  # An open descriptor: /dev/stdout links to one.
                return os.open(path.name, os.O_WRONLY | os.O_TRUNC | _CLOEXEC, dir_fd=folder)
            path = Path(os.readlink(f"/proc/self/fd/{folder}")) / os.readlink(path.name, dir_fd=folder)
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))


def _empty_file(fd: int, path: Path, folder: os.stat_result) -> int:
    """Empty the open regular file `fd` (a FIFO or device stays), make the descriptor blocking, and return `fd`.

    Raises UntrustedPath, after closing the unchanged file, if it belongs to another user, and if it has several names
    and others may write to its folder. `folder` is the status of its folder.
    """
    status = os.fstat(fd)
    if not _is_own(status):
        reason = _foreign_owner_text(status)
    elif stat.S_ISREG(status.st_mode) and status.st_nlink > 1 and folder.st_mode & _OTHERS_WRITE:
        reason = (
            "the file has other names (hard links), and other users may write to its folder, so that one of them may "
            "have put it there; remove this name of it: its other names keep the content"
        )
    else:
        if stat.S_ISREG(status.st_mode):
            os.ftruncate(fd, 0)
        os.set_blocking(fd, True)
        return fd
    close_descriptor(fd)
    raise UntrustedPath(path, reason)


def _explain_open_error(error: OSError, path: Path | str) -> OSError:
    """Return the error to raise for an `open` that follows no link: UntrustedPath for a link, else `error` itself."""
    return UntrustedPath(path, "a symbolic link; allowed: the file itself") if error.errno == errno.ELOOP else error


def _require_regular(fd: int, path: Path | str) -> int:
    """Return `fd` if it is a regular file. Raises OSError, after closing it, for a folder, FIFO or device."""
    mode = os.fstat(fd).st_mode
    if stat.S_ISREG(mode):
        return fd
    close_descriptor(fd)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise OSError(errno.EINVAL, "not a regular file", str(path))


@contextmanager
def _open_parent(path: Path) -> Iterator[int]:
    """Yield a descriptor of the folder of `path`, which may be writable for others.

    Raises UntrustedPath if the path leads through another user's link, OSError if the folder is missing.
    """
    fd, _, _ = _walk_path(path.parent, None, checks_trust=False)
    try:
        yield fd
    finally:
        close_descriptor(fd)


def _walk_path(
    path: Path, mode: int | None, *, trusts_grants: bool = False, checks_trust: bool = True
) -> tuple[int, set[int], bool]:
    """Resolve a path; return its descriptor, the trusted user ids, and whether it is sticky and others may write to it.

    Missing folders are made with `mode`, unless it is None. With `trusts_grants`, the owner of a folder counts as
    trusted if root owns all folders above it and they are not sticky. Without `checks_trust`, any folder is accepted,
    and a link of a user who alone may write to the link's folder; the folder is then never called sticky. Raises
    UntrustedPath for another user's link or folder and for a folder, not sticky, where others may write, OSError for a
    missing folder.
    """
    trusted_ids, links = {0, os.geteuid()}, 0
    remaining_names = list(reversed((path if path.is_absolute() else Path.cwd() / path).parts[1:]))
    fd, by_root, shared = os.open("/", _FOLDER), True, False
    try:
        while remaining_names:
            name = remaining_names.pop()
            status = _stat_or_make(name, fd, mode)
            if stat.S_ISLNK(status.st_mode):
                links += 1
                if status.st_uid not in trusted_ids and (
                    checks_trust or not _is_sole_writer(os.fstat(fd), status.st_uid)
                ):
                    raise UntrustedPath(
                        path, f"the path leads through {_foreign_owner_text(status)}; use a path without this link"
                    )
                if links > _MAX_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
                target = Path(os.readlink(name, dir_fd=fd))
                if target.is_absolute():
                    fd, by_root = _open_subfolder(fd, "/"), True
                remaining_names += reversed([part for part in target.parts if part != "/"])
                continue
            fd = _open_subfolder(fd, name)
            if not checks_trust:
                continue
            status = os.fstat(fd)
            if trusts_grants and by_root:
                trusted_ids.add(status.st_uid)
            shared = bool(status.st_mode & stat.S_ISVTX and status.st_mode & _OTHERS_WRITE)
            location = Path(os.readlink(f"/proc/self/fd/{fd}"))
            if status.st_uid not in trusted_ids:
                raise UntrustedPath(
                    location, f"the folder {_foreign_owner_text(status)}; remove it, or use another folder"
                )
            if status.st_mode & _OTHERS_WRITE and not shared:
                raise UntrustedPath(
                    location, "other users may write to this folder; allowed: only its owner (chmod go-w)"
                )
            by_root = by_root and status.st_uid == 0 and not shared
    except BaseException:
        close_descriptor(fd)
        raise
    return fd, trusted_ids, shared


def _stat_or_make(name: str, folder: int, mode: int | None) -> os.stat_result:
    """Return the status of `name` in a folder, without following a link.

    A missing one is made as a folder with `mode`; FileNotFoundError if `mode` is None.
    """
    try:
        return os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        if mode is None:
            raise
    os.mkdir(name, mode, dir_fd=folder)
    return os.stat(name, dir_fd=folder, follow_symlinks=False)


def _open_subfolder(fd: int, name: str) -> int:
    """Open the folder `name` inside the folder `fd`, close `fd`, and return the new descriptor.

    Raises OSError if it cannot be opened; `fd` then stays open.
    """
    following = os.open(name, _FOLDER, dir_fd=fd)
    close_descriptor(fd)
    return following


def _is_sole_writer(folder: os.stat_result, uid: int) -> bool:
    """Whether a folder belongs to user `uid`, and no other user may write there."""
    return folder.st_uid == uid and not folder.st_mode & _OTHERS_WRITE


def _is_own(status: os.stat_result) -> bool:
    """Whether the owner is this user or root; True on a system without HAS_OWNERS."""
    return not HAS_OWNERS or status.st_uid in (0, os.geteuid())


def _foreign_owner_text(status: os.stat_result) -> str:
    """Return the reason of `UntrustedPath` for a file or link whose owner is neither this user nor root."""
    link = "a link that " if stat.S_ISLNK(status.st_mode) else ""
    return f"{link}belongs to user {status.st_uid}, not to this user or root"


@contextmanager
def standing_elsewhere() -> Iterator[None]:
    """Make the root the current folder during the block, on Linux, for imports that read settings of the current one.

    matplotlib does, and so does python-control, which imports it. The current folder may have been deleted.
    """
    if not HAS_OWNERS:
        yield
        return
    here = os.open(".", os.O_PATH)
    try:
        os.chdir("/")
        yield
    finally:
        os.fchdir(here)
        close_descriptor(here)
