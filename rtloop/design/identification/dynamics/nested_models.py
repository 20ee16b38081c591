"""Models of growing order from a closed loop; order and delay are chosen by prediction of a held-out part.

Every second block of the recording is held out of the fits, but not of the search for their starting values: a
spectrum of every second block has sidebands, which hide a lightly damped mode. Models are judged there by the
prediction errors A_n (x − G u − x₀), with one A_n for all. Of two models the smaller is taken unless the squared errors
of the larger are less by CLEAR_STD_ERRORS standard errors of their difference (Diebold & Mariano 1995).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.dynamics.identify_delay import delay_input
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.instrumental import (
    Estimate,
    InstrumentedRecording,
    estimate_plant,
    fit_whitening,
    iterate_estimate,
    past_mask,
    residual_noise,
    whiten,
)
from rtloop.design.identification.dynamics.markov import fit_residues
from rtloop.design.identification.dynamics.mode_search import Spectra
from rtloop.foundation.arrays import Complex, Real

BLOCK_SAMPLES = 256
WHITENING_ROUNDS = 3
CLEAR_STD_ERRORS = 2.5
"""Least difference of two models, in standard errors of the difference of their squared errors."""


@dataclass(frozen=True)
class JudgedModel:
    """Estimate behind a delay of `delay_ticks` samples, and its errors in µm² of the whitened residual.

    `squared_errors` are the squared prediction errors over the held-out blocks, (samples,), `total_squares` their sum
    over the whole recording.
    """

    estimate: Estimate
    delay_ticks: int
    squared_errors: Real
    total_squares: float

    @property
    def model(self) -> Innovations:
        """Estimated model of the plant, without its covariance."""
        return self.estimate.model

    @property
    def rms_um(self) -> float:
        """Rms prediction error over the held-out blocks, in µm of the whitened residual."""
        return float(np.sqrt(np.mean(self.squared_errors)))

    def is_worse_than(self, reference: JudgedModel) -> bool:
        """Whether the held-out errors have a larger mean square than the errors of `reference`, by more than
        CLEAR_STD_ERRORS standard errors of the difference.
        """
        excess = self.squared_errors - reference.squared_errors
        return float(excess.mean()) > CLEAR_STD_ERRORS * float(excess.std()) / np.sqrt(excess.size)


class FinalModel(NamedTuple):
    """Estimate from the whole recording, the taps of the noise filter A_n used for it, and its judgement."""

    estimate: Estimate
    whitening: Real
    judged_model: JudgedModel


class ModelSearch:
    """Search over models of one recording; `whitening` has the taps of the noise filter before the first model."""

    def __init__(self, data: InstrumentedRecording, whitening: Real) -> None:
        """Prepare a search on `data`; every second block of BLOCK_SAMPLES is held out of the fits.

        `whitening` has the taps of the noise filter assumed before the first model.
        """
        self._data, self._whitening, self._judging_whitening = data, whitening, whitening
        has_past, blocks = past_mask(data.run.input.size), np.arange(data.run.input.size) // BLOCK_SAMPLES
        self._has_past, self._is_fitted = has_past, has_past & (blocks % 2 == 0)
        self._is_held_out: npt.NDArray[np.bool_] = has_past & (blocks % 2 == 1)

    def grow(
        self, start: JudgedModel | None, delay_ticks: int, most_poles: int, patience: int | None = None
    ) -> list[JudgedModel]:
        """Add modes one by one to `start` (None: no modes), up to `most_poles` poles or until `patience` modes in a row
        bring no gain (None: no such limit).

        Return all models in growing order, `start` first, up to the first fit that fails; [] if there is none. The
        noise filter A_n of the best one judges them, and is stored for all later fits and judgements of this search.
        """
        data = delay_recording(self._data, delay_ticks)
        models = [start] if start else []
        empty = np.zeros(0, complex)
        model = start.model if start else Innovations(data.run.period_s, empty, empty, empty)
        while model.order < most_poles and not (
            patience and len(models) > patience and _is_without_gain(models, patience)
        ):
            rate = self._next_rate(model, data, pair_allowed=most_poles - model.order > 1)
            extended = _replace_modes(model, np.append(model.rates, rate), np.append(model.residues, 0.0))
            if (next_model := self._fit_and_judge(extended, delay_ticks, refit=True)) is None:
                break
            models.append(next_model)
            model = next_model.model
        if models:
            best_model = min(models, key=lambda item: item.rms_um)
            self._judging_whitening = fit_whitening(residual_noise(best_model.model, data.run))
        return [self._judge_estimate(item.estimate, delay_ticks) for item in models]

    def add_delay(self, base_model: JudgedModel) -> JudgedModel | None:
        """Return the same modes fitted behind one more sample of delay; None if the fit fails."""
        model = base_model.model
        start = replace(model, residues=model.residues * model.z_poles)
        return self._fit_and_judge(start, base_model.delay_ticks + 1)

    def prune(self, base_model: JudgedModel, order: int | None = None) -> JudgedModel:
        """Return the model without modes that bring no gain; with `order`, without the least useful ones until at most
        `order` poles remain, or no smaller model settles.
        """
        if order and base_model.model.order <= order:
            return base_model
        reduced = self.remove_each_mode(base_model)
        best_model = min(
            (candidate for candidate in reduced if candidate and candidate.estimate.is_settled),
            key=lambda candidate: candidate.rms_um,
            default=None,
        )
        return (
            base_model
            if best_model is None or (not order and best_model.is_worse_than(base_model))
            else self.prune(best_model, order)
        )

    def remove_each_mode(self, base_model: JudgedModel) -> list[JudgedModel | None]:
        """Return the model fitted without each of its modes in turn; [] for a single mode. None marks a failed fit."""
        model = base_model.model
        smaller_models = [
            _replace_modes(model, np.delete(model.rates, mode), np.delete(model.residues, mode))
            for mode in range(model.rates.size if model.rates.size > 1 else 0)
        ]
        return [self._fit_and_judge(smaller_model, base_model.delay_ticks) for smaller_model in smaller_models]

    def refit_on_whole(self, base_model: JudgedModel) -> FinalModel | None:
        """Return the model refitted on the whole recording, WHITENING_ROUNDS times, with A_n from its residuals.

        None if an iteration does not settle.
        """
        data, estimate, whitening = (
            delay_recording(self._data, base_model.delay_ticks),
            base_model.estimate,
            self._judging_whitening,
        )
        for _ in range(WHITENING_ROUNDS):
            whitening = fit_whitening(residual_noise(estimate.model, data.run))
            estimate = iterate_estimate(estimate.model, data, whitening, self._has_past)
            if not estimate.is_settled:
                return None
        return FinalModel(estimate, whitening, self._judge_estimate(estimate, base_model.delay_ticks))

    def _next_rate(self, model: Innovations, data: InstrumentedRecording, *, pair_allowed: bool) -> complex:
        """Return the rate in rad/s of the mode that best explains the whitened residuals of `model` (`find_mode`)."""
        residual, driven = (
            whiten(signal, self._whitening) for signal in (residual_noise(model, data.run), data.driven_input)
        )
        residual[~self._has_past] = 0.0
        return Spectra(residual, driven, data.run.period_s).find_mode(pair_allowed=pair_allowed)

    def _fit_and_judge(self, start: Innovations, delay_ticks: int, *, refit: bool = False) -> JudgedModel | None:
        """Return the judged estimate from `start`; `refit` fits its residues first. None if the estimate fails."""
        data, whitening = delay_recording(self._data, delay_ticks), self._judging_whitening
        if refit:
            start = fit_residues(
                start, *(whiten(signal, whitening) for signal in (data.driven_input, data.run.position_um))
            )
        estimate = estimate_plant(start, data, whitening, self._is_fitted)
        return self._judge_estimate(estimate, delay_ticks) if estimate else None

    def _judge_estimate(self, estimate: Estimate, delay_ticks: int) -> JudgedModel:
        """Return an estimate with its squared prediction errors, whitened by the filter A_n that the search now judges
        with: the errors in the held-out blocks, and the sum over the whole recording.
        """
        errors = whiten(
            residual_noise(estimate.model, delay_recording(self._data, delay_ticks).run), self._judging_whitening
        )
        return JudgedModel(
            estimate, delay_ticks, errors[self._is_held_out] ** 2, float(np.sum(errors[self._has_past] ** 2))
        )


def preferred_models(models: list[JudgedModel]) -> list[JudgedModel]:
    """Return the models of fewest poles among all that are not clearly worse (`is_worse_than`) than the best one, least
    total error first.

    `models` has at least one. If any model has settled, only settled models are considered.
    """
    eligible = [model for model in models if model.estimate.is_settled] or models
    best_model = min(eligible, key=lambda model: model.rms_um)
    equivalent = [model for model in eligible if not model.is_worse_than(best_model)]
    fewest_poles = min(model.model.order for model in equivalent)
    return sorted(
        (model for model in equivalent if model.model.order == fewest_poles), key=lambda model: model.total_squares
    )


def delay_recording(data: InstrumentedRecording, ticks: int) -> InstrumentedRecording:
    """Return the recording with its input and û delayed by `ticks` samples, 0 before."""
    return InstrumentedRecording(
        delay_input(data.run, ticks), delay_input(replace(data.run, input=data.driven_input), ticks).input
    )


def _is_without_gain(models: list[JudgedModel], count: int) -> bool:
    """Whether the last `count` models are all not clearly better (`is_worse_than`) than the best one before them."""
    best_model = min(models[:-count], key=lambda model: model.rms_um)
    return not any(best_model.is_worse_than(model) for model in models[-count:])


def _replace_modes(model: Innovations, rates: Complex, residues: Complex) -> Innovations:
    """Return a model with the period of `model` and the modes `rates` (m,), rad/s, and `residues` (m,).

    Its noise gains and offset are 0.
    """
    return Innovations(model.period_s, rates.astype(complex), residues.astype(complex), np.zeros(rates.size, complex))
