"""Who asked for what, where the service is slow to say so."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rtloop.engine.messages import MESSAGE, Kind, Origin
from rtloop.errors import UnavailableError
from rtloop.panel.views.events import Events

LOOP: Any = SimpleNamespace(rate_hz=1000.0, axes={"x": {}})


def test_a_silent_service_is_asked_for_one_name_and_not_for_all() -> None:
    asked: list[str] = []

    def exchange(_: str, resource: str, *__: object) -> tuple[int, str, bytes]:
        asked.append(resource)
        if len(asked) == 2:
            raise UnavailableError("no answer")
        return 200, "application/json", b'{"name": "ada"}'

    messages = np.zeros(50, MESSAGE)
    messages["kind"], messages["origin"], messages["identity"] = Kind.SET_MODE, Origin.OPERATOR, np.arange(50)
    service: Any = SimpleNamespace(client=SimpleNamespace(exchange=exchange, path=Path("none")))
    events = Events(service)
    events.take(messages, LOOP, 0)
    assert asked == ["/asked_by?identity=0", "/asked_by?identity=1"]
    told = [event["who"] for event in events.after(0)[1]]
    assert (told[0], set(told[1:]), len(told)) == ("ada", {"operator"}, 50)
    events.take(messages[:1], LOOP, 0)
    assert len(asked) == 3, "it may answer again"
