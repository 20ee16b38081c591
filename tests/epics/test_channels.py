"""Channels without a service: long values, long texts, alarms, and a mode that need not wait for a setpoint."""

from __future__ import annotations

import asyncio
import threading
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
