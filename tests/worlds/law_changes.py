"""Invariant of changes of laws: what an answered change set stays set until another change of the same keys.

Two changes that read the same configuration and each write their own lose one of the two: the loop then runs without a
change that a client was told of.
"""

from __future__ import annotations

from typing import Any

from tests.worlds.world import Request, Run, World

CHANGES = ("/tune", "/controller", "/undo", "/reload", "/learn", "/response")
"""Requests that change laws, or may."""
Key = tuple[str, str, str]
"""Axis, section and key."""


class LawChanges:
    """Values that answered changes have set in the present loop, with the tick of each."""

    def __init__(self, world: World) -> None:
        self._world, self._run = world, None
        self._set: dict[Key, tuple[int, Any]] = {}

    def on_answer(self, request: Request) -> str:
        """Take in an answer; return what is lost, "" if nothing is or a change is under way."""
        if request.path not in CHANGES or (request.run is None and request.path != "/reload"):
            return ""
        self._follow(request)
        live, runs = self._world.service.live, self._world.runs
        under_way = any(other.path in CHANGES and other.code is None for other in self._world.requests)
        if live is None or under_way or self._run is not runs[-1] or self._run.ended_s is not None:
            return ""
        axes = {axis.name: axis for axis in live.prepared.configuration.axes}
        for (axis, section, key), (tick, value) in self._set.items():
            present = getattr(getattr(axes[axis], section), key)
            if present != value:
                return f"{request}: {axis}.{section}.{key} is {present}, and was set to {value} at tick {tick}"
        return ""

    def _follow(self, request: Request) -> None:
        """Take in an answer; a change of which it is unknown what it set makes all unknown."""
        run = request.run if isinstance(request.run, Run) else self._run
        if run is not self._run:
            self._run, self._set = run, {}
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
        return any(
            other.path in CHANGES and other.path != "/tune" and other.code not in (409, 422)
            and other.sent_s <= request.answered_s and other.answered_s >= request.sent_s
            for other in self._world.requests
        )  # fmt: skip
