"""The loop's side of a node behind UDP or a serial line: opening, facts, parking and closing.

The exchange of a tick is compiled code in `exchange`; its frames are described in docs/node-protocol.md.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Channel, Driver, Exchanges, Facts, Pointers, Wiring, require_channels
from rtloop.drivers.errors import DriverError
from rtloop.drivers.node import frames
from rtloop.drivers.node.card import OBSERVED, WINDOW, make_card
from rtloop.drivers.node.exchange import HIGH_V, node_read, node_write
from rtloop.drivers.node.failures import failure_text
from rtloop.drivers.node.frames import Drive, Sample, Welcome
from rtloop.drivers.node.keys import read_key
from rtloop.drivers.node.link import Link, open_link
from rtloop.drivers.node.options import NodeOptions, SerialOptions, UdpOptions
from rtloop.drivers.node.tags import Seal

RETRY_S, BUSY_S, CONFIRM_S = 0.05, 1.5, 0.02
DOUBT_S = 1.0
"""Time in which the node's own WELCOME may still come after one that cannot be used."""
LONGEST_PARKING_S = 10.0
OPENING_HOLD_US = 0xFFFFFFFF
UNCONFIRMED = (
    "the node does not confirm that its outputs are at their safe values; they may carry voltage until the node's "
    "watchdog parks them; check the amplifier"
)
TOLERANCE = 1e-6
BITS_PER_BYTE = 10
MEASURING_WAIT_S, ANY_LEVEL = 0.1, 1 << 40
US_PER_S, US_PER_MS = 1e6, 1e3


class NodeDriver(Driver):
    """The driver of a node; its two kinds differ in their options, which choose the line."""

    options_model = NodeOptions
    WHO_DRIVES: ClassVar[str]
    """Words for those who can drive a node without a key."""

    def __init__(self, options: NodeOptions, wiring: Mapping[str, Wiring], rate_hz: float) -> None:
        """Check the wiring; no line is opened. Raises ValueError for a channel that the node lacks."""
        super().__init__(options, wiring, rate_hz)
        self._options = options
        self._link: Link | None = None
        self._card: npt.NDArray[np.void] | None = None
        self._key: bytes | None = None
        self._arrays: dict[str, npt.NDArray[np.generic]] = {}
        require_channels(wiring, self.facts)

    @property
    def facts(self) -> Facts:
        """Facts: the channels and ranges that the options describe, the delay of the exchange in ticks, and the largest
        rate of the line.
        """
        options = self._options
        analogue_inputs = [Channel(f"adc{i}", *options.input_range_v) for i in range(self._count(options.inputs))]
        outputs = [
            Channel(f"dac{i}", *options.output_range_v, options.safe_v) for i in range(self._count(options.outputs))
        ]
        return Facts(
            inputs=(*analogue_inputs, *_digital_channels("di", options.digital_inputs)),
            outputs=(*outputs, *_digital_channels("do", options.digital_outputs)),
            observed=OBSERVED,
            max_rate_hz=self._max_rate_hz(len(analogue_inputs), len(outputs)),
            hardware_watchdog=True,
            delay_ticks=0 if options.waits else 1,
        )

    def cautions(self) -> Sequence[str]:
        """Return a warning for options without a key, or with a key that cannot be used."""
        if self._options.key is None:
            return (f"driver.key: none, so {self.WHO_DRIVES} can drive the node; make a key (docs/drivers.md, A key)",)
        try:
            read_key(self._options.key)
        except DriverError as error:
            return (str(error),)
        return ()

    def _count(self, number: int | None) -> int:
        """Return `number`, an option's number of channels; if it is None, the number of axes, at least 1."""
        return number or max(len(self.wiring), 1)

    def _max_rate_hz(self, inputs: int, outputs: int) -> float:
        """Return the tick rate at which the frames of a tick fill the line: infinity, unless a subclass knows the line.

        `inputs` and `outputs` are the numbers of analogue channels.
        """
        return float("inf")

    @property
    def error(self) -> DriverError | None:
        """Error with the reason for which the exchange has ended; None before its end, and for a closed driver."""
        failure = 0 if self._card is None else int(self._card["failure"][0])
        return DriverError(f"{self._options.label}: {failure_text(failure)}") if failure else None

    def open(self) -> Pointers:
        """Open the line, compare the node with the options, and begin a session; the node's outputs ramp to their safe
        values before the method returns.

        Raises DriverError, with the line closed, if no node answers within `wait_s`, if the node has other channels,
        ranges or safe values, another version, or a largest rate below the loop's, if a serial line is too slow for
        the loop, if another controller drives the node, if its outputs do not reach their safe values in time, if the
        line fails, for a key that cannot be read, and if loop and node do not have the same key, or none.
        """
        self._key = read_key(self._options.key)
        self._link = open_link(self._options)
        try:
            return self._open_node(self._link)
        except OSError as error:
            self._close_link()
            raise DriverError(f"{self._options.label}: {error.strerror or error}") from None
        except BaseException:
            self._close_link()
            raise

    def _open_node(self, link: Link) -> Pointers:
        """Compare the node on an open line with the options, begin a session, and make the memory of the exchange.

        Returns the pointers of `open`. Does not close the line. Raises OSError if the line fails, else as `open`.
        """
        options = self._options
        self._session = secrets.randbelow(frames.MAX_SESSION) + 1
        welcome = self._greet(link)
        self._require_fit(welcome)
        self._require_rate(link, welcome)
        read, write = node_read.address, node_write.address
        last, seal = self._begin_session(link, welcome)
        self._card, self._arrays = make_card(
            link.fd, link.strangers_fd, seal, in_scales=welcome.inputs, out_scales=welcome.outputs,
            digital_inputs=options.digital_inputs, digital_outputs=options.digital_outputs,
            hold_ticks=options.hold_ticks, error_limit=options.error_limit, waits=options.waits,
            deadline_ns=round(options.deadline_us * US_PER_MS), hold_us=round(options.watchdog_ms * US_PER_MS),
            session=self._session, sequence=last, last_sequence=last, newest=last,
        )  # fmt: skip
        self._set_codes([scale.safe for scale in welcome.outputs])
        self._arrays["ring_ns"][last % WINDOW] = time.monotonic_ns()
        return Pointers(self._card.ctypes.data, read, write)

    def measure_exchanges(self, count: int) -> Exchanges:
        """Open the node, whose outputs ramp to their safe values, measure `count` exchanges, and close the node.

        A pause of one tick's period comes before each exchange. Whatever the option `answer`, an exchange waits for its
        answer for up to MEASURING_WAIT_S, and counts as lost without it. Raises DriverError as `open` and `close` do,
        and, after closing the node, if the node ends the session.
        """
        pointers, durations_us, lost = self.open(), list[float](), 0
        try:
            card = self._opened_card
            card["waits"], card["deadline_ns"] = 1, round(MEASURING_WAIT_S * 1e9)
            card["error_limit"], card["hold_us"] = ANY_LEVEL, OPENING_HOLD_US  # The outputs are safe all the time.
            values = np.zeros(len(self.facts.inputs) + 1 + len(OBSERVED))
            node_read(pointers.context, values.ctypes.data)
            for _ in range(count):
                time.sleep(1.0 / self.rate_hz)
                status = node_read(pointers.context, values.ctypes.data)
                if self.error is not None:
                    raise self.error
                durations_us += [float(values[-1])] if status == 0 else []
                lost += status != 0
        finally:
            self.close()
        return Exchanges(tuple(durations_us), lost)

    @property
    def _opened_card(self) -> npt.NDArray[np.void]:
        """Record CARD of the open exchange, shape (1,). Raises DriverError if the driver is not open."""
        if self._card is None:
            raise DriverError(f"{self._options.label}: the driver is not open; call open() first")
        return self._card

    def close(self) -> None:
        """End the session, wait until all outputs have their safe values, and close the line.

        A refusal by the node counts as success: the node has ended the session before, and parks its outputs itself. If
        the driver is not open, do nothing. Raises DriverError, with the line closed, if the node does not answer, if
        its ramp takes longer than LONGEST_PARKING_S, and if the line fails.
        """
        if self._link is None or self._card is None:
            return
        sequence, *state = (int(self._card[name][0]) for name in ("last_sequence", "boot", "opening", "turn"))
        try:
            self._park(self._link, sequence, Seal(self._key, *state))
        except OSError as error:
            raise DriverError(f"{self._options.label}: {error.strerror or error}; {UNCONFIRMED}") from None
        finally:
            self._card, self._arrays = None, {}
            self._close_link()

    def _close_link(self) -> None:
        """Close the line if it is open."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _greet(self, link: Link) -> Welcome:
        """Send a HELLO every RETRY_S until the node describes itself, and return its description.

        Raises DriverError if no description comes within `wait_s`, and, some time after it was seen first, because
        anybody may forge it, if the node speaks another version of the protocol or has another key; OSError if the line
        fails.
        """
        deadline_s, sequence, fault = time.monotonic() + self._options.wait_s, 0, None
        while time.monotonic() < deadline_s:
            sequence += 1
            link.send(frames.hello(sequence, self._session))
            answer = self._await_welcome(link, RETRY_S)
            if isinstance(answer, Welcome):
                return answer
            if answer is not None and fault is None:
                deadline_s = min(deadline_s, time.monotonic() + DOUBT_S)
            fault = answer or fault
        if fault is not None:
            raise DriverError(f"{self._options.label}: {fault}")
        command = "--serial" if isinstance(self._options, SerialOptions) else "--udp"
        raise DriverError(
            f"{self._options.label}: no node has answered within {self._options.wait_s:g} s; "
            f"switch the node on, or start a simulated node with `rtloop hil serve CONFIG {command}`"
        )

    def _await_welcome(self, link: Link, timeout_s: float) -> Welcome | str | None:
        """Return the node's description if it comes within `timeout_s`; else the fault of one that cannot be used, None
        if there was none.

        Raises OSError if the line fails.
        """
        fault = None
        for header, data in _receive_for(link, timeout_s):
            if header.session != self._session:
                continue
            refusal = frames.read_refusal(data) if header.format == frames.REFUSAL_FORMAT else None
            if refusal is not None and refusal.reason == frames.VERSION_REFUSED:
                fault = (
                    f"the node speaks version {refusal.version} of the protocol; allowed: {frames.VERSION}; install "
                    "the node's program of this version of rtloop"
                )
            if header.format == frames.WELCOME and (welcome := frames.read_welcome(data)) is not None:
                fault = self._key_fault(data, welcome)
                if fault is None:
                    return welcome
        return fault

    def _key_fault(self, data: bytes, welcome: Welcome) -> str | None:
        """Return the fault of a WELCOME whose tag or flag does not fit the key of the options; None if both do."""
        if bool(welcome.flags & frames.KEYED) != (self._key is not None):
            if self._key is None:
                return "the node has a key, and driver.key is not set; set driver.key to a file with the node's key"
            return "the node has no key; give the node the key in driver.key, or remove driver.key"
        if not frames.is_genuine(data, Seal(self._key, welcome.boot, welcome.opening)):
            return "the node has another key than the file in driver.key; give both the same key"
        return None

    def _require_fit(self, welcome: Welcome) -> None:
        """Raise DriverError, naming the option, for a node with other channels, ranges or safe values than the options,
        or one that does not allow the loop's rate.
        """
        options = self._options
        for name, count, expected in (
            ("inputs", len(welcome.inputs), self._count(options.inputs)),
            ("outputs", len(welcome.outputs), self._count(options.outputs)),
            ("digital_inputs", welcome.digital_inputs, options.digital_inputs),
            ("digital_outputs", welcome.digital_outputs, options.digital_outputs),
        ):
            if count != expected:
                raise DriverError(
                    f"{options.label}: the node has {count} {name.replace('_', ' ')}; driver.{name} is {expected}; "
                    "allowed: equal numbers"
                )
        for name, scales, range_v in (
            ("input_range_v", welcome.inputs, options.input_range_v),
            ("output_range_v", welcome.outputs, options.output_range_v),
        ):
            for i, scale in enumerate(scales):
                lowest_v, highest_v = scale.volts(scale.lowest), scale.volts(scale.highest)
                lsb_v = abs(scale.volts_per_code)
                if not lsb_v > 0 or abs(lowest_v - range_v[0]) > 2 * lsb_v or abs(highest_v - range_v[1]) > 2 * lsb_v:
                    raise DriverError(
                        f"{options.label}: driver.{name} is {list(range_v)} V; allowed: the range of the node's "
                        f"channel {i}, [{lowest_v:.6g}, {highest_v:.6g}] V"
                    )
        for i, scale in enumerate(welcome.outputs):
            if abs(scale.volts(scale.safe) - options.safe_v) > 2 * abs(scale.volts_per_code):
                raise DriverError(
                    f"{options.label}: the node parks output {i} at {scale.volts(scale.safe):.6g} V; "
                    f"driver.safe_v is {options.safe_v:g} V; allowed: equal values"
                )
        if self.rate_hz * welcome.period_us > US_PER_S:
            raise DriverError(
                f"{options.label}: loop.rate_hz is {self.rate_hz:g} Hz; the node allows at most "
                f"{US_PER_S / welcome.period_us:.6g} Hz"
            )

    def _require_rate(self, link: Link, welcome: Welcome) -> None:
        """Do nothing: every line counts as fast enough. A subclass may measure its line, and raise DriverError."""

    def _begin_session(self, link: Link, welcome: Welcome) -> tuple[int, Seal]:
        """Send an OPEN every RETRY_S until the node is ready: it obeys this session, and its outputs are safe.

        Returns the sequence number of the OPEN that the node answered as ready, and the seal of the session. Raises
        DriverError if another loop drives the node for longer than BUSY_S, if the node refuses for another reason, and
        if the node is not ready within `wait_s`; OSError if the line fails.
        """
        safe = tuple(scale.safe for scale in welcome.outputs)
        start_s, sequence = time.monotonic(), 0
        while time.monotonic() < start_s + self._options.wait_s:
            sequence += 1
            if self._key is not None and sequence > 1:  # Another loop may have opened a session meanwhile.
                welcome = self._greet(link)
            seal = Seal(self._key, welcome.boot, welcome.opening)
            flags = frames.OPEN | frames.ANSWER
            sent = frames.drive(Drive(sequence, self._session, flags, 0, OPENING_HOLD_US, safe), seal)
            link.send(sent)
            answer = self._await_answer(link, sequence, RETRY_S, sent, seal)
            if isinstance(answer, Sample) and answer.flags & frames.READY:
                return sequence, seal
            if isinstance(answer, frames.Refusal):
                if answer.reason in (frames.UNKNOWN, frames.WATCHDOG):
                    continue  # No node answers an OPEN so: somebody sent a false copy before it.
                if answer.reason != frames.BUSY or time.monotonic() > start_s + BUSY_S:
                    raise DriverError(f"{self._options.label}: {failure_text(answer.reason)}")
                time.sleep(RETRY_S)
        raise DriverError(
            f"{self._options.label}: the node's outputs did not reach their safe values within "
            f"{self._options.wait_s:g} s; check the node, or raise driver.wait_s"
        )

    def _await_answer(
        self, link: Link, sequence: int, timeout_s: float, sent: bytes, seal: Seal
    ) -> Sample | frames.Refusal | None:
        """Return the sample or refusal that answers this session's DRIVE `sequence`, the frame `sent`.

        Returns None if no answer comes within `timeout_s`. Frames with a wrong tag, or with malformed content, are not
        used. Raises OSError if the line fails.
        """
        for header, data in _receive_for(link, timeout_s):
            if header.session != self._session or header.sequence != sequence:
                continue
            if header.format == frames.SAMPLE_FORMAT and frames.is_genuine(data, seal):
                sample = frames.read_sample(data)
                if sample is not None:
                    return sample
            refusal = frames.read_refusal(data) if header.format == frames.REFUSAL_FORMAT else None
            if refusal is not None and self._is_answer(data, refusal, sent):
                return refusal
        return None

    def _is_answer(self, data: bytes, refusal: frames.Refusal, sent: bytes) -> bool:
        """Whether a REFUSAL, the frame `data`, is the node's and refuses the frame `sent`; True without a key."""
        seal = Seal(self._key, refusal.boot, refusal.opening)
        return seal.key is None or (frames.is_genuine(data, seal) and refusal.drive_tag == frames.tag_in(sent))

    def _park(self, link: Link, sequence: int, seal: Seal) -> None:
        """Send a PARK every CONFIRM_S until the node says that all outputs are safe, or refuses: then its session has
        ended before.

        `sequence` is the number of the last frame sent, `seal` that of the session. Raises DriverError if no answer
        comes for `wait_s`, or if the node's ramp takes longer than LONGEST_PARKING_S; OSError if the line fails.
        """
        start_s, heard_s = time.monotonic(), time.monotonic()
        codes = tuple(self._arrays["safe"].tolist())
        while time.monotonic() < min(heard_s + self._options.wait_s, start_s + LONGEST_PARKING_S):
            sequence = (sequence + 1) & 0xFFFFFFFF
            seal = seal._replace(turn=seal.turn + (sequence == 0))
            content = Drive(sequence, self._session, frames.PARK | frames.ANSWER, 0, OPENING_HOLD_US, codes)
            sent = frames.drive(content, seal)
            link.send(sent)
            answer = self._await_answer(link, sequence, CONFIRM_S, sent, seal)
            if isinstance(answer, frames.Refusal):
                return
            if isinstance(answer, Sample):
                heard_s = time.monotonic()
                if answer.flags & frames.AT_SAFE:
                    return
                time.sleep(CONFIRM_S / 4)
        raise DriverError(f"{self._options.label}: {UNCONFIRMED}")

    def _set_codes(self, codes: list[int]) -> None:
        """Write the codes of the outputs into the frame that the first ticks send, and store them for parking."""
        sent = self._arrays["sent"].view(np.uint8)[frames.DRIVE_HEAD :][: 4 * len(codes)]
        sent.view(np.int32)[:] = codes
        self._arrays["safe"] = np.array(codes, np.int32)


class UdpDriver(NodeDriver):
    """The driver of a node behind UDP."""

    kind = "udp"
    options_model = UdpOptions
    WHO_DRIVES = "everybody who can send to the node, such as all users of this computer,"


class SerialDriver(NodeDriver):
    """The driver of a node behind a serial line or USB."""

    kind = "serial"
    options_model = SerialOptions
    WHO_DRIVES = "everybody who may open the serial line, such as the group dialout,"
    PROBES = 64
    """Exchanges by which `open` measures the line."""

    def _max_rate_hz(self, inputs: int, outputs: int) -> float:
        """Return the tick rate at which the frames of a tick fill a line of `baud` bit/s; infinity without `baud`.

        Of the two directions, the one with more bytes in a tick counts. `inputs` and `outputs` are the numbers of
        analogue channels.
        """
        baud = self._options.baud if isinstance(self._options, SerialOptions) else None
        to_node = frames.drive_bytes(outputs) * (2 if self._options.waits else 1)
        longest = max(to_node, frames.sample_bytes(inputs)) + 2  # COBS adds a byte and the byte 0
        return float("inf") if baud is None else baud / (BITS_PER_BYTE * longest)

    def _require_rate(self, link: Link, welcome: Welcome) -> None:
        """Send HELLO to the node PROBES times, and measure the time to each answer; no output moves.

        `welcome` is not used. Raises DriverError if the node answers fewer than half of them within RETRY_S each, or if
        the median time is longer than a period of the loop; OSError if the line fails.
        """
        durations_s = []
        for sequence in range(1, self.PROBES + 1):
            start_s = time.monotonic()
            link.send(frames.hello(sequence, self._session))
            if isinstance(self._await_welcome(link, RETRY_S), Welcome):
                durations_s.append(time.monotonic() - start_s)
        if len(durations_s) < self.PROBES / 2:
            raise DriverError(
                f"{self._options.label}: the node answered {len(durations_s)} of {self.PROBES} frames; "
                "allowed: at least half; check the line"
            )
        median_s = float(np.median(durations_s))
        if median_s * self.rate_hz > 1:
            raise DriverError(
                f"{self._options.label}: an exchange with the node takes {median_s * US_PER_S:.0f} µs (median of "
                f"{self.PROBES} exchanges); loop.rate_hz is {self.rate_hz:g} Hz; allowed: at most {1 / median_s:.0f} Hz"
            )


def _digital_channels(prefix: str, count: int) -> list[Channel]:
    """Return the channels `prefix`0, 1, … of digital inputs or outputs, with the range 0 … HIGH_V and safe at 0."""
    return [Channel(f"{prefix}{i}", 0.0, HIGH_V) for i in range(count)]


def _receive_for(link: Link, duration_s: float) -> Iterator[tuple[frames.Header, bytes]]:
    """Yield each valid frame that comes within `duration_s` as (Header, bytes of the whole frame).

    Raises OSError if the line is broken.
    """
    deadline_s = time.monotonic() + duration_s
    while (remaining_s := deadline_s - time.monotonic()) > 0:
        data = link.receive(remaining_s)
        if data is not None and (header := frames.read_header(data)) is not None:
            yield header, data
