"""How far the plant may move, and the loop be delayed, before what it met is missed."""

from __future__ import annotations

from collections.abc import Callable

from rtloop.analysis.closed_loop import Loop
from rtloop.analysis.margins import delay_tolerated
from rtloop.analysis.perturbation import Change, Maker, Range, until_bad
from rtloop.design.synthesis.specification import SpecificationOptions
from rtloop.design.verification.judgement import Limit, specified
from rtloop.linear.transfer import Transfer


def until_missed(
    make: Maker, plant: Transfer, change: Change, asked: SpecificationOptions, required: dict[str, Limit]
) -> Range:
    """The range over which every limit of `required` is met; (0, 0) if one is not as it stands."""

    def met(moved: Transfer) -> bool:
        loop = make(moved)
        values = specified(loop, asked) if loop.is_stable else {}
        return bool(values) and all(limit.met(values[name]) for name, limit in required.items())

    return until_bad(met, plant, change, coarse=4.0, tolerance=0.01)


def delay_margin_us(loop: Loop) -> float:
    """The delay that brings a crossover to −1, the least over all of them; infinite without a crossover."""
    return 1e6 * delay_tolerated(loop)[0] if loop.is_stable else 0.0


def delay_ticks_tolerated(delayed: Callable[[int], Loop], most: int = 64) -> int:
    """The largest number of samples of delay with which, and with all fewer ones, the loop is stable; −1 if none."""
    for ticks in range(most + 1):
        if not delayed(ticks).is_stable:
            return ticks - 1
    return most
