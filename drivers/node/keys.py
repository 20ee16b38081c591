"""The file of the key that loop and node share. Messages name the file and never quote it."""

from __future__ import annotations

import os
import re
import stat

from rtloop.drivers.errors import DriverError
from rtloop.drivers.node.tags import KEY_BYTES
from rtloop.foundation.trusted import open_own

DIGITS = 2 * KEY_BYTES
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def read_key(path: str | None) -> bytes | None:
    """Return the key in a file, 16 bytes; None without a path.

    Raises DriverError for a file that is missing, a link, another user's, or accessible to group or others, and for
    other content than DIGITS hexadecimal digits.
    """
    if path is None:
        return None
    try:
        with os.fdopen(open_own(path), "rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(DIGITS + 3)
    except OSError as error:
        remedy = "give the path of a file of your own with the key"
        raise DriverError(f"driver.key: {path}: {error.strerror}; {remedy}") from None
    if mode & _OTHERS:
        raise DriverError(
            f"driver.key: {path}: the file has the permissions {stat.S_IMODE(mode):03o}; allowed: none "
            f"for group and others (chmod 600 {path}). If others may have read the key, make a new one"
        )
    if not re.fullmatch(rb"[0-9a-fA-F]{%d}(\r?\n)?" % DIGITS, text):
        raise DriverError(
            f"driver.key: {path}: the content is not a key; allowed: {DIGITS} hexadecimal digits on one "
            f"line, such as `(umask 077; openssl rand -hex {KEY_BYTES} > {path})` makes"
        )
    key = bytes.fromhex(text.decode())
    if len(set(key)) == 1:
        raise DriverError(
            f"driver.key: {path}: {KEY_BYTES} equal bytes are no key; allowed: random ones; make a new key"
        )
    return key
