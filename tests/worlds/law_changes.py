"""Invariant of changes of laws: what an answered change or a reload set stays set until another change of it.

Two changes that read the same configuration and each write their own lose one of the two: the loop then runs without a
change that a client was told of.
"""

from __future__ import annotations

from typing import Any

from tests.worlds.world import Request, Run, World

KEYS = (("controller", "gain"), ("interlocks", "position_um"), ("limits", "command_um"))
"""Sections and keys that the requests change."""
CHANGES = ("/tune", "/controller", "/undo", "/reload", "/learn", "/response")
"""Requests that change laws, or may."""
SIGNAL_S = 1.0
"""Longest time for which a reload by a signal may be under way."""
Key = tuple[str, str, str]
"""Axis, section and key."""


class LawChanges:
    """Values that answered changes have set in the present loop, with the tick of each."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._run: Run | None = None
        self._set: dict[Key, tuple[int, Any]] = {}
        self._signals, self._configuration = 0, world.service.configuration
        self._is_file_known = True
        """Whether the newest reload has set all values; one that is refused may have set some."""

    def on_answer(self, request: Request) -> str:
        """Take in an answer; return what is lost, "" if nothing is or a change is under way."""
        if request.path not in CHANGES or (request.run is None and request.path != "/reload"):
            return ""
        self._follow(request)
        service, run = self._world.service, self._run
        under_way = any(other.path in CHANGES and other.code is None for other in self._world.requests)
        under_way |= self._has_signal(self._world.turns.now_s - SIGNAL_S)
        if service.live is None or run is None or under_way or run is not self._world.runs[-1] or run.ended_s:
            return ""
        present = values(service.live.prepared.configuration.axes)
        in_file = values(service.configuration.axes) if self._is_file_known else {}
        expected = {key: value for key, value in in_file.items() if not self._is_touched(key)}
        expected |= {key: value for key, (_, value) in self._set.items()}
        lost = [f"{key} is {present[key]}, and was set to {value}" for key, value in expected.items()
                if present[key] != value]  # fmt: skip
        return f"{request}: {lost[0]}" if lost else ""

    def _is_touched(self, key: Key) -> bool:
        """Return whether a change may have set a key since the last reload, or, without one, the run's begin."""
        assert self._run is not None
        reloads_s = [other.sent_s for other in self._world.requests if (other.path, other.code) == ("/reload", 200)]
        since_s = max([self._run.began_s, *reloads_s, *self._world.signals_s])
        return any(
            other.path in CHANGES and other.path != "/reload" and other.code not in (409, 422)
            and other.answered_s >= since_s and other.body["axis"] == key[0]
            and (other.path != "/tune" or (other.body["section"] == key[1] and key[2] in other.body["values"]))
            for other in self._world.requests
        )  # fmt: skip

    def _follow(self, request: Request) -> None:
        """Take in an answer; a change of which it is unknown what it set makes all unknown."""
        run = request.run if isinstance(request.run, Run) else self._run
        if run is not self._run:
            self._run, self._set = run, {}
        if self._signals != len(self._world.signals_s) or request.path == "/reload":
            self._signals, self._set, self._is_file_known = len(self._world.signals_s), {}, False
        if self._configuration is not self._world.service.configuration:
            self._configuration, self._is_file_known = self._world.service.configuration, True
        if request.code in (409, 422):
            return
        if request.code != 200 or request.path not in ("/tune", "/controller", "/undo"):
            self._set.clear()
            return
        tick, body = request.answer["tick"], request.body
        if request.path == "/tune":
            for key, value in body["values"].items():
                name = (body["axis"], body["section"], key)
                if self._overlaps_another(request):  # It may have been taken back before its answer.
                    self._set.pop(name, None)
                elif self._set.get(name, (-1, None))[0] <= tick:
                    self._set[name] = tick, value
            return
        is_undone = request.path == "/undo"
        section, _, keys = request.answer["undone"].partition(": ") if is_undone else ("controller", "", "")
        for name in [*self._set]:
            is_meant = name[0] == body["axis"] and name[1] == section and (not keys or name[2] in keys.split(", "))
            if is_meant and self._set[name][0] <= tick:
                del self._set[name]

    def _overlaps_another(self, request: Request) -> bool:
        """Return whether a change of another kind was under way while `request` was."""
        return self._has_signal(request.sent_s - SIGNAL_S) or any(
            other.path in CHANGES and other.path != "/tune" and other.code not in (409, 422)
            and other.sent_s <= request.answered_s and other.answered_s >= request.sent_s
            for other in self._world.requests
        )  # fmt: skip

    def _has_signal(self, since_s: float) -> bool:
        return any(signal_s >= since_s for signal_s in self._world.signals_s)


def values(axes: Any) -> dict[Key, Any]:
    """Return the values of KEYS of axes."""
    return {(axis.name, *key): getattr(getattr(axis, key[0]), key[1]) for axis in axes for key in KEYS}
