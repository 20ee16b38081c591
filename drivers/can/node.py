"""The simulated rig as a node on a CAN bus: a process that answers drive frames with samples.

The rig runs by its own clock on a fixed fine grid, with or without drive frames. A drive frame that is not newer than
the last one is ignored. Without drive frames for the watchdog's time, the outputs ramp to 0 V. When frames come again,
the outputs ramp to the commanded drives and then follow them.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence

import numpy as np

from rtloop.drivers.can.bus import BUS_ERRORS, error_text, open_bus, require_interface
from rtloop.drivers.can.driver import LISTEN_S
from rtloop.drivers.can.extra import can
from rtloop.drivers.can.frames import Frame, choose_exchange, load_frames, require_signals
from rtloop.drivers.can.options import CanOptions
from rtloop.drivers.errors import DriverError
from rtloop.hil.free_running import FreeRunningRig

RIG_RATE_HZ = 20_000.0
IDLE_S, RAMP_S = 0.01, 0.001
SAFE_V, STARTING = 0.0, 0.0
ANNOUNCED = ("Channels", "Serving", "Watchdog", "Identity")
"""Signals of the frame Node."""


class RigNode:
    """A node on an open bus; its owner calls `step` continually."""

    def __init__(self, bus: can.BusABC, options: CanOptions, axes: Sequence[str]) -> None:
        """Build the rig at rest and compile it; nothing is sent.

        Raises ValueError if rig, axes and DBC file do not fit together, and if the file has no frame Node with the
        signals ANNOUNCED.
        """
        self._bus, self._options = bus, options
        frames = load_frames(options)
        self._exchange = choose_exchange(frames, len(axes), options)
        if "Node" not in frames:
            raise ValueError(
                f"dbc: {options.dbc}: has no message Node, which the simulated node sends; add the message to this file"
            )
        self._announcement: Frame = frames["Node"]
        require_signals(self._announcement, ANNOUNCED, options)
        self._rig = FreeRunningRig(options, axes, RIG_RATE_HZ)
        self.drive_v = self._rig.drive_v
        self._target_v = np.full(len(axes), SAFE_V)
        self._padding = [0.0] * (self._exchange.channel_capacity - len(axes))
        self.samples = self.ignored = self.parked = 0
        self._following, self._newest = False, 0
        self._serving, self._identity = False, secrets.randbits(32)
        self._start_s = self._last_move_s = self._last_frame_s = time.monotonic()

    def announce(self) -> None:
        """Send this node's announcement: number of channels, starting or serving, watchdog time in ms, random identity.

        Raises python-can's errors.
        """
        values = (self._exchange.channels, self._serving, self._options.watchdog_ms, self._identity)
        self._bus.send(self._announcement.message(self._options, values))

    def require_alone(self) -> None:
        """Announce this node, listen for LISTEN_S, then mark this node as serving in its later announcements.

        Raises DriverError, without the mark, if a sample of another node, or another node's announcement, comes in this
        time. Raises python-can's errors.
        """
        self.announce()
        deadline_s = time.monotonic() + LISTEN_S
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            message = self._bus.recv(remaining_s)
            if message is None:
                break
            if (
                message.arbitration_id == self._exchange.sample.identifier
                or self._foreign_node_state(message) is not None
            ):
                raise DriverError(
                    f"{self._options.label}: another rtloop node is on this bus already; stop it, or use another bus"
                )
        self._serving = True

    def _foreign_node_state(self, message: can.Message) -> float | None:
        """Return the state in another node's announcement: STARTING, or 1 for serving.

        Returns None for any other message, this node's own announcement included.
        """
        if message.arbitration_id != self._announcement.identifier or not self._announcement.fits(message):
            return None
        _, serving, _, identity = self._announcement.unpack(message.data)
        return None if identity == self._identity else serving

    def step(self) -> None:
        """Wait for a frame, advance the rig to the present time, and process the frame.

        The wait is at most IDLE_S, or RAMP_S while the outputs do not follow drive frames. A drive frame is applied, or
        counted in `ignored`. The announcement of another node that starts is answered by this node's own. After
        `watchdog_ms` without an accepted drive frame, outputs that followed drive frames begin a ramp to 0 V; the ramp
        is counted in `parked` unless all outputs are at 0 V. Raises python-can's errors.
        """
        message = self._bus.recv(IDLE_S if self._following else RAMP_S)
        now_s = time.monotonic()
        self._catch_up(now_s)
        if message is not None and message.arbitration_id == self._exchange.drive.identifier:
            if self._apply_drive_frame(message):
                self._last_frame_s = now_s
                return
            self.ignored += 1
        elif message is not None and self._foreign_node_state(message) == STARTING:
            self.announce()
        if self._following and now_s - self._last_frame_s > self._options.watchdog_ms * 1e-3:
            self.parked += bool(np.any(self.drive_v != SAFE_V))
            self._target_v[:], self._following, self._newest = SAFE_V, False, 0

    def _apply_drive_frame(self, message: can.Message) -> bool:
        """Take the frame's volts as target, answer with a sample, and return True.

        The outputs jump to the target if they follow drive frames, else they ramp there. Returns False, without an
        answer, for a malformed frame or one not newer than the last. Sequence 0 is always accepted, and its volts are
        reached by a ramp; after it, after the start and after a parking, any sequence is accepted.
        """
        drive, highest = self._exchange.drive, self._exchange.highest_sequence
        if not drive.fits(message):
            return False
        sequence, *volts = drive.unpack(message.data)
        if sequence and self._newest and not 0 < (sequence - self._newest) % highest <= highest // 2:
            return False
        self._newest = int(sequence)
        self._target_v[:] = volts[: self.drive_v.size]
        if sequence == 0:
            self._following = bool(np.all(self.drive_v == self._target_v))
        if self._following:
            self.drive_v[:] = self._target_v
        values = (sequence, 0.0, *self._rig.sample_v, *self._padding)
        self._bus.send(self._exchange.sample.message(self._options, values))
        self.samples += 1
        return True

    def _catch_up(self, now_s: float) -> None:
        """Advance the rig, and a ramp of its outputs, to the time `now_s` of `time.monotonic`.

        When a ramp has reached the volts of a drive frame, later drive frames set the outputs at once.
        """
        self._rig.advance_to(now_s - self._start_s)
        if not self._following:
            step_v = self._options.park_slew_v_per_s * (now_s - self._last_move_s)
            self.drive_v[:] = np.clip(self._target_v, self.drive_v - step_v, self.drive_v + step_v)
            self._following = self._newest > 0 and bool(np.all(self.drive_v == self._target_v))
        self._last_move_s = now_s


def serve(
    options: CanOptions,
    axes: Sequence[str],
    is_stopped: Callable[[], bool],
    on_ready: Callable[[], None] = lambda: None,
) -> str:
    """Run a node on the bus of the options until `is_stopped()`; return a sentence with the numbers of samples, ignored
    frames and parkings.

    `on_ready` is called after LISTEN_S without another node on the bus. Raises ValueError for an interface that
    python-can lacks, if rig, axes and DBC file do not fit together, and for a DBC file without the frame Node;
    DriverError if the bus cannot be opened or fails, and for another node on the bus.
    """
    require_interface(options)
    with open_bus(options) as bus:
        node = RigNode(bus, options, axes)
        try:
            node.require_alone()
            on_ready()
            while not is_stopped():
                node.step()
        except BUS_ERRORS as error:
            raise DriverError(f"{options.label}: {error_text(error)}") from error
    return (
        f"{node.samples} samples sent, {node.ignored} drive frames ignored, "
        f"outputs parked {node.parked} times by the watchdog"
    )
