"""One drives, many watch: the lock that whoever moves or changes something holds under a name.

It is taken by the first command of a name, or explicitly, and free again after SILENCE_S without one. It keeps people
from getting into each other's way and is no security: whoever reaches the control socket may give any name.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rtloop.engine.messages import Origin
from rtloop.service.desk import Asker, Refused, asked_by

SILENCE_S = 60.0
log = logging.getLogger("rtloop")


@dataclass
class _Holding:
    """Who drives, since when (s since 1970), when they were heard last, and how much of theirs is being worked on."""

    name: str
    since_unix_s: float
    heard_s: float
    working: int = 0


class Lock:
    """Held by one name at a time; from any thread. `now_s` is a clock that is never put right."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._guard = threading.Lock()
        self._holding: _Holding | None = None

    @property
    def held(self) -> dict[str, Any] | None:
        """Who drives, since when, and until when if nothing more comes; None where nobody does."""
        with self._guard:
            holder = self._present()
            if holder is None:
                return None
            until_s = time.time() + self._left_s(holder)
            since_s = holder.since_unix_s
            return {"name": holder.name, "since_unix_s": round(since_s, 3), "until_unix_s": round(until_s, 3)}

    def take(self, name: str) -> None:
        """Drive, or go on driving. Raises Refused while somebody else does."""
        with self._guard:
            self._take(name)

    def release(self, name: str) -> None:
        """Drive no longer. Raises Refused while somebody else does."""
        with self._guard:
            self._require(name)
            self._holding = None

    def break_open(self, name: str, key: str, key_sha256: str | None) -> None:
        """Drive in the place of whoever does. Raises Refused where no key is configured, or another one."""
        if key_sha256 is None:
            raise Refused("emergency key: none is configured; service.emergency_key_sha256 is needed")
        if not hmac.compare_digest(hashlib.sha256(key.encode(errors="replace")).hexdigest(), key_sha256):
            log.warning("%s gave a wrong emergency key", name)
            raise Refused("emergency key: this is not the one that is configured")
        with self._guard:
            holder = self._present()
            if holder is not None and holder.name != name:
                log.warning("%s takes the lock from %s by the emergency key", name, holder.name)
                self._holding = None
            self._take(name)

    @contextmanager
    def driving(self, name: str, origin: Origin = Origin.OPERATOR) -> Iterator[None]:
        """Take the lock and ask by that name in between, which is no silence. Raises Refused while others drive."""
        with self._guard:
            holder = self._take(name)
            holder.working += 1
        try:
            with asked_by(Asker(name, origin, lambda: self._still(name))):
                yield
        finally:
            with self._guard:
                holder.working -= 1
                holder.heard_s = self._now_s()

    def _still(self, name: str) -> None:
        """Raises Refused where somebody else has taken the lock meanwhile."""
        with self._guard:
            self._require(name)

    def _take(self, name: str) -> _Holding:
        self._require(name)
        if self._holding is None:
            self._holding = _Holding(name, time.time(), 0.0)
            log.info("%s drives", name)
        self._holding.heard_s = self._now_s()
        return self._holding

    def _require(self, name: str) -> None:
        holder = self._present()
        if holder is not None and holder.name != name:
            since_text = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(holder.since_unix_s))
            remaining_s = self._left_s(holder)
            raise Refused(
                f"{holder.name} has driven since {since_text} and does until {remaining_s:.0f} s have passed "
                "without a command; "
                "stop works for everybody"
            )

    def _present(self) -> _Holding | None:
        """Who drives now; silence ends it."""
        if self._holding is not None and self._left_s(self._holding) <= 0:
            self._holding = None
        return self._holding

    def _left_s(self, holding: _Holding) -> float:
        return SILENCE_S if holding.working else SILENCE_S - (self._now_s() - holding.heard_s)
