"""Commands of a run: from the schedule, which is fixed before it, and from the queue.

The queue has one producer and one consumer. The loop alone decides the tick at which a command takes effect, and
acknowledges it by an event of the same kind and values. The producer may withdraw a command that the loop has not yet
claimed: both exchange the mark of its slot, and the first succeeds.
"""

from __future__ import annotations

import numpy as np

from rtloop.engine.context import (
    axis_generators,
    control_words,
    event_ring,
    law_record,
    message_array,
    word_array,
)
from rtloop.engine.memory import COMMAND_SLOTS, SharedBlock, Word
from rtloop.engine.messages import MESSAGE_VALUES, Kind
from rtloop.engine.ring import ONE, claim, publish
from rtloop.errors import RtloopError
from rtloop.foundation.native.atomics import compare_exchange, load_acquire, store_release
from rtloop.foundation.native.compiled import jit, jit_checked, jit_rare, jit_rare_checked
from rtloop.foundation.native.pointers import address_pointer, carray, copy_bytes
from rtloop.foundation.native.word_access import compare_exchange as exchanged_word
from rtloop.foundation.native.word_access import store_release as store_word
from rtloop.kernel.access import axis_state, coefficients_record, loop_state
from rtloop.kernel.layout import COEFFICIENTS
from rtloop.kernel.prefilter import refill_prefilter, tap_outputs_um
from rtloop.kernel.reference import GENERATOR_PARAMETERS, Generator
from rtloop.kernel.step import coefficients_fit, continue_prefilter, mark_new_controller, reset_trip, set_mode
from rtloop.signals import Mode

COMMANDS_PER_TICK = 4
HEAD, TAIL, STOP_WORD = int(Word.COMMANDS_HEAD), int(Word.COMMANDS_TAIL), int(Word.STOP)
SET_MODE, SET_REFERENCE, RESET_TRIP, STOP, LOAD_LAW, REFUSED = (
    int(kind) for kind in (Kind.SET_MODE, Kind.SET_REFERENCE, Kind.RESET_TRIP, Kind.STOP, Kind.LOAD_LAW, Kind.REFUSED)
)
OFF, RAW, FEEDFORWARD, CLOSED_LOOP = (int(mode) for mode in Mode)
HOLD = int(Generator.HOLD)
GONE = np.uint64(0)
"""Mark of a command that was claimed or withdrawn."""


class QueueFull(RtloopError):
    """The queue is full of commands that the loop has not yet claimed."""


def send(block: SharedBlock, command: np.ndarray, urgent: bool = False) -> int:
    """Put one MESSAGE record (1,) into the queue and return its position; only one process may call this.

    Raises QueueFull if COMMAND_SLOTS commands wait for the loop; for an `urgent` command, if URGENT_SLOTS more than
    these wait.
    """
    head, tail = block.load(Word.COMMANDS_HEAD), block.load(Word.COMMANDS_TAIL)
    slots = block["commands"]
    if head - tail >= (slots.size if urgent else COMMAND_SLOTS):
        raise QueueFull(f"{head - tail} commands wait for the loop already; try again")
    slots[head % slots.size] = command[0]
    store_word(_mark(block, head), head + 1)
    block.store(Word.COMMANDS_HEAD, head + 1)
    return head


def withdraw(block: SharedBlock, position: int) -> bool:
    """Withdraw the command at `position`, which `send` returned; return True.

    Returns False, without effect, if the loop has claimed the command, or it was withdrawn before.
    """
    return bool(exchanged_word(_mark(block, position), position + 1, int(GONE)))


def _mark(block: SharedBlock, position: int) -> int:
    """Return the address of the word that marks the command at `position`: position + 1 while it waits, else GONE."""
    marks = block["commands_marks"]
    return marks.ctypes.data + position % marks.size * marks.itemsize


@jit_checked
def _claim_command(marks, position):
    """Claim the command at `position`, so that it can no longer be withdrawn. Returns False if it was withdrawn."""
    return compare_exchange(marks, position % marks.size, np.uint64(position + 1), GONE)


@jit
def apply_commands(loop):
    """Apply the commands due at this tick: all of the schedule, and at most COMMANDS_PER_TICK of the queue."""
    if loop.scheduled < loop.schedule_count:
        _apply_schedule(loop)
    words = control_words(loop)
    if load_acquire(words, HEAD) != words[TAIL]:
        _apply_queue(loop)


@jit_rare_checked
def _apply_schedule(loop):
    """Apply all scheduled commands whose tick has come."""
    schedule = message_array(loop.schedule, loop.schedule_count)
    while loop.scheduled < loop.schedule_count and schedule[loop.scheduled].tick <= loop.tick:
        _apply_command(loop, schedule[loop.scheduled])
        loop.scheduled += 1


@jit_rare_checked
def _apply_queue(loop):
    """Take at most COMMANDS_PER_TICK commands from the queue, and apply each one that was not withdrawn."""
    words, queue = control_words(loop), message_array(loop.commands, loop.command_count)
    marks = word_array(loop.commands_marks, loop.command_count)
    tail = words[TAIL]
    waiting = np.int64(load_acquire(words, HEAD) - tail)
    for _ in range(min(waiting, COMMANDS_PER_TICK)):
        if _claim_command(marks, np.int64(tail)):
            _apply_command(loop, queue[np.int64(tail % np.uint64(loop.command_count))])
        tail += ONE
        store_release(words, TAIL, tail)


@jit_rare
def _apply_command(loop, command):
    """Apply one command and publish its event, or the event of its refusal.

    Refused are a mode while the loop is tripped or stops, and coefficients that `_load_law` does not accept. The event
    of STOP follows when the loop stops.
    """
    law, state = law_record(loop), loop_state(law_record(loop))
    if command.kind == SET_MODE:
        if state.trip != 0 or loop.stopping != 0:
            _publish_answer(loop, command, REFUSED, (float(command.kind), command.values[0]))
            return
        mode = np.int64(command.values[0])
        if mode != OFF:
            _change_units(loop, mode, command.values[2] != 0.0)
        set_mode(law, mode, loop.tick == 0 and mode != CLOSED_LOOP)
    elif command.kind == SET_REFERENCE:
        _set_reference(loop, command)
    elif command.kind == RESET_TRIP:
        reset_trip(law)
    elif command.kind == LOAD_LAW:
        if not _load_law(loop, command.axis, command.values[0] != 0.0):
            _publish_answer(loop, command, REFUSED, (float(command.kind), 0.0))
            return
    elif command.kind == STOP:
        store_release(control_words(loop), STOP_WORD, ONE)  # the loop publishes the event when it stops
        return
    _publish_answer(loop, command, command.kind, command.values)


@jit
def _publish_answer(loop, command, kind, values):
    """Publish an event `kind` with the axis, origin and identity of a command, which it acknowledges or refuses."""
    publish_event(loop, kind, command.axis, command.origin, command.identity, values)


@jit_checked
def _change_units(loop, mode, holds_output):
    """Set the unit of all references for `mode`: V in RAW, else µm.

    With `holds_output`, a reference in the other unit becomes a constant: the drive in RAW, the applied command in
    FEEDFORWARD, the position in CLOSED_LOOP. Without it, the reference keeps its numbers in the new unit.
    """
    generators, law, volts = axis_generators(loop), law_record(loop), 1 if mode == RAW else 0
    for a in range(loop.axis_count):
        if holds_output and generators[a].volts != volts:
            in_force = axis_state(law, a).drive_v
            if mode == FEEDFORWARD:
                in_force = axis_state(law, a).applied_command_um
            elif mode == CLOSED_LOOP:
                in_force = axis_state(law, a).position_um
            generators[a].kind, generators[a].parameters[0], generators[a].feed_um = HOLD, in_force, 0.0
            generators[a].start_tick = generators[a].held_until = loop.tick
        generators[a].volts = volts


@jit_checked
def _set_reference(loop, command):
    """Start, at this tick, the generator whose kind and parameters are a command's `values`.

    It starts on the command's axis, on all axes for a negative number, in V if the mode is RAW, else in µm.
    """
    generators, volts = axis_generators(loop), 1 if loop_state(law_record(loop)).mode == RAW else 0
    for a in range(loop.axis_count):
        if command.axis < 0 or command.axis == a:
            generators[a].kind = np.int64(command.values[0])
            generators[a].start_tick = loop.tick
            generators[a].held_until = loop.tick
            generators[a].feed_um = 0.0
            generators[a].volts = volts
            for i in range(GENERATOR_PARAMETERS):
                generators[a].parameters[i] = command.values[1 + i]


@jit_checked
def _load_law(loop, first, is_new_controller):
    """Activate the staged coefficients of axis `first` and of the axes that share its controller, and order a snapshot.

    Returns False, without a change, for an axis that does not exist, for counts that do not fit their records, and for
    a controller with another number of axes than before. A new controller continues from the applied command (µm).
    """
    law = law_record(loop)
    size = law.coefficients_bytes
    if first < 0 or first >= law.axis_count:
        return False
    staged = loop.staged + first * size
    count = max(np.int64(carray(address_pointer(staged), 1, COEFFICIENTS)[0].controller_axes), 1)
    for i in range(count):
        staged_coefficients = carray(address_pointer(staged + i * size), 1, COEFFICIENTS)[0]
        if not coefficients_fit(law, first + i, staged + i * size):
            return False
        if staged_coefficients.controller_axes != coefficients_record(law, first + i).controller_axes:
            return False
    for i in range(count):
        _load_axis(law, first + i, staged + i * size)
    if is_new_controller:
        mark_new_controller(law, first)
    loop.next_snapshot = loop.tick
    return True


@jit_checked
def _load_axis(law, a, staged):
    """Activate the coefficients of one axis from address `staged`.

    The axis's pre-filter continues with its history if only its taps change. If its sections change, or it had no taps
    and gets some, it restarts, filled with the next reference.
    """
    before, after = coefficients_record(law, a), carray(address_pointer(staged), 1, COEFFICIENTS)[0]
    needs_refill = (before.tap_count == 0 and after.tap_count != 0) or before.section_count != after.section_count
    if not needs_refill:
        for i in range(after.section_count):
            for j in range(after.sections.shape[1]):
                needs_refill = needs_refill or before.sections[i, j] != after.sections[i, j]
    size, state = law.coefficients_bytes, axis_state(law, a)
    last_um = tap_outputs_um(before, state)
    copy_bytes(law.coefficients + a * size, staged, size)
    if needs_refill:
        refill_prefilter(state)
    elif state.tap_index >= 0:
        continue_prefilter(law, a, last_um)


@jit_rare
def publish_event(loop, kind, axis, origin, identity, values):
    """Publish an event of this tick in the ring of events and count it in `loop.events`.

    Its values are `values`, at most MESSAGE_VALUES, and then zeros.
    """
    ring, position = event_ring(loop), np.uint64(loop.events)
    event = ring.slots[claim(ring, position)]
    event.tick = loop.tick
    event.kind = kind
    event.axis = axis
    event.origin = origin
    event.identity = identity
    for i in range(MESSAGE_VALUES):
        event.values[i] = values[i] if i < len(values) else 0.0
    publish(ring, position)
    loop.events += 1
