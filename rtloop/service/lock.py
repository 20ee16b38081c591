"""The lock of a service: one named requester at a time sends commands, and many watch.

The first command of a name takes a free lock, and so does the request `/lock`. The lock is free again after
LOCK_TIMEOUT_S without a command of its holder. It avoids conflicts between operators and is no access control: a client
of the control socket may use any name.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rtloop.engine.messages import Origin
from rtloop.foundation import timing
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.service.desk import Refusal, Requester, use_requester

LOCK_TIMEOUT_S = 60.0
log = logging.getLogger("rtloop")


@dataclass
class _LockHolder:
    """The lock holder: name, time of taking the lock (s since 1970), monotonic time of the last command, number of
    requests in progress.
    """

    name: str
    since_unix_s: float
    last_command_s: float
    active_requests: int = 0


class Lock:
    """A lock that one name holds at a time. Thread-safe; `now_s` is a monotonic clock."""

    def __init__(self, now_s: Callable[[], float] = timing.monotonic_s) -> None:
        """Begin with a free lock; `now_s` returns a monotonic time in s."""
        self._now_s = now_s
        self._guard = timing.lock()
        self._holder: _LockHolder | None = None

    @property
    def holder(self) -> dict[str, object] | None:
        """{name, since_unix_s: start, until_unix_s: end if the holder sends no further command}, times in s since 1970;
        None for a free lock.
        """
        with self._guard:
            holder = self._current_holder()
            if holder is None:
                return None
            until_s = timing.unix_s() + self._remaining_s(holder)
            since_s = holder.since_unix_s
            return {"name": holder.name, "since_unix_s": round(since_s, 3), "until_unix_s": round(until_s, 3)}

    def take(self, name: str) -> None:
        """Take the lock for `name`, or, if `name` holds it, restart its LOCK_TIMEOUT_S. Raises Refusal while another
        name holds the lock.
        """
        with self._guard:
            self._take(name)

    def release(self, name: str) -> None:
        """Release the lock that `name` holds; a free lock stays free. Raises Refusal while another name holds it."""
        with self._guard:
            self._require_available(name)
            self._holder = None

    def break_open(self, name: str, key: str, key_sha256: str | None) -> None:
        """Take the lock for `name`, also from its holder, with the emergency key; log a takeover and a wrong key.

        `key_sha256` is the SHA-256 of the configured key in hexadecimal digits, None if no key is configured. Raises
        Refusal for None and for another `key`, also while the lock is free.
        """
        if key_sha256 is None:
            raise Refusal("no emergency key is configured; set service.emergency_key_sha256")
        if not hmac.compare_digest(hashlib.sha256(key.encode(errors="replace")).hexdigest(), key_sha256):
            log.warning("%s gave a wrong emergency key", name)
            raise Refusal(
                "the given emergency key is wrong; allowed: the key whose SHA-256 is service.emergency_key_sha256"
            )
        with self._guard:
            holder = self._current_holder()
            if holder is not None and holder.name != name:
                log.warning(
                    "%s takes the lock from %s: the request had the emergency key (service.emergency_key_sha256)",
                    name,
                    holder.name,
                )
                self._holder = None
            self._take(name)

    @contextmanager
    def hold(self, name: str, origin: Origin = Origin.OPERATOR) -> Iterator[None]:
        """Take or renew the lock for `name`, keep it from expiring during the work within, and let this work send its
        commands under `name`.

        `origin` is the commands' origin in the recording. Afterwards the lock stays taken for LOCK_TIMEOUT_S. Raises
        Refusal while another name holds the lock; so does a command within, once another name has taken the lock.
        """
        with self._guard:
            holder = self._take(name)
            holder.active_requests += 1
        try:
            with use_requester(Requester(name, origin, lambda: self._require_held_by(name))):
                yield
        finally:
            with self._guard:
                holder.active_requests -= 1
                holder.last_command_s = self._now_s()

    def _require_held_by(self, name: str) -> None:
        """Raise Refusal if another name than `name` holds the lock now; a free lock passes."""
        with self._guard:
            self._require_available(name)

    def _take(self, name: str) -> _LockHolder:
        """Take or renew the lock and return its holder; `_guard` must be held. Raises as `take`."""
        self._require_available(name)
        if self._holder is None:
            self._holder = _LockHolder(name, timing.unix_s(), 0.0)
            log.info("%s takes the lock", name)
        self._holder.last_command_s = self._now_s()
        return self._holder

    def _require_available(self, name: str) -> None:
        """Raise Refusal while another name than `name` holds the lock; `_guard` must be held."""
        holder = self._current_holder()
        if holder is not None and holder.name != name:
            since_text = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(holder.since_unix_s))
            remaining_s = self._remaining_s(holder)
            name_text = "operator (a client without a name)" if holder.name == OPERATOR else holder.name
            raise Refusal(
                f"{name_text} has held the lock since {since_text}; the lock becomes free after "
                f"{remaining_s:.0f} s without a command; `rtloop ctl stop` works without the lock"
            )

    def _current_holder(self) -> _LockHolder | None:
        """Return the holder, None if there is none; an expired holder is removed first. `_guard` must be held."""
        if self._holder is not None and self._remaining_s(self._holder) <= 0:
            self._holder = None
        return self._holder

    def _remaining_s(self, holder: _LockHolder) -> float:
        """Return the time, s, after which the lock is free if its holder sends no further command; 0 or less once the
        lock has expired, LOCK_TIMEOUT_S during a request of the holder.
        """
        return LOCK_TIMEOUT_S if holder.active_requests else LOCK_TIMEOUT_S - (self._now_s() - holder.last_command_s)
