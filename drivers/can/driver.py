"""The loop's side of a node on a CAN bus.

Tick n ends with drive frame n, which makes the node convert its inputs, set its outputs and answer with sample n.
Tick n + 1 begins with the newest received frame: sample n, at most as old as the time since drive n was sent.
Sample n does not show drive n yet: the delay is one period longer than with an ADC that is read within the tick.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping, Sequence

from rtloop.drivers.base import Channel, Facts, Wiring, require_channels
from rtloop.drivers.can.bus import BUS_ERRORS, error_text, open_bus, require_interface
from rtloop.drivers.can.extra import can
from rtloop.drivers.can.frames import choose_exchange, load_frames
from rtloop.drivers.can.options import CanOptions
from rtloop.drivers.can.stream import AnswerStream
from rtloop.drivers.errors import DriverError
from rtloop.drivers.python import PythonDriver

OBSERVED = (
    "can_lost_samples", "can_reordered_samples", "can_duplicated_samples", "can_invalid_frames", "can_held_ticks"
)  # fmt: skip
LISTEN_S, RETRY_S, CONFIRM_S = 0.1, 0.05, 0.02
CONFIRMATIONS = 25
MAX_FRAMES_PER_TICK = 64
STATUS_HELD = 1


class CanDriver(PythonDriver):
    """The driver of a node on a CAN bus."""

    kind = "can"
    options_model = CanOptions

    def __init__(self, options: CanOptions, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Read the DBC file and choose its frames of drives and samples; the bus is not opened.

        Raises ValueError for an interface that python-can lacks, for a DBC file that cannot be used or has no frames
        for so many axes, and for a channel in `wiring` other than adc<i> or dac<i>, with i below the number of axes.
        """
        super().__init__(options, wiring, rate_hz)
        self._options = options
        require_interface(options)
        self._exchange = choose_exchange(load_frames(options), len(wiring), options)
        self._bus: can.BusABC | None = None
        require_channels(wiring, self.facts)

    @property
    def facts(self) -> Facts:
        """Facts: a channel pair adc<i>, dac<i> per axis with the DBC's ranges; the largest rate is that at which the
        frames fill the bus.
        """
        drive, sample = self._exchange.drive.signals, self._exchange.sample.signals
        count = self._exchange.channels
        return Facts(
            inputs=tuple(_channel(f"adc{i}", sample[f"Sample_{i}"]) for i in range(count)),
            outputs=tuple(_channel(f"dac{i}", drive[f"Drive_{i}"]) for i in range(count)),
            observed=OBSERVED,
            max_rate_hz=self._exchange.max_rate_hz(self._options),
            hardware_watchdog=True,
            delay_ticks=1,
        )

    def start(self) -> None:
        """Open the bus, listen for at most LISTEN_S to find another controller, then send the safe values until the
        node answers; reset all counts.

        Raises DriverError, with the bus closed, if the bus fails, if another controller drives the node, and if no node
        answers within `wait_s`.
        """
        self._stream = AnswerStream(self._exchange.highest_sequence)
        self._sent_ns = [0] * (self._exchange.highest_sequence + 1)
        self._sent_frames = [b""] * (self._exchange.highest_sequence + 1)
        self._volts = [0.0] * self._exchange.channels
        self._age_us, self._held_ticks, self._total_held_ticks = 0.0, 0, 0
        self._padding = [0.0] * (self._exchange.channel_capacity - self._exchange.channels)
        self._message = self._exchange.drive.message(self._options, [0.0] * (1 + self._exchange.channel_capacity))
        self._bus = open_bus(self._options)
        try:
            self._listen(LISTEN_S)  # The frames of another controller raise DriverError.
            self._stream = AnswerStream(self._exchange.highest_sequence)
            self._await_node()
        except BUS_ERRORS as error:
            self._close_bus()
            raise DriverError(f"{self._options.label}: {error_text(error)}") from error
        except DriverError:
            self._close_bus()
            raise

    def read(self) -> Sequence[float]:
        """Process up to MAX_FRAMES_PER_TICK received frames and return the newest sample, in V for each input channel.

        Sets `sample_age_us`, the time since the drive frame of this sample was sent, plus the age that the node
        reports. Sets `status` to 0, or to STATUS_HELD while the node has not answered the last drive frame and the
        previous sample is held; after more than `hold_ticks` such ticks in sequence the age is infinite. Each call
        before the first `write` first discards older frames, sends the safe values and waits up to RETRY_S for the
        answer. Raises DriverError if another controller drives the node or the driver is not open; python-can's errors
        pass through.
        """
        if self._stream.sent == 0:  # Much time may pass between `open` and the first tick.
            while self._receive(0.0) is not None:
                pass  # Frames from before the first tick are old.
            self._send_opening_frame()
            self._listen(RETRY_S)
        for _ in range(MAX_FRAMES_PER_TICK):
            message = self._receive(0.0)
            if message is None:
                break
            self._process_frame(message)
        stream = self._stream
        self._held_ticks = 0 if stream.newest == stream.sent else self._held_ticks + 1
        self._total_held_ticks += self._held_ticks > 0
        self.status = STATUS_HELD if self._held_ticks else 0
        sent_ns = self._sent_ns[stream.sequence(stream.newest) if stream.newest else 0]
        age_us = (time.monotonic_ns() - sent_ns) * 1e-3 + self._age_us
        self.sample_age_us = math.inf if self._held_ticks > self._options.hold_ticks else age_us
        return self._volts

    def observe(self) -> Sequence[float]:
        """Return the counts since `start`, in the order of OBSERVED: lost, reordered and duplicated samples, invalid
        frames, ticks with a held sample.
        """
        stream = self._stream
        return stream.lost, stream.reordered, stream.duplicated, stream.invalid, self._total_held_ticks

    def write(self, volts: Sequence[float]) -> None:
        """Send `volts`, one per output channel, with the next sequence number; do not wait for the answer.

        A value that its integer in the frame cannot hold is clipped. Call `open` before. Raises ValueError for NaN or
        another number of values, OverflowError for infinity, DriverError after the bus was closed; python-can's errors
        pass through.
        """
        self._send(self._stream.next_sequence(), volts)

    def stop(self) -> None:
        """Wait until the node answers the last drive frame, in which `close` sent the safe values; then close the bus.

        Without an answer within CONFIRM_S, the driver sends the safe values again, CONFIRMATIONS times at most. Without
        an open bus, a call does nothing. Raises DriverError, with the bus closed, if no answer comes, if the bus fails,
        and if another controller drives the node.
        """
        if self._bus is None:
            return
        try:
            for _ in range(CONFIRMATIONS):
                deadline_s = time.monotonic() + CONFIRM_S
                while (remaining_s := deadline_s - time.monotonic()) > 0:
                    message = self._receive(remaining_s)
                    if (
                        message is not None
                        and self._process_frame(message)
                        and self._stream.newest == self._stream.sent
                    ):
                        return
                self.write([channel.safe_v for channel in self.facts.outputs])
            raise DriverError(
                f"{self._options.label}: the node does not confirm that its outputs are at their safe values; they may "
                "carry voltage until the node's watchdog parks them; check the amplifier"
            )
        except BUS_ERRORS as error:
            raise DriverError(f"{self._options.label}: {error_text(error)}") from error
        finally:
            self._close_bus()

    def _close_bus(self) -> None:
        """Close the bus if it is open. An error while closing is ignored: no more frames will be sent."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(*BUS_ERRORS):
                bus.shutdown()

    def _await_node(self) -> None:
        """Send the safe values every RETRY_S until the node answers.

        Raises DriverError if no answer comes within `wait_s`, and if another controller drives the node; python-can's
        errors pass through.
        """
        deadline_s = time.monotonic() + self._options.wait_s
        while time.monotonic() < deadline_s:
            self._send_opening_frame()
            if self._listen(RETRY_S):
                return
        raise DriverError(
            f"{self._options.label}: no node has answered within {self._options.wait_s:g} s; "
            "switch the node on, or start a simulated node with `rtloop hil serve CONFIG --can`"
        )

    def _send_opening_frame(self) -> None:
        """Send the safe values with sequence number 0, which a node accepts and answers at any time."""
        self._send(0, [channel.safe_v for channel in self.facts.outputs])

    def _listen(self, duration_s: float) -> bool:
        """Process frames until a new sample comes, for at most `duration_s`; return whether one came.

        Raises DriverError if another controller drives the node; python-can's errors pass through.
        """
        deadline_s = time.monotonic() + duration_s
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            message = self._receive(remaining_s)
            if message is not None and self._process_frame(message):
                return True
        return False

    def _send(self, sequence: int, volts: Sequence[float]) -> None:
        """Store the bytes of a drive frame with `volts`, and the time in ns, at index `sequence`; then send the frame.

        Raises DriverError if the bus is not open; python-can's errors pass through.
        """
        self._sent_frames[sequence] = self._exchange.drive.pack((sequence, *volts, *self._padding))
        self._message.data[:] = self._sent_frames[sequence]
        self._sent_ns[sequence] = time.monotonic_ns()
        self._opened_bus.send(self._message)

    def _receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame, or None if none comes within `timeout_s`.

        Raises DriverError if the bus is not open; python-can's errors pass through.
        """
        return self._opened_bus.recv(timeout_s)

    @property
    def _opened_bus(self) -> can.BusABC:
        """The open bus. Raises DriverError if the driver is not open."""
        if self._bus is None:
            raise DriverError(f"{self._options.label}: the driver is not open; call open() first")
        return self._bus

    def _process_frame(self, message: can.Message) -> bool:
        """Store a new sample, or count a late, repeated or invalid frame; return whether `message` was a new sample.

        Frames of other identifiers are ignored. A sample is new if it is newer than all earlier ones; samples that it
        skips count as lost. The answer to an opening frame is new until the first `write`, and ignored later. Raises
        DriverError for a drive frame that this driver did not send: another controller drives the node.
        """
        drive, sample = self._exchange.drive, self._exchange.sample
        if message.arbitration_id == drive.identifier and drive.fits(message):
            sequence = int(drive.unpack(message.data)[0])
            if bytes(message.data) != self._sent_frames[sequence]:  # Some interfaces return the frames that were sent.
                raise DriverError(
                    f"{self._options.label}: another controller drives this node; stop the other controller"
                )
        elif message.is_error_frame or (message.arbitration_id == sample.identifier and not sample.fits(message)):
            self._stream.invalid += 1
        elif message.arbitration_id == sample.identifier:
            sequence, age_us, *volts = sample.unpack(message.data)
            if self._stream.sent == 0 if sequence == 0 else self._stream.count_answer(int(sequence)):
                self._volts, self._age_us = volts[: self._exchange.channels], age_us
                return True
        return False


def _channel(name: str, signal: object) -> Channel:
    """Return a channel `name` with the physical range of `signal`, a signal of the DBC, in V."""
    return Channel(name, float(signal.minimum), float(signal.maximum))  # type: ignore[attr-defined]
