"""The table of requests of the control API: REQUESTS.

The service's dispatch (`application`), the OpenAPI description (`description`) and the panel's proxy derive from this
table. A new request is one entry here, and its body in `bodies` if it has one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypedDict, TypeVar

from pydantic import ValidationError

from rtloop.configuration.file import describe
from rtloop.configuration.reference_options import TableOptions
from rtloop.configuration.references import read_samples
from rtloop.errors import ConfigError
from rtloop.service.api.bodies import (
    MAX_BODY_BYTES,
    Body,
    ControllerBody,
    IdentityQuery,
    LearnBody,
    LockBody,
    ModeBody,
    ReferenceBody,
    ResponseBody,
    SetpointBody,
    TuneBody,
    UndoBody,
    WaveformBody,
)
from rtloop.service.api.lanes import Lane
from rtloop.service.api.metrics import metrics_text
from rtloop.service.changing.live import LiveLaw
from rtloop.service.desk import Refusal, current_requester
from rtloop.service.measuring.learning import learn
from rtloop.service.measuring.measurement import MeasurementHistory, ResponseRequest, measure_response
from rtloop.service.service import Service, State
from rtloop.service.status import running_configuration, status
from rtloop.supervision.supervisor import Supervisor

B = TypeVar("B")
SMALL_BYTES = 1 << 16


class Sender(Enum):
    """Clients that may send a request, and whether it needs a valid name."""

    ANYONE = "anyone; a name has no effect"
    NAMED = "any client with a valid name, or without a name"
    LOCK_HOLDER = "the lock holder; the request takes a free lock"
    STOPPER = "anyone; an invalid name is ignored"


@dataclass(frozen=True)
class ApiRequest:
    """One request of the control API.

    `action` receives the service and the validated body (None without one) and returns a JSON value, or the text of
    `/metrics`. It runs in a thread of `lane`; with None it runs at once in the server's event loop, and must be quick.
    """

    method: str
    path: str
    summary: str
    action: Callable[[Service, Any], object]
    body: type[Body] | None = None
    """Fields of the JSON body, or of the query of a GET request."""
    lane: Lane | None = Lane.ORDINARY
    sender: Sender = Sender.LOCK_HOLDER
    errors: tuple[int, ...] = (409, 413, 422, 503, 504)
    """Status codes other than 200 that are documented."""
    page_bytes: int | None = SMALL_BYTES
    """Largest body that the panel forwards; None: the panel does not forward the request."""
    media_type: str = "application/json"
    body_optional: bool = False

    @property
    def name(self) -> str:
        """The path without its slash."""
        return self.path.removeprefix("/")


class _LaneArgument(TypedDict):
    """The lane that several requests share."""

    lane: Lane | None


class _Arguments(_LaneArgument):
    """The arguments of ApiRequest that several requests share."""

    sender: Sender
    errors: tuple[int, ...]


def _tick(action: Callable[[Service, B], int]) -> Callable[[Service, B], dict[str, int]]:
    """Return an action whose response is {tick: the tick that `action` returns}."""
    return lambda service, body: {"tick": action(service, body)}


def _require_running(service: Service, activity: str) -> tuple[Supervisor, LiveLaw]:
    """Return supervisor and law of the loop.

    Raises Refusal without a loop and, with `activity` in its message, in any state but "running".
    """
    live, supervisor = service.require_live(), service.supervisor
    if supervisor is None or service.state is not State.RUNNING:
        remedy = service.ctl("start")
        if service.state is State.TRIPPED:
            arm = [service.ctl("arm")] if service.configuration.service.arm else []
            remedy = ", then ".join([service.ctl("reset"), *arm, remedy])
        raise Refusal(
            f"{activity}: needs a running loop, but the state of the service is {service.state}; use {remedy}"
        )
    return supervisor, live


def _arm(service: Service, _: None) -> dict[str, object]:
    """Arm the service. Returns {}; raises as `Service.arm`."""
    service.arm()
    return {}


def _set_reference(service: Service, body: ReferenceBody) -> int:
    """Start the reference of the body on its axis, and return the tick at which it took effect.

    A table's file is read here, and must be in or below the configuration's folder, because a client must not read
    other files with the service's permissions.
    Raises Refusal without a loop, ConfigError for a table that is invalid or cannot be read, and as
    `LiveReferences.set` or, for a table, `LiveReferences.set_waveform`.
    """
    live = service.require_live()
    if body.reference.get("kind") != "table":
        return live.references.set(body.axis, body.reference)
    try:
        table = TableOptions.model_validate(body.reference)
        samples = read_samples(Path(table.file), folder=service.configuration.folder)
    except ValidationError as error:
        raise ConfigError("reference", describe(error, "reference", body.reference)) from None
    except ValueError as error:
        raise ConfigError("reference", [f"reference.{error}"]) from None
    return live.references.set_waveform(body.axis, samples, table.hold_ticks, table.repeat)


def _set_setpoint(service: Service, body: SetpointBody) -> int:
    """Hold the reference of an axis at a value, µm (V in raw mode). Returns the tick at which it took effect.

    Raises Refusal without a loop, and as `LiveReferences.set`.
    """
    return service.require_live().references.set(body.axis, {"kind": "hold", "value": body.value})


def _play_waveform(service: Service, body: WaveformBody) -> int:
    """Play the body's samples on an axis. Returns the tick of the first one.

    Raises Refusal without a loop, and as `LiveReferences.set_waveform`.
    """
    references = service.require_live().references
    return references.set_waveform(body.axis, body.columns, body.hold_ticks, body.repeat)


def _measure_response(service: Service, body: ResponseBody) -> dict[str, object]:
    """Measure the response of the body's axis. Returns `LoopMeasurement.for_json`; the service stores the figures for
    `/status`.

    Raises Refusal unless the loop runs, and as `measure_response`.
    """
    request, running_loop = ResponseRequest(**body.model_dump(exclude={"axis"})), _require_running(service, "response")
    with service.current_measurement.begin("response", body.axis):
        measurement = measure_response(*running_loop, body.axis, request)
    service.measurements.setdefault(body.axis, MeasurementHistory()).add(measurement)
    return measurement.for_json()


def _learn(service: Service, body: LearnBody) -> dict[str, object]:
    """Learn the table for one period of the reference as `learn` does. Returns `LearnResult.for_json` after all cycles.

    The progress is in `/status` meanwhile. Raises Refusal unless the loop runs, and as `learn`.
    """
    running_loop, current_measurement = _require_running(service, "learn"), service.current_measurement
    with current_measurement.begin("learn", body.axis, body.cycles):
        return learn(*running_loop, body.axis, body.learn_request, current_measurement.add_cycle).for_json()


def _undo(service: Service, body: UndoBody) -> dict[str, object]:
    """Undo the last change of an axis. Returns {tick, undone: the change in words}.

    Raises Refusal without a loop, and as `LiveLaw.undo`.
    """
    tick, change_text = service.require_live().undo(body.axis)
    return {"tick": tick, "undone": change_text}


def _command_origin(service: Service, query: IdentityQuery) -> dict[str, str | None]:
    """Return {name: requester, change: change of a law in words} of the command whose event has this `identity`.

    Each is None if it is unknown, and without a loop.
    """
    supervisor, live, identity = service.supervisor, service.live, int(query.identity)
    name = None if supervisor is None else supervisor.names.requester(identity)
    return {"name": name, "change": None if live is None else live.change_text(identity)}


def _take_lock(service: Service, body: LockBody) -> dict[str, object] | None:
    """Take the lock for the current requester, or renew it; with the body's emergency key also from another holder.

    Returns the lock holder as in `Lock.holder`. Raises Refusal as `Lock.take`, with a key as `Lock.break_open`.
    """
    name = current_requester().name
    if body.emergency_key is None:
        service.lock.take(name)
    else:
        service.lock.break_open(name, body.emergency_key, service.configuration.service.emergency_key_sha256)
    return service.lock.holder


def _release_lock(service: Service, _: None) -> dict[str, object]:
    """Release the requester's lock. Returns {}; raises as `Lock.release`."""
    service.lock.release(current_requester().name)
    return {}


_READ: _Arguments = {"lane": None, "sender": Sender.ANYONE, "errors": ()}
_STATE_READ: _Arguments = {**_READ, "errors": (409,)}
_QUERY_READ: _Arguments = {**_READ, "errors": (422,)}
_BUILD: _LaneArgument = {"lane": Lane.BUILD}
_SAFETY: _LaneArgument = {"lane": Lane.SAFETY}
_LOCK: _Arguments = {"lane": None, "sender": Sender.NAMED, "errors": (409, 413, 422)}

REQUESTS = (
    ApiRequest("GET", "/status", "Return state, rate, faults and newest signals.", lambda s, _: status(s), **_READ),
    ApiRequest("GET", "/configuration", "Return the running configuration with all changes, the columns of a record, "
               "and the paths of shared block and recordings.", lambda s, _: running_configuration(s),
               **_STATE_READ),
    ApiRequest("GET", "/asked_by", "Return the name of the client that sent a command, and the change of a law that "
               "the command made; the `identity` in the command's event selects it. Null if unknown.",
               _command_origin, IdentityQuery, page_bytes=None,
               **_QUERY_READ),
    ApiRequest("GET", "/metrics", "Return metrics in Prometheus' text format.", lambda s, _: metrics_text(s),
               media_type="text/plain; version=0.0.4; charset=utf-8", **_READ),
    ApiRequest("POST", "/arm", "Allow the outputs to be driven.", _arm),
    ApiRequest("POST", "/start", "Set the configured mode.", _tick(lambda s, _: s.start())),
    ApiRequest("POST", "/stop", "Ramp the outputs to their safe values; a stop does not wait for other requests.",
               _tick(lambda s, _: s.stop()),
               sender=Sender.STOPPER, **_SAFETY),
    ApiRequest("POST", "/reset", "Clear latched trips; the outputs stay off.", _tick(lambda s, _: s.reset()),
               **_SAFETY),
    ApiRequest("POST", "/reload", "Read the configuration file again and apply its changes to the running loop.",
               lambda s, _: s.reload_now(), page_bytes=None, **_BUILD),
    ApiRequest("POST", "/mode", "Change the mode bumplessly.", _tick(lambda s, body: s.set_mode(body.mode)), ModeBody),
    ApiRequest("POST", "/reference", "Change the reference of an axis.", _tick(_set_reference), ReferenceBody),
    ApiRequest("POST", "/setpoint", "Hold the reference of an axis at a value, in µm (V in mode raw).",
               _tick(_set_setpoint), SetpointBody),
    ApiRequest("POST", "/waveform", "Play samples as the reference of an axis.", _tick(_play_waveform), WaveformBody,
               page_bytes=MAX_BODY_BYTES),
    ApiRequest("POST", "/response", "Measure the closed loop of an axis about its setpoint.", _measure_response,
               ResponseBody, Lane.MEASUREMENT),
    ApiRequest("POST", "/learn", "Play one period of a reference repeatedly and learn a table with less error; the "
               "table continues to play unless `keep` is false.",
               _learn, LearnBody, Lane.MEASUREMENT, page_bytes=MAX_BODY_BYTES),
    ApiRequest("POST", "/tune", "Change keys of controller, limits, interlocks, prefilter or model.",
               _tick(lambda s, body: s.require_live().tune(body.axis, body.section, body.values)), TuneBody,
               **_BUILD),
    ApiRequest("POST", "/controller", "Verify another controller and load it bumplessly.",
               _tick(lambda s, body: s.require_live().load_controller(body.axis, body.controller)),
               ControllerBody, **_BUILD),
    ApiRequest("POST", "/preview", "Return margins and step response before and after a change as in `/tune`, without "
               "making the change.",
               lambda s, body: s.require_live().preview(body.axis, body.section, body.values), TuneBody,
               sender=Sender.ANYONE, **_BUILD),
    ApiRequest("POST", "/undo", "Undo the last change of an axis.", _undo, UndoBody, **_BUILD),
    ApiRequest("POST", "/lock", "Take the lock if it is free; with the emergency key, also from its holder.",
               _take_lock, LockBody,
               body_optional=True, **_LOCK),
    ApiRequest("DELETE", "/lock", "Release the lock.", _release_lock, **_LOCK),
)  # fmt: skip
"""All requests. The response to a command that the loop executes has the `tick` at which the command took effect.
`/openapi.json` describes this table.
"""
