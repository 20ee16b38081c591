"""A node as docs/node-protocol.md describes it, with the simulated rig in place of converters.

It takes frames and times and returns frames. The caller has the clock and the line.
"""

from __future__ import annotations

import secrets
from collections.abc import Hashable, Sequence

from rtloop.drivers.node import frames
from rtloop.drivers.node.frames import Drive, Refusal, Sample, Scale, Welcome
from rtloop.drivers.node.options import NodeOptions
from rtloop.drivers.node.tags import Seal
from rtloop.hil.free_running import FreeRunningRig

CODE_BITS = 24
RIG_RATE_HZ = 50_000.0
RAMP_STEP_US = 1000
LONGEST_HOLD_US = 10_000_000
SHORTEST_PERIOD_US = 10
MODULUS = 1 << 32
NEWER_STEPS = 2_000_000 // SHORTEST_PERIOD_US
"""Largest step from the newest sequence to that of a DRIVE: two frames in each shortest period of a second."""
US_PER_S = 1e6
KINDS = frames.OPEN | frames.APPLY | frames.PARK


class SimulatedNode:
    """A node with the channels of the options; its converters have CODE_BITS bits over their ranges.

    Channels of no axis are not wired: inputs read 0 V, and digital inputs read the digital outputs of the same number.
    """

    def __init__(
        self, options: NodeOptions, axes: Sequence[str], boot: int | None = None, key: bytes | None = None
    ) -> None:
        """Build the rig at rest, with the outputs at their safe values, and compile it.

        `boot` is the number of this start in the node's frames, None for a random one; `key` has 16 bytes, None for a
        node without a key. Raises ValueError if rig and
        axes do not fit together.
        """
        self.boot = secrets.randbits(32) if boot is None else boot
        self._rig = FreeRunningRig(options, axes, RIG_RATE_HZ)
        change = options.park_slew_v_per_s * 1e-3
        safe_v, counts = options.safe_v, (options.inputs or len(axes), options.outputs or len(axes))
        self._inputs = (_scale(options.input_range_v, None, 0.0),) * counts[0]
        self._outputs = (_scale(options.output_range_v, safe_v, change),) * counts[1]
        self._digital_counts = options.digital_inputs, options.digital_outputs
        self.codes = [scale.safe for scale in self._outputs]
        self.digital = 0
        self._key = key
        self._session = self._ended = self._openings = self._turn = 0
        self._parked: tuple[int, Hashable] = (0, None)
        self._sender: Hashable = None
        self._newest = self._applied = 0
        self._hold_us = self._heard_us = self._step_us = 0.0
        self.is_ramping = False
        self.samples = self.invalid = self.foreign = self.old = self.refused = self.watchdog_parkings = 0

    @property
    def outputs_v(self) -> list[float]:
        """Voltages at the analogue outputs, in V."""
        return [scale.volts(code) for scale, code in zip(self._outputs, self.codes, strict=True)]

    @property
    def _is_safe(self) -> bool:
        """Whether all analogue outputs have their safe codes; digital outputs do not count."""
        return all(code == scale.safe for scale, code in zip(self._outputs, self.codes, strict=True))

    def poll(self, now_us: float) -> None:
        """Advance the rig to `now_us` since its start, and the outputs' ramp by a step if one is due.

        A session without a DRIVE for its hold time ends, and the outputs begin to ramp to their safe codes.
        """
        self._rig.advance_to(now_us / US_PER_S)
        if self._session and now_us - self._heard_us >= self._hold_us:
            self.watchdog_parkings += not self._is_safe
            self._ended, self._session = self._session, 0
            self._parked = (0, None) if self._parked[0] == self._ended else self._parked
            self._begin_ramp(now_us)
        if self.is_ramping and now_us >= self._step_us:
            self._step_us = now_us + RAMP_STEP_US
            for i, scale in enumerate(self._outputs):
                distance = scale.safe - self.codes[i]
                self.codes[i] += max(-scale.change_per_ms, min(scale.change_per_ms, distance))
            self.is_ramping = not self._is_safe
        self._set_outputs()

    def _begin_ramp(self, now_us: float) -> None:
        """Set the digital outputs to 0 and begin the ramp of the others to their safe codes, unless a ramp runs."""
        if not self.is_ramping:
            self.digital = self._applied = 0
            self.is_ramping, self._step_us = not self._is_safe, now_us + RAMP_STEP_US

    def receive(self, data: bytes, sender: Hashable, now_us: float) -> bytes | None:
        """Process the bytes of a frame that came from `sender` at `now_us`; return the bytes of the answer.

        None without an answer: for bytes that are no frame for a node, counted in `invalid`, for a DRIVE with a wrong
        tag, counted in `foreign`, for one that is not newer than the last one, counted in `old`, and for one that asks
        for none.
        """
        self.poll(now_us)
        header = frames.read_header(data)
        if header is not None and header.format == frames.HELLO and (version := frames.read_hello(data)) is not None:
            if version != frames.VERSION:
                return self._refuse(header, frames.VERSION_REFUSED, data)
            return frames.welcome(header.sequence, self._describe(header.session), self._key)
        content = frames.read_drive(data) if header is not None and header.format == frames.DRIVE_FORMAT else None
        if header is None or content is None:
            self.invalid += 1
            return None
        reason = self._lack_of_access(content, sender)
        seal = self._seal(content)
        if self._session or not reason:  # A DRIVE of no session is refused whatever its tag, for a node that restarted.
            is_copy = self._key is not None and reason == frames.BUSY and content.session == self._session
            if is_copy or not frames.is_genuine(data, seal):
                self.foreign += 1
                return None
        if not reason and not self._is_due(content):
            self.old += 1
            return None
        if reason := reason or self._fault_of_content(content):
            return self._refuse(header, reason, data)
        return self._accept(content, seal, sender, now_us)

    def _seal(self, content: Drive) -> Seal:
        """Return the seal of a DRIVE: of its session, which is open or was parked, or of the next one."""
        is_known = content.session == (self._session or self._parked[0])
        if not is_known or not (self._session or content.flags & frames.PARK):
            return Seal(self._key, self.boot, self._openings)
        is_next_turn = content.sequence < self._newest and self._is_newer(content)
        return Seal(self._key, self.boot, (self._openings - 1) % MODULUS, (self._turn + is_next_turn) % MODULUS)

    def _lack_of_access(self, content: Drive, sender: Hashable) -> int:
        """Return the reason, a key of REFUSALS, for which `sender` may not drive the node now; 0 if it may.

        Only the DRIVE's session and flags and the address of `sender` decide.
        """
        parks_from_anywhere = self._key is not None and content.flags & frames.PARK
        if self._session:
            is_at_home = sender == self._sender or parks_from_anywhere
            return 0 if content.session == self._session and is_at_home else frames.BUSY
        if content.session == 0:
            return frames.UNKNOWN
        session, address = self._parked
        is_parked = content.flags & frames.PARK and content.session == session
        is_parked = is_parked and (sender == address or parks_from_anywhere)
        if content.flags & frames.OPEN or is_parked:
            return 0
        return frames.WATCHDOG if content.session == self._ended else frames.UNKNOWN

    def _fault_of_content(self, content: Drive) -> int:
        """Return the reason, a key of REFUSALS, for which the content of a DRIVE is refused; 0 for none.

        Refused are another number of outputs, codes out of range, no hold time, and contradictory flags.
        """
        if len(content.codes) != len(self._outputs):
            return frames.SIZE
        if any(not s.lowest <= code <= s.highest for s, code in zip(self._outputs, content.codes, strict=True)):
            return frames.RANGE
        return frames.FLAGS if content.hold_us == 0 or (content.flags & KINDS).bit_count() > 1 else 0

    def _is_due(self, content: Drive) -> bool:
        """Whether a DRIVE comes after the newest one or has the flag PARK; True without a session."""
        return not self._session or bool(content.flags & frames.PARK) or self._is_newer(content)

    def _is_newer(self, content: Drive) -> bool:
        """Whether the sequence of a DRIVE is newer than the newest one."""
        return 0 < (content.sequence - self._newest) % MODULUS <= NEWER_STEPS

    def _accept(self, content: Drive, seal: Seal, sender: Hashable, now_us: float) -> bytes | None:
        """Convert the inputs, begin a session if a DRIVE says OPEN, and obey its flags.

        Returns the bytes of the sample if the DRIVE asks for one, else None.
        """
        codes, digital = self._read_inputs(), self.digital & ((1 << self._digital_counts[0]) - 1)
        if content.flags & frames.OPEN:
            self._openings = (self._openings + (not self._session)) % MODULUS
            self._session, self._sender = content.session, sender
            self._begin_ramp(now_us)
        if self._session:
            self._newest, self._turn, self._heard_us = content.sequence, seal.turn, now_us
            self._hold_us = min(content.hold_us, LONGEST_HOLD_US)
            self._obey(content, now_us)
        self._set_outputs()
        if not content.flags & frames.ANSWER:
            return None
        self.samples += 1
        is_ready = self._session != 0 and not self.is_ramping
        flags = frames.READY * is_ready | frames.AT_SAFE * self._is_safe
        return frames.sample(
            Sample(content.sequence, content.session, self.boot, flags, digital, 0, self._applied, tuple(codes)), seal
        )

    def _obey(self, content: Drive, now_us: float) -> None:
        """End the session and begin a ramp if a DRIVE says PARK; apply its codes if it says APPLY and no ramp runs."""
        if content.flags & frames.PARK:
            self._parked, self._session = (self._session, self._sender), 0
            self._ended = 0 if self._ended == self._parked[0] else self._ended
            self._begin_ramp(now_us)
        elif content.flags & frames.APPLY and not self.is_ramping:
            self.codes[:] = content.codes
            self.digital = content.digital & ((1 << self._digital_counts[1]) - 1)
            self._applied = content.sequence

    def _read_inputs(self) -> list[int]:
        """Return the codes of the inputs: the rig's readings, and 0 V at channels of no axis."""
        readings = self._rig.sample_v.tolist() + [0.0] * len(self._inputs)
        return [
            max(scale.lowest, min(scale.highest, round((volts - scale.offset_v) / scale.volts_per_code)))
            for scale, volts in zip(self._inputs, readings, strict=False)
        ]

    def _set_outputs(self) -> None:
        """Set the drives of the rig's axes to the volts of the outputs' codes."""
        count = min(len(self.codes), self._rig.drive_v.size)
        self._rig.drive_v[:count] = self.outputs_v[:count]

    def _refuse(self, header: frames.Header, reason: int, data: bytes) -> bytes:
        """Return the bytes of the refusal of the frame `data`, for `reason`, a key of REFUSALS; count it."""
        self.refused += 1
        opening = 0 if reason == frames.VERSION_REFUSED else self._openings
        return frames.refusal(
            Refusal(
                header.sequence, header.session, self.boot, reason, frames.VERSION, opening, frames.tag_in(data)
            ),
            self._key,
        )  # fmt: skip

    def _describe(self, session: int) -> Welcome:
        """Return the description of the node for a session's HELLO."""
        is_open = session != 0 and session == self._session
        opening = (self._openings - is_open) % MODULUS
        flags = frames.DRIVEN * (self._session != 0) | frames.KEYED * (self._key is not None)
        return Welcome(
            session, frames.VERSION, self.boot, LONGEST_HOLD_US, SHORTEST_PERIOD_US, flags, opening, self._inputs,
            self._outputs, *self._digital_counts,
        )  # fmt: skip


def _scale(range_v: tuple[float, float], safe_v: float | None, change_v: float) -> Scale:
    """Return the Scale of a channel of CODE_BITS bits over a range in V; `change_v` is its change in 1 ms of a ramp.

    `safe_v` is None for an input, whose safe code and change are 0.
    """
    lowest_v, highest_v = range_v
    volts_per_code = (highest_v - lowest_v) / (2**CODE_BITS - 1)
    half = 2 ** (CODE_BITS - 1)
    offset_v = lowest_v + half * volts_per_code
    safe = 0 if safe_v is None else round((safe_v - offset_v) / volts_per_code)
    change = 0 if safe_v is None else max(1, round(change_v / volts_per_code))
    return Scale(-half, half - 1, safe, change, volts_per_code, offset_v)
