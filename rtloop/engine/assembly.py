"""Assembly of the compiled loop from a plan, a shared block, a driver's pointers and a clock."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rtloop.drivers.base import Channel, Facts, Pointers, Wiring, channel_index
from rtloop.engine.clock import Clock, clock_context, paced_clock
from rtloop.engine.context import LOOP
from rtloop.engine.heartbeat import STAT_BYTES
from rtloop.engine.late_clock import virtual_clock
from rtloop.engine.loop import Outcome, run_ticks
from rtloop.engine.memory import SharedBlock
from rtloop.engine.messages import MESSAGE
from rtloop.engine.plan import Pacing, Plan
from rtloop.errors import HostRefusal
from rtloop.foundation.arrays import Real
from rtloop.foundation.native.c_function import Entry
from rtloop.foundation.native.compiled import UNCOMPILED, python_entry
from rtloop.foundation.native.pointers import address_pointer, carray
from rtloop.kernel.layout import CONDITIONS, LAW
from rtloop.kernel.memory import LawMemory
from rtloop.kernel.reference import GENERATOR
from rtloop.kernel.step import set_mode
from rtloop.laws.binding import bind_functions
from rtloop.laws.registry import LawReference, law_layout
from rtloop.signals import Mode

SNAPSHOT_SECONDS = 1.0
REHEARSED_TICKS = 100
REHEARSED_LAWS = ("prandtl_ishlinskii", "transfer")
UNLIMITED = np.iinfo(np.int64).max
CLOSED_LOOP = int(Mode.CLOSED_LOOP)


def law_at_rest(plan: Plan) -> LawMemory:
    """Return the memory of the plan's laws before the first tick, in the plan's mode.

    Raises ValueError for a law that cannot be compiled or calls a forbidden function.
    """
    memory = LawMemory.create_at_rest(plan.layout, bind_functions(plan.laws), plan.coefficients, plan.extras)
    _set_initial_mode(memory.records.ctypes.data, int(plan.mode))
    return memory


@python_entry("int64(intp, int64)")
def _set_initial_mode(law_address, mode):
    """Set the mode of the LAW record at an address before its first tick. Returns 0."""
    set_mode(carray(address_pointer(law_address), 1, LAW)[0], mode, mode != CLOSED_LOOP)
    return 0


class Assembly:
    """A loop's context (`loop`, one record) and the arrays that it points to, kept alive together."""

    def __init__(
        self, plan: Plan, block: SharedBlock, facts: Facts, pointers: Pointers, clock: Clock, law: LawMemory
    ) -> None:
        """Fill in the loop's context from the plan, and write the plan's table and the drives at rest to `block`.

        No tick is run. Raises ValueError for a channel that the driver lacks, HostRefusal if the loop is compiled and
        the laws are not.
        """
        if UNCOMPILED and isinstance(run_ticks, Entry):  # It would take the functions' numbers for addresses.
            raise HostRefusal(
                "environment: NUMBA_DISABLE_JIT is set, but a loop runs compiled only; unset it. Tests of a law run "
                "uncompiled with it (rtloop.laws.conformance)"
            )
        self._loops = np.zeros(1, LOOP).view(np.recarray)
        self.loop = self._loops[0]
        self._arrays: dict[str, npt.NDArray[Any]] = {}
        self._law = law
        self._add_array("law", law.records)
        self._wire_channels(plan, facts)
        self._map_shared_block(plan, block)
        self._set_functions(pointers, clock)
        period_s = 1.0 / plan.pacing.rate_hz
        self.loop.period_s, self.loop.period_us = period_s, period_s * 1e6
        self.loop.heartbeat_timeout_ns, self.loop.heart_fd = plan.pacing.heartbeat_timeout_s * 1e9, -1
        self.loop.snapshot_ticks = max(1, round(SNAPSHOT_SECONDS * plan.pacing.rate_hz))
        self.loop.record_limit = UNLIMITED if plan.ticks is None else plan.ticks

    @property
    def generators(self) -> npt.NDArray[np.void]:
        """The reference generators that the loop reads, one GENERATOR record an axis."""
        return self._arrays["generators"]

    @property
    def outputs_v(self) -> Real:
        """Copy of the driver's outputs in V, (outputs,): the axes' drives of the last successful write, and the other
        outputs as the last tick computed them. Before the first tick: drives at rest, safe values.
        """
        outputs_v = self._arrays["outputs"].copy()
        outputs_v[self._arrays["output_index"]] = self._arrays["last_drive_v"]
        return outputs_v

    def run(self, until_tick: int) -> Outcome:
        """Run the compiled loop until it has executed `until_tick` ticks since its start; return why it ended.

        DONE leaves the outputs as they are, and a later call continues; the other values are as Outcome describes them.
        """
        return Outcome(run_ticks(self._loops.ctypes.data, until_tick))

    def _add_array(self, name: str, array: npt.NDArray[np.generic]) -> None:
        """Store `array` under `name`, which keeps it alive, and write its address to the context's field `name`."""
        self._arrays[name] = array
        self._loops[name] = array.ctypes.data

    def _wire_channels(self, plan: Plan, facts: Facts) -> None:
        """Create the buffers of a tick, and set the indices of the channels of axes, extra inputs and outputs, enable
        switch and hold input.

        Raises ValueError for a channel that the driver lacks.
        """
        axes, loop = plan.axes, self.loop
        loop.axis_count, loop.input_count, loop.output_count = len(axes), len(facts.inputs), len(facts.outputs)
        loop.observed_count = len(facts.observed)
        loop.enable_index = -1 if plan.enable_input is None else channel_index(facts.inputs, plan.enable_input)
        names = plan.extras.inputs
        loop.hold_index = -1
        if plan.hold is not None:
            loop.hold_index, loop.hold_min_v = names.index(plan.hold.input), plan.hold.min_v
            loop.hold_while_high = plan.hold.while_high
        wiring = [plan.wiring[axis] for axis in axes]
        wired = {
            "input_index": (facts.inputs, [wire.input for wire in wiring]),
            "output_index": (facts.outputs, [wire.output for wire in wiring]),
            "extra_input_index": (facts.inputs, [plan.extra_channels[name] for name in names]),
            "extra_output_index": (facts.outputs, [plan.extra_channels[output.name] for output in plan.extras.outputs]),
        }
        arrays = {
            "inputs": np.zeros(len(facts.inputs) + 1 + len(facts.observed)),
            "outputs": np.array([channel.safe_v for channel in facts.outputs]),
            "timing": np.zeros(4),
            "conditions": np.zeros(1, CONDITIONS),
            "heart_text": np.zeros(STAT_BYTES, np.uint8),
            **{name: np.zeros(len(axes)) for name in ("adc_v", "references", "feeds_um")},
            **{
                field: np.array([channel_index(channels, channel) for channel in channel_names], np.int64)
                for field, (channels, channel_names) in wired.items()
            },
        }
        for name, array in arrays.items():
            self._add_array(name, array)

    def _map_shared_block(self, plan: Plan, block: SharedBlock) -> None:
        """Put the arrays of the shared block, the schedule and a copy of the generators into the context.

        Writes the plan's table and the drives at rest to the block.
        """
        loop = self.loop
        for name in ("words", "last_drive_v", "commands", "commands_marks", "table", "staged"):
            self._add_array(name, block[name])
        for name in ("ticks", "events", "snapshots"):
            for part in ("head", "marks", "slots"):
                self._add_array(f"{name}_{part}", block[f"{name}_{part}"])
            self._loops[f"{name}_capacity"] = block[f"{name}_marks"].size
        block["table"][: plan.table.size] = plan.table
        block["last_drive_v"][:] = self._law.axes["drive_v"]
        loop.table_count, loop.command_count = block["table"].size, block["commands"].size
        loop.column_count, loop.snapshot_bytes = block["ticks_slots"].shape[1], block["snapshots_slots"].shape[1]
        self._add_array("generators", plan.generators.copy())
        self._add_array("schedule", plan.schedule)
        loop.schedule_count = plan.schedule.size

    def _set_functions(self, pointers: Pointers, clock: Clock) -> None:
        """Write the addresses of the functions of driver and clock, from `pointers` and `clock`, to the loop's context.

        `wait` is the driver's if it has one, else the clock's.
        """
        loop = self.loop
        loop.read, loop.write, loop.driver_context = pointers.read, pointers.write, pointers.context
        loop.now, loop.clock_context = clock.now, clock.context
        waiting = pointers if pointers.wait else clock
        loop.wait, loop.wait_context = waiting.wait, waiting.context


def rehearse() -> None:
    """Run some ticks of the simulated rig in virtual time, in this process, so that loop, clocks and rig are compiled
    or loaded from the cache.
    """
    pacing = Pacing(rate_hz=1000.0, paced=False, simulated_lateness_us=(0.0,))
    wiring = {"x": Wiring("adc0", "dac0")}
    laws = tuple(map(LawReference, REHEARSED_LAWS))
    coefficients = np.zeros(1, law_layout(laws).coefficients)
    coefficients["controller_axes"], coefficients["controller_law"] = 1, REHEARSED_LAWS.index("transfer")
    coefficients["trip_slew_v_per_tick"] = Channel("dac0").maximum_v
    empty_schedule = np.zeros(0, MESSAGE)
    plan = Plan("rehearsal", ("x",), pacing, REHEARSED_TICKS, "sim", {}, wiring, laws, coefficients, Mode.OFF,
                np.zeros(1, GENERATOR), np.zeros(0), empty_schedule,
                ("x_true_position_um", "x_hysteresis_um"))  # fmt: skip
    driver, block = plan.driver(), SharedBlock.create(plan.sizes)
    facts, pointers = driver.facts, driver.open()
    virtual = virtual_clock(plan, facts, block, pointers, REHEARSED_TICKS)
    paced_clock(clock_context(pacing.rate_hz), 0.0)  # compiles it
    Assembly(plan, block, facts, pointers, virtual.clock, law_at_rest(plan)).run(REHEARSED_TICKS)
