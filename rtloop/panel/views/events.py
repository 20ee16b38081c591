"""What was commanded, tripped and changed, as the loop said it: the last of it, in words, for all clients."""

from __future__ import annotations

import json
import threading
from collections import deque
from typing import Any

from rtloop.engine.messages import Kind, Origin
from rtloop.errors import RtloopError
from rtloop.panel.views.link import Description, Service
from rtloop.panel.views.words import words
from rtloop.recording.file.topics.events import Event, event_of

KEPT = 200
ASK_S = 0.2
"""For a name; ticks come meanwhile, and the ring holds ten seconds: a silent service is not asked for the others."""


class Events:
    """The last KEPT, numbered from 1 on."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._kept: deque[tuple[int, Event]] = deque(maxlen=KEPT)
        self._count = 0
        self._lock = threading.Lock()

    def take(self, messages: Any, loop: Description, run: int) -> None:
        """Add records of MESSAGE, (n,), of the run that is read; who asked is asked of the service while it answers."""
        answers = True
        for message in messages[-KEPT:]:
            name = None
            if answers and int(message["kind"]) < Kind.REFUSED and int(message["origin"]) == Origin.OPERATOR:
                try:
                    name = self._name(int(message["identity"]))
                except RtloopError:
                    answers = False
            time_ns = round(int(message["tick"]) / loop.rate_hz * 1e9)
            event = event_of(message, tuple(loop.axes), time_ns, name=name)
            event["what"]["text"] = words(event)
            with self._lock:
                self._count += 1
                self._kept.append((self._count, {**event, "run": run}))

    def after(self, number: int) -> tuple[int, list[Event]]:
        """The number of the newest, and those that are kept behind `number`."""
        with self._lock:
            return self._count, [event for at, event in self._kept if at > number]

    def _name(self, identity: int) -> str | None:
        """Of the operator; None where no name was given. Raises UnavailableError, HostRefused."""
        status, _, data = self._service.client.exchange("GET", f"/asked_by?identity={identity}", None, ASK_S)
        return json.loads(data)["name"] if status == 200 else None
