"""What was commanded, tripped and changed, as the loop said it: the last of it, in words, for all clients.

Late ticks with nothing else between them are one row, which grows: on an overloaded host they would push off the rest.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from rtloop.engine.messages import Kind, Origin
from rtloop.errors import RtloopError
from rtloop.panel.views.event_text import OFF, RunState, event_text
from rtloop.panel.views.lateness import LATE_END_KIND, LATE_KIND, LateEpisodes
from rtloop.panel.views.service import Description, Service
from rtloop.recording.file.topics.events import Event, event_from_message

MAX_ROWS = 200
QUERY_TIMEOUT_S = 0.2
"""For a name; ticks come meanwhile, and the ring holds ten seconds: a silent service is asked for the others later."""


@dataclass
class Row:
    """What is kept of an event, or of several that are one."""

    number: int
    """Under which it was told last."""
    event: Event


class OperatorAnswer(NamedTuple):
    """What the service knows of a command: the operator's name, and the change of a law; None for what it does not."""

    name: str | None = None
    change: str | None = None

    def apply_to(self, event: Event) -> Event:
        """An event that was told before the service answered."""
        text = {"change": self.change, "text": self.change} if self.change else {}
        return {**event, "who": self.name or event["who"], "what": {**event["what"], **text}}


class Events:
    """The last KEPT rows. What is told has a number, from 1 on; a row that grew is told again, under another one."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._rows: deque[Row] = deque(maxlen=MAX_ROWS)
        self._late_row: tuple[Row, LateEpisodes] | None = None
        """The last one of late ticks."""
        self._run, self._in_force = -1, RunState({})
        """The run that was told last, and its references and mode."""
        self._lock = threading.Lock()
        self._pending_rows: deque[tuple[Row, int]] = deque(maxlen=MAX_ROWS)
        """Rows whose operator's name the service has not said yet, and the identity of each."""
        self.newest = 0
        """Number of what was told last."""

    def append(self, messages: Any, loop: Description, run: int) -> None:
        """Add records of MESSAGE, (n,), or none, of the run that is read; who asked is asked of the service."""
        is_answering = self._complete_pending()
        if run != self._run:
            is_complete = (
                len(messages) <= MAX_ROWS
            )  # else older events are not told, and nobody knows what they left in force
            mode = OFF if is_complete and not loop.values.get("schedule") else None
            self._run, self._in_force = run, RunState(loop.axes if is_complete else {}, mode)
        for message in messages[-MAX_ROWS:]:
            answer, identity = OperatorAnswer(), int(message["identity"])
            is_from_operator = int(message["kind"]) < Kind.REFUSED and int(message["origin"]) == Origin.OPERATOR
            if is_from_operator and is_answering:
                try:
                    answer = self._query_operator(identity)
                except RtloopError:
                    is_answering = False
            time_ns = round(int(message["tick"]) / loop.rate_hz * 1e9)
            event = {**event_from_message(message, tuple(loop.axes), time_ns, name=answer.name), "run": run}
            if answer.change:
                event["what"]["change"] = answer.change
            if event["kind"] not in (LATE_KIND, LATE_END_KIND):
                event = with_text(event, self._in_force.describe_change(event))
            with self._lock:
                self.newest += 1
                self._append_row(event, loop.rate_hz)
            if is_from_operator and not is_answering:
                self._pending_rows.append((self._rows[-1], identity))

    def _complete_pending(self) -> bool:
        """Have rows tell who asked, oldest first; whether the service answers."""
        while self._pending_rows:
            row, identity = self._pending_rows[0]
            try:
                answer = self._query_operator(identity)
            except RtloopError:
                return False
            self._pending_rows.popleft()
            if answer.name or answer.change:
                with self._lock:
                    self.newest += 1
                    row.number, row.event = self.newest, answer.apply_to(row.event)
        return True

    def events_after(self, number: int) -> list[tuple[int, Event]]:
        """What was told behind `number` and is kept, as it happened, each as it is now, with its number."""
        with self._lock:
            return [(row.number, row.event) for row in self._rows if row.number > number]

    def _append_row(self, event: Event, rate_hz: float) -> None:
        if event["kind"] not in (LATE_KIND, LATE_END_KIND):
            self._rows.append(Row(self.newest, event))
            return
        if (late_row := self._matching_late_row(event)) is not None:
            row, lateness = late_row
            lateness.add(event)
            row.number, row.event = self.newest, with_text(lateness.summary_event())
            return
        lateness = LateEpisodes(event, rate_hz)
        self._late_row = Row(self.newest, with_text(lateness.summary_event())), lateness
        self._rows.append(self._late_row[0])

    def _matching_late_row(self, event: Event) -> tuple[Row, LateEpisodes] | None:
        """The newest row, where that is one of late ticks; of an episode's end, the row that it began in."""
        if self._late_row is None or self._late_row[0].event["run"] != event["run"]:
            return None
        return self._late_row if event["kind"] == LATE_END_KIND or self._late_row[0] is self._rows[-1] else None

    def _query_operator(self, identity: int) -> OperatorAnswer:
        """Answer of the service about a command. Raises UnavailableError, HostRefused."""
        status, _, data = self._service.client.exchange("GET", f"/asked_by?identity={identity}", None, QUERY_TIMEOUT_S)
        response = json.loads(data) if status == 200 else {}
        return OperatorAnswer(response.get("name"), response.get("change"))


def with_text(event: Event, text: str | None = None) -> Event:
    """An event with its words, those of `words` by default."""
    return {**event, "what": {**event["what"], "text": event_text(event) if text is None else text}}
