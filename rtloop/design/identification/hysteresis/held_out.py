"""What a sum of plays errs by on data that it was not fitted to.

Of several recordings each is left out in turn: slopes and creep come from the others. What is a recording's own
(offset, drift, memory at its beginning) comes from every other fortieth of it, and is judged on those between, and
the other way round: so fine, for what was remembered shows in those samples alone that it still governs. Of a single
recording four fortieths are left out at a time; the plays remember what the drive did in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rtloop.design.identification.hysteresis.memory_fit import Common, Limits, Own, Stretch, errors, fit_memory
from rtloop.hil.modal import Real

PIECES, FOLDS = 40, 10
"""A recording is judged piece by piece; a single one is fitted so often, each time without as many of them."""
GROUPS = 5
"""At most so many fits: more recordings than that are left out several at a time."""


class Held(NamedTuple):
    """Blocks of a recording (a mask), the model that knows nothing of them, and what is the recording's own."""

    blocks: npt.NDArray[np.bool_]
    common: Common
    own: Own


def fitted(stretches: Sequence[Stretch], memories: Sequence[Real], limits: Limits) -> tuple[Common, list[Own]]:
    """Slopes, creep and what is each recording's own. `memories`, of each, are the rises of its memory curve to begin
    at.

    First without drift and creep, which an unsuitable memory would otherwise be made up for by.
    """
    bare = [_bare(stretch) for stretch in stretches]
    flat = _flat(limits)
    owns = [_beginning(one, flat, rises) for one, rises in zip(bare, memories, strict=True)]
    common, owns = fit_memory(bare, flat, owns, limits)
    if stretches[0].creep.shape[1] == 0 and stretches[0].own.shape[1] == 1:
        return common, owns
    common = Common(common.slopes, np.zeros(stretches[0].creep.shape[1]))
    return fit_memory(
        stretches, common, [_with_terms(one, full) for one, full in zip(owns, stretches, strict=True)], limits
    )


def nearest(stretch: Stretch, memories: Sequence[Real], limits: Limits, common: Common | None = None) -> Real:
    """That one of several memories to begin at which ends nearest to the recording, by itself or by a model given."""
    bare = _bare(stretch) if common is None else stretch._replace(own=stretch.own[:, :1])
    left = []
    for rises in memories if len(memories) > 1 else ():
        begun = _flat(limits) if common is None else common
        found, owns = fit_memory([bare], begun, [_beginning(bare, begun, rises)], limits, fixed=common is not None)
        left.append(float(np.sum(errors(bare, found, owns[0]) ** 2)))
    return memories[int(np.argmin(left)) if left else 0]


def own_of(stretch: Stretch, common: Common, rises: Real, limits: Limits) -> Own:
    """Offset, drift and memory of a recording by a model that is given."""
    bare = stretch._replace(own=stretch.own[:, :1])
    owns = fit_memory([bare], common, [_beginning(bare, common, rises)], limits, fixed=True)[1]
    if stretch.own.shape[1] == 1:
        return owns[0]
    return fit_memory([stretch], common, [_with_terms(owns[0], stretch)], limits, fixed=True)[1][0]


def errors_held_out(stretch: Stretch, held: Sequence[Held]) -> Real:
    """In µm (blocks,)."""
    found = np.empty(stretch.position_um.size)
    for one in held:
        found[one.blocks] = errors(stretch.only(one.blocks), one.common, one.own)
    return found


def errors_as_written(stretch: Stretch, held: Sequence[Held], written: int, known: int) -> Real:
    """In µm, of the first `written` plays alone: without larger ones, drift and creep, which no file gets.

    Of the blocks from `known` on, where nothing of their memory is estimated. Their mean is taken for the sensor's
    offset: the one that was found stands beside what larger plays remember.
    """
    found = []
    for one in held:
        slopes = one.common.slopes.copy()
        slopes[written:] = slopes[written - 1]
        found.append(Held(one.blocks, Common(slopes, np.empty(0)), one.own._replace(terms=np.zeros(1))))
    left = errors_held_out(_bare(stretch), found)[known:]
    return left - np.mean(left)


def judged(stretch: Stretch, common: Common, rises: Real, limits: Limits) -> list[Held]:
    """A recording that the model knows nothing of: its own from one half of it, held against the other."""
    even = _pieces(stretch, PIECES) % 2 == 0
    return [Held(~half, common, own_of(stretch.only(half), common, rises, limits)) for half in (even, ~even)]


def held_out(stretches: Sequence[Stretch], memories: Sequence[Real], limits: Limits) -> list[Real]:
    """Errors in µm of every recording, (blocks,) each, by fits that it had no part in."""
    fits = fits_held_out(stretches, memories, limits)
    return [errors_held_out(one, held) for one, held in zip(stretches, fits, strict=True)]


def fits_held_out(stretches: Sequence[Stretch], memories: Sequence[Real], limits: Limits) -> list[list[Held]]:
    """Every recording, by fits that it had no part in."""
    if len(stretches) == 1:
        return [_piece_by_piece(stretches[0], memories, limits)]
    found: list[list[Held]] = [[]] * len(stretches)
    for group in range(min(GROUPS, len(stretches))):
        others = [i for i in range(len(stretches)) if i % GROUPS != group]
        common, _ = fitted([stretches[i] for i in others], [memories[i] for i in others], limits)
        for i in range(group, len(stretches), GROUPS):
            found[i] = judged(stretches[i], common, memories[i], limits)
    return found


def _piece_by_piece(stretch: Stretch, memories: Sequence[Real], limits: Limits) -> list[Held]:
    found, folds = [], _pieces(stretch, PIECES) % FOLDS
    for fold in range(FOLDS):
        common, owns = fitted([stretch.only(folds != fold)], memories, limits)
        found.append(Held(folds == fold, common, owns[0]))
    return found


def _pieces(stretch: Stretch, pieces: int) -> npt.NDArray[np.intp]:
    """Number of the piece that each block belongs to."""
    return np.arange(stretch.position_um.size) * pieces // stretch.position_um.size


def _flat(limits: Limits) -> Common:
    return Common(np.full(limits.thresholds_v.size, limits.range_um / limits.drive_v), np.empty(0))


def _beginning(stretch: Stretch, common: Common, rises: Real) -> Own:
    return Own(np.full(1, float(np.mean(errors(stretch, common, Own(np.zeros(1), rises))))), rises)


def _bare(stretch: Stretch) -> Stretch:
    return stretch._replace(own=stretch.own[:, :1], creep=stretch.creep[:, :0])


def _with_terms(own: Own, stretch: Stretch) -> Own:
    return Own(np.append(own.terms, np.zeros(stretch.own.shape[1] - own.terms.size)), own.rises)
