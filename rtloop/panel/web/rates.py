"""Limits of the rate of requests, for all clients together or for each client."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial
from socket import inet_aton
from sys import byteorder

from starlette.types import Scope

from rtloop.foundation import timing
from rtloop.foundation.trusted import open_user_file

MAX_CLIENTS = 256
CONNECTIONS = "/proc/self/net/tcp"
"""The kernel's table of connections: a line for each end, with the user of that end."""
ESTABLISHED, USER_FIELD = "01", 7
"""Code of the state in which an end has a user; index of the user in a line."""


class RateLimit:
    """A rate limit: on average `per_s` requests a second, and up to `burst` at once."""

    def __init__(self, per_s: float, burst: int, now_s: Callable[[], float] = timing.monotonic_s) -> None:
        """Allow `burst` requests at once; `now_s` returns the time in s."""
        self._per_s, self._burst, self._now_s = per_s, burst, now_s
        self._allowance, self._updated_s = float(burst), now_s()

    def __str__(self) -> str:
        """The average rate for a message: "50 a second"."""
        return f"{self._per_s:g} a second"

    def allows(self) -> bool:
        """Return whether another request is within the limit, and count it if so; a refused request does not count."""
        now_s = self._now_s()
        self._allowance = min(self._allowance + (now_s - self._updated_s) * self._per_s, float(self._burst))
        self._updated_s = now_s
        if self._allowance < 1:
            return False
        self._allowance -= 1
        return True


class ClientRateLimits:
    """A RateLimit for each client, by any hashable key; only the MAX_CLIENTS with the latest requests are kept."""

    def __init__(self, per_s: float, burst: int, now_s: Callable[[], float] = timing.monotonic_s) -> None:
        """Begin without clients; each gets a RateLimit with these arguments at its first request."""
        self._make_limit = partial(RateLimit, per_s, burst, now_s)
        self._rates: OrderedDict[Hashable, RateLimit] = OrderedDict()

    def __len__(self) -> int:
        return len(self._rates)

    def __str__(self) -> str:
        """The average rate of one client for a message: "5 a second"."""
        return str(self._make_limit())

    def allows(self, client: Hashable) -> bool:
        """Return whether another request of `client` is within its limit, and count it if so."""
        rate = self._rates.setdefault(client, self._make_limit())
        self._rates.move_to_end(client)
        while len(self._rates) > MAX_CLIENTS:
            self._rates.popitem(last=False)
        return rate.allows()


def identify_client(scope: Scope) -> tuple[str, int | None]:
    """Return (address, user id) of a request's client: "" for an unknown address, None for an unknown user.

    On this host all clients share an address. Headers in which a proxy names its client are ignored.
    """
    client, server = scope.get("client"), scope.get("server")
    if not client or not server:
        return "", None
    try:
        addresses = [f"{int.from_bytes(inet_aton(host), byteorder):08X}:{port:04X}" for host, port in (client, server)]
        with os.fdopen(open_user_file(CONNECTIONS), encoding="ascii") as file:
            line = next((line for line in file if f" {addresses[0]} {addresses[1]} {ESTABLISHED} " in line), None)
    except OSError:
        line = None
    return client[0], None if line is None else int(line.split()[USER_FIELD])
