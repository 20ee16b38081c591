"""Options of the shipped laws: bounds, keys that exclude each other, and their transfer to another process."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from pydantic import ValidationError

from rtloop.configuration.file import parse
from rtloop.errors import ConfigError
from rtloop.laws import binding
from rtloop.laws.conformance import Bench
from rtloop.laws.limited_return import LimitedLoop
from rtloop.laws.registry import law_from_text
from rtloop.laws.shipped.coupled import Coupled
from rtloop.laws.shipped.options import CoupledOptions, PrandtlIshlinskiiOptions
from rtloop.laws.shipped.pid import PidOptions
from rtloop.laws.shipped.prandtl_ishlinskii import PrandtlIshlinskii
from rtloop.laws.shipped.repetitive import Repetitive, RepetitiveOptions
from rtloop.laws.shipped.transfer import TransferController
from rtloop.recording.replay.laws import _installed_laws
from tests.kernel.harness import EQ_4, EXACT, PERIOD_S
from tests.laws.test_shipped import EXAMPLES

LOOP = {"gain": 1.0, "numerator": [[1.0]], "denominator": [[1.0, 30.0]]}


def test_options_that_belong_to_no_law_reach_another_process() -> None:
    options = PidOptions(ki_per_s=150.0)
    assert pickle.loads(pickle.dumps(options)) == options


def test_an_option_of_a_type_that_no_file_can_hold_is_refused_with_its_line() -> None:
    text = """import io
from rtloop.laws.options import ControllerOptions
class MineOptions(ControllerOptions):
    stream: io.StringIO
"""
    with pytest.raises(ValueError, match=r"mine\.py, line 3: .*StringIO"):
        law_from_text(text, "mine.py")


@pytest.mark.parametrize("gain", [0.0, -0.5, 1.0 + 1e-9, np.nan])
def test_a_memory_that_would_grow_is_refused(gain: float) -> None:
    with pytest.raises(ValidationError, match="gain"):
        RepetitiveOptions(ki_per_s=10.0, repeat_s=0.01, gain=gain)
    assert RepetitiveOptions(ki_per_s=10.0, repeat_s=0.01, gain=1.0).gain == 1.0


@pytest.mark.parametrize(("repeat", "fits"), [(16_384, True), (16_385, False)])
def test_the_longest_period_has_one_place_a_tick(repeat: int, fits: bool) -> None:
    options = RepetitiveOptions(ki_per_s=10.0, repeat_s=repeat * PERIOD_S, smooth_ticks=0, lead_ticks=16_383)
    law = Repetitive(options, PERIOD_S, None)
    if not fits:
        with pytest.raises(ValueError, match="repeat_s"):
            law.build()
        return
    coefficients = law.build()
    assert (coefficients["places"], coefficients["ahead"]) == (repeat, repeat - 1)
    assert all(limits.low <= coefficients[name] <= limits.high for name, limits in law.allowed_coefficients.items())


@pytest.mark.parametrize("excluded", [{"a": [[1.0]]}, {"b": [[1.0, 1.0]]}, {"c": [[1.0], [1.0]]}, {"prewarp_hz": 10.0}])
def test_loops_and_matrices_do_not_stand_side_by_side(excluded: dict) -> None:
    with pytest.raises(ValidationError, match="not allowed together with loops"):
        CoupledOptions.model_validate({"axes": ["x", "y"], "loops": [LOOP, LOOP], **excluded})


@pytest.mark.parametrize(("order", "fits"), [(48, True), (49, False)])
def test_a_controller_of_several_axes_has_up_to_48_states(order: int, fits: bool) -> None:
    random = np.random.default_rng(1)
    options = CoupledOptions.model_validate(
        {
            "axes": ["x", "y"],
            "a": np.diag(-np.geomspace(1.0, 3e3, order)).tolist(),
            "b": random.normal(size=(order, 2)).tolist(),
            "c": random.normal(size=(2, order)).tolist(),
            "d": np.eye(2).tolist(),
        }
    )
    law = Coupled(options, PERIOD_S, (None, None))
    if fits:
        assert law.build()["order"] == 48
        return
    with pytest.raises(ValueError, match="order 49; allowed: up to 48"):
        law.build()


def test_the_edge_of_the_limited_range_is_the_limit_times_the_plants_gain() -> None:
    """A command at the limit holds the plant at the edge, and half the limit lets it return half way to 0."""
    gains = np.array([2.0, 0.5])
    loop = LimitedLoop(lambda position, reference, limit: np.full(2, min(limit, 10.0)), gains, 10.0, by_load=False)
    assert loop.edge_um.tolist() == [20.0, 5.0]
    np.testing.assert_allclose(loop.follow(np.zeros(2), 3, limited=True), [[20.0, 5.0]] * 3)
    loop = LimitedLoop(lambda position, reference, limit: np.full(2, 5.0), gains, 10.0, by_load=False)
    np.testing.assert_allclose(loop.follow(np.zeros(2), 200, limited=True)[-1], [10.0, 2.5])


@pytest.mark.parametrize("drive_v", [0.05, -0.02, 0.0])
def test_an_entry_within_the_dead_band_finds_where_in_it_the_drive_is(drive_v: float) -> None:
    """The band is ±0.095 V about the play's output: a drive half way in the band is a direction of ½."""
    bench = Bench(PrandtlIshlinskii(PrandtlIshlinskiiOptions.model_validate(EXACT), PERIOD_S, None), compiled=False)
    bench._call("enter", drive_v)
    assert bench.state["dead_band_direction"][0] == pytest.approx(drive_v / 0.095)
    bench = Bench(PrandtlIshlinskii(PrandtlIshlinskiiOptions.model_validate(EQ_4), PERIOD_S, None), compiled=False)
    bench._call("enter", drive_v)
    assert bench.state["dead_band_direction"][0] == 0.0


@pytest.mark.parametrize(("key", "meant"), [("ki", "ki_per_s"), ("ki_per_sec", "ki_per_s"), ("kip", "kp")])
def test_a_misspelt_key_that_a_law_need_not_have_is_compared_with_its_keys(key: str, meant: str) -> None:
    text = EXAMPLES["pid"].read_text()
    (line,) = [line for line in text.splitlines() if line.startswith("ki_per_s =")]
    with pytest.raises(ConfigError, match=rf"axis\.x\.controller\.{key}: unknown key; did you mean {meant}\?"):
        parse(text.replace(line, f"{key} = 1.0"), "test", EXAMPLES["pid"].parent, "test")


def test_a_misspelt_key_of_a_law_is_taken_for_the_one_that_is_missing() -> None:
    text = EXAMPLES["repetitive"].read_text().replace("ki_per_s =", "ki_per_second =")
    with pytest.raises(ConfigError) as error:
        parse(text, "test", EXAMPLES["repetitive"].parent, "test")
    message = str(error.value)
    assert "axis.x.controller.ki_per_s: missing; this key is required" in message
    assert "axis.x.controller.ki_per_second: unknown key; did you mean ki_per_s?" in message


def test_code_of_a_shared_controller_is_cached_for_each_number_of_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Records of two and of three axes differ in size: code for three axes would write beyond the memory of two."""
    names: list[str] = []
    monkeypatch.setattr(binding, "cached_address", lambda function, name, signature: names.append(name) or 1)
    for axes in (1, 2, 3):
        kind = TransferController if axes == 1 else Coupled
        records = kind.records(axes)
        names.append("")
        assert [binding._function_address(kind, records, name) for name in ("output", "update")] == [1, 1]
    assert len(set(names)) == 7


def test_a_law_of_rtloop_is_not_looked_for_among_installed_ones() -> None:
    assert _installed_laws("transfer") == ()
    assert _installed_laws("no-such-law") == ()
