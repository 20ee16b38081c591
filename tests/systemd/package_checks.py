"""The service of the Debian package runs, an upgrade and a purge park its outputs, and its recordings remain.

A copy of the package's interpreter runs this program, so that it can read the board's memory after the purge.
"""

from __future__ import annotations

import os
import subprocess
import sys

from checks import BOARD, RECORDINGS, UNIT, Board, await_running, require, run, unit_property, wait_until

UNITS = (BOARD, UNIT)


def start() -> Board:
    """Start board and service; return the board once its output is not zero."""
    run("systemctl", "start", *UNITS)
    await_running()
    board = Board()
    wait_until(lambda: board.drive_v != 0.0, 60.0, "the output moves")
    return board


def require_parked(board: Board, occasion: str) -> None:
    """Require that the output is at 0 V, that no unit is active, and that no process of the service's user remains."""
    require(board.drive_v == 0.0, f"{occasion}: the output stays at {board.drive_v:.3f} V")
    states = [unit_property("ActiveState", unit) for unit in UNITS]
    require(set(states) == {"inactive"}, f"{occasion}: the units are {states}")
    require(subprocess.run(["pgrep", "-u", "rtloop"]).returncode == 1, f"{occasion}: processes remain")
    print(f"ok  {occasion}: output {board.drive_v:.3f} V, units {states}")


def main() -> None:
    """Start the service, upgrade, start it again, purge; require parked outputs and, at the end, the recordings."""
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
        require(not os.path.lexists(name), f"{name} remains")
    print(f"ok  {len(recordings)} finished recordings remain")


if __name__ == "__main__":
    main()
