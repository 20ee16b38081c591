"""The last events of the loop with their texts, for all clients: commands, trips, changed laws.

Late ticks without another event between them are one row that grows, and so is a gap of lost ticks; on an overloaded
host they would displace the other rows.
"""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.engine.messages import Kind, Origin
from rtloop.errors import RtloopError
from rtloop.foundation import timing
from rtloop.panel.events.event_text import OFF, RunState, event_text
from rtloop.panel.events.lateness import LATE_END_KIND, LATE_KIND, LateEpisodes
from rtloop.panel.service.service import Description, Service
from rtloop.recording.file.topics.events import GAP, Event, event_from_message

MAX_ROWS = 200
PANEL = "panel"
"""Value of `who` for ticks that the panel did not read in time."""
GAP_QUIET_S = 1.0
"""Time of ticks without another lost tick after which a gap has ended."""
QUERY_TIMEOUT_S = 0.2
"""Longest wait for an operator's name. The ring holds ten seconds of ticks; a silent service is asked again later."""


@dataclass
class EventRow:
    """A row of the list: an event, or several late ticks together."""

    number: int
    """Number of its newest version."""
    event: Event


@dataclass
class Gap:
    """A gap of lost ticks: its row, and the tick of the newest loss."""

    row: EventRow
    last_tick: int = 0


class OperatorAnswer(NamedTuple):
    """The service's response about a command: operator's name and change of a law; None if unknown."""

    name: str | None = None
    change: str | None = None


class Events:
    """The last MAX_ROWS rows of the list of events. Each version of a row has a number, from 1; a changed row gets a
    new one.
    """

    def __init__(self, service: Service) -> None:
        """Begin with an empty list; `service` names the operators of commands."""
        self._service = service
        self._rows: deque[EventRow] = deque(maxlen=MAX_ROWS)
        self._late_row: tuple[EventRow, LateEpisodes] | None = None
        """Newest row of late ticks."""
        self._gaps: dict[str, Gap] = {}
        """Newest gap of each loser of ticks."""
        self._run, self._run_state = -1, RunState({})
        """Run of the newest event, and its references and mode."""
        self._lock = timing.lock()
        self._pending_rows: deque[tuple[EventRow, int]] = deque(maxlen=MAX_ROWS)
        """Rows whose operator the service has not named yet, with the identity of the command."""
        self.newest = 0
        """Number of the newest version of any row."""

    @property
    def references(self) -> dict[str, dict[str, object]]:
        """Return {axis: {kind, text, value}} of the references that play now, as `PlayedReference` describes them.

        `value` is None unless the reference is constant; an axis whose reference is unknown is missing.
        """
        return {axis: reference._asdict() for axis, reference in self._run_state.references.items()}

    def append(self, messages: npt.NDArray[np.void], loop: Description, run: int) -> None:
        """Add messages (n,) of MESSAGE, n ≥ 0, of the run `run` of a loop as rows, at most the last MAX_ROWS of them.

        Messages about late ticks may extend a row. Requests the operator of each command from the service, waiting at
        most QUERY_TIMEOUT_S each, up to the first request without a response; a later call completes the other rows.
        """
        is_answering = self._complete_pending()
        if run != self._run:
            is_complete = len(messages) <= MAX_ROWS  # Else older events are dropped, and their effect is unknown.
            mode = OFF if is_complete and not loop.values.get("schedule") else None
            self._run, self._run_state = run, RunState(loop.axes if is_complete else {}, mode)
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
            self._append_event(event, loop.rate_hz)
            if is_from_operator and not is_answering:
                self._pending_rows.append((self._rows[-1], identity))

    def add_lost_ticks(self, who: str, ticks: int, cause: str, tick: int, loop: Description, run: int) -> None:
        """Add `ticks` lost at or before `tick` by `who`, RECORDER or PANEL, with their `cause` in words.

        They extend the loser's newest gap; a gap ends after GAP_QUIET_S without a lost tick.
        """
        gap = self._gaps.get(who)
        is_open = gap is not None and gap.row.event["run"] == run and tick <= gap.last_tick + GAP_QUIET_S * loop.rate_hz
        if gap is None or not is_open:
            event = {"tick": tick, "time_ns": round(tick / loop.rate_hz * 1e9), "kind": GAP, "who": who, "axis": None}
            gap = self._gaps[who] = Gap(EventRow(0, event | {"what": {"ticks": 0}, "run": run}))
        gap.last_tick = tick
        details = {"ticks": gap.row.event["what"]["ticks"] + ticks, "cause": cause}
        self._renew(gap.row, add_text(summary := {**gap.row.event, "what": details}, event_text(summary)))

    def _complete_pending(self) -> bool:
        """Request operators and changes of the pending rows from the service, oldest first, and add them to the rows.

        Returns False at the first request without a response, else True, also without pending rows.
        """
        while self._pending_rows:
            row, identity = self._pending_rows[0]
            try:
                name, change = self._query_operator(identity)
            except RtloopError:
                return False
            self._pending_rows.popleft()
            if name or change:
                details = row.event["what"] | ({"change": change, "text": change} if change else {})
                self._renew(row, {**row.event, "who": name or row.event["who"], "what": details})
        return True

    def events_after(self, number: int) -> list[tuple[int, Event]]:
        """Return (number, event) of the newest version of each row whose number is above `number`, oldest row first.

        A changed row keeps its place in this order and gets a new number, so that the numbers need not ascend.
        """
        with self._lock:
            return [(row.number, row.event) for row in self._rows if row.number > number]

    def _append_event(self, event: Event, rate_hz: float) -> None:
        """Add an event with its text as a new row, or to the row of late ticks that it belongs to."""
        if event["kind"] not in (LATE_KIND, LATE_END_KIND):
            self._renew(EventRow(0, event), add_text(event, self._run_state.describe_change(event)))
            return
        if (late_row := self._matching_late_row(event)) is not None:
            late_row[1].add(event)
        else:
            self._late_row = late_row = EventRow(0, event), LateEpisodes(event, rate_hz)
        summary = late_row[1].summary_event()
        self._renew(late_row[0], add_text(summary, event_text(summary)))

    def _renew(self, row: EventRow, event: Event) -> None:
        """Store an event in a row under the next number; a row with the number 0 is new, and is added at the end."""
        with self._lock:
            self.newest += 1
            if row.number == 0:
                self._rows.append(row)
            row.number, row.event = self.newest, event

    def _matching_late_row(self, event: Event) -> tuple[EventRow, LateEpisodes] | None:
        """Return the row of late ticks that an event of the kind LATE_KIND or LATE_END_KIND extends, with its episodes.

        For LATE_END_KIND it is the newest row of late ticks in the event's run; for LATE_KIND only if no other row came
        after it. None if there is no such row.
        """
        if self._late_row is None or self._late_row[0].event["run"] != event["run"]:
            return None
        return self._late_row if event["kind"] == LATE_END_KIND or self._late_row[0] is self._rows[-1] else None

    def _query_operator(self, identity: int) -> OperatorAnswer:
        """Return the service's response about the command `identity`; None in both fields for an unknown command.

        Both are None also if the service refuses.
        Raises UnavailableError without an answer within QUERY_TIMEOUT_S, HostRefusal for a server that is not trusted.
        """
        status, _, data = self._service.client.exchange("GET", f"/asked_by?identity={identity}", None, QUERY_TIMEOUT_S)
        response = json.loads(data) if status == 200 else {}
        return OperatorAnswer(response.get("name"), response.get("change"))


def add_text(event: Event, text: str) -> Event:
    """Return a copy of an event with the key `text` added to its `what`."""
    return {**event, "what": {**event["what"], "text": text}}
