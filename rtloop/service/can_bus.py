"""Supervision over a CAN bus: status, heartbeat and trips out; setpoints, modes and trip resets in; frames of the DBC.

Two threads of the service's process; nothing here is in the path of a tick. What the loop is asked for here is
recorded as asked for by "can"; for the lock, the bus is one of those who give no name. A frame that is malformed,
outside the envelope or does not suit the state is counted in the status frame, said in the log (at most once a
second), and changes nothing.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from rtloop import errors, signals
from rtloop.drivers.errors import DriverError, MissingLibrary
from rtloop.engine.messages import Origin
from rtloop.errors import ConfigError, UnavailableError
from rtloop.recording.file.topics.events import OPERATOR
from rtloop.service.desk import Asker, Refused, asked_by
from rtloop.service.service import Service, State
from rtloop.signals import Mode

POLL_S = 0.01
LOG_PERIOD_S = 1.0
END_TIMEOUT_S = 5.0
log = logging.getLogger("rtloop")


@contextlib.contextmanager
def supervised_by_can(service: Service) -> Iterator[None]:
    """Both threads for as long as the service runs, where [service.can] is there. Raises RtloopError."""
    options = service.configuration.service.can
    if options is None:
        yield
        return
    section = f"{service.config}: service.can"
    try:
        from rtloop.drivers.can.bus import open_bus, require_interface
        from rtloop.drivers.can.frames import load_frames

        require_interface(options)
        frames = load_frames(options)
        bus = open_bus(options)
    except MissingLibrary as error:
        raise errors.MissingExtra(f"{section}: {error}") from None
    except ValueError as error:
        raise ConfigError(str(service.config), [f"service.can.{error}"]) from None
    except DriverError as error:
        raise UnavailableError(f"{section}: {error}") from None
    supervision = CanSupervision(service, bus, frames)
    threads = [threading.Thread(target=work, daemon=True) for work in (supervision.tell, supervision.listen)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        supervision.ending.set()
        for thread in threads:
            thread.join(END_TIMEOUT_S)
        bus.shutdown()


class CanSupervision:
    """What the service says on a bus, and what it does when it is told something there."""

    def __init__(self, service: Service, bus: Any, frames: dict[str, Any]) -> None:
        self._service, self._bus, self._frames = service, bus, frames
        self._options = service.configuration.service.can
        self._commands: dict[int, tuple[Any, Callable[..., object]]] = {
            frames[name].identifier: (frames[name], command)
            for name, command in (("Setpoint", self._setpoint), ("Mode", self._mode), ("TripReset", self._reset))
        }
        self.ending = threading.Event()
        self.refused = 0
        self._said_s = 0.0

    def tell(self) -> None:
        """Status and heartbeat with the periods of the DBC, and a trip at once."""
        due_s = dict.fromkeys(("Status", "Heartbeat"), time.monotonic())
        beat_count, is_tripped = 0, False
        while not self.ending.wait(POLL_S):
            row, now_s = self._newest(), time.monotonic()
            causes = 0 if row is None else int(row[signals.FLAGS]) & signals.TRIP_MASK
            tick = 0 if row is None else int(row[signals.TICK]) % 2**32
            if causes and not is_tripped:
                self._send("Trip", causes, tick)
            is_tripped = bool(causes)
            if now_s >= due_s["Heartbeat"]:
                self._send("Heartbeat", beat_count % 2**16, tick)
                beat_count += 1
            if now_s >= due_s["Status"]:
                mode = Mode.OFF if row is None else row[signals.MODE]
                state = list(State).index(self._service.state)
                self._send("Status", state, mode, self.refused % 2**16, causes)
            for name, due_time_s in due_s.items():
                if now_s >= due_time_s:
                    due_s[name] = now_s + self._frames[name].cycle_s

    def listen(self) -> None:
        """Follow the frames that come, one after the other."""
        while not self.ending.is_set():
            try:
                message = self._bus.recv(POLL_S)
            except Exception as error:  # whatever an interface raises: the service goes on
                self._complain(f"cannot be read: {error}")
                self.ending.wait(LOG_PERIOD_S)
                continue
            if message is not None and message.arbitration_id in self._commands:
                self._follow(message)

    def _follow(self, message: Any) -> None:
        frame, command = self._commands[message.arbitration_id]
        try:
            if not frame.fits(message):
                raise Refused(f"{len(message.data)} bytes; a plain frame of {frame.length} is needed")
            command(*frame.unpack(message.data))
        except Exception as error:  # no frame may end the thread
            self.refused += 1
            self._complain(f"{frame.name}: {'; '.join(getattr(error, 'faults', [str(error)]))}")

    def _setpoint(self, axis: float, value: float) -> None:
        live = self._service.live
        if live is None:
            raise Refused(f"no loop is running: the service is {self._service.state}")
        axes = live.prepared.plan.axes
        if axis >= len(axes):
            raise Refused(f"axis {axis:g}: 0 to {len(axes) - 1} are allowed")
        with self._service.lock.driving(OPERATOR, Origin.CAN):
            live.references.set(axes[int(axis)], {"kind": "hold", "value": value})

    def _mode(self, number: float) -> None:
        if number not in list(Mode):
            raise Refused(f"mode {number:g}: 0 to {max(Mode)} are allowed")
        lock_context = asked_by(Asker(origin=Origin.CAN))
        with lock_context if number == Mode.OFF else self._service.lock.driving(OPERATOR, Origin.CAN):
            self._service.set_mode(Mode(int(number)).name.lower())

    def _reset(self, confirm: float) -> None:
        if confirm != 1:
            raise Refused(f"confirm {confirm:g}: 1 is needed")
        with self._service.lock.driving(OPERATOR, Origin.CAN):
            self._service.reset()

    def _newest(self) -> Any:
        supervisor = self._service.supervisor
        return None if supervisor is None else supervisor.latest()

    def _send(self, name: str, *values: float) -> None:
        try:
            self._bus.send(self._frames[name].message(self._options, values))
        except Exception as error:
            self._complain(f"cannot be written: {error}")

    def _complain(self, text: str) -> None:
        """At most once a second: a flood of frames must not become one of the journal."""
        now_s = time.monotonic()
        if now_s - self._said_s >= LOG_PERIOD_S:
            self._said_s = now_s
            assert self._options is not None
            log.warning("%s: %s", self._options.label, text)
