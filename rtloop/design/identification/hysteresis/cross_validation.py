"""Errors of a sum of plays on data that were not used for its fit.

A recording is left out whole, and slopes and creep come from the others, provided that two of them move every play
nearly as far: from a single one, drift could be taken for hysteresis. Its own offsets and drift come from every second
piece of it and are judged on the pieces between, and the reverse. If no two others do, every FOLDS-th piece of all
recordings is left out of a fit, which the left-out pieces judge; the plays still follow the drive there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.least_squares import (
    Equations,
    Limits,
    SharedGains,
    fit_gains,
    fit_own_gains,
    model_errors,
)
from rtloop.foundation.arrays import Real

PIECES, FOLDS = 40, 10
"""Pieces of a stretch, and number of fits: each leaves out every FOLDS-th piece."""
GROUPS = 5
"""Most fits without whole recordings: of more recordings than that, each fit leaves out every GROUPS-th one."""
COVERED_SHARE, LEAST_OTHERS = 0.95, 2
"""A recording is covered if LEAST_OTHERS others move every play by this fraction of its travel."""


def cross_validate(recordings: Sequence[Equations], limits: Limits) -> list[Real]:
    """Return held-out errors in µm, measured minus modelled, of every recording, (blocks, 2).

    A recording that the others cover (`_is_covered`) is judged by a fit without it; with more than GROUPS recordings,
    these others and this fit also lack every GROUPS-th one before and after it. All other recordings are judged by fits
    without the judged piece. Column 0: the whole model; column 1: the plays alone, as they are written, less the mean
    of these errors over each stretch of known memory. NaN where memory, the state of the plays, is not known.
    """
    errors_um = _errors_by_piece(recordings, limits)
    for group in range(GROUPS):
        other_recordings = [recording for i, recording in enumerate(recordings) if i % GROUPS != group]
        covered = [i for i in range(group, len(recordings), GROUPS) if _is_covered(recordings[i], other_recordings)]
        if covered:
            common, _ = fit_gains(other_recordings, limits)
            for i in covered:
                errors_um[i] = unseen_errors(recordings[i], common)
    return errors_um


def unseen_errors(recording: Equations, common: SharedGains) -> Real:
    """Return errors (blocks, 2) in µm, measured minus modelled, of a recording that was not used for `common`.

    Column 0: the whole model; column 1: the plays alone, less the mean of these errors over each stretch of known
    memory. NaN where memory is not known. The recording's own offsets and drift are fitted to every second of the
    PIECES pieces of each stretch and judged on the pieces between, then the reverse.
    """
    errors_um, is_odd = np.full((recording.is_known.size, 2), np.nan), piece_numbers(recording) % 2 == 1
    for fitted_blocks in (recording.is_known & is_odd, recording.is_known & ~is_odd):
        judged_blocks = recording.is_known & ~fitted_blocks
        errors_um[judged_blocks] = _residual_columns(
            recording.select_blocks(judged_blocks),
            common,
            fit_own_gains(recording.select_blocks(fitted_blocks), common),
        )
    return _remove_play_offsets(recording, errors_um)


def piece_numbers(recording: Equations) -> npt.NDArray[np.intp]:
    """Return the number of each block's piece (blocks,): a stretch of known memory is divided into PIECES pieces of
    equal length, numbered from 0 in each stretch; −1 where memory is not known.
    """
    numbers = np.full(recording.is_known.size, -1)
    for column in (recording.offsets.T > 0) & recording.is_known:
        numbers[column] = np.arange(column.sum()) * PIECES // column.sum()
    return numbers


def _errors_by_piece(recordings: Sequence[Equations], limits: Limits) -> list[Real]:
    """Return errors in µm (blocks, 2), measured minus modelled, of every recording; each fit leaves out one fold, every
    FOLDS-th piece (`piece_numbers`) of each recording, and judges it.

    Column 0: the whole model; column 1: the plays alone, less the mean of these errors over each stretch of known
    memory. NaN where memory is unknown.
    """
    errors_um = [np.full((recording.is_known.size, 2), np.nan) for recording in recordings]
    folds = [np.where(recording.is_known, piece_numbers(recording) % FOLDS, -1) for recording in recordings]
    for fold in range(FOLDS):
        fitted_recordings = [
            recording.select_blocks(fold_numbers != fold)
            for recording, fold_numbers in zip(recordings, folds, strict=True)
        ]
        common, gains = fit_gains(fitted_recordings, limits)
        for recording, fold_numbers, own_gains, error_um in zip(recordings, folds, gains, errors_um, strict=True):
            error_um[fold_numbers == fold] = _residual_columns(
                recording.select_blocks(fold_numbers == fold), common, own_gains
            )
    return [
        _remove_play_offsets(recording, error_um) for recording, error_um in zip(recordings, errors_um, strict=True)
    ]


def _residual_columns(recording: Equations, common: SharedGains, own_gains: Real) -> Real:
    """Return measured minus modelled position in µm, (blocks, 2): of the whole model, and of its plays alone."""
    return np.column_stack(
        [model_errors(recording, common, own_gains), recording.position_um - recording.slopes @ common.slopes]
    )


def _remove_play_offsets(recording: Equations, errors_um: Real) -> Real:
    """Subtract from the errors of the plays alone the mean of these errors over each stretch of known memory, because
    plays have no offset.

    `errors_um` (blocks, 2) has the errors of the whole model and of its plays alone. Column 1 is changed in place where
    memory is known; the array is returned.
    """
    for stretch in (recording.offsets.T > 0) & recording.is_known:
        errors_um[stretch, 1] -= np.mean(errors_um[stretch, 1])
    return errors_um


def _is_covered(recording: Equations, other_recordings: Sequence[Equations]) -> bool:
    """Whether LEAST_OTHERS or more of `other_recordings` move each play by at least COVERED_SHARE of its travel in
    `recording`; they need not be the same ones for each play.
    """
    if len(other_recordings) < LEAST_OTHERS:
        return False
    covered_travel = np.sort([_play_travel(recording_other) for recording_other in other_recordings], axis=0)[
        -LEAST_OTHERS
    ]
    return bool(np.all(covered_travel >= COVERED_SHARE * _play_travel(recording)))


def _play_travel(recording: Equations) -> Real:
    """Return the largest range of the column of every slope within one stretch of known memory, in V, (plays,).

    All are 0 without such a stretch.
    """
    stretches = (recording.offsets.T > 0) & recording.is_known
    return np.max(
        [np.zeros(recording.slopes.shape[1]), *(np.ptp(recording.slopes[stretch], axis=0) for stretch in stretches)],
        axis=0,
    )
