"""The exchange of a tick with a node, in compiled code: `node_read` and `node_write`, the loop's C functions.

A tick ends with DRIVE n. Its answer, SAMPLE n, is used in tick n + 1; with `waits`, a tick begins with a DRIVE without
codes, and its answer is used in the same tick if it comes within `deadline_ns`. Two checks decide whether the loop can
continue. A node that refuses, restarts or parks is a failure at once. Each tick without its answer raises an error
level by 2, each tick with its answer lowers the level by 1, as in LinuxCNC's driver hm2_eth; the level `error_limit` is
a failure.
"""

from __future__ import annotations

import numpy as np

from rtloop.drivers.node.card import CARD, COUNTS, SCALE, WINDOW
from rtloop.drivers.node.failures import LINE_GONE, LINK, NOT_A_NUMBER, NOT_READY, RESTARTED, SILENT
from rtloop.drivers.node.frames import (
    ANSWER,
    APPLY,
    BATCHES,
    CRC_BYTES,
    DRIVE,
    DRIVE_FORMAT,
    DRIVE_HEAD,
    END_BYTES,
    MAGIC,
    OPEN,
    READY,
    REFUSAL,
    REFUSAL_BYTES,
    REFUSAL_FORMAT,
    SAMPLE,
    SAMPLE_FORMAT,
    SAMPLE_HEAD,
)
from rtloop.drivers.node.tags import TAG_BYTES, write_tag
from rtloop.drivers.node.transport import BROKEN, EMPTY, GONE, receive_frame, send_frame, take_strangers
from rtloop.foundation.native.compiled import cfunc, jit, jit_rare
from rtloop.foundation.native.monotonic import monotonic_ns
from rtloop.foundation.native.pointers import SIGNATURE, address_pointer, carray, load_word

FAILED, GOOD, HELD = -1, 0, 1
MAX_FRAMES_PER_TICK = 64
STRANGERS_EVERY = 64
"""Reads from one count of other senders' datagrams to the next: a system call that finds none takes 0.3 µs."""
OPEN_TRIES, OPEN_WAIT_NS = 200, 5_000_000
RISE, FALL = 2, 1
"""Steps of the error level for a tick without and with its answer (LinuxCNC, hm2_eth)."""
HIGH_V, THRESHOLD_V = 5.0, 2.5
"""Volts that stand for a digital channel's 1, and those from which on an output is 1."""
OBSERVED_COUNT = len(COUNTS)


@cfunc(SIGNATURE)
def node_read(context, values):
    """Fill `values` with the newest sample's volts, its age in µs, and the values of the signals OBSERVED.

    The first call begins the session again. Each later call, with `waits`, asks for a sample and waits for it, at most
    `deadline_ns`; without `waits`, it takes the frames that have come. Returns GOOD; HELD while the last request is not
    answered: the values are the previous sample's, and after more than `hold_ticks` such ticks the age is infinite;
    FAILED, with the reason in `failure`, once the exchange has ended.
    """
    card = carray(context, 1, CARD)[0]
    if card.running == 0:
        _open_again(card)
        card.running = 1
    elif card.waits != 0:
        _send_drive(card, ANSWER)
        _await_answer(card, card.deadline_ns)
    else:
        _receive_newest(card)
    if card.reads_until_strangers == 0:
        card.foreign += take_strangers(card, MAX_FRAMES_PER_TICK)
        card.reads_until_strangers = STRANGERS_EVERY
    card.reads_until_strangers -= 1
    is_held = card.newest != card.sequence
    card.held_in_a_row = card.held_in_a_row + 1 if is_held else 0
    card.held += 1 if is_held else 0
    card.error_level = card.error_level + RISE if is_held else max(card.error_level - FALL, 0)
    if card.error_level >= card.error_limit and card.failure == 0:
        card.failure = LINK
    _fill_values(card, values)
    if card.failure != 0:
        return FAILED
    return HELD if is_held else GOOD


@cfunc(SIGNATURE)
def node_write(context, values):
    """Send the codes nearest to the volts of every analogue output, clipped to the node's ranges, and a bit for every
    digital output: 1 from THRESHOLD_V on.

    Returns GOOD, also for a frame that the system does not take; FAILED for NaN in any output: no frame is sent, and
    the exchange has ended.
    """
    card = carray(context, 1, CARD)[0]
    volts = carray(values, card.outputs + card.digital_outputs)
    for i in range(card.outputs + card.digital_outputs):
        if np.isnan(volts[i]):
            card.failure = NOT_A_NUMBER
            return FAILED
    scales = carray(address_pointer(card.out_scales), card.outputs, SCALE)
    codes = carray(address_pointer(card.sent + DRIVE_HEAD), card.outputs, np.int32)
    for i in range(card.outputs):
        scale = scales[i]
        code = np.rint((volts[i] - scale.offset_v) / scale.volts_per_code)
        codes[i] = scale.lowest if code < scale.lowest else (scale.highest if code > scale.highest else np.int64(code))
    frame = carray(address_pointer(card.sent), 1, DRIVE)[0]
    digital = 0
    for i in range(card.digital_outputs):
        digital |= (1 if volts[card.outputs + i] >= THRESHOLD_V else 0) << i
    frame.digital = digital
    _send_drive(card, APPLY if card.waits != 0 else APPLY | ANSWER)
    return GOOD


@jit_rare
def _send_drive(card, flags):
    """Send a DRIVE with the codes and digital outputs at `card.sent`; `flags` is a sum of OPEN, APPLY and ANSWER.

    With ANSWER, the frame becomes the last request, and the time of sending is stored. A frame that the system does not
    take is not reported: it counts as one whose answer is missing.
    """
    frame = carray(address_pointer(card.sent), 1, DRIVE)[0]
    card.last_sequence = np.uint32(card.last_sequence + np.uint32(1))
    card.turn += 1 if card.last_sequence == 0 else 0
    frame.magic, frame.format, frame.batches = MAGIC, DRIVE_FORMAT, BATCHES
    frame.sequence, frame.session = card.last_sequence, card.session
    frame.bits, frame.outputs, frame.hold_us, frame.zero = flags, card.outputs, card.hold_us, 0
    length = DRIVE_HEAD + 4 * card.outputs
    if card.is_keyed != 0:
        write_tag(card.key_low, card.key_high, card.sent, length, card.boot, card.opening, card.turn)
        tags = carray(address_pointer(card.ring_tag), WINDOW, np.uint64)
        tags[np.int64(card.last_sequence) % WINDOW] = load_word(card.sent + length)
    length += TAG_BYTES
    check = carray(address_pointer(card.sent + length), 1, np.uint32)
    check[0] = checksum(card, card.sent, length)
    if flags & ANSWER:
        card.sequence = card.last_sequence
        card.requests += 1
        index = np.int64(card.sequence) % WINDOW
        carray(address_pointer(card.ring_sequence), WINDOW, np.uint32)[index] = card.sequence
        carray(address_pointer(card.ring_request), WINDOW, np.int64)[index] = card.requests
        carray(address_pointer(card.ring_ns), WINDOW, np.int64)[index] = monotonic_ns(card.timespec)
    send_frame(card, length + CRC_BYTES)


@jit
def checksum(card, address, length):
    """Return the CRC-32 of the `length` bytes, a multiple of 4, at `address`, with the tables of `card`."""
    tables = carray(address_pointer(card.crc_table), (4, 256), np.uint32)
    words = carray(address_pointer(address), length // 4, np.uint32)
    value = np.uint32(0xFFFFFFFF)
    for i in range(length // 4):
        word = np.int64(value ^ words[i])
        value = (
            tables[3, word & 0xFF] ^ tables[2, word >> 8 & 0xFF] ^ tables[1, word >> 16 & 0xFF] ^ tables[0, word >> 24]
        )
    return np.uint32(value ^ np.uint32(0xFFFFFFFF))


@jit_rare
def _open_again(card):
    """Begin the session once more, because much time may have passed since the driver was opened; wait for the answer.

    The outputs stay at their safe values: the node does not apply the codes of an OPEN. Sets all counts to 0, and
    `failure` if no answer comes within OPEN_TRIES times OPEN_WAIT_NS.
    """
    deadline_ns = monotonic_ns(card.timespec) + OPEN_WAIT_NS
    while receive_frame(card) > GONE and monotonic_ns(card.timespec) < deadline_ns:
        pass  # Frames from before the first tick are old.
    while take_strangers(card, MAX_FRAMES_PER_TICK) > 0 and monotonic_ns(card.timespec) < deadline_ns:
        pass
    first_opening = card.opening
    for number in range(OPEN_TRIES):
        # A session that the node has ended meanwhile is begun anew with the next opening.
        card.opening = np.uint32(first_opening + np.uint32(number & 1))
        _send_drive(card, OPEN | ANSWER)
        _await_answer(card, OPEN_WAIT_NS)
        if card.newest == card.sequence or card.failure != 0:
            break
    if card.newest != card.sequence and card.failure == 0:
        card.failure = SILENT
    card.opening_request = card.requests
    card.lost = card.reordered = card.duplicated = card.invalid = card.foreign = card.held = card.error_level = 0


@jit
def _await_answer(card, duration_ns):
    """Receive frames until the last request is answered, or the exchange fails, for at most `duration_ns`.

    After that time, up to MAX_FRAMES_PER_TICK waiting frames are still received, because the answer may be among them
    if the process was suspended.
    """
    deadline_ns, frames_after = monotonic_ns(card.timespec) + duration_ns, 0
    while card.newest != card.sequence and card.failure == 0:
        has_frame = _receive_one(card)
        if monotonic_ns(card.timespec) > deadline_ns:
            frames_after += 1
            if not has_frame or frames_after == MAX_FRAMES_PER_TICK:
                break


@jit
def _receive_newest(card):
    """Receive frames until the last request is answered or no frame is left, at most MAX_FRAMES_PER_TICK.

    Frames that came after that answer, such as a duplicate, wait for the next tick.
    """
    for _ in range(MAX_FRAMES_PER_TICK):
        if not _receive_one(card) or card.newest == card.sequence:
            break


@jit_rare
def _receive_one(card):
    """Receive a frame if one has come, and process or count it; return whether one had come.

    Sets `failure` if a frame says that the exchange has ended, such as a refusal, and for a serial line that has ended.
    """
    length = receive_frame(card)
    if length == GONE:
        card.failure = LINE_GONE
    if length in (EMPTY, GONE):
        return False
    if length == BROKEN or not _is_whole(card, length):
        card.invalid += 1
    else:
        frame = carray(address_pointer(card.received), 1, REFUSAL)[0]
        if frame.session != card.session or (card.is_keyed != 0 and not _is_genuine(card, length)):
            card.foreign += 1  # of a run before this one, of another controller, or of one who lacks the key
        elif frame.boot != card.boot:
            card.failure = RESTARTED
        elif frame.format == REFUSAL_FORMAT:
            card.failure = frame.reason
        else:
            _take_sample(card)
    return True


@jit
def _is_whole(card, length):
    """Whether the bytes received are a SAMPLE with the node's number of inputs or a REFUSAL, with a correct CRC-32."""
    frame = carray(address_pointer(card.received), 1, SAMPLE)[0]
    if length < REFUSAL_BYTES or frame.magic != MAGIC or frame.batches != BATCHES:
        return False
    if frame.format == SAMPLE_FORMAT:
        if length != SAMPLE_HEAD + 4 * card.inputs + END_BYTES or frame.inputs != card.inputs:
            return False
    elif frame.format != REFUSAL_FORMAT or length != REFUSAL_BYTES:
        return False
    check = carray(address_pointer(card.received + length - CRC_BYTES), 1, np.uint32)[0]
    return check == checksum(card, card.received, length - CRC_BYTES)


@jit
def _is_genuine(card, length):
    """Whether the whole frame received has the right tag, and a REFUSAL also the tag of a DRIVE that was sent.

    The bytes of tag and check are overwritten.
    """
    content = length - END_BYTES
    frame = carray(address_pointer(card.received), 1, REFUSAL)[0]
    received_tag = load_word(card.received + content)
    if frame.format != REFUSAL_FORMAT:
        turn = card.turn - (1 if frame.sequence > card.last_sequence else 0)
        write_tag(card.key_low, card.key_high, card.received, content, card.boot, card.opening, turn)
        return load_word(card.received + content) == received_tag
    sent_tag = carray(address_pointer(card.ring_tag), WINDOW, np.uint64)[np.int64(frame.sequence) % WINDOW]
    write_tag(card.key_low, card.key_high, card.received, content, frame.boot, frame.opening, 0)
    return load_word(card.received + content) == received_tag and frame.drive_tag == sent_tag != 0


@jit
def _take_sample(card):
    """Copy the sample received if it is newer than all earlier ones; else count it as reordered, duplicated or invalid.

    Requests that a newer sample skips count as lost, until their answers come late. A late answer to a request from
    before the first tick is not counted. A code outside its channel's range makes the sample invalid. A newer sample of
    a node that is not ready is not copied; from the first tick on it sets `failure`.
    """
    frame = carray(address_pointer(card.received), 1, SAMPLE)[0]
    received = carray(address_pointer(card.received + SAMPLE_HEAD), card.inputs, np.int32)
    scales = carray(address_pointer(card.in_scales), card.inputs, SCALE)
    requests = carray(address_pointer(card.ring_request), WINDOW, np.int64)
    sequences = carray(address_pointer(card.ring_sequence), WINDOW, np.uint32)
    index = np.int64(frame.sequence) % WINDOW
    is_valid = sequences[index] == frame.sequence and requests[index] != 0
    for i in range(card.inputs):
        is_valid = is_valid and scales[i].lowest <= received[i] <= scales[i].highest
    if not is_valid:
        card.invalid += 1
        return
    request = requests[index]
    if request < 0:
        card.duplicated += 1
        return
    requests[index] = -request  # It is answered.
    if request < card.newest_request:
        if request > card.opening_request:
            card.lost -= 1
            card.reordered += 1
        return
    if not frame.bits & READY:
        card.failure = NOT_READY if card.running != 0 else 0
        return
    card.lost += request - card.newest_request - 1
    card.newest_request = request
    card.newest, card.digital, card.age_ns = frame.sequence, frame.digital, frame.age_ns
    sent_ns = carray(address_pointer(card.ring_ns), WINDOW, np.int64)[index]
    card.exchange_ns = monotonic_ns(card.timespec) - sent_ns
    codes = carray(address_pointer(card.codes), card.inputs, np.int32)
    for i in range(card.inputs):
        codes[i] = received[i]


@jit
def _fill_values(card, values):
    """Fill `values` with volts of inputs and digital inputs, the age in µs, and the counts.

    The age is infinite after more than `hold_ticks` successive held ticks.
    """
    inputs = card.inputs + card.digital_inputs
    out = carray(values, inputs + 1 + OBSERVED_COUNT)
    scales = carray(address_pointer(card.in_scales), card.inputs, SCALE)
    codes = carray(address_pointer(card.codes), card.inputs, np.int32)
    for i in range(card.inputs):
        out[i] = scales[i].offset_v + codes[i] * scales[i].volts_per_code
    for i in range(card.digital_inputs):
        out[card.inputs + i] = HIGH_V if np.int64(card.digital) >> i & 1 else 0.0
    index = np.int64(card.newest) % WINDOW
    sent_ns = carray(address_pointer(card.ring_ns), WINDOW, np.int64)[index]
    age_us = (monotonic_ns(card.timespec) - sent_ns + card.age_ns) * 1e-3
    out[inputs] = np.inf if card.held_in_a_row > card.hold_ticks else age_us
    out[inputs + 1] = card.lost
    out[inputs + 2] = card.reordered
    out[inputs + 3] = card.duplicated
    out[inputs + 4] = card.invalid
    out[inputs + 5] = card.foreign
    out[inputs + 6] = card.held
    out[inputs + 7] = card.error_level
    out[inputs + 8] = card.exchange_ns * 1e-3
