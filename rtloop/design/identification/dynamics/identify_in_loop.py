"""Linear dynamics D(s) from a loop that stays closed, whose noise comes back to the plant's input.

The reference is known, and owes nothing to the noise: it makes the instruments (`instrumental`). Orders and delays are
tried by `nested_models`, judged on what was held out. The result is that of `identify_dynamics`, D(0) = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtloop.design.identification.dynamics.dynamics_fit import (
    Candidate,
    DynamicsFit,
    Mode,
    modes_of,
    static_gain_std,
    transfer_of,
)
from rtloop.design.identification.dynamics.identify_delay import MOST_TICKS, delayed
from rtloop.design.identification.dynamics.identify_dynamics import Criterion, identify_dynamics
from rtloop.design.identification.dynamics.instrumental import (
    Instrumented,
    left_by,
    whitened,
    whitening_of,
    with_past,
)
from rtloop.design.identification.dynamics.markov import ARX_ORDER
from rtloop.design.identification.dynamics.nested_models import Final, Judged, Search, late, preferred
from rtloop.design.identification.dynamics.outside import LoopExcitation, from_outside, from_rest
from rtloop.design.identification.dynamics.prediction_error import LARGEST_ORDER, Excitation
from rtloop.design.identification.dynamics.residuals import residual_tests
from rtloop.design.identification.measured import UnsuitableData

METHOD = "refined instrumental variables, closed loop"
LEAST_SAMPLES = 50 * ARX_ORDER
PATIENCE = 2
"""Modes in a row that do not pay, after which no more are tried."""
SPARE = 4
"""Poles beyond those asked for, that are tried where a mode in the way must be found before one that is asked for."""
SHORT = 4
"""Order of A_n before there is a model: a long one takes for noise what light modes have left."""
LARGEST_SPREAD = 0.1
"""A frequency with a larger standard deviation, relative to itself, is none that was found."""


def identified_dynamics(
    run: Excitation,
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    criterion: Criterion | None = None,
    validation: Sequence[Excitation] = (),
    delay_ticks: int | None = None,
) -> DynamicsFit:
    """By the method for a loop that was closed, or else by `identify_dynamics`, whose arguments these are.

    Raises UnsuitableData, and ValueError for options that contradict each other.
    """
    if not isinstance(run, LoopExcitation):
        return identify_dynamics(run, order, largest_order, criterion or "held-out", validation, delay_ticks)
    if criterion not in (None, "held-out"):
        raise ValueError(f"criterion {criterion!r}: the order of a closed loop's model is chosen by 'held-out'")
    return identify_in_loop(run, order, largest_order, validation, delay_ticks)


def identify_in_loop(
    run: LoopExcitation,
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    validation: Sequence[Excitation] = (),
    delay_ticks: int | None = None,
) -> DynamicsFit:
    """The model of `order` poles behind `delay_ticks` samples; both, where not given, as the part held out tells.

    What it leaves of the runs `validation` is told beside it. Raises UnsuitableData.
    """
    _require_enough(run)
    run = from_rest(run)
    driven, answer = from_outside(run), from_outside(replace(run, input=run.position_um))
    data = Instrumented(run, driven)
    search = Search(data, whitening_of(run.position_um - answer, SHORT))
    found, as_good = _searched(search, order, largest_order, delay_ticks)
    chosen = _final(search, found, as_good)
    if chosen is None:
        raise UnsuitableData(
            f"{run.name}: no stable model of order {order or f'1 to {largest_order}'} explains it; another order, or "
            "more excitation from outside, is needed"
        )
    delay_ticks = chosen.judged.delay_ticks
    later = [delayed(one, delay_ticks) for one in validation]
    settled = [one for one in (*found, *as_good) if one.delay_ticks == delay_ticks and one.estimate.settled]
    tried = {one.model.order: one for one in settled}
    candidates = tuple(_candidate(tried[key], later) for key in sorted(tried))
    return _described(run.name, chosen, late(data, delay_ticks), candidates)


def _final(search: Search, found: list[Judged], as_good: list[Judged]) -> Final | None:
    """The best of those that are as good as any; where the whole recording settles none of them, the next best."""
    finals = [final for one in as_good if (final := search.final(one))]
    if finals:
        return min(finals, key=lambda one: one.judged.total)
    others = sorted((one for one in found if one.estimate.settled), key=lambda one: one.rms_um)
    return next((final for one in others if (final := search.final(one))), None)


def _searched(
    search: Search, order: int | None, largest_order: int, delay_ticks: int | None
) -> tuple[list[Judged], list[Judged]]:
    """All models that were tried, and those of the fewest poles that are as good as any; none where none is stable."""
    most, patience = order or largest_order, None if order else PATIENCE
    found = search.grown(None, delay_ticks or 0, most, patience)
    if order and found and not any(one.model.order == order and one.estimate.settled for one in found):
        larger = search.grown(found[-1], delay_ticks or 0, order + SPARE)
        found += [search.pruned(one, order) for one in larger]
    found = [one for one in found if order in (None, one.model.order)]
    if not found:
        return [], []
    if delay_ticks is None:
        found = _with_delays(search, found)
    as_good = preferred(found)
    if order is not None:
        return found, as_good
    if as_good[0].delay_ticks and delay_ticks is None:
        found += search.grown(as_good[0], as_good[0].delay_ticks, most, 1)
        as_good = preferred(found)
    as_good = [search.pruned(one) for one in as_good]
    fewest = min(one.model.order for one in as_good)
    return found, [one for one in as_good if one.model.order == fewest]


def _with_delays(search: Search, found: list[Judged]) -> list[Judged]:
    """Models behind 0 … MOST_TICKS samples, until one more makes all of them worse; none larger than without delay."""
    best = preferred(found)[0]
    largest = best.model.order
    small = [one for one in found if one.model.order <= largest]
    everything, row = list(found), [one for one in small if one.estimate.settled] or small
    row = [*row, *(one for one in search.reduced(best) if one)]
    for _ in range(MOST_TICKS):
        pairs = [(one, later) for one in row if (later := search.later(one))]
        row = [later for _, later in pairs]
        everything += row
        if all(later.worse_than(one) for one, later in pairs):
            break
    return everything


def _require_enough(run: LoopExcitation) -> None:
    if run.input.size < LEAST_SAMPLES:
        raise UnsuitableData(
            f"{run.name}: too short: {run.input.size} ticks in closed loop; at least {LEAST_SAMPLES} are needed"
        )
    if not np.any(np.ptp(run.outside, axis=1) > 0):
        raise UnsuitableData(
            f"{run.name}: no excitation from outside: the reference stands still. Noise alone cannot tell the plant "
            "from the controller that answers to it: a reference that moves (multisine, chirp or steps) is needed"
        )


def _candidate(judged: Judged, validation: Sequence[Excitation]) -> Candidate:
    unknowns = judged.model.pack(noise=False).size
    left = [left_by(judged.model, run) for run in validation]
    return Candidate(
        judged.model.order,
        judged.rms_um,
        2 * np.log(judged.rms_um) + 2 * unknowns / judged.squares.size,
        float(np.sqrt(np.mean(np.concatenate(left) ** 2))) if left else np.nan,
    )


def _described(name: str, chosen: Final, data: Instrumented, candidates: tuple[Candidate, ...]) -> DynamicsFit:
    model = chosen.estimate.model
    modes = modes_of(model, chosen.estimate.covariance, noise=False)
    _require_known(name, modes)
    left = left_by(model, data.run)
    whole = with_past(left.size)
    errors = whitened(left, chosen.whitening)[whole]
    return DynamicsFit(
        transfer_of(model),
        model.static_gain,
        static_gain_std(model, chosen.estimate.covariance, noise=False),
        modes,
        float(np.sqrt(np.mean(errors**2))),
        100 * (1 - float(np.std(left) / np.std(data.run.position_um))),
        residual_tests(data.driven[whole], errors, ARX_ORDER),
        candidates,
        model,
        chosen.judged.delay_ticks,
        METHOD,
    )


def _require_known(name: str, modes: tuple[Mode, ...]) -> None:
    best = min(modes, key=lambda mode: mode.frequency_std_hz / mode.frequency_hz)
    if best.frequency_std_hz > LARGEST_SPREAD * best.frequency_hz:
        raise UnsuitableData(
            f"{name}: too little excitation from outside: the mode known best is at {best.frequency_hz:.4g} ± "
            f"{best.frequency_std_hz:.2g} Hz; a reference that moves further, or over more frequencies, is needed"
        )
