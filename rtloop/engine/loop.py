"""Compiled loop: it executes tick after tick, with the same code for hardware, simulation and replay.

    wait ─► read ─► interlocks, reference, law ─► write ─► memories ─► record

Snapshots and commands come before the wait, in the slack of the period. Driver and clock are C function pointers;
no function here allocates, locks or prints.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from rtloop.engine.commands import apply_commands, publish_event
from rtloop.engine.context import (
    axis_generators,
    control_words,
    float_array,
    int_array,
    law_record,
    loop_record,
    snapshot_ring,
    tick_conditions,
    tick_ring,
)
from rtloop.engine.heartbeat import is_heartbeat_lost
from rtloop.engine.memory import Word
from rtloop.engine.messages import ALL_AXES, Kind, Origin
from rtloop.engine.ring import claim, publish
from rtloop.foundation.native.atomics import load_acquire
from rtloop.foundation.native.compiled import jit, jit_rare, python_entry
from rtloop.foundation.native.pointers import call, copy_bytes
from rtloop.kernel.access import axis_state, loop_state, trip_record
from rtloop.kernel.extras import extra_inputs, extra_outputs
from rtloop.kernel.layout import LOOP_STATE
from rtloop.kernel.reference import FOR_EVER, reference_sample
from rtloop.kernel.step import all_coefficients_fit, evaluate, set_mode, update
from rtloop.signals import (
    ADC,
    COMMAND,
    COMMON_COUNT,
    DEADLINE,
    DEMAND,
    DRIVE,
    DRIVER_STATUS,
    ENABLE,
    ERROR,
    EXEC,
    FEED,
    FLAGS,
    LATENESS,
    LAW,
    MODE,
    PER_AXIS_COUNT,
    PERIODS_MISSED,
    POSITION,
    READ,
    REFERENCE,
    SAMPLE_AGE,
    TICK,
    WRITE,
    Flag,
    Mode,
)


class Outcome(IntEnum):
    """Reason why `run_ticks` returned."""

    DONE = 0
    """The requested number of ticks was executed."""
    STOPPED = 1
    """The outputs are safe after a stop."""
    DRIVER_FAILED = 2
    """The outputs are safe, or given up, after a read or write failed; or the clock ended the run."""
    HEARTBEAT_LOST = 3
    """The outputs are safe after the supervisor's heartbeat stopped."""
    LAW_FAILED = 4
    """A count or an index was beyond its array, or an axis had no controller or several; the outputs are as the last
    tick wrote them."""


READ_FAILED, WRITE_FAILED = 1, 2
STOP_WORD = int(Word.STOP)
OFF = int(Mode.OFF)
TRIP_LAW = float(Flag.TRIP_LAW)
OVERRUN, WRITE_FAILED_FLAG, TRIP_HEARTBEAT = int(Flag.OVERRUN), int(Flag.WRITE_FAILED), int(Flag.TRIP_HEARTBEAT)
LOOP_ORIGIN, SUPERVISOR = int(Origin.LOOP), int(Origin.SUPERVISOR)
STOP_KIND = int(Kind.STOP)
TRIPPED, DRIVER_FAILED = int(Kind.TRIPPED), int(Kind.DRIVER_FAILED)
LATENESS_BEGINS, LATENESS_OVER = int(Kind.PERIODS_MISSED), int(Kind.LATENESS_OVER)
DONE, STOPPED, FAILURE, ORPHANED, BROKEN = (int(outcome) for outcome in Outcome)
LOOP_STATE_BYTES = LOOP_STATE.itemsize
US_PER_NS, NS_PER_US = 1e-3, 1e3
TICK_BYTES = 8
"""Bytes of the tick at the beginning of a snapshot."""
GIVE_UP_S = 1.0
"""Time after which the loop gives up a card that refuses every write; its parking is tried afterwards."""


@python_entry("int64(intp, int64)")
def run_ticks(loop_address, until_tick):
    """Run the loop of the LOOP record at `loop_address` until `until_tick` or until it must end; return an Outcome.

    DONE leaves the outputs as they are: a later call continues. A stop, a failed driver and a lost heartbeat ramp the
    outputs down first; GIVE_UP_S of refused writes end the ramp. A failure of the clock and LAW_FAILED end the run at
    once, without a ramp: the caller brings the outputs down. LAW_FAILED means that a count is beyond its record, an
    index beyond its array, or that an axis has no controller or several; the law's memory is then unreliable.
    """
    loop, outcome = loop_record(loop_address), BROKEN
    try:
        if not all_coefficients_fit(law_record(loop)):
            # The text reaches nobody: the supervisor words the outcome LAW_FAILED (OUTCOME_MESSAGES).
            raise IndexError(
                "a count in the coefficients is larger than its array, or an axis has no controller or several"
            )
        outcome = _run_ticks(loop, until_tick)
        if outcome != DONE:
            _end_late_episode(loop)
    except Exception:
        publish_event(loop, TRIPPED, ALL_AXES, LOOP_ORIGIN, 0, (TRIP_LAW, 0.0))
    return outcome


@jit
def _run_ticks(loop, until_tick):
    """Execute ticks; return DONE once ticks 0 … `until_tick` − 1 were executed, another Outcome once a run that must
    end has safe outputs or has given them up.

    Returns FAILURE at once if the clock ends the run.
    """
    while loop.tick < until_tick:
        _prepare_tick(loop)
        if call(loop.wait, loop.wait_context, loop.timing) != 0:
            return FAILURE
        _execute_tick(loop)
        loop.tick += 1
        state = loop_state(law_record(loop))
        if state.settled != 0:
            if loop.failed != 0:
                return FAILURE
            if state.trip & TRIP_HEARTBEAT != 0:
                return ORPHANED
            if loop.stopping != 0:
                return STOPPED
    return DONE


@jit
def _prepare_tick(loop):
    """Do the work before a tick's deadline: apply due commands to the loop, begin a stop, publish a snapshot.

    A stop, which ramps the outputs down, begins if a stop is requested, or if the driver's first failure was a write.
    The snapshot is due once a second, and after new coefficients. With the snapshot, an episode of late ticks ends if
    no period was missed for a second.
    """
    apply_commands(loop)
    failing = loop.failed == WRITE_FAILED  # the next write may succeed: the ramp is tried
    if loop.stopping == 0 and (failing or load_acquire(control_words(loop), STOP_WORD) != 0):
        loop.stopping = 1
        publish_event(loop, STOP_KIND, ALL_AXES, LOOP_ORIGIN if failing else SUPERVISOR, 0, (0.0, 0.0))
        set_mode(law_record(loop), OFF, False)
    if loop.tick >= loop.next_snapshot:
        _publish_snapshot(loop)
        loop.next_snapshot = loop.tick + loop.snapshot_ticks
        if loop.tick >= loop.late_until:
            _end_late_episode(loop)


@jit
def _execute_tick(loop):
    """Read, evaluate, write, advance the memory of laws, and publish the tick's events and record.

    From tick `record_limit` on there is no record.
    """
    timing = float_array(loop.timing, 4)
    deadline_ns, wake_ns, missed, now_ns = timing[0], timing[1], timing[2], timing[3]

    status = call(loop.read, loop.driver_context, loop.inputs)
    read_ns = _elapsed_ns(loop)

    lateness_us = (wake_ns - deadline_ns) * US_PER_NS
    late_ns = wake_ns - deadline_ns + missed * loop.period_us * NS_PER_US
    lost = is_heartbeat_lost(loop, now_ns, late_ns)
    _evaluate_law(loop, status, lost, lateness_us)
    law_ns = _elapsed_ns(loop)

    write_status = call(loop.write, loop.driver_context, loop.outputs)
    write_ns = _elapsed_ns(loop)

    _record_outputs(loop, write_status)
    state = loop_state(law_record(loop))
    update(law_record(loop))
    _publish_events(loop, status, write_status, missed)
    if loop.tick >= loop.record_limit:
        return
    ring, position = tick_ring(loop), np.uint64(loop.tick)
    row = ring.slots[claim(ring, position)]
    _fill_signals(loop, row)
    row[TICK] = float(loop.tick)
    row[DEADLINE] = deadline_ns
    row[LATENESS] = lateness_us
    row[READ] = (read_ns - wake_ns) * US_PER_NS
    row[LAW] = (law_ns - read_ns) * US_PER_NS
    row[WRITE] = (write_ns - law_ns) * US_PER_NS
    row[PERIODS_MISSED] = missed
    row[MODE] = float(state.mode)
    row[DRIVER_STATUS] = float(status)
    row[EXEC] = (_elapsed_ns(loop) - wake_ns) * US_PER_NS
    overrun = lateness_us + row[EXEC] > loop.period_us
    row[FLAGS] = float(state.tick_flags | (OVERRUN if overrun else 0) | (WRITE_FAILED_FLAG if write_status < 0 else 0))
    publish(ring, position)


@jit
def _elapsed_ns(loop):
    """Return the ns since the start, also written to the first value at `loop.timing`.

    NaN, without a write, in virtual time, whose clock has no `now`.
    """
    if loop.now == 0:
        return np.nan
    call(loop.now, loop.clock_context, loop.timing)
    return float_array(loop.timing, 1)[0]


@jit
def _record_outputs(loop, write_status):
    """Store the drives of a successful write in the shared block, for parking.

    After a failed one (status below 0) the last drives are held.
    """
    if write_status < 0:
        _hold_outputs(loop)
        return
    law, last_drive_v = law_record(loop), float_array(loop.last_drive_v, loop.axis_count)
    loop.refused = 0
    for a in range(loop.axis_count):
        last_drive_v[a] = axis_state(law, a).drive_v


@jit_rare
def _hold_outputs(loop):
    """Let the law continue from the last successfully written drives after a failed write.

    The outputs count as settled only after more than GIVE_UP_S of successive failed writes.
    """
    law, last_drive_v = law_record(loop), float_array(loop.last_drive_v, loop.axis_count)
    loop.refused += 1
    loop_state(law).settled = 1 if loop.refused * loop.period_s > GIVE_UP_S else 0
    for a in range(loop.axis_count):
        axis_state(law, a).drive_v = last_drive_v[a]


@jit
def _evaluate_law(loop, status, heartbeat_lost, lateness_us):
    """Compute references and the law from the inputs that were read; set the driver's outputs, in V.

    `status` is the read's, below 0 for a failure, which trips, as a lost heartbeat does.
    """
    inputs = float_array(loop.inputs, loop.input_count + 1 + loop.observed_count)
    outputs = float_array(loop.outputs, loop.output_count)
    adc_v, references = float_array(loop.adc_v, loop.axis_count), float_array(loop.references, loop.axis_count)
    feeds_um = float_array(loop.feeds_um, loop.axis_count)
    input_index, output_index = (
        int_array(loop.input_index, loop.axis_count),
        int_array(loop.output_index, loop.axis_count),
    )
    generators, table = axis_generators(loop), float_array(loop.table, loop.table_count)
    law = law_record(loop)
    if law.extra_count != 0:
        _read_extras(loop, inputs)
    for a in range(loop.axis_count):
        adc_v[a] = inputs[input_index[a]]
        references[a] = reference_sample(generators[a], loop.tick, loop.period_s, table, inputs)
        feeds_um[a] = generators[a].feed_um
    conditions = tick_conditions(loop)
    conditions.driver_status = status
    conditions.heartbeat_lost = 1 if heartbeat_lost else 0
    conditions.sample_age_us = inputs[loop.input_count]
    conditions.lateness_us = lateness_us
    conditions.enable_v = inputs[loop.enable_index] if loop.enable_index >= 0 else 0.0
    evaluate(law, adc_v, references, feeds_um, conditions)
    for a in range(loop.axis_count):
        outputs[output_index[a]] = axis_state(law, a).drive_v
    if law.extra_count != 0:
        _set_extras(loop, outputs)


@jit_rare
def _read_extras(loop, inputs):
    """Copy the extra inputs for the law; delay references by a tick while the hold input holds them.

    A reference that begins in this tick shows its first sample.
    """
    law, read = law_record(loop), extra_inputs(law_record(loop))
    index = int_array(loop.extra_input_index, law.extra_input_count)
    for k in range(law.extra_input_count):
        read[k] = inputs[index[k]]
    if loop.hold_index >= 0 and (read[loop.hold_index] >= loop.hold_min_v) == (loop.hold_while_high != 0):
        generators = axis_generators(loop)
        for a in range(loop.axis_count):
            if generators[a].start_tick < loop.tick:
                generators[a].start_tick += 1
                if generators[a].held_until < FOR_EVER:
                    generators[a].held_until += 1


@jit_rare
def _set_extras(loop, outputs):
    """Copy the value of each extra output, in V, to its channel among the driver's outputs."""
    law, extras = law_record(loop), extra_outputs(law_record(loop))
    index = int_array(loop.extra_output_index, law.extra_output_count)
    for k in range(law.extra_output_count):
        outputs[index[k]] = extras[k].value_v


@jit_rare
def _fill_extras(loop, row, column):
    """Fill the columns of `row` from `column` on with the volts of the extra inputs, then of the extra outputs; return
    nothing.
    """
    law = law_record(loop)
    read, extras = extra_inputs(law), extra_outputs(law)
    for k in range(law.extra_input_count):
        row[column + k] = read[k]
    for k in range(law.extra_output_count):
        row[column + law.extra_input_count + k] = extras[k].value_v


@jit
def _fill_signals(loop, row):
    """Fill a row with sample age, enable input, signals of each axis, extra inputs and outputs, observed signals."""
    inputs = float_array(loop.inputs, loop.input_count + 1 + loop.observed_count)
    adc_v, references = float_array(loop.adc_v, loop.axis_count), float_array(loop.references, loop.axis_count)
    feeds_um = float_array(loop.feeds_um, loop.axis_count)
    law = law_record(loop)
    row[SAMPLE_AGE] = inputs[loop.input_count]
    row[ENABLE] = tick_conditions(loop).enable_v
    for a in range(loop.axis_count):
        column, state = COMMON_COUNT + a * PER_AXIS_COUNT, axis_state(law, a)
        row[column + ADC] = adc_v[a]
        row[column + POSITION] = state.position_um
        row[column + REFERENCE] = references[a]
        row[column + ERROR] = state.error_um
        row[column + COMMAND] = state.command_um
        row[column + DEMAND] = state.demand_v
        row[column + DRIVE] = state.drive_v
        row[column + FEED] = feeds_um[a]
    column = COMMON_COUNT + loop.axis_count * PER_AXIS_COUNT
    if law.extra_count != 0:
        _fill_extras(loop, row, column)
    column += law.extra_count
    for i in range(loop.observed_count):
        row[column + i] = inputs[loop.input_count + 1 + i]


@jit
def _publish_events(loop, status, write_status, missed):
    """Publish the events of this tick: a trip, a failure of the driver, the beginning of an episode of late ticks.

    The first failure of the driver is stored in `loop.failed` (READ_FAILED or WRITE_FAILED), `failed_tick` and
    `failed_status`.
    """
    new_trip = loop_state(law_record(loop)).new_trip
    if new_trip != 0:
        _publish_trip(loop, new_trip)
    if loop.failed == 0 and (status < 0 or write_status < 0):
        loop.failed = WRITE_FAILED if write_status < 0 else READ_FAILED
        failing, operation = (write_status, 1.0) if write_status < 0 else (status, 0.0)
        loop.failed_tick, loop.failed_status = loop.tick, failing
        publish_event(loop, DRIVER_FAILED, ALL_AXES, LOOP_ORIGIN, 0, (float(failing), operation))
    if missed > 0.0:
        _record_lateness(loop, missed)


@jit_rare
def _publish_trip(loop, causes):
    """Publish the event of a trip: all new causes, then the first cause of the first axis with its value, its limit and
    the number of its law.
    """
    trip = trip_record(law_record(loop))
    if trip.cause == 0 and int(causes) & TRIP_HEARTBEAT != 0:
        silence = (float(causes), loop.silence_s, loop.heartbeat_timeout_ns * 1e-9, 0.0, float(loop.silence))
        publish_event(loop, TRIPPED, ALL_AXES, LOOP_ORIGIN, 0, silence)
        return
    values = (float(causes), trip.value, trip.limit, float(trip.cause), float(trip.law))
    publish_event(loop, TRIPPED, trip.axis, LOOP_ORIGIN, 0, values)


@jit_rare
def _record_lateness(loop, missed):
    """Begin an episode of late ticks, with an event, or continue it; it ends after a second without a missed period."""
    if loop.tick >= loop.late_until:
        _end_late_episode(loop)
    if loop.late_ticks == 0:
        publish_event(loop, LATENESS_BEGINS, ALL_AXES, LOOP_ORIGIN, 0, (missed, 0.0))
    periods = np.int64(missed)
    loop.late_ticks += 1
    loop.late_periods += periods
    loop.late_largest = max(loop.late_largest, periods)
    loop.late_until = loop.tick + np.int64(1.0 / loop.period_s)


@jit_rare
def _end_late_episode(loop):
    """Publish the totals of an episode of late ticks if it had more than one, and set them to 0 in any case."""
    if loop.late_ticks > 1:
        values = (float(loop.late_periods), float(loop.late_ticks), float(loop.late_largest))
        publish_event(loop, LATENESS_OVER, ALL_AXES, LOOP_ORIGIN, 0, values)
    loop.late_ticks = loop.late_periods = loop.late_largest = 0


@jit_rare
def _publish_snapshot(loop):
    """Publish tick, coefficients and state as bytes, after the commands of this tick.

    Raises IndexError if they are longer than a slot of the ring.
    """
    ring, position = snapshot_ring(loop), np.uint64(loop.snapshots)
    slot, law, offset = claim(ring, position), law_record(loop), TICK_BYTES
    for i in range(TICK_BYTES):
        ring.slots[slot, i] = (loop.tick >> (8 * i)) & 0xFF
    for address, count in (
        (law.coefficients, law.axis_count * law.coefficients_bytes),
        (law.axes, law.axis_count * law.axes_bytes),
        (law.loop, LOOP_STATE_BYTES),
    ):
        if offset + count > loop.snapshot_bytes:
            raise IndexError("the coefficients and states of the laws have more bytes than the space for a snapshot")
        copy_bytes(loop.snapshots_slots + slot * loop.snapshot_bytes + offset, address, count)
        offset += count
    publish(ring, position)
    loop.snapshots += 1
