"""Second opinion on a loop by python-control: closed-loop poles, margins and the step, from the numbers that will run.

    T = P C F/(1 + P C) + P G/(1 + P C)        F: taps and sections toward the error,  G: taps toward the command

C is read from the coefficients of the compiled law, P from the numbers of the axis's model; python-control samples it
behind the hold. No function of `rtloop.linear` takes part, and `rtloop.analysis` only as the first opinion. Importing
python-control takes more than a second: no loop imports this module, and a service only in a process of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq, minimize_scalar

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.held_plant import POINTS
from rtloop.analysis.margins import loop_margins
from rtloop.analysis.step_response import step_response
from rtloop.configuration.axis import PrefilterOptions
from rtloop.configuration.checks import AxisCheck, SharedLoop
from rtloop.configuration.prepare import Prepared
from rtloop.foundation.arrays import Complex, Real
from rtloop.foundation.trusted import standing_elsewhere
from rtloop.laws.contract import build_record
from rtloop.laws.shipped.transfer import TransferController
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.options import TransferOptions

with standing_elsewhere():
    import control

Matrices = tuple[Real, Real, Real, Real | float]
"""Matrices A, B, C and D of a state space."""
library: Any = control  # its annotations do not describe its functions
POLE_TOLERANCE, STEP_TOLERANCE, MARGIN_TOLERANCE = 1e-6, 1e-6, 1e-3
"""Largest distance of a pole in z, largest difference of a unit step, and largest relative difference of a margin."""
REMEDY = "rtloop or python-control computes a wrong value; report this with the configuration"
LEAST_POLE = 0.3
"""Smaller |z| are not compared: poles of a delay lie together at 0, where rounding moves each far."""
STEP_TICKS, GRID_POINTS = 400, 1500
"""Ticks of the step that is compared; frequencies on the logarithmic grid."""
WIDTHS = np.tan(np.linspace(-1.5, 1.5, 60))
"""Frequencies near a light pole, in widths of its peak."""


class LoopNumbers(NamedTuple):
    """All numbers of a loop as it will run: controller (A, b, c, d) per tick, model in s, delay, reference path.

    `sensor_hz` is the bandwidth of a sensor in the loop, None without one. `with_reference` is the controller from
    errors and references, None for a law that uses errors alone.
    """

    controller: Matrices
    model: TransferOptions
    delay_ticks: int
    prefilter: PrefilterOptions
    period_s: float
    sensor_hz: float | None = None
    with_reference: Matrices | None = None


class AxisPaths(NamedTuple):
    """python-control systems of an axis: the loop broken at its sensor, reference to position, added command to
    position.
    """

    open_loop: Any
    closed: Any
    added: Any


class Opinion(NamedTuple):
    """Closed-loop `poles` in z, margins by name, and x at the ticks after a unit step, empty for an unstable loop."""

    poles: Complex
    margins: dict[str, float]
    position: Real


def faults_on_models(prepared: Prepared) -> list[str]:
    """Return a sentence for each quantity of the axes' loops for which python-control computes another value, else [].

    The loops have the coefficients of the plan, and the axes' models. Axes without a loop on a model are left out.
    """
    records = np.asarray(prepared.plan.coefficients)["controller"]
    faults = list[str]()
    for axis, check, record in zip(prepared.configuration.axes, prepared.checks, records, strict=True):
        if check.on_model is None:
            continue
        if check.together is not None:
            faults += _coupled_faults(prepared, check, check.together)
        else:
            faults += axis_faults(check, axis.model, axis.prefilter, check.on_model, check.delay_ticks, record=record)
    return faults


def _coupled_faults(prepared: Prepared, check: AxisCheck, shared: SharedLoop) -> list[str]:
    """Return the sentences of `axis_faults` for an axis that shares its controller; [] without disagreement or loop."""
    if shared.linear is None or check.on_model is None:
        return []
    linear = shared.linear
    a, b, c, d = linear.system
    options = {axis.name: axis for axis in prepared.configuration.axes}
    delays = {entry.name: entry.delay_ticks for entry in prepared.checks}
    models = {name: options[name].model for name in shared.axes}
    axes = [
        LoopNumbers(
            (a, b, c, d), model, delays[name], options[name].prefilter, linear.period_s, None, linear.with_reference
        )
        for name, model in models.items()
        if model is not None
    ]
    coupling = np.array(
        [
            [1.0 if row == column else 0.0 if model is None else model.coupling.get(column, 0.0) for column in models]
            for row, model in models.items()
        ]
    )
    opinion = coupled_opinion(axes, coupling, shared.place)
    return _axis_sentences(check.name, disagreements(check.on_model, opinion))


def axis_faults(
    check: AxisCheck,
    model: TransferOptions | None,
    prefilter: PrefilterOptions,
    loop: Loop,
    delay_ticks: int,
    sensor_hz: float | None = None,
    record: npt.NDArray[np.uint8] | None = None,
) -> list[str]:
    """Return a sentence for each quantity of `loop` for which python-control computes another value; [] if none.

    python-control closes the loop of the controller of `check` and `model` behind `delay_ticks` samples, with a
    first-order sensor of bandwidth `sensor_hz` unless it is None, and takes the step through `prefilter`. `record`
    (bytes,) uint8 holds the coefficients of a transfer function as they run; None builds them from the law.

    The result is also [] for an axis that shares its controller (`faults_on_models` judges it), and without a model or
    a linear law.
    """
    if check.together is not None or check.linear is None or model is None:
        return []
    linear, matrices = check.linear, controller_matrices(check, record)
    with_reference = None if isinstance(linear, DiscreteController) else linear.with_reference
    numbers = LoopNumbers(matrices, model, delay_ticks, prefilter, linear.period_s, sensor_hz, with_reference)
    return _axis_sentences(check.name, disagreements(loop, second_opinion(numbers)))


def _axis_sentences(name: str, faults: list[str]) -> list[str]:
    """Return the faults, each behind "axis.NAME: "; the last one is followed by REMEDY."""
    return [f"axis.{name}: {fault}{f'; {REMEDY}' if fault is faults[-1] else ''}" for fault in faults]


def controller_matrices(check: AxisCheck, record: npt.NDArray[np.uint8] | None = None) -> Matrices:
    """Return (A, b, c, d) of the controller per tick.

    For a transfer function, they come from the coefficients that the kernels read, `record` (bytes,) uint8 or, if that
    is None, built from the law; for any other law, they are the matrices of its linear part, which come from running
    its functions.
    """
    if not isinstance(check.law, TransferController):
        return tuple(check.linear.system)  # pyright: ignore[reportOptionalMemberAccess, reportReturnType]
    built = build_record(check.law)
    if record is not None:
        built = record[: built.dtype.itemsize].view(built.dtype)
    numbers = built.view(np.recarray)[0]
    states = np.arange(numbers.own.size)
    a = numbers.coupling.copy()
    a[states, states], a[states, states ^ 4] = numbers.own, numbers.partner  # partners stand four places apart
    used = states[: int(numbers.order)]
    return a[np.ix_(used, used)], numbers.b[used], numbers.c[used], float(numbers.d)


def second_opinion(numbers: LoopNumbers) -> Opinion:
    """Return closed-loop poles, margins and step of a loop as python-control computes them."""
    controller, plant = _state_space(*numbers.controller, numbers.period_s), _sampled_plant(numbers)
    open_loop = library.series(controller, plant)
    closed = _closed_with_reference(numbers, plant, 0) or library.feedback(open_loop, 1)
    return _opinion(AxisPaths(open_loop, closed, library.feedback(plant, controller)), numbers)


def coupled_opinion(axes: Sequence[LoopNumbers], coupling: Real, place: int) -> Opinion:
    """Return the opinion on the loop of axis number `place` of `axes`, broken at its sensor, the other loops closed.

    The controller of each of `axes` is the shared one, from all errors to all commands; `coupling` (axes, axes) is
    position (row) per command (column).
    """
    period_s, count = axes[place].period_s, len(axes)
    plants = library.append(*(_sampled_plant(numbers) for numbers in axes))
    system = library.ss(*axes[place].controller, period_s)
    plant = library.series(library.ss([], [], [], coupling, period_s), plants)
    closed = library.feedback(library.series(system, plant), library.ss([], [], [], np.eye(count), period_s))
    tracking, added = closed[place, place], library.feedback(plant, system)[place, place]
    open_loop = library.feedback(tracking, 1, 1)
    tracking = _closed_with_reference(axes[place], plant, place) or tracking
    return _opinion(AxisPaths(open_loop, tracking, added), axes[place])


def _closed_with_reference(numbers: LoopNumbers, plant: Any, place: int) -> Any:
    """Return the closed loop from the reference of axis `place` to its position; None for a law that uses errors alone.

    `plant` is from all commands to all positions.
    """
    if numbers.with_reference is None:
        return None
    count, period_s = plant.noutputs, numbers.period_s
    law = library.ss(*numbers.with_reference, period_s)
    positions = library.ss([], [], [], np.vstack([np.eye(count), np.zeros((count, count))]), period_s)
    reference = library.ss([], [], [], np.tile(np.eye(count), (2, 1)), period_s)
    return library.series(reference, library.feedback(library.series(law, plant), positions))[place, place]


def _opinion(paths: AxisPaths, numbers: LoopNumbers) -> Opinion:
    """Return poles, margins and step of a loop with these paths; `numbers` give the period and the pre-filter alone."""
    period_s = numbers.period_s
    poles = np.asarray(paths.closed.poles(), complex)
    margins = _margins(paths.open_loop, np.concatenate([paths.open_loop.poles(), poles]))
    if np.any(np.abs(poles) >= 1):
        return Opinion(poles, margins, np.empty(0))
    tick = np.arange(STEP_TICKS)
    position: Real = np.zeros(STEP_TICKS)
    for path, taps, sections in (
        (paths.closed, numbers.prefilter.taps or (1.0,), numbers.prefilter.sections),
        (paths.added, numbers.prefilter.command_taps, ()),
    ):
        signal: Real = np.convolve(taps or (0.0,), np.ones(STEP_TICKS))[:STEP_TICKS]
        for b0, b1, b2, a1, a2 in sections:
            section = library.ss(library.tf([b0, b1, b2], [1.0, a1, a2], period_s))
            signal = np.asarray(library.forced_response(section, tick * period_s, signal).outputs)
        position = position + np.asarray(library.forced_response(path, tick * period_s, signal).outputs)
    return Opinion(poles, margins, position)


def disagreements(loop: Loop, opinion: Opinion) -> list[str]:
    """Return a sentence for each quantity in which `loop` and `opinion` differ by more than its tolerance; [] if none.

    Only the poles are compared if `loop` or `opinion` is unstable, or if `loop` is in continuous time.
    """
    faults = []
    ours, theirs = (poles[np.abs(poles) > LEAST_POLE] for poles in (loop.poles, opinion.poles))
    if ours.size != theirs.size:
        faults.append(
            f"closed-loop poles with |z| > {LEAST_POLE:g}: rtloop finds {ours.size} poles, python-control "
            f"{theirs.size} poles"
        )
    elif ours.size:
        distances = np.abs(ours[:, None] - theirs)
        furthest = max(distances.min(axis=0).max(), distances.min(axis=1).max())
        if not furthest <= POLE_TOLERANCE:
            faults.append(
                f"closed-loop poles: rtloop and python-control differ by up to {furthest:.3g} in z; "
                f"allowed: {POLE_TOLERANCE:g}"
            )
    if not (loop.is_stable and opinion.position.size) or loop.period_s is None:
        return faults
    margins = loop_margins(loop)._asdict()
    for name, value in opinion.margins.items():
        if not np.isclose(margins[name], value, rtol=MARGIN_TOLERANCE, atol=0.0, equal_nan=True):
            faults.append(
                f"{name}: rtloop computes {margins[name]:.6g}, python-control {value:.6g}; allowed: a difference of "
                f"{100 * MARGIN_TOLERANCE:g} %"
            )
    position = step_response(loop, (STEP_TICKS - 1) * loop.period_s).position[::POINTS][:STEP_TICKS]
    difference = float(np.abs(position - opinion.position).max())
    if not difference <= STEP_TOLERANCE:
        faults.append(
            f"step response: rtloop and python-control differ by {difference:.3g} of the step's height; allowed: "
            f"{STEP_TOLERANCE:g}"
        )
    return faults


def _margins(open_loop: Any, poles: Complex) -> dict[str, float]:
    """Return margins by name as `rtloop.analysis.margins` defines them, from responses on a grid that is dense near
    `poles` (in z).

    Keys: crossover_hz (NaN without a crossover), phase_margin_deg and gain_margin, a factor (inf where none exists),
    max_sensitivity.
    """
    period_s = float(open_loop.dt)
    rates: Complex = np.log(poles[np.abs(poles) > LEAST_POLE].astype(complex))
    light = rates[(rates.imag > 0) & (rates.imag < math.pi)]
    near = np.abs(light.imag)[:, None] + np.outer(np.maximum(np.abs(light.real), 1e-6), WIDTHS)
    grid = np.unique(np.concatenate([np.geomspace(1e-6, 1.0, GRID_POINTS) * math.pi, np.abs(near).ravel()]))
    grid = grid[(grid > 0) & (grid < math.pi)] / period_s

    def respond(rad_s: npt.ArrayLike) -> Complex:
        """Return L at angular frequencies, by python-control."""
        return open_loop(np.exp(1j * period_s * np.asarray(rad_s)))

    def crossings(value: Callable[[Complex], Real], is_near: npt.NDArray[np.bool_]) -> list[Any]:
        """Return the angular frequencies at which `value` of L changes sign, where `is_near` (grid,) is True."""
        at = lambda rad_s: float(value(respond(rad_s)))
        cells = [(grid[k], grid[k + 1]) for k in np.flatnonzero((np.diff(value(response) > 0)) & is_near[:-1])]
        # A sign of rounding size may differ between one evaluation of the whole grid and one of a single point.
        return [brentq(at, low, high) for low, high in cells if at(low) * at(high) <= 0.0]

    response = respond(grid)
    gain_crossings = crossings(lambda gain: np.abs(gain) - 1.0, np.ones(grid.size, bool))
    phase_crossings = crossings(np.imag, np.real(response) < 0)
    ends = np.real(open_loop(np.array([1.0 + 1e-12, -1.0])))  # where a response is real, and the grid ends
    factors = [-1 / value for value in (*np.real(respond(phase_crossings)), *ends) if -1 < value < 0]
    lowest = int(np.argmin(np.abs(1 + response)))
    bounds = grid[max(lowest - 1, 0)], grid[min(lowest + 1, grid.size - 1)]
    nearest = minimize_scalar(lambda rad_s: np.abs(1 + respond(rad_s)), bounds=bounds, method="bounded")
    return {
        "crossover_hz": min(gain_crossings, default=math.nan) / (2 * math.pi),
        "phase_margin_deg": min(np.abs(np.angle(-respond(gain_crossings), deg=True)), default=math.inf),
        "gain_margin": min(factors, default=math.inf),
        "max_sensitivity": 1 / min(float(nearest.fun), float(np.abs(1 + response[lowest]))),
    }


def _sampled_plant(numbers: LoopNumbers) -> Any:
    """Return the plant, with its sensor, behind its hold and its delay, as python-control system.

    Time is counted in periods, so that all numbers are near 1.
    """
    period_s, model = numbers.period_s, numbers.model
    if model.form == "state_space":
        parts = [_state_space(period_s * np.array(model.a), period_s * np.array(model.b), model.c, model.d or 0.0, 0)]
    else:
        parts = [library.ss(library.tf(top, bottom)) for top, bottom in _factors(model, period_s)]
    if numbers.sensor_hz is not None:
        rate = 2 * math.pi * numbers.sensor_hz * period_s
        parts.append(library.ss(library.tf([rate], [1.0, rate])))
    held = library.sample_system(library.series(*parts), 1.0, "zoh")
    plant = _state_space(held.A, held.B, held.C, float(held.D.item()), period_s)
    for _ in range(numbers.delay_ticks):
        plant = library.series(_state_space([[0.0]], [1.0], [1.0], 0.0, period_s), plant)
    return plant


def _factors(
    model: TransferOptions, period_s: float
) -> list[tuple[npt.NDArray[np.floating], npt.NDArray[np.floating]]]:
    """Return (numerator, denominator) in s·T of factors whose product is the model without its delay.

    Highest power first. The first factor is the gain, the others are of second order or less. Not for the form
    "state_space".
    """
    gain = 1.0 if model.gain is None else model.gain
    if model.form == "zpk":
        zeros, poles = (np.array([complex(*root) for root in roots]) for roots in (model.zeros, model.poles))
    else:
        is_nested = model.form == "factors"
        tops, bottoms = (
            [np.trim_zeros(np.array(factor, float), "f") for factor in (factors if is_nested else [factors])]
            for factors in (model.numerator, model.denominator)
        )
        gain *= math.prod(float(top[0]) for top in tops) / math.prod(float(bottom[0]) for bottom in bottoms)
        zeros, poles = (np.concatenate([[], *map(np.roots, factors)]) for factors in (tops, bottoms))
    pairs = zip_longest(
        _real_polynomials(period_s * zeros), _real_polynomials(period_s * poles), fillvalue=np.ones(1)
    )  # fmt: skip
    sections = [(np.asarray(top), np.asarray(bottom)) for top, bottom in pairs]
    return [(np.array([gain * period_s ** (len(poles) - len(zeros))]), np.ones(1)), *sections]


def _real_polynomials(roots: Real | npt.NDArray[np.complexfloating]) -> list[npt.NDArray[np.floating]]:
    """Return real polynomials, highest power first, of second order for pairs of `roots`, and of first order for a
    remaining real root.
    """
    real = np.sort(roots[roots.imag == 0].real)
    pairs = [
        *((root, root.conjugate()) for root in roots[roots.imag > 0]),
        *(real[i : i + 2] for i in range(0, len(real), 2)),
    ]
    return sorted((np.poly(pair).real for pair in pairs), key=len, reverse=True)


def _state_space(a: npt.ArrayLike, b: npt.ArrayLike, c: npt.ArrayLike, d: float | Real, dt: float) -> Any:
    """Return a python-control system with one input and one output; `dt` is the period in s, 0 if continuous."""
    return library.ss(a, np.reshape(b, (-1, 1)), np.reshape(c, (1, -1)), [[d]], dt)
