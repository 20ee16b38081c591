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
    driven, driven_position = from_outside(run), from_outside(replace(run, input=run.position_um))
    data = Instrumented(run, driven)
    search = Search(data, whitening_of(run.position_um - driven_position, SHORT))
    models, equivalent = _searched(search, order, largest_order, delay_ticks)
    final = _final(search, models, equivalent)
    if final is None:
        raise UnsuitableData(
            f"{run.name}: no stable model of order {order or f'1 to {largest_order}'} explains it; another order, or "
            "more excitation from outside, is needed"
        )
    delay_ticks = final.judged.delay_ticks
    delayed_validation = [delayed(item, delay_ticks) for item in validation]
    settled_models = [
        item for item in (*models, *equivalent) if item.delay_ticks == delay_ticks and item.estimate.settled
    ]
    by_order = {item.model.order: item for item in settled_models}
    candidates = tuple(_candidate(by_order[key], delayed_validation) for key in sorted(by_order))
    return _described(run.name, final, late(data, delay_ticks), candidates)


def _final(search: Search, found: list[Judged], as_good: list[Judged]) -> Final | None:
    """The best of those that are as good as any; where the whole recording settles none of them, the next best."""
    finals = [final for model in as_good if (final := search.final(model))]
    if finals:
        return min(finals, key=lambda model: model.judged.total)
    fallbacks = sorted((model for model in found if model.estimate.settled), key=lambda model: model.rms_um)
    return next((final for model in fallbacks if (final := search.final(model))), None)


def _searched(
    search: Search, order: int | None, largest_order: int, delay_ticks: int | None
) -> tuple[list[Judged], list[Judged]]:
    """All models that were tried, and those of the fewest poles that are as good as any; none where none is stable."""
    most_poles, patience = order or largest_order, None if order else PATIENCE
    models = search.grown(None, delay_ticks or 0, most_poles, patience)
    if order and models and not any(model.model.order == order and model.estimate.settled for model in models):
        larger_models = search.grown(models[-1], delay_ticks or 0, order + SPARE)
        models += [search.pruned(model, order) for model in larger_models]
    models = [model for model in models if order in (None, model.model.order)]
    if not models:
        return [], []
    if delay_ticks is None:
        models = _with_delays(search, models)
    equivalent = preferred(models)
    if order is not None:
        return models, equivalent
    if equivalent[0].delay_ticks and delay_ticks is None:
        models += search.grown(equivalent[0], equivalent[0].delay_ticks, most_poles, 1)
        equivalent = preferred(models)
    equivalent = [search.pruned(model) for model in equivalent]
    fewest_poles = min(model.model.order for model in equivalent)
    return models, [model for model in equivalent if model.model.order == fewest_poles]


def _with_delays(search: Search, found: list[Judged]) -> list[Judged]:
    """Models behind 0 … MOST_TICKS samples, until one more makes all of them worse; none larger than without delay."""
    best = preferred(found)[0]
    largest = best.model.order
    small_models = [model for model in found if model.model.order <= largest]
    all_models, current = list(found), [model for model in small_models if model.estimate.settled] or small_models
    current = [*current, *(model for model in search.reduced(best) if model)]
    for _ in range(MOST_TICKS):
        pairs = [(model, later) for model in current if (later := search.later(model))]
        current = [later for _, later in pairs]
        all_models += current
        if all(later.worse_than(model) for model, later in pairs):
            break
    return all_models


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
    residuals = [left_by(judged.model, run) for run in validation]
    return Candidate(
        judged.model.order,
        judged.rms_um,
        2 * np.log(judged.rms_um) + 2 * unknowns / judged.squares.size,
        float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))) if residuals else np.nan,
    )


def _described(name: str, chosen: Final, data: Instrumented, candidates: tuple[Candidate, ...]) -> DynamicsFit:
    model = chosen.estimate.model
    modes = modes_of(model, chosen.estimate.covariance, noise=False)
    _require_known(name, modes)
    residual_um = left_by(model, data.run)
    past = with_past(residual_um.size)
    errors = whitened(residual_um, chosen.whitening)[past]
    return DynamicsFit(
        transfer_of(model),
        model.static_gain,
        static_gain_std(model, chosen.estimate.covariance, noise=False),
        modes,
        float(np.sqrt(np.mean(errors**2))),
        100 * (1 - float(np.std(residual_um) / np.std(data.run.position_um))),
        residual_tests(data.driven[past], errors, ARX_ORDER),
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
