"""Notifications to systemd (READY, STATUS, WATCHDOG, STOPPING), one datagram each (sd_notify(3))."""

from __future__ import annotations

import contextlib
import os
import socket


class Notifier:
    """Sender of notifications to the service manager; without one it sends nothing.

    The environment names the manager's socket (NOTIFY_SOCKET). `watchdog_s` is the watchdog time of the systemd unit,
    None without a watchdog for this process.
    """

    def __init__(self) -> None:
        """Read the manager's socket and the watchdog time from the environment (NOTIFY_SOCKET, WATCHDOG_…)."""
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        watchdog_us = os.environ.get("WATCHDOG_USEC", "")
        is_this_process = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = int(watchdog_us) / 1e6 if watchdog_us.isdigit() and is_this_process else None
        self._next_s = 0.0

    def send(self, **fields: str | int) -> None:
        """Send fields in one datagram, as in `send(READY=1, STATUS="…")`; no effect without a manager.

        An OSError is ignored, and the datagram is then lost.
        """
        if not self._address:
            return
        message = "\n".join(f"{name}={value}" for name, value in fields.items())
        # A manager that ended, or does not read, must not stop the loop.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)
            channel.sendto(message.encode(), self._address)

    def limit_watchdog(self, limit_s: float | None = None) -> None:
        """Set systemd's watchdog time, s; None restores the unit's time. No effect if the unit has no watchdog."""
        limit_s = limit_s or self.watchdog_s
        if self.watchdog_s and limit_s:
            self.send(WATCHDOG_USEC=round(limit_s * 1e6))

    def is_due(self, period_s: float, now_s: float) -> bool:
        """Return True, and begin a period of `period_s`, at the first call and once the last period has passed; else
        return False.

        `now_s` is a monotonic time; all callers share one period.
        """
        if now_s < self._next_s:
            return False
        self._next_s = now_s + period_s
        return True
