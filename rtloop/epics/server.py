"""`rtloop epics`: a server of Channel Access for one service, until SIGINT or SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from caproto import CaprotoError
from caproto.asyncio.server import Context

from rtloop.client import Client
from rtloop.client.connection import Connection
from rtloop.epics.channels import Channel, make_channel
from rtloop.epics.requests import Requests
from rtloop.epics.variables import LOOP_VARIABLES, STOPS, Status, Variable, axis_variables
from rtloop.errors import RtloopError, UnavailableError, one_line_error

PERIOD_S = 0.1
SILENT_S = 3.0
"""Time without an answer after which a service counts as gone; after a refused connection it counts so at once."""
NICE = 10


class ChannelServer:
    """Channels of the loop behind `connection`; `log` receives one line for each write and for each change of service.

    With `allows_control` clients may write. Channels of an axis exist once the service reported the axis.
    """

    def __init__(self, connection: Connection, prefix: str, allows_control: bool, log: Callable[[str], None]) -> None:
        """Make the channels of the loop as a whole, whose names begin with `prefix`; `refresh` reads a status."""
        self._connection, self._prefix, self._allows_control, self._log = connection, prefix, allows_control, log
        self.database: dict[str, Channel] = {}
        """Channels by name, which the server of caproto reads."""
        self._channels: dict[str, Channel] = {}
        self._requests, self._reader = Requests(), ThreadPoolExecutor(1, "status")
        self._refresh_lock = asyncio.Lock()
        self._refusal_text, self._lost_text = "", ""
        self._message = Variable("MESSAGE", lambda _: self._refusal_text, is_text=True)
        self._add((*LOOP_VARIABLES, self._message))

    def _add(self, variables: tuple[Variable, ...]) -> None:
        """Add the channels of variables that have none yet.

        With `allows_control`, those of variables with a `request` are writable.
        """
        for variable in variables:
            name = f"{self._prefix}{variable.suffix}"
            if name in self._channels:
                continue
            channel = self._channels[name] = self.database[name] = make_channel(name, variable)
            channel.report_write = self._report_write
            if self._allows_control and variable.request is not None:
                channel.writer = self._send

    async def update(self) -> None:
        """Refresh all channels every PERIOD_S, for ever."""
        while True:
            await self.refresh()
            await asyncio.sleep(PERIOD_S)

    async def refresh(self) -> None:
        """Read the status of the service once, and show it; after an error, or SILENT_S without an answer, make all
        channels INVALID.
        """
        async with self._refresh_lock:
            reading = asyncio.get_running_loop().run_in_executor(self._reader, lambda: self._connection.status)
            try:
                status = await asyncio.wait_for(reading, SILENT_S)
            except TimeoutError:
                await self._show_lost(f"the service has not answered for {SILENT_S:g} s")
            except RtloopError as error:
                await self._show_lost(str(error))
            else:
                await self.show_status(status)

    async def show_status(self, status: Status) -> None:
        """Show a response of `/status` in all channels, and add the channels of an axis that has none yet.

        The first response after a time without an answer is logged.
        """
        if self._lost_text:
            self._log("the service answers")
        self._lost_text = ""
        for axis in status.get("axes", {}):
            self._add(axis_variables(axis))
        for channel in self._channels.values():
            await channel.show(channel.variable.read(status), status.get("mode"))

    async def _show_lost(self, text: str) -> None:
        """Make all channels INVALID, and show the reason `text` in MESSAGE; a reason that is new is logged."""
        if text != self._lost_text:
            self._log(f"{text}; the channels are INVALID until the service answers")
        self._lost_text = text
        for channel in self._channels.values():
            await channel.show_lost(text if channel.variable is self._message else channel.variable.lost)

    async def _send(self, channel: Channel, value: object) -> None:
        """Send the request of a written value to the service: a stop at once, any other one after the earlier ones.

        Raises RtloopError for a refusal.
        """
        variable = channel.variable
        if variable.request is None:
            raise TypeError(f"{variable.suffix}: only variables with a request can be written")
        request = partial(variable.request, self._connection, value)
        is_stop = (variable.suffix, value) in STOPS
        await (self._requests.stop(request) if is_stop else self._requests.execute(request))

    async def _report_write(self, channel: Channel, address: str, refusal: RtloopError | None) -> None:
        """Log the outcome of a write by the client at `address`, show its refusal in MESSAGE ("" for None), and refresh
        all channels, so that they show its effect.
        """
        self._refusal_text = "" if refusal is None else f"{channel.name}: {' '.join(str(refusal).split())}"
        self._log(f"written by {address}: {self._refusal_text or f'{channel.name}: done'}")
        await self.refresh()

    def close(self) -> None:
        """Withdraw the requests that have not begun, let the threads end, and release the lock if clients may write; an
        RtloopError of the release is ignored.
        """
        self._requests.close()
        self._reader.shutdown(wait=False, cancel_futures=True)
        if self._allows_control:
            with contextlib.suppress(RtloopError):  # Another client may hold it, or the service may be gone.
                self._connection.release()


def serve(
    control: Path, prefix: str, interface: str, allows_control: bool, name: str, log: Callable[[str], None]
) -> int:
    """Serve the service at the socket `control` on the IPv4 address `interface` until SIGINT or SIGTERM. Returns 0.

    Requests are recorded under `name`. The port is EPICS_CA_SERVER_PORT (5064). The process gets a low CPU priority.
    Raises UnavailableError if the address cannot be used, or if a variable EPICS_… of the environment is invalid.
    """
    logging.getLogger("caproto").setLevel(logging.CRITICAL)  # It logs each refused write with a traceback.
    _limit_beacons(interface)
    with contextlib.suppress(OSError):
        os.nice(NICE)
    try:
        asyncio.run(_serve(Connection(Client(control, name)), prefix, interface, allows_control, log))
    except (CaprotoError, OSError) as error:
        cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
        remedy = "use another --interface or EPICS_CA_SERVER_PORT"
        raise UnavailableError(f"Channel Access on {interface}: {cause}; {remedy}") from None
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # A second Ctrl-C ends a request that still waits.
    return 0


async def _serve(
    connection: Connection, prefix: str, interface: str, allows_control: bool, log: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM. Raises CaprotoError or OSError if the address cannot be used or a variable EPICS_…
    of the environment is invalid.
    """
    channels = ChannelServer(connection, prefix, allows_control, log)
    context = Context(channels.database, [interface])

    async def begin(_: object) -> None:
        """Log the address, then update the channels for ever."""
        access = "clients may write" if allows_control else "read only"
        log(f"serving {prefix}* on {interface}, port {context.port}: {access}")
        await channels.update()

    def log_broken_connection(_: object, report: dict[str, Any]) -> None:
        """Log why caproto has stopped serving a connection, such as bytes that break the protocol."""
        log(f"connection: {one_line_error(report['exception']) if 'exception' in report else report['message']}")

    loop = asyncio.get_running_loop()
    loop.set_exception_handler(log_broken_connection)
    serving = asyncio.ensure_future(context.run(startup_hook=begin))
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, serving.cancel)
    try:
        await serving  # Returns when it is cancelled.
    finally:
        channels.close()


def _limit_beacons(interface: str) -> None:
    """Keep beacons of a loopback address on this host, unless the environment names addresses for them."""
    if ipaddress.IPv4Address(interface).is_loopback:
        os.environ.setdefault("EPICS_CAS_BEACON_ADDR_LIST", interface)
        os.environ.setdefault("EPICS_CAS_AUTO_BEACON_ADDR_LIST", "NO")
