"""Channels of Channel Access: they show values with an alarm, and pass a client's written value to a function."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from caproto import (
    AccessRights,
    AlarmSeverity,
    AlarmStatus,
    CaprotoValueError,
    ChannelAlarm,
    ChannelChar,
    ChannelData,
    ChannelDouble,
    ChannelEnum,
    ChannelType,
    Forbidden,
    native_type,
)

from rtloop.epics.variables import Variable, unit_in_mode
from rtloop.errors import RtloopError

TEXT_BYTES = 1000
"""Longest text; a client reserves as much."""
Writer = Callable[["Channel", object], Awaitable[None]]
"""Function that receives a channel and the value that a client wrote. Raises RtloopError to refuse it."""


class Channel(ChannelData):
    """A channel that shows `variable`; read only while `writer` is None."""

    name: str
    variable: Variable
    writer: Writer | None = None
    report_write: Callable[[Channel, str, RtloopError | None], Awaitable[None]]
    """Receives the channel, the address of the client, and None or the refusal."""
    _shown: tuple[object, ...] = ()

    async def show(self, value: object, mode: str | None) -> None:
        """Show a value that the service reported in `mode`, with a MAJOR alarm if it is the variable's `alarm`.

        `value` None: unknown; the channel keeps the last value, with the alarm INVALID.
        """
        unit = unit_in_mode(self.variable, mode)
        if value is None:
            await self._show(None, AlarmStatus.READ, AlarmSeverity.INVALID_ALARM, unit)
        elif value == self.variable.alarm:
            await self._show(value, AlarmStatus.STATE, AlarmSeverity.MAJOR_ALARM, unit)
        else:
            await self._show(value, AlarmStatus.NO_ALARM, AlarmSeverity.NO_ALARM, unit)

    async def show_lost(self, value: object) -> None:
        """Show that no service answers: INVALID, with `value` or, for None, the last value."""
        await self._show(value, AlarmStatus.COMM, AlarmSeverity.INVALID_ALARM, None)

    async def _show(self, value: Any, status: AlarmStatus, severity: AlarmSeverity, unit: str | None) -> None:
        """Send value, alarm and, for a number, unit to the subscribers, unless all are shown already; `value` or `unit`
        None keeps the shown one.
        """
        shown = (value, status, severity, unit)
        if shown == self._shown:
            return
        self._shown = shown
        metadata: dict[str, Any] = {"units": unit} if unit is not None and isinstance(self, ChannelDouble) else {}
        value = self.value if value is None else value
        # caproto's check of a value would replace the alarm by one of its own.
        await super().write(value, verify_value=False, status=status, severity=severity, **metadata)

    def check_access(self, hostname: str, username: str) -> AccessRights:
        """Return READ, with WRITE if the channel has a writer; the client's `hostname` and `username` are ignored."""
        return AccessRights.READ if self.writer is None else AccessRights.READ | AccessRights.WRITE

    async def auth_write(self, hostname: str, username: str, data: object, data_type: ChannelType, metadata: object, *,
                         flags: int = 0, user_address: tuple[str, int] | None = None) -> None:  # fmt: skip
        """Convert a client's value, pass it to `writer`, and report the outcome to `report_write`; alarms and limits
        that the client sends are dropped.

        Raises Forbidden for a channel that is read only; RtloopError, whose text the client receives, for a value that
        does not suit the channel or that the service refuses.
        """
        if self.writer is None:
            raise Forbidden(f"{self.name} is read only")
        refusal = None
        try:
            await self.write_from_dbr(data, data_type, None)
        except RtloopError as error:
            refusal = error
        except (CaprotoValueError, AttributeError, TypeError):  # No value, several, an acknowledgement of an alarm.
            allowed = ", ".join(self.variable.choices) or "a number"
            refusal = RtloopError(f"the written value is not a value of this channel; allowed: {allowed}")
        await self.report_write(self, "?" if user_address is None else user_address[0], refusal)
        if refusal is not None:
            raise refusal

    async def write(self, value: object, **_: object) -> None:
        """Pass a client's value to `writer`, without showing it: the shown value comes from the service alone.

        Called by caproto's `write_from_dbr`. No effect without a writer. Raises RtloopError for a refused value,
        CaprotoValueError for several values.
        """
        if self.writer is not None:
            await self.writer(self, self.from_client(self.preprocess_value(value)))

    def from_client(self, value: Any) -> object:
        """Return a client's value in the form that `writer` expects: unchanged, unless a subclass converts it."""
        return value


class NumberChannel(Channel, ChannelDouble):
    """A channel whose value is a number of double precision."""

    async def write_from_dbr(self, data: Any, data_type: ChannelType, metadata: object, *, flags: int = 0) -> None:
        """Convert a client's value and write it. Raises CaprotoValueError for an empty text (caproto would write 0)."""
        if native_type(data_type) is ChannelType.STRING and not all(text.strip() for text in data):
            raise CaprotoValueError(data)
        await super().write_from_dbr(data, data_type, metadata, flags=flags)

    def from_client(self, value: float) -> float:
        """Return the client's value as a float."""
        return float(value)


class ChoiceChannel(Channel, ChannelEnum):
    """A channel with one of some words."""

    def from_client(self, value: float) -> str:
        """Return the word with the number `value`; caproto converts a written word to its number before.

        Raises CaprotoValueError for a number without a word.
        """
        if value not in range(len(self.enum_strings)):
            raise CaprotoValueError(value)
        return self.enum_strings[int(value)]


class TextChannel(Channel, ChannelChar):
    """A channel with a text of at most TEXT_BYTES bytes of UTF-8, as an array of characters."""

    async def _show(self, value: str | None, status: AlarmStatus, severity: AlarmSeverity, unit: str | None) -> None:
        """Show the text on one line, its line breaks as spaces, cut to TEXT_BYTES; else as `Channel._show`."""
        if value is not None:
            value = " ".join(value.split()).encode()[:TEXT_BYTES].decode(errors="ignore")
        await super()._show(value, status, severity, unit)


def make_channel(name: str, variable: Variable) -> Channel:
    """Return the channel of a variable, a ChoiceChannel, TextChannel or NumberChannel, with `name` as its full name.

    It is read only, and INVALID until its first value.
    """
    alarm = ChannelAlarm(status=AlarmStatus.UDF, severity=AlarmSeverity.INVALID_ALARM)
    if variable.choices:
        channel = ChoiceChannel(alarm=alarm, value=variable.choices[0], enum_strings=variable.choices)
    elif variable.is_text:
        channel = TextChannel(alarm=alarm, value="", max_length=TEXT_BYTES, string_encoding="utf-8")
    else:
        channel = NumberChannel(alarm=alarm, value=0.0, units=variable.unit, precision=variable.precision)
    channel.name, channel.variable = name, variable
    return channel
