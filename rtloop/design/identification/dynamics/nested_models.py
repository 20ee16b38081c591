"""Models of growing order from a closed loop, the order and the delay by what predicts the part held out.

Every second block of the recording is held out of the fits, though not of the search for where they begin: a spectrum
of every second block has sidebands, in which a light mode is lost. There a model is judged by its prediction errors
A_n (x − G u − x₀), with one A_n for all models. Of two models the smaller is taken unless the larger one's squared
errors are less by CLEAR standard errors of their difference (Diebold & Mariano 1995).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.dynamics.identify_delay import delayed
from rtloop.design.identification.dynamics.innovations import Innovations
from rtloop.design.identification.dynamics.instrumental import (
    Estimate,
    Instrumented,
    estimated,
    left_by,
    settled,
    whitened,
    whitening_of,
    with_past,
)
from rtloop.design.identification.dynamics.markov import with_residues
from rtloop.design.identification.dynamics.mode_search import Spectra
from rtloop.hil.modal import Complex, Real

BLOCK = 256
REWHITENED = 3
CLEAR = 2.5
"""Standard errors."""


@dataclass(frozen=True)
class Judged:
    """An estimate behind `delay_ticks`, its squared prediction errors where they are held out, and their whole sum."""

    estimate: Estimate
    delay_ticks: int
    squares: Real
    total: float

    @property
    def model(self) -> Innovations:
        """G."""
        return self.estimate.model

    @property
    def rms_um(self) -> float:
        """Of the part held out."""
        return float(np.sqrt(np.mean(self.squares)))

    def worse_than(self, other: Judged) -> bool:
        """By more than chance."""
        excess = self.squares - other.squares
        return float(excess.mean()) > CLEAR * float(excess.std()) / np.sqrt(excess.size)


class Final(NamedTuple):
    """The estimate, the whitening A_n that it was made with, and how it is judged beside others."""

    estimate: Estimate
    whitening: Real
    judged: Judged


class Search:
    """Over models of one recording; `whitening` is the noise's, as far as it is known before there is a model."""

    def __init__(self, data: Instrumented, whitening: Real) -> None:
        self._data, self._whitening, self._judging = data, whitening, whitening
        has_past, blocks = with_past(data.run.input.size), np.arange(data.run.input.size) // BLOCK
        self._whole, self._kept = has_past, has_past & (blocks % 2 == 0)
        self._held_out: npt.NDArray[np.bool_] = has_past & (blocks % 2 == 1)

    def grown(self, start: Judged | None, delay_ticks: int, most: int, in_vain: int | None = None) -> list[Judged]:
        """From `start`, or from nothing, by a mode more each, up to `most` poles, or until `in_vain` in a row do not
        pay."""
        data = late(self._data, delay_ticks)
        models = [start] if start else []
        model = start.model if start else _nothing(data.run.period_s)
        while model.order < most and not (in_vain and len(models) > in_vain and _in_vain(models, in_vain)):
            rate = self._next(model, data, pair_allowed=most - model.order > 1)
            if (judged := self._judged(with_mode(model, rate), delay_ticks, fresh=True)) is None:
                break
            models.append(judged)
            model = judged.model
        if models:
            best = min(models, key=lambda item: item.rms_um)
            self._judging = whitening_of(left_by(best.model, data.run))
        return [self._scored(item.estimate, delay_ticks) for item in models]

    def later(self, judged: Judged) -> Judged | None:
        """The same modes behind one sample of delay more: each begins a sample earlier behind it."""
        model = judged.model
        start = replace(model, residues=model.residues * model.images)
        return self._judged(start, judged.delay_ticks + 1)

    def pruned(self, judged: Judged, order: int | None = None) -> Judged:
        """Without the modes that do not pay; where an `order` is asked for, without those above it that pay least."""
        if order and judged.model.order <= order:
            return judged
        reduced = self.reduced(judged)
        best = min(
            (candidate for candidate in reduced if candidate and candidate.estimate.settled),
            key=lambda candidate: candidate.rms_um,
            default=None,
        )
        return judged if best is None or (not order and best.worse_than(judged)) else self.pruned(best, order)

    def reduced(self, judged: Judged) -> list[Judged | None]:
        """Without each of its modes in turn, if it has more than one."""
        modes = range(judged.model.rates.size if judged.model.rates.size > 1 else 0)
        return [self._judged(_without(judged.model, i), judged.delay_ticks) for i in modes]

    def final(self, judged: Judged) -> Final | None:
        """By the whole recording, with A_n of what the model leaves; None where nothing settles."""
        data, estimate, whitening = late(self._data, judged.delay_ticks), judged.estimate, self._judging
        for _ in range(REWHITENED):
            whitening = whitening_of(left_by(estimate.model, data.run))
            estimate = settled(estimate.model, data, whitening, self._whole)
            if not estimate.settled:
                return None
        return Final(estimate, whitening, self._scored(estimate, judged.delay_ticks))

    def _next(self, model: Innovations, data: Instrumented, *, pair_allowed: bool) -> complex:
        residual, driven = (whitened(signal, self._whitening) for signal in (left_by(model, data.run), data.driven))
        residual[~self._whole] = 0.0
        return Spectra(residual, driven, data.run.period_s).mode(pair_allowed=pair_allowed)

    def _judged(self, start: Innovations, delay_ticks: int, *, fresh: bool = False) -> Judged | None:
        data, whitening = late(self._data, delay_ticks), self._judging
        if fresh:
            start = with_residues(
                start, *(whitened(signal, whitening) for signal in (data.driven, data.run.position_um))
            )
        estimate = estimated(start, data, whitening, self._kept)
        return self._scored(estimate, delay_ticks) if estimate else None

    def _scored(self, estimate: Estimate, delay_ticks: int) -> Judged:
        errors = whitened(left_by(estimate.model, late(self._data, delay_ticks).run), self._judging)
        return Judged(estimate, delay_ticks, errors[self._held_out] ** 2, float(np.sum(errors[self._whole] ** 2)))


def preferred(found: list[Judged]) -> list[Judged]:
    """Of those that settled, where any did, those of the fewest poles which are not worse than the best; first that
    which fits all of the recording best."""
    eligible = [model for model in found if model.estimate.settled] or found
    best = min(eligible, key=lambda model: model.rms_um)
    equivalent = [model for model in eligible if not model.worse_than(best)]
    fewest_poles = min(model.model.order for model in equivalent)
    return sorted((model for model in equivalent if model.model.order == fewest_poles), key=lambda model: model.total)


def late(data: Instrumented, ticks: int) -> Instrumented:
    """The recording with its input `ticks` samples later; at rest before it."""
    return Instrumented(delayed(data.run, ticks), delayed(replace(data.run, input=data.driven), ticks).input)


def with_mode(model: Innovations, rate: complex) -> Innovations:
    """One mode more, of residue 0."""
    return _with(model, np.append(model.rates, rate), np.append(model.residues, 0.0))


def _in_vain(found: list[Judged], last: int) -> bool:
    best = min(found[:-last], key=lambda model: model.rms_um)
    return not any(best.worse_than(model) for model in found[-last:])


def _without(model: Innovations, mode: int) -> Innovations:
    return _with(model, np.delete(model.rates, mode), np.delete(model.residues, mode))


def _with(model: Innovations, rates: Complex, residues: Complex) -> Innovations:
    return Innovations(model.period_s, rates.astype(complex), residues.astype(complex), np.zeros(rates.size, complex))


def _nothing(period_s: float) -> Innovations:
    empty = np.zeros(0, dtype=complex)
    return Innovations(period_s, empty, empty, empty)
