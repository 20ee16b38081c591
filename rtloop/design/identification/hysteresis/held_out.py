"""What a sum of plays errs by on data that it was not fitted to.

A recording is left out whole, so that slopes and creep come from the others, where two of these move every play as far
as it does: from a single one, drift would pass for hysteresis. Its own (offsets, drift) then comes from every other
piece of it, and is judged on those between, and the other way round. What no two others show is left out piece by
piece, of all recordings at once; the plays remember what the drive did there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.least_squares import Common, Equations, Limits, errors, fitted, own_of
from rtloop.hil.modal import Real

PIECES, FOLDS = 40, 10
"""Of a stretch; there are so many fits, each time without as many of them."""
GROUPS = 5
"""At most so many fits: more recordings than that are left out several at a time."""
SHOWN, OTHERS = 0.95, 2
"""Others show a recording where so many move every play by this part of what it does."""


def held_out(recordings: Sequence[Equations], limits: Limits) -> list[Real]:
    """Errors in µm of every recording, (blocks, 2) each, by fits without it; NaN where memory is not known.

    First of all that is fitted, then of the plays alone, as they are written, offsets aside.
    """
    found = _piece_by_piece(recordings, limits)
    for group in range(GROUPS):
        others = [one for i, one in enumerate(recordings) if i % GROUPS != group]
        whole = [i for i in range(group, len(recordings), GROUPS) if _shown(recordings[i], others)]
        if whole:
            common, _ = fitted(others, limits)
            for i in whole:
                found[i] = judged(recordings[i], common)
    return found


def judged(one: Equations, common: Common) -> Real:
    """Errors in µm (blocks, 2) of a recording that the model knows nothing of; NaN where memory is not known."""
    found, odd = np.full((one.known.size, 2), np.nan), pieces(one) % 2 == 1
    for half in (one.known & odd, one.known & ~odd):
        rest = one.known & ~half
        found[rest] = _left(one.only(rest), common, own_of(one.only(half), common))
    return _offsets_aside(one, found)


def pieces(one: Equations) -> npt.NDArray[np.intp]:
    """Number of the piece of its stretch that each block is in; −1 where memory is not known."""
    found = np.full(one.known.size, -1)
    for column in (one.offsets.T > 0) & one.known:
        found[column] = np.arange(column.sum()) * PIECES // column.sum()
    return found


def _piece_by_piece(recordings: Sequence[Equations], limits: Limits) -> list[Real]:
    found = [np.full((one.known.size, 2), np.nan) for one in recordings]
    folds = [np.where(one.known, pieces(one) % FOLDS, -1) for one in recordings]
    for fold in range(FOLDS):
        rest = [one.only(among != fold) for one, among in zip(recordings, folds, strict=True)]
        common, owns = fitted(rest, limits)
        for one, among, own, left in zip(recordings, folds, owns, found, strict=True):
            left[among == fold] = _left(one.only(among == fold), common, own)
    return [_offsets_aside(one, left) for one, left in zip(recordings, found, strict=True)]


def _left(one: Equations, common: Common, own: Real) -> Real:
    return np.column_stack([errors(one, common, own), one.position_um - one.slopes @ common.slopes])


def _offsets_aside(one: Equations, found: Real) -> Real:
    """The plays alone leave every stretch its offset: its mean."""
    for part in (one.offsets.T > 0) & one.known:
        found[part, 1] -= np.mean(found[part, 1])
    return found


def _shown(one: Equations, others: Sequence[Equations]) -> bool:
    if len(others) < OTHERS:
        return False
    moved = np.sort([_moved(other) for other in others], axis=0)[-OTHERS]
    return bool(np.all(moved >= SHOWN * _moved(one)))


def _moved(one: Equations) -> Real:
    """How far every slope's column goes within a stretch (plays,): between them, it goes where memory is not known."""
    stretches = (one.offsets.T > 0) & one.known
    return np.max([np.zeros(one.slopes.shape[1]), *(np.ptp(one.slopes[part], axis=0) for part in stretches)], axis=0)
