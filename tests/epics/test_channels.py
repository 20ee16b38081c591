"""Channels without a service: long values, long texts, alarms, and a mode that need not wait for a setpoint."""

from __future__ import annotations

import asyncio
import threading
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("caproto", reason="caproto is missing: pip install 'rtloop[epics]'")

from caproto import ChannelType

from rtloop.epics.channels import TEXT_BYTES, make_channel
from rtloop.epics.server import ChannelServer
from rtloop.epics.variables import LOOP_VARIABLES, axis_variables
from rtloop.errors import LoopFault

TABLE = {variable.suffix: variable for variable in (*LOOP_VARIABLES, *axis_variables("x"))}

TIMEOUT_S = 60.0
LOST = object()
"""Stands for a value of a service that does not answer."""


def read_after(suffix: str, *values: Any) -> tuple[Any, str]:
    """Return the value and the severity of a channel that has shown `values` one after the other."""

    async def show_and_read() -> tuple[Any, str]:
        channel = make_channel(suffix, TABLE[suffix])
        for value in values:
            await (channel.show_lost(None) if value is LOST else channel.show(value, "closed_loop"))
        metadata, data = await channel.read(ChannelType["TIME_" + channel.data_type.name])
        assert metadata.severity == channel.alarm.severity
        return channel.value, channel.alarm.severity.name if data is not None else ""

    return asyncio.run(show_and_read())


def test_a_tick_after_years_is_exact():
    """Five years at 20 kHz: beyond the 32 bits of an integer of Channel Access, within the 53 of a double."""
    ticks = 5 * 365 * 86_400 * 20_000 + 1
    assert read_after("TICK", ticks) == (ticks, "NO_ALARM")


def test_a_long_text_is_cut_between_letters_and_put_on_one_line():
    text, severity = read_after("CAUSE", "refused:\n  " + "µ" * TEXT_BYTES)
    assert severity == "NO_ALARM"
    assert text == "refused: " + "µ" * ((TEXT_BYTES - len("refused: ")) // 2)


def test_an_unknown_value_is_invalid_and_keeps_the_last_one():
    assert read_after("x:POSITION") == (0.0, "INVALID_ALARM"), "before the first value"
    assert read_after("x:POSITION", 12.5, None) == (12.5, "INVALID_ALARM")
    assert read_after("x:POSITION", 12.5, None, 13.0) == (13.0, "NO_ALARM")
    assert read_after("x:POSITION", 12.5, LOST, None) == (12.5, "INVALID_ALARM"), "a service without a loop is back"


def test_a_trip_is_a_major_alarm():
    assert read_after("TRIPPED", "no", "yes") == ("yes", "MAJOR_ALARM")
    assert read_after("STATE", "tripped", "stopped") == ("stopped", "NO_ALARM")


def test_a_unit_that_changes_alone_is_shown():
    """A reference of 5 µm, then one of 5 V in mode raw."""

    async def show_in_both_modes() -> list[str]:
        channel, units = make_channel("REFERENCE", TABLE["x:REFERENCE"]), []
        for mode in ("closed_loop", "raw"):
            await channel.show(5.0, mode)
            units.append(channel.units)
        return units

    assert asyncio.run(show_in_both_modes()) == ["um", "V"]


def test_each_loss_of_the_service_is_logged_and_a_later_axis_gets_channels():
    async def lose_twice() -> list[str]:
        log: list[str] = []
        server = ChannelServer(None, "L:", True, log.append)  # type: ignore[arg-type]
        for axes in ({"x": {}}, {"x": {}, "y": {}}):
            await server.show_status({"state": "running", "armed": True, "axes": axes})
            await server._show_lost("gone")
            await server._show_lost("gone")
        assert "L:y:SETPOINT" in server.database
        return log

    lost = "gone; the channels are INVALID until the service answers"
    assert asyncio.run(lose_twice()) == [lost, "the service answers", lost]


def test_a_write_that_succeeds_clears_the_refusal_of_the_one_before():
    async def write_twice() -> list[Any]:
        connection: Any = SimpleNamespace(status={"state": "running", "armed": True, "axes": {}})
        server = ChannelServer(connection, "L:", True, lambda _: None)
        message, shown = server.database["L:MESSAGE"], []
        for refusal in (LoopFault("refused"), None):
            await server._report_write(message, "127.0.0.1", refusal)
            shown.append(message.value)
        server._reader.shutdown()
        return shown

    assert asyncio.run(write_twice()) == ["L:MESSAGE: refused", ""]


class SlowLoop:
    """Connection whose method `setpoint` does not return before `released` is set."""

    def __init__(self) -> None:
        self.began, self.released = threading.Event(), threading.Event()
        self.commands: list[Any] = []

    def setpoint(self, axis: str, um: float) -> None:
        self.began.set()
        self.released.wait()
        self.commands.append((axis, um))

    def mode(self, mode: str) -> None:
        self.commands.append(mode)


def test_mode_off_overtakes_a_setpoint_that_stands_still():
    """A write of mode raw waits for the setpoint; mode off waits for neither and withdraws mode raw."""
    loop = SlowLoop()

    async def write() -> list[Any]:
        server = ChannelServer(loop, "L:", True, lambda _: None)  # type: ignore[arg-type]
        await server.show_status({"state": "running", "armed": True, "axes": {"x": {}}})
        setpoint, mode = server.database["L:x:SETPOINT"], server.database["L:MODE"]
        tasks = [asyncio.create_task(setpoint.writer(setpoint, 5.0)), asyncio.create_task(mode.writer(mode, "raw"))]
        await asyncio.to_thread(loop.began.wait)
        try:
            await asyncio.wait_for(mode.writer(mode, "off"), TIMEOUT_S)
            assert loop.commands == ["off"]
        finally:
            loop.released.set()
        return await asyncio.gather(*tasks, return_exceptions=True)

    outcomes = asyncio.run(write())
    assert loop.commands == ["off", ("x", 5.0)]
    assert [isinstance(outcome, LoopFault) for outcome in outcomes] == [False, True]
