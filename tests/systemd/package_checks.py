"""The service of the Debian package: it runs, an upgrade and a purge park its outputs, and its recordings stay.

A copy of the package's interpreter runs this program: it reads the board's memory when the package is gone.
"""

from __future__ import annotations

import os
import subprocess
import sys

from checks import BOARD, RECORDINGS, UNIT, Board, await_running, require, run, show, until

UNITS = (BOARD, UNIT)


def start() -> Board:
    """Start board and service; return the board once its output is not zero."""
    run("systemctl", "start", *UNITS)
    await_running()
    board = Board()
    until(lambda: board.drive_v != 0.0, 60.0, "the output moves")
    return board


def require_parked(board: Board, what: str) -> None:
    """The output is at zero, no service runs, and no process of the service's user is left."""
    require(board.drive_v == 0.0, f"{what}: the output stays at {board.drive_v:.3f} V")
    states = [show("ActiveState", unit) for unit in UNITS]
    require(set(states) == {"inactive"}, f"{what}: the units are {states}")
    require(subprocess.run(["pgrep", "-u", "rtloop"]).returncode == 1, f"{what}: processes are left")
    print(f"ok  {what}: output {board.drive_v:.3f} V, units {states}")


def main() -> None:
    """Start, upgrade, start, purge; the recordings are there afterwards."""
    run("systemctl", "enable", *UNITS)
    board = start()
    print(f"ok  installed: {run('/usr/bin/rtloop', '--version').strip()}, output {board.drive_v:.3f} V")
    run("dpkg", "--install", sys.argv[1])
    require_parked(board, "upgraded")
    board = start()
    run("dpkg", "--purge", "rtloop")
    require_parked(board, "purged")
    recordings = list(RECORDINGS.glob("*.mcap"))
    require(len(recordings) >= 2, f"recordings: {recordings}")
    require(not list(RECORDINGS.glob("*.part")), "a recording is unfinished")
    for name in ("/opt/rtloop", "/etc/rtloop", "/run/rtloop", "/var/cache/rtloop", "/usr/bin/rtloop"):
        require(not os.path.lexists(name), f"{name} is left")
    print(f"ok  {len(recordings)} finished recordings are kept")


if __name__ == "__main__":
    main()
