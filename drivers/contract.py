"""The conformance suite of drivers: tests of the contract with the loop, inherited by each driver's own tests.

    from rtloop.drivers.contract import DriverContract

    class TestMyCard(DriverContract):
        def driver(self):
            return MyCard(MyCardOptions(), {"x": Wiring("ai0", "ao0")}, 1000.0)

Then run pytest on it. The tests drive the outputs over their whole ranges and beyond: disconnect all actuators.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rtloop.drivers.base import ABI_VERSION, Channel, Driver, Facts, Pointers
from rtloop.drivers.registry import kinds

_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p, ctypes.POINTER(ctypes.c_double))
_UNTOUCHED = -123456.789
_GUARD = 16


class DriverCalls:
    """Calls of a driver's C functions, as the loop makes them."""

    def __init__(self, pointers: Pointers, facts: Facts) -> None:
        """Take `read` and `write` at the pointers; `facts` give the number of values that `read` returns.

        `wait` is not used. Raises AssertionError if `pointers` has another ABI version, or if `read` or `write` is 0.
        """
        assert pointers.abi_version == ABI_VERSION, f"ABI version {pointers.abi_version}; allowed: {ABI_VERSION}"
        assert 0 not in (pointers.read, pointers.write), (
            f"addresses of the C functions: read {pointers.read}, write {pointers.write}; allowed: numbers other than 0"
        )
        self._pointers, self._facts = pointers, facts
        self._read, self._write = _FUNCTION(pointers.read), _FUNCTION(pointers.write)

    def read(self) -> tuple[int, list[float]]:
        """Call `read`; return its status and its values: inputs in V, age in µs, observed signals.

        Raises AssertionError if `read` writes more values than these, or leaves one out with a status of at least 0.
        """
        count = len(self._facts.inputs) + 1 + len(self._facts.observed)
        values = (ctypes.c_double * (count + _GUARD))(*[_UNTOUCHED] * (count + _GUARD))
        status = self._read(self._pointers.context, values)
        assert values[count:] == [_UNTOUCHED] * _GUARD, (
            f"read wrote more than its {count} values (inputs, age, observed signals)"
        )
        is_incomplete = status >= 0 and _UNTOUCHED in values[:count]
        assert not is_incomplete, (
            f"read left out at least one of its {count} values (inputs, age, observed signals): {values[:count]}"
        )
        return status, values[:count]

    def write(self, volts: Sequence[float]) -> int:
        """Write `volts` to all outputs and return the status. Raises AssertionError if `write` changes its argument."""
        buffer = (ctypes.c_double * len(volts))(*volts)
        status = self._write(self._pointers.context, buffer)
        assert list(map(str, buffer)) == list(map(str, map(float, volts))), (
            "write changed the voltages that the loop handed over; it may only read them"
        )
        return status


class DriverContract:
    """Tests of a driver: override `driver`, and `outputs` if the voltages at the hardware can be observed."""

    tolerance_v = 0.01
    """Largest deviation of an output from the written value, such as its resolution."""

    def driver(self) -> Driver:
        """Return a new driver that is not open, for each test. Override it: here it raises NotImplementedError."""
        raise NotImplementedError

    def outputs(self, driver: Driver) -> Sequence[float] | None:
        """Return the volts at the outputs now, in the order of the facts; None, as here, if they cannot be observed."""
        return None

    @contextmanager
    def opened(self) -> Iterator[tuple[Driver, DriverCalls]]:
        """Open a new driver, yield it with its calls, and close it at the end, also after a failure."""
        driver = self.driver()
        try:
            yield driver, DriverCalls(driver.open(), driver.facts)
        finally:
            driver.close()

    def test_facts_are_known_before_open(self) -> None:
        """The facts are plausible, do not change, and are read without access to the hardware."""
        driver = self.driver()
        before, facts = self.outputs(driver), driver.facts
        for channel in (*facts.inputs, *facts.outputs):
            ends = channel.minimum_v, channel.maximum_v
            assert all(map(math.isfinite, ends)), (
                f"channel {channel.name!r}: range {ends[0]} … {ends[1]} V; allowed: finite numbers"
            )
            assert channel.minimum_v < channel.maximum_v, (
                f"channel {channel.name!r}: range {ends[0]} … {ends[1]} V; allowed: the lower end before the higher"
            )
        for channel in facts.outputs:
            assert channel.minimum_v <= channel.safe_v <= channel.maximum_v, (
                f"channel {channel.name!r}: safe_v is {channel.safe_v} V; allowed: a value in the range of the "
                "channel, "
                f"{channel.minimum_v} … {channel.maximum_v} V"
            )
        for names in ([c.name for c in facts.inputs], [c.name for c in facts.outputs], facts.observed):
            assert len(set(names)) == len(names), (
                f"names of inputs, outputs or observed signals: {names}; allowed: each name once"
            )
        assert facts.max_rate_hz > 0, f"max_rate_hz is {facts.max_rate_hz} Hz; allowed: above 0"
        assert driver.facts == facts, "two reads of `facts` gave different values; allowed: the same facts at each read"
        assert self.outputs(driver) == before, "reading the facts moved the outputs; facts must not touch the hardware"

    def test_a_configuration_can_name_it(self) -> None:
        """`kind` is a text, equal to the name of its entry point if it has one; the options are of `options_model`."""
        driver = self.driver()
        place = f"{type(driver).__module__}:{type(driver).__qualname__}"
        names = [kind for kind, location in kinds().items() if location == place]
        kind, model = getattr(driver, "kind", None), driver.options_model
        assert isinstance(kind, str), f"kind is {kind!r}; allowed: a text, the name in a configuration"
        assert not names or kind in names, (
            f"kind is {kind!r}; the entry point of this driver has the name {', '.join(names)}; allowed: equal names"
        )
        actual_model = type(driver.options)
        assert actual_model is model, (
            f"the options are of class {actual_model.__name__}; options_model is {model.__name__}; "
            "allowed: equal classes"
        )

    def test_wiring_names_channels(self) -> None:
        """The input and output of every axis are channels of the facts."""
        driver = self.driver()
        inputs, outputs = ({c.name for c in kind} for kind in (driver.facts.inputs, driver.facts.outputs))
        for axis, wiring in driver.wiring.items():
            assert wiring.input in inputs, f"axis {axis}: input {wiring.input!r} is unknown; allowed: {sorted(inputs)}"
            assert wiring.output in outputs, (
                f"axis {axis}: output {wiring.output!r} is unknown; allowed: {sorted(outputs)}"
            )

    def test_close_before_open_is_harmless(self) -> None:
        """`close` before `open` leaves the hardware untouched, and the driver can be opened afterwards."""
        driver = self.driver()
        before = self.outputs(driver)
        driver.close()
        assert self.outputs(driver) == before, "close before open moved the outputs; close must not touch the hardware"
        driver.open()
        driver.close()

    def test_open_gives_pointers(self) -> None:
        """The pointers are integers of the loop's ABI version; `read` and `write` are not null."""
        driver = self.driver()
        try:
            pointers = driver.open()
            DriverCalls(pointers, driver.facts)
            assert all(isinstance(address, int) for address in pointers), (
                f"open returned the addresses {tuple(pointers)}; allowed: integers"
            )
        finally:
            driver.close()

    def test_open_says_where_the_outputs_are(self) -> None:
        """`outputs_v` gives the volts at the outputs after `open`, or None for outputs that `open` has not moved.

        `open` leaves an output unchanged or makes it safe. Parking ramps from the values of `outputs_v`: a wrong one
        becomes a step. For a card with a watchdog, which may be in a ramp, the outputs themselves are not compared.
        """
        driver = self.driver()
        before_v = self.outputs(driver)
        driver.open()
        try:
            reported_v, after_v, channels = driver.outputs_v(), self.outputs(driver), driver.facts.outputs
            if reported_v is not None:
                assert len(reported_v) == len(channels), f"outputs_v() is {reported_v}; allowed: {len(channels)} values"
                assert all(map(math.isfinite, reported_v)), f"outputs_v() is {reported_v}; allowed: finite numbers"
            if before_v is not None and after_v is not None and not driver.facts.hardware_watchdog:
                self._require_outputs(
                    driver, before_v if reported_v is None else reported_v, f"open, with outputs_v() {reported_v},"
                )
                for channel, before, after in zip(channels, before_v, after_v, strict=True):
                    stayed = min(abs(after - before), abs(after - channel.safe_v)) <= self.tolerance_v
                    assert stayed, (
                        f"channel {channel.name!r}: open moved the output from {before} V to {after} V; allowed: no "
                        "motion, "
                        f"or safe_v = {channel.safe_v} V"
                    )
        finally:
            driver.close()

    def test_read_fills_every_value(self) -> None:
        """`read` gives inputs within their ranges, an age of at least 0 µs, and all observed signals, all finite."""
        with self.opened() as (driver, calls):
            for _ in range(3):
                calls.write([channel.safe_v for channel in driver.facts.outputs])
                status, values = calls.read()
                assert status >= 0, f"read returned status {status}; allowed: 0 or more{_error_suffix(driver)}"
                inputs = driver.facts.inputs
                for channel, value in zip(inputs, values[: len(inputs)], strict=True):
                    inside = channel.minimum_v <= value <= channel.maximum_v
                    assert inside, (
                        f"channel {channel.name!r}: read gave {value} V; allowed: the range of the channel, "
                        f"{channel.minimum_v} … {channel.maximum_v} V"
                    )
                age_us, observed = values[len(inputs)], values[len(inputs) + 1 :]
                assert 0 <= age_us < math.inf, f"the sample's age is {age_us} µs; allowed: 0 or more, finite"
                assert all(map(math.isfinite, observed)), f"observed signals {observed} are not all finite"

    def test_write_accepts_the_whole_range(self) -> None:
        """All outputs follow writes from one end of their ranges to the other."""
        with self.opened() as (driver, calls):
            for share in (0.0, 0.25, 0.5, 1.0):
                volts = [_volts_at_share(channel, share) for channel in driver.facts.outputs]
                status = calls.write(volts)
                assert status >= 0, (
                    f"write({volts}) returned status {status}; allowed: 0 or more{_error_suffix(driver)}"
                )
                self._require_outputs(driver, volts, f"write({volts})")

    def test_nothing_outside_the_range_gets_through(self) -> None:
        """Values outside the range, NaN and infinity are clipped or refused."""
        with self.opened() as (driver, calls):
            channels = driver.facts.outputs
            for excess in (1.0, 1e308, math.inf, -1.0, -1e308, -math.inf, math.nan):
                calls.write([(c.maximum_v if excess > 0 else c.minimum_v) + excess for c in channels])
                for channel, volts in zip(channels, self.outputs(driver) or (), strict=False):
                    inside = channel.minimum_v - self.tolerance_v <= volts <= channel.maximum_v + self.tolerance_v
                    assert inside, (
                        f"channel {channel.name!r}: {volts} V reached the hardware; allowed: the range of the channel, "
                        f"{channel.minimum_v} … {channel.maximum_v} V"
                    )

    def test_not_a_number_moves_no_output(self) -> None:
        """A write of NaN leaves every output where it was, whatever status it returns."""
        with self.opened() as (driver, calls):
            calls.write([_volts_at_share(channel, 0.75) for channel in driver.facts.outputs])
            before_v = self.outputs(driver)
            calls.write([math.nan for _ in driver.facts.outputs])
            if before_v is not None:
                self._require_outputs(driver, list(before_v), "write(NaN)")

    def test_close_parks_every_output(self) -> None:
        """`close` sets every output to its safe value."""
        with self.opened() as (driver, calls):
            calls.write([_volts_at_share(channel, 0.75) for channel in driver.facts.outputs])
        self._require_outputs(driver, [channel.safe_v for channel in driver.facts.outputs], "close")

    def test_close_again_and_again(self) -> None:
        """`close` can be called repeatedly."""
        with self.opened() as (driver, _):
            driver.close()
            driver.close()

    def test_open_after_close(self) -> None:
        """A driver that was closed can be opened again, and reads and writes."""
        with self.opened() as (driver, calls):
            calls.write([_volts_at_share(channel, 0.75) for channel in driver.facts.outputs])
            driver.close()
            calls = DriverCalls(driver.open(), driver.facts)
            assert calls.read()[0] >= 0, f"read failed after close and open{_error_suffix(driver)}"
            status = calls.write([channel.safe_v for channel in driver.facts.outputs])
            assert status >= 0, f"write failed after close and open{_error_suffix(driver)}"

    def _require_outputs(self, driver: Driver, expected: Sequence[float], event: str) -> None:
        """Raise AssertionError if an observable output differs by more than `tolerance_v` from `expected`, in V.

        `event` names the preceding call in the message.
        """
        outputs_v = self.outputs(driver)
        if outputs_v is not None:
            deviation = max(abs(a - b) for a, b in zip(outputs_v, expected, strict=True))
            assert deviation <= self.tolerance_v, (
                f"after {event} the outputs are at {list(outputs_v)} V; allowed: {list(expected)} V"
            )


def _error_suffix(driver: Driver) -> str:
    """Return ": TYPE: MESSAGE" of the driver's attribute `error`, which a PythonDriver sets when it fails.

    Returns "" if the driver has no such attribute, or if it is None.
    """
    error = getattr(driver, "error", None)
    return "" if error is None else f": {type(error).__name__}: {error}"


def _volts_at_share(channel: Channel, share: float) -> float:
    """Return the voltage at the fraction `share` of a channel's range, 0 at its lower end and 1 at its upper."""
    return channel.minimum_v + share * (channel.maximum_v - channel.minimum_v)
