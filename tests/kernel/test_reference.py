"""Reference generators against formulas written out in numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from rtloop.configuration.reference_options import ReferenceOptions
from rtloop.configuration.references import TableOfSamples, extent, generator_values
from rtloop.drivers.base import Channel
from rtloop.foundation.native.compiled import jit
from rtloop.kernel.reference import GENERATOR, reference_sample

RATE_HZ, START = 10_000.0, 137
INPUTS = (Channel("adc0"), Channel("joystick"))
TICKS = 30_000
TIME_S = np.arange(TICKS) / RATE_HZ


@jit
def write_samples(generators, first, period_s, table, volts, out, feed):
    """Write the reference's samples from tick `first` on to `out`, and its additions to the command to `feed`."""
    for k in range(out.size):
        out[k] = reference_sample(generators[0], first + k, period_s, table, volts[k])
        feed[k] = generators[0].feed_um


def generate(options: dict, ticks: int = TICKS, volts: np.ndarray | None = None, folder: Path = Path()) -> np.ndarray:
    """Return the samples of a reference with these configured options, which begins at tick START."""
    return generate_both(options, ticks, volts, folder)[0]


def generate_both(options: dict, ticks: int, volts: np.ndarray | None, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of `generate`, and the additions to the command in the same ticks."""
    checked = TypeAdapter(ReferenceOptions).validate_python(options)
    table = TableOfSamples()
    table.add(np.full(5, 1e6))  # another axis's samples
    values = generator_values(checked, RATE_HZ, INPUTS, folder, table)
    generators = np.zeros(1, GENERATOR).view(np.recarray)
    generators.kind, generators.start_tick = values[0], START
    generators.parameters[0, : len(values) - 1] = values[1:]
    out, feed = np.empty(ticks), np.empty(ticks)
    volts = np.zeros((ticks, 3)) if volts is None else volts
    write_samples(generators, START, 1 / RATE_HZ, table.samples, volts, out, feed)
    return out, feed


VOLTS = np.random.default_rng(4).normal(0, 3, (TICKS, 3))
FORMULAS = [
    ({"kind": "hold", "value": -3.25}, np.full(TICKS, -3.25), 0.0),
    # level number floor(t / dwell), then the first level again
    (
        {"kind": "steps", "levels": [20.0, 0.0, -20.0], "dwell_s": 0.25},
        np.array([20.0, 0.0, -20.0])[np.arange(TICKS) // 2500 % 3],
        0.0,
    ),
    (
        {"kind": "steps", "levels": [1, 2], "dwell_s": 0.007, "repeat": False},
        np.array([1.0, 2.0])[np.minimum(np.arange(TICKS) // 70, 1)],
        0.0,
    ),
    (
        {"kind": "sine", "amplitude": 20, "frequency_hz": 17.3, "offset": 1.5, "phase_deg": 40},
        1.5 + 20 * np.sin(2 * np.pi * 17.3 * TIME_S + np.radians(40)),
        1e-9,
    ),
    # straight lines between the zeros and peaks of a sine: 2/π · arcsin(sin)
    (
        {"kind": "triangle", "amplitude": 20, "frequency_hz": 17.3, "offset": -2, "phase_deg": -30},
        -2 + 20 * 2 / np.pi * np.arcsin(np.sin(2 * np.pi * 17.3 * TIME_S + np.radians(-30))),
        1e-6,
    ),
    ({"kind": "input", "channel": "joystick", "per_v": -2.5, "offset": 4.0}, 4.0 - 2.5 * VOLTS[:, 1], 1e-14),
]


@pytest.mark.parametrize(("options", "expected", "tolerance"), FORMULAS)
def test_a_generator_follows_its_formula(options, expected, tolerance):
    np.testing.assert_allclose(generate(options, volts=VOLTS), expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("suffix", "columns"), [(".npy", 1), (".csv", 1), (".txt", 1), (".npy", 2)])
@pytest.mark.parametrize("repeat", [True, False])
def test_table(tmp_path, suffix, columns, repeat):
    """A second column is added to the command, sample by sample."""
    recorded = np.random.default_rng(2).normal(0, 10, (701, columns))
    path = tmp_path / f"trajectory{suffix}"
    if suffix == ".npy":
        np.save(path, recorded.squeeze())
    else:
        np.savetxt(path, recorded, fmt="%.17g")
    index = np.arange(TICKS) // 3
    expected = recorded[index % 701 if repeat else np.minimum(index, 700)]
    options = {"kind": "table", "file": path.name, "hold_ticks": 3, "repeat": repeat}
    reference, feed = generate_both(options, TICKS, None, tmp_path)
    assert np.array_equal(reference, expected[:, 0])
    assert np.array_equal(feed, expected[:, 1] if columns == 2 else np.zeros(TICKS))


@pytest.mark.parametrize("logarithmic", [True, False])
@pytest.mark.parametrize(("start_hz", "end_hz"), [(1.0, 2000.0), (900.0, 3.0), (50.0, 50.0)])
def test_chirp(logarithmic, start_hz, end_hz):
    """The phase is the integral of the frequency, here by Gauss-Legendre quadrature tick by tick."""
    duration_s = 2.0
    nodes, weights = np.polynomial.legendre.leggauss(8)
    node_times_s = TIME_S[:-1, None] + (nodes + 1) / 2 / RATE_HZ
    share = np.minimum(node_times_s / duration_s, 1.0)
    hz = start_hz * (end_hz / start_hz) ** share if logarithmic else start_hz + (end_hz - start_hz) * share
    turns = np.concatenate([[0.0], np.cumsum(hz @ weights / 2 / RATE_HZ)])
    options = {"kind": "chirp", "amplitude": 4.0, "start_hz": start_hz, "end_hz": end_hz, "duration_s": duration_s}
    sweep = generate({**options, "offset": 0.5, "logarithmic": logarithmic})
    np.testing.assert_allclose(sweep, 0.5 + 4 * np.sin(2 * np.pi * turns), rtol=0, atol=1e-7)


def test_a_long_run_keeps_its_phase():
    """A sine has the phase of its formula even after a week at 10 kHz."""
    week = 7 * 24 * 3600 * 10_000
    generators = np.zeros(1, GENERATOR).view(np.recarray)
    generators.kind, generators.parameters[0, :2] = 2, (1.0, 0.5)
    out = np.empty(20_000)
    write_samples(generators, week, 1e-4, np.zeros(1), np.zeros((20_000, 1)), out, np.empty(20_000))
    np.testing.assert_allclose(out, np.sin(np.pi * np.arange(20_000) / 10_000), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "sine", "amplitude": 20, "frequency_hz": 595.5},
        {"kind": "chirp", "amplitude": 20, "start_hz": 1, "end_hz": 1000, "duration_s": 1.0},
        {"kind": "steps", "levels": [1, 2, 3], "dwell_s": 0.001},
    ],
)
def test_twice_the_same(options):
    assert generate(options).tobytes() == generate(options).tobytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"kind": "steps", "levels": [1], "dwell_s": 1e-5},
            "dwell_s: 1e-05 s; allowed: at least one period of 0.0001 s",
        ),
        (
            {"kind": "input", "channel": "knob", "per_v": 1},
            "'knob' is not a channel of this driver; allowed: adc0, joy",
        ),
        ({"kind": "table", "file": "absent.csv"}, r"file: .*absent\.csv: .*(not found|No such file)"),
        ({"kind": "table", "file": "words.csv"}, r"words\.csv is not one or two columns of numbers"),
        ({"kind": "table", "file": "nan.csv"}, r"nan\.csv contains NaN, .* allowed: finite numbers within ±1e\+09"),
        (
            {"kind": "table", "file": "wide.csv"},
            r"wide\.csv is not one or two columns of numbers \(line 1\)",
        ),
        (
            {"kind": "table", "file": "wide.npy"},
            r"wide\.npy holds an array of 2 × 3 numbers; allowed: one or two columns",
        ),
        ({"kind": "table", "file": "complex.npy"}, r"complex\.npy contains complex128; allowed: real numbers"),
        ({"kind": "table", "file": "nothing.npy"}, r"nothing\.npy is not one or two columns of numbers"),
        ({"kind": "table", "file": "empty.csv"}, r"empty\.csv .*at least one number"),
        ({"kind": "table", "file": "pickled.npy"}, r"pickled\.npy is not one or two columns of numbers"),
    ],
)
def test_references_that_cannot_be(tmp_path, options, message):
    contents = {"words": "one\ntwo\n", "nan": "1\nnan\n", "wide": "1,2,3\n4,5,6\n", "empty": ""}
    for name, content in contents.items():
        (tmp_path / f"{name}.csv").write_text(content)
    np.save(tmp_path / "wide.npy", np.zeros((2, 3)))
    np.save(tmp_path / "complex.npy", np.ones(3, complex))
    (tmp_path / "nothing.npy").write_bytes(b"")
    np.save(tmp_path / "pickled.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(ValueError, match=message):
        generate(options, folder=tmp_path)


@pytest.mark.parametrize("options", [
    {"kind": "hold", "value": -3.0},
    {"kind": "steps", "levels": [1.0, -4.0, 2.0], "dwell_s": 0.5},
    {"kind": "sine", "amplitude": -2.0, "frequency_hz": 5.0, "offset": 7.0, "phase_deg": 30.0},
    {"kind": "triangle", "amplitude": 2.0, "frequency_hz": 5.0, "offset": -7.0},
    {"kind": "chirp", "amplitude": 2.0, "start_hz": 3.0, "end_hz": 9.0, "duration_s": 2.0, "offset": 6.0},
], ids=lambda options: options["kind"])  # fmt: skip
def test_how_far_each_kind_comes_is_known_beforehand(options: dict) -> None:
    table = TableOfSamples()
    values = generator_values(TypeAdapter(ReferenceOptions).validate_python(options), RATE_HZ, INPUTS, Path(), table)
    samples = generate(options)
    assert extent(values, table.samples) == pytest.approx((samples.min(), samples.max()), abs=1e-3)
