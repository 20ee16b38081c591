"""How often something may be asked for."""

from __future__ import annotations

import time
from collections.abc import Callable


class Rate:
    """So many a second in the long run, and `burst` at once."""

    def __init__(self, per_s: float, burst: int, now_s: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._now_s = per_s, burst, now_s
        self._left, self._seen_s = float(burst), now_s()

    def __str__(self) -> str:
        return f"{self._per_s:g} a second"

    def allows(self) -> bool:
        """Whether one more is within the rate; it counts if it is."""
        now_s = self._now_s()
        self._left = min(self._left + (now_s - self._seen_s) * self._per_s, float(self._burst))
        self._seen_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True
