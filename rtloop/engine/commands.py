"""Commands at a tick: from the schedule, which is known beforehand, and from the queue, which is not.

A queue has one producer and one consumer. The loop alone decides the tick at which a command takes effect, and says
so by an event of the same kind and values.
"""

from __future__ import annotations

import numpy as np

from hil.atomics import load_acquire, store_release
from hil.compiled import jit, seldom
from rtloop.engine.context import axes_of, event_ring, generators_of, messages, octets, state_of, words_of
from rtloop.engine.memory import SharedBlock, Word
from rtloop.engine.messages import MESSAGE_VALUES, Kind
from rtloop.engine.ring import ONE, claim, publish
from rtloop.law.law import reset_trip, set_controller, set_mode
from rtloop.law.layout import COEFFICIENTS
from rtloop.law.reference import GENERATOR_PARAMETERS

COMMANDS_PER_TICK = 4
HEAD, TAIL, STOP_WORD = int(Word.COMMANDS_HEAD), int(Word.COMMANDS_TAIL), int(Word.STOP)
SET_MODE, SET_REFERENCE, RESET_TRIP, STOP, LOAD_LAW, REFUSED = (
    int(kind) for kind in (Kind.SET_MODE, Kind.SET_REFERENCE, Kind.RESET_TRIP, Kind.STOP, Kind.LOAD_LAW, Kind.REFUSED)
)
COEFFICIENT_BYTES = COEFFICIENTS.itemsize


class QueueFull(RuntimeError):
    """The loop has not taken the commands before this one."""


def send(block: SharedBlock, command: np.ndarray) -> None:
    """Put one MESSAGE record into the queue. Single producer. Raises QueueFull."""
    head, tail = int(block.words[HEAD]), int(block.words[TAIL])
    slots = block["commands"]
    if head - tail >= slots.size:
        raise QueueFull(f"{slots.size} commands are waiting for the loop")
    slots[head % slots.size] = command[0]
    _advance(block.words, head + 1)


@jit
def _advance(words, head):
    store_release(words, HEAD, np.uint64(head))


@jit
def apply_commands(loop):
    """Apply what is due at this tick: all of the schedule, and of the queue at most COMMANDS_PER_TICK."""
    schedule = messages(loop.schedule, loop.schedule_count)
    while loop.scheduled < loop.schedule_count and schedule[loop.scheduled].tick <= loop.tick:
        _apply(loop, schedule[loop.scheduled])
        loop.scheduled += 1
    words, queue = words_of(loop), messages(loop.commands, loop.command_count)
    tail = words[TAIL]
    waiting = np.int64(load_acquire(words, HEAD) - tail)
    for _ in range(min(waiting, COMMANDS_PER_TICK)):
        _apply(loop, queue[np.int64(tail % np.uint64(loop.command_count))])
        tail += ONE
        store_release(words, TAIL, tail)


@seldom
def _apply(loop, command):
    state = state_of(loop)
    if command.kind == SET_MODE:
        if state.trip != 0 or loop.stopping != 0:
            values = (float(command.kind), command.values[0])
            publish_event(loop, REFUSED, command.axis, command.origin, command.identity, values)
            return
        set_mode(axes_of(loop), state, np.int64(command.values[0]), loop.tick == 0)
    elif command.kind == SET_REFERENCE:
        _set_reference(loop, command)
    elif command.kind == RESET_TRIP:
        reset_trip(state)
    elif command.kind == LOAD_LAW:
        _load_law(loop, command.axis, command.values[0] != 0.0)
    elif command.kind == STOP:
        store_release(words_of(loop), STOP_WORD, ONE)  # the loop reports it when it stops
        return
    ring, position = event_ring(loop), np.uint64(loop.events)
    event = ring.slots[claim(ring, position)]
    event.tick = loop.tick
    event.kind = command.kind
    event.axis = command.axis
    event.origin = command.origin
    event.identity = command.identity
    for i in range(MESSAGE_VALUES):
        event.values[i] = command.values[i]
    publish(ring, position)
    loop.events += 1


@jit
def _set_reference(loop, command):
    generators = generators_of(loop)
    for a in range(loop.axis_count):
        if command.axis < 0 or command.axis == a:
            generators[a].kind = np.int64(command.values[0])
            generators[a].start_tick = loop.tick
            generators[a].held_until = loop.tick
            for i in range(GENERATOR_PARAMETERS):
                generators[a].parameters[i] = command.values[1 + i]


@jit
def _load_law(loop, axis, another):
    """Take the staged coefficients of an axis; another controller continues from the command in force."""
    offset = axis * COEFFICIENT_BYTES
    size = (loop.axis_count) * COEFFICIENT_BYTES
    staged, active = octets(loop.staged, size), octets(loop.coefficients, size)
    active[offset : offset + COEFFICIENT_BYTES] = staged[offset : offset + COEFFICIENT_BYTES]
    if another:
        set_controller(axes_of(loop)[axis])
    loop.next_snapshot = loop.tick


@seldom
def publish_event(loop, kind, axis, origin, identity, values):
    """An event of this tick with two values."""
    ring, position = event_ring(loop), np.uint64(loop.events)
    event = ring.slots[claim(ring, position)]
    event.tick = loop.tick
    event.kind = kind
    event.axis = axis
    event.origin = origin
    event.identity = identity
    for i in range(MESSAGE_VALUES):
        event.values[i] = 0.0
    event.values[0] = values[0]
    event.values[1] = values[1]
    publish(ring, position)
    loop.events += 1
