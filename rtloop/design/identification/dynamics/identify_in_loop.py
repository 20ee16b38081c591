"""Linear dynamics D(s) from a loop that stays closed, whose noise comes back to the plant's input.

The reference is known and independent of the noise: it makes the instruments (`instrumental`). `nested_models` tries
orders and delays and judges them on held-out blocks. The result has the form of `identify_dynamics`, D(0) = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtloop.design.identification.axis_recording import UnsuitableData
from rtloop.design.identification.dynamics.dynamics_fit import (
    LARGEST_RELATIVE_STD,
    Candidate,
    DynamicsFit,
    Mode,
    continuous_transfer,
    estimate_modes,
    static_gain_std,
)
from rtloop.design.identification.dynamics.excitation import LoopExcitation, driven_input, shift_to_zero
from rtloop.design.identification.dynamics.identify_delay import MOST_TICKS, delay_input
from rtloop.design.identification.dynamics.identify_dynamics import Criterion, identify_dynamics
from rtloop.design.identification.dynamics.instrumental import (
    InstrumentedRecording,
    fit_whitening,
    past_mask,
    residual_noise,
    whiten,
)
from rtloop.design.identification.dynamics.markov import ARX_ORDER
from rtloop.design.identification.dynamics.nested_models import (
    FinalModel,
    JudgedModel,
    ModelSearch,
    delay_recording,
    preferred_models,
)
from rtloop.design.identification.dynamics.plausibility import require_plausible
from rtloop.design.identification.dynamics.prediction_error import LARGEST_ORDER, Excitation
from rtloop.design.identification.dynamics.residuals import residual_tests

METHOD = "refined instrumental variables"
LEAST_SAMPLES = 50 * ARX_ORDER
PATIENCE = 2
"""Modes in a row without gain, after which the search ends."""
SPARE_POLES = 4
"""Poles tried beyond the requested order, where another mode must be found first; they are pruned afterwards."""
INITIAL_NOISE_ORDER = 4
"""Order of A_n before there is a model: a long one would model undiscovered lightly damped modes as noise."""


def identify_recorded_dynamics(
    run: Excitation,
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    criterion: Criterion | None = None,
    validation: Sequence[Excitation] = (),
    delay_ticks: int | None = None,
) -> DynamicsFit:
    """Identify dynamics of a LoopExcitation by `identify_in_loop`, of any other run by `identify_dynamics`.

    The model has `order` poles behind `delay_ticks` samples of delay; None estimates them, the order up to
    `largest_order`. The candidates also report their errors on the runs `validation`. None for `criterion` is
    "held-out". Raises ValueError for another criterion of a LoopExcitation, and the errors of both functions and of
    `require_plausible`, such as UnsuitableData.
    """
    if not isinstance(run, LoopExcitation):
        fit = identify_dynamics(run, order, largest_order, criterion or "held-out", validation, delay_ticks)
    elif criterion not in (None, "held-out"):
        raise ValueError(
            f"criterion: {criterion!r}; allowed for a closed loop, and for a recording that does not begin at rest: "
            "'held-out'"
        )
    else:
        fit = identify_in_loop(run, order, largest_order, validation, delay_ticks)
    require_plausible(run, fit)
    return fit


def identify_in_loop(
    run: LoopExcitation,
    order: int | None = None,
    largest_order: int = LARGEST_ORDER,
    validation: Sequence[Excitation] = (),
    delay_ticks: int | None = None,
) -> DynamicsFit:
    """Identify a model of `order` poles behind `delay_ticks` samples; each that is None is chosen by the errors in
    held-out blocks, the order up to `largest_order`.

    The candidates also report their errors on `validation`. Raises UnsuitableData for fewer than LEAST_SAMPLES ticks,
    for external signals that all stand still, if no fit settles, and if no mode's frequency is certain.
    """
    _require_samples(run)
    run = shift_to_zero(run)
    driven, driven_position = driven_input(run), driven_input(replace(run, input=run.position_um))
    data = InstrumentedRecording(run, driven)
    search = ModelSearch(data, fit_whitening(run.position_um - driven_position, INITIAL_NOISE_ORDER))
    models, equivalent = _search_models(search, order, largest_order, delay_ticks)
    final = _choose_final(search, models, equivalent)
    if final is None:
        raise UnsuitableData(
            f"{run.name}: no stable model of order {order or f'1 to {largest_order}'} found; use another order, or a "
            "reference that moves more"
        )
    delay_ticks = final.judged_model.delay_ticks
    delayed_validation = [delay_input(item, delay_ticks) for item in validation]
    settled_models = [
        item for item in (*models, *equivalent) if item.delay_ticks == delay_ticks and item.estimate.is_settled
    ]
    by_order = {item.model.order: item for item in settled_models}
    candidates = tuple(_describe_candidate(by_order[key], delayed_validation) for key in sorted(by_order))
    return _build_fit(run.name, final, delay_recording(data, delay_ticks), candidates)


def _choose_final(search: ModelSearch, models: list[JudgedModel], equivalent: list[JudgedModel]) -> FinalModel | None:
    """Return the `equivalent` model of least total error, refitted on the whole recording.

    Models whose refit does not settle are left out. If none is left, return the refit of the first settled one of
    `models`, by rising held-out error, whose refit settles; None if no refit does.
    """
    finals = [final for model in equivalent if (final := search.refit_on_whole(model))]
    if finals:
        return min(finals, key=lambda model: model.judged_model.total_squares)
    fallbacks = sorted((model for model in models if model.estimate.is_settled), key=lambda model: model.rms_um)
    return next((final for model in fallbacks if (final := search.refit_on_whole(model))), None)


def _search_models(
    search: ModelSearch, order: int | None, largest_order: int, delay_ticks: int | None
) -> tuple[list[JudgedModel], list[JudgedModel]]:
    """Return all models tried (of `order`, if given), and the models of fewest poles that are as good as the best one.

    The second list is pruned if `order` is None, so that its models need not be in the first list. Both are empty if no
    fit succeeds.
    """
    most_poles, patience = order or largest_order, None if order else PATIENCE
    models = search.grow(None, delay_ticks or 0, most_poles, patience)
    if order and models and not any(model.model.order == order and model.estimate.is_settled for model in models):
        larger_models = search.grow(models[-1], delay_ticks or 0, order + SPARE_POLES)
        models += [search.prune(model, order) for model in larger_models]
    models = [model for model in models if order in (None, model.model.order)]
    if not models:
        return [], []
    if delay_ticks is None:
        models = _add_delays(search, models)
    equivalent = preferred_models(models)
    if order is not None:
        return models, equivalent
    if equivalent[0].delay_ticks and delay_ticks is None:
        models += search.grow(equivalent[0], equivalent[0].delay_ticks, most_poles, 1)
        equivalent = preferred_models(models)
    equivalent = [search.prune(model) for model in equivalent]
    fewest_poles = min(model.model.order for model in equivalent)
    return models, [model for model in equivalent if model.model.order == fewest_poles]


def _add_delays(search: ModelSearch, models: list[JudgedModel]) -> list[JudgedModel]:
    """Return `models`, and refits of the models of at most the preferred one's order behind 1 … MOST_TICKS further
    samples of delay; the delay stops rising once a further sample makes all of them clearly worse.
    """
    best_model = preferred_models(models)[0]
    largest = best_model.model.order
    small_models = [model for model in models if model.model.order <= largest]
    all_models, current = list(models), [model for model in small_models if model.estimate.is_settled] or small_models
    current = [*current, *(model for model in search.remove_each_mode(best_model) if model)]
    for _ in range(MOST_TICKS):
        pairs = [(model, delayed) for model in current if (delayed := search.add_delay(model))]
        current = [delayed for _, delayed in pairs]
        all_models += current
        if all(delayed.is_worse_than(model) for model, delayed in pairs):
            break
    return all_models


def _require_samples(run: LoopExcitation) -> None:
    """Raise UnsuitableData for fewer than LEAST_SAMPLES ticks."""
    if run.input.size < LEAST_SAMPLES:
        raise UnsuitableData(
            f"{run.name}: too short: {run.input.size} ticks; allowed in closed loop, and without a rest at the "
            f"beginning: at least {LEAST_SAMPLES} ticks. Record longer"
        )


def _describe_candidate(model_judgement: JudgedModel, validation: Sequence[Excitation]) -> Candidate:
    """Return a judged model's order, held-out rms error (µm), AIC, and rms residual (µm) on `validation`, NaN without.

    The recordings of `validation` are delayed like the model's already.
    """
    unknowns = model_judgement.model.pack(noise=False).size
    residuals = [residual_noise(model_judgement.model, run) for run in validation]
    return Candidate(
        model_judgement.model.order,
        model_judgement.rms_um,
        2 * np.log(model_judgement.rms_um) + 2 * unknowns / model_judgement.squared_errors.size,
        float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))) if residuals else np.nan,
    )


def _build_fit(
    name: str, final: FinalModel, data: InstrumentedRecording, candidates: tuple[Candidate, ...]
) -> DynamicsFit:
    """Return the result for the final model. Raises UnsuitableData if no mode's frequency is certain.

    The input of `data` is delayed by the model's delay already; `candidates` describe the settled models at this delay,
    one for each order.
    """
    model = final.estimate.model
    modes = estimate_modes(model, final.estimate.covariance, noise=False)
    _require_certain_mode(name, modes)
    residual_um = residual_noise(model, data.run)
    past = past_mask(residual_um.size)
    errors = whiten(residual_um, final.whitening)[past]
    return DynamicsFit(
        continuous_transfer(model),
        model.static_gain,
        static_gain_std(model, final.estimate.covariance, noise=False),
        modes,
        float(np.sqrt(np.mean(errors**2))),
        100 * (1 - float(np.std(residual_um) / np.std(data.run.position_um))),
        residual_tests(data.driven_input[past], errors, ARX_ORDER),
        candidates,
        model,
        final.judged_model.delay_ticks,
        METHOD,
    )


def _require_certain_mode(name: str, modes: tuple[Mode, ...]) -> None:
    """Raise UnsuitableData if every mode's frequency has a standard deviation above LARGEST_RELATIVE_STD times the
    frequency. `name` names the recording.
    """
    most_certain = min(modes, key=lambda mode: mode.frequency_std_hz / mode.frequency_hz)
    if most_certain.frequency_std_hz > LARGEST_RELATIVE_STD * most_certain.frequency_hz:
        raise UnsuitableData(
            f"{name}: too little external excitation: no mode has a certain frequency. The most certain mode is at "
            f"{most_certain.frequency_hz:.4g} ± {most_certain.frequency_std_hz:.2g} Hz (standard deviation); allowed: "
            f"a standard deviation of up to {100 * LARGEST_RELATIVE_STD:g} %. Use a reference with a larger "
            "amplitude or more frequencies"
        )
