"""The table of EPICS channels: name, type, value in `/status`, and the request that a written value becomes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rtloop.client.connection import Connection
from rtloop.errors import RtloopError
from rtloop.signals import Mode

Status = Mapping[str, Any]
"""A response of `/status`."""
MODES = tuple(mode.name.lower() for mode in Mode)
NO_YES = ("no", "yes")
IDLE, EXECUTE = "idle", "execute"
STOPS = {("MODE", MODES[Mode.OFF]), ("STOP", EXECUTE)}
"""Suffix and value of the writes that stop the loop."""


class Variable(NamedTuple):
    """One channel: the prefix and `suffix` are its name.

    With `choices` the channel is an enumeration, with `is_text` a long text, else a double. `read` returns its value in
    a status, None for an unknown one. `request` sends a written value to the service; None: read only. The value
    `alarm` is a MAJOR alarm. While no service answers, the channel shows `lost`, or with None its last value.
    """

    suffix: str
    read: Callable[[Status], object]
    request: Callable[[Connection, Any], object] | None = None
    choices: tuple[str, ...] = ()
    is_text: bool = False
    unit: str = ""
    precision: int = 0
    alarm: object = None
    lost: object = None


def axis_variables(axis: str) -> tuple[Variable, ...]:
    """Return the variables POSITION, REFERENCE, ERROR, DRIVE and SETPOINT of an axis; the axis's name and ":" begin
    their suffixes. Only SETPOINT can be written.

    Reference and setpoint are in V in mode raw (`unit_in_mode`), else in µm.
    """

    def signal(name: str) -> Callable[[Status], float | None]:
        """Return a function that returns the signal `name` of the axis from a status, None without a loop or for a
        value that is not finite.
        """
        return lambda status: status.get("axes", {}).get(axis, {}).get(name)

    def set_setpoint(loop: Connection, value: float) -> int:
        """Hold the reference of the axis at a value, in µm (V in mode raw). Returns its first tick.

        Raises RtloopError if the service refuses it or does not answer.
        """
        return loop.setpoint(axis, value)

    return (
        Variable(f"{axis}:POSITION", signal("position_um"), unit="um", precision=4),
        Variable(f"{axis}:REFERENCE", signal("reference_um"), unit="um", precision=4),
        Variable(f"{axis}:ERROR", signal("error_um"), unit="um", precision=4),
        Variable(f"{axis}:DRIVE", signal("drive_v"), unit="V", precision=4),
        Variable(f"{axis}:SETPOINT", signal("reference_um"), set_setpoint, unit="um", precision=4),
    )


def unit_in_mode(variable: Variable, mode: str | None) -> str:
    """Return the unit of a variable: V for a reference or setpoint in mode raw, else its `unit`, also for mode None."""
    is_reference = variable.suffix.endswith((":REFERENCE", ":SETPOINT"))
    return "V" if is_reference and mode == MODES[Mode.RAW] else variable.unit


def _read_cause(status: Status) -> str:
    """Return the reason of a trip, or else its causes, and the latched faults as one text; "" without any."""
    reasons = [status.get("trip_reason") or ", ".join(status.get("trip", ())), *status.get("faults", ())]
    return "; ".join(dict.fromkeys(reason for reason in reasons if reason))


def _command(suffix: str, send: Callable[[Connection], object]) -> Variable:
    """Return the variable of a command: EXECUTE sends it, and the channel always shows IDLE."""

    def request(loop: Connection, value: str) -> object:
        """Send the command. Raises RtloopError for any value but EXECUTE, and for a refusal of the service."""
        if value != EXECUTE:
            raise RtloopError(f"the written value is {value}; allowed: {EXECUTE} (1)")
        return send(loop)

    return Variable(suffix, lambda _: IDLE, request, (IDLE, EXECUTE))


LOOP_VARIABLES = (
    Variable("CONNECTED", lambda _: "yes", choices=NO_YES, lost="no"),
    Variable("STATE", lambda status: status["state"], is_text=True, alarm="tripped"),
    Variable("MODE", lambda status: status.get("mode"), lambda loop, mode: loop.mode(mode), MODES),
    Variable("ARMED", lambda status: NO_YES[status["armed"]], choices=NO_YES),
    Variable("TRIPPED", lambda status: NO_YES[status["state"] == "tripped"], choices=NO_YES, alarm="yes"),
    Variable("CAUSE", _read_cause, is_text=True),
    Variable("TICK", lambda status: status.get("tick")),
    Variable("RATE", lambda status: status.get("rate_hz"), unit="Hz", precision=1),
    Variable("LATE_TICKS", lambda status: status.get("overruns")),
    _command("ARM", Connection.arm),
    _command("START", Connection.start),
    _command("STOP", Connection.stop),
    _command("RESET", Connection.reset),
)
"""Channels of the loop as a whole. A tick is a double: in an integer of Channel Access it would overflow after days."""
