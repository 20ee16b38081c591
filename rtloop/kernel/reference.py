"""Reference generators: one sample for each tick, from the tick's index and the loop's period.

A generator counts executed ticks: a stall of the host delays the reference and never makes it jump. Samples are
recorded and are inputs of a replay, so generators may use libm.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from rtloop.foundation.native.compiled import jit_checked

GENERATOR_PARAMETERS = 8


class Generator(IntEnum):
    """Kinds of generators, each with the meaning of its `parameters`."""

    HOLD = 0
    """value, which stays constant"""
    TABLE = 1
    """first sample, number of samples, ticks per sample, 1 to repeat (0 holds the last sample), 1 if as many samples of
    an addition to the command follow the samples of the reference"""
    SINE = 2
    """amplitude, frequency in Hz, offset, phase in turns"""
    TRIANGLE = 3
    """amplitude, frequency in Hz, offset, phase in turns"""
    CHIRP = 4
    """amplitude, start in Hz, end in Hz, duration in s, offset, 1 for a logarithmic sweep"""
    INPUT = 5
    """input channel index, reference per volt, offset"""


GENERATOR = np.dtype(
    [
        ("kind", np.int64),
        ("start_tick", np.int64),
        ("parameters", np.float64, (GENERATOR_PARAMETERS,)),
        # sample of HOLD or TABLE and the tick up to which it is valid: most ticks need no division
        ("held", np.float64),
        ("held_until", np.int64),
        # 1 for volts, of mode raw; else µm
        ("volts", np.int64),
        # addition to the command, in µm, from a table's second column
        ("feed_um", np.float64),
    ],
    align=True,
)
FOR_EVER = np.iinfo(np.int64).max

HOLD, TABLE, SINE, TRIANGLE, CHIRP = (int(kind) for kind in Generator if kind is not Generator.INPUT)
TURN = 2.0 * math.pi


@jit_checked
def reference_sample(generator, tick, period_s, table, inputs):
    """Return the reference of one axis at `tick`, in µm (V for mode raw).

    Generator.HOLD and TABLE store their sample in `generator`, with the first tick at which it is no longer valid.
    Generator.TABLE also sets `generator.feed_um`, the addition to the command in µm; all other kinds leave it. `table`
    (n,) has the samples of all tables, `inputs` readings in V. An index outside `table` or `inputs` raises IndexError.
    """
    if tick < generator.held_until:
        return generator.held
    p = generator.parameters
    elapsed = tick - generator.start_tick
    if generator.kind == HOLD:
        generator.held, generator.held_until = p[0], FOR_EVER
        return generator.held
    if generator.kind == TABLE:
        index, hold_ticks = elapsed // np.int64(p[2]), np.int64(p[2])
        generator.held_until = generator.start_tick + (index + 1) * hold_ticks
        place = np.int64(p[0]) + _table_index(index, np.int64(p[1]), p[3] != 0.0)
        generator.held = table[place]
        generator.feed_um = table[place + np.int64(p[1])] if p[4] != 0.0 else 0.0
        return generator.held
    if generator.kind == SINE:
        return p[2] + p[0] * math.sin(TURN * _phase(elapsed * period_s * p[1] + p[3]))
    if generator.kind == TRIANGLE:
        phase = _phase(elapsed * period_s * p[1] + p[3] + 0.25)
        return p[2] + p[0] * (4.0 * phase - 1.0 if phase < 0.5 else 3.0 - 4.0 * phase)
    if generator.kind == CHIRP:
        return p[4] + p[0] * math.sin(TURN * _phase(_chirp_turns(p, elapsed * period_s)))
    return inputs[np.int64(p[0])] * p[1] + p[2]


@jit_checked
def _table_index(index, count, repeat):
    """Return the index, within a table of `count` samples, of sample `index`: modulo `count` if `repeat`, else at most
    count − 1.
    """
    if repeat:
        return index % count
    return index if index < count else count - 1


@jit_checked
def _phase(turns):
    """Return the fraction of a turn, in 0 ≤ phase < 1."""
    return turns - math.floor(turns)


@jit_checked
def _chirp_turns(p, time_s):
    """Return the turns (cycles) of a sweep after `time_s`; its last frequency continues after its end.

    `p` has the parameters of Generator.CHIRP.
    """
    start_hz, end_hz, duration_s = p[1], p[2], p[3]
    swept_s = time_s if time_s < duration_s else duration_s
    if p[5] != 0.0:
        rate = math.log(end_hz / start_hz) / duration_s
        turns = start_hz * swept_s if rate == 0.0 else start_hz * math.expm1(rate * swept_s) / rate
    else:
        turns = swept_s * (start_hz + 0.5 * (end_hz - start_hz) * swept_s / duration_s)
    return turns + (time_s - swept_s) * end_hz
