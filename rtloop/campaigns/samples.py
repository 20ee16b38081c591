"""Samples: a number in (0, 1) for each rig and each uncertain key, which does not depend on worker or order.

With "random", the number of rig i and key K depends on seed, i and K alone. Rigs added later leave the numbers of the
rigs before, except with "latin_hypercube"; a key added at the end leaves the other keys' numbers, except with
"saltelli".
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from rtloop.foundation.arrays import Real

Sampling = Literal["random", "latin_hypercube", "sobol", "saltelli"]
BITS, SOBOL_BITS = 52, 30
"""Bits of a number, whose 2⁵² values are floats exactly, and bits of a number of Sobol's sequence."""


def stream_word(*names: object) -> int:
    """Return a random integer, 0 … 2⁶⁴ − 1, that depends on `names` alone."""
    digest = hashlib.sha256("/".join(map(str, names)).encode()).digest()
    return int.from_bytes(digest[:8], "little")


def noise_seed(seed: int, rig: int) -> int:
    """Return the seed of the noise of rig number `rig`, 0 … 2⁶³ − 1."""
    return stream_word(seed, rig, "noise") >> 1


def unit_samples(sampling: Sampling, keys: Sequence[str], first: int, count: int, total: int, seed: int) -> Real:
    """Return numbers in (0, 1) for samples `first` … `first` + `count` − 1, counted from 0, (count, keys).

    `total` is the number of all samples, which Latin hypercubes alone use. Raises ValueError for samples beyond it, and
    for more keys than Sobol's sequence has dimensions.
    """
    if first < 0 or first + count > total:
        raise ValueError(
            f"samples of rigs {first + 1} … {first + count}; allowed in a campaign of {total} rigs: 1 … {total}"
        )
    if sampling == "sobol":
        return _sobol(keys, first, count, seed)
    if sampling == "saltelli":
        return _saltelli(keys, first, count, seed)
    columns = [
        _hypercube(key, first, count, total, seed)
        if sampling == "latin_hypercube"
        else np.array([_unit(stream_word(seed, number, key)) for number in range(first, first + count)])
        for key in keys
    ]
    return np.stack(columns, axis=1) if columns else np.empty((count, 0))


def block_size(keys: int) -> int:
    """Return the number of samples of a block of Saltelli's design: A, B, and A with each key of B."""
    return keys + 2


def _saltelli(keys: Sequence[str], first: int, count: int, seed: int) -> Real:
    """Return samples of Saltelli's design, (count, keys): in blocks a row of A, a row of B, and A with each key of B.

    A and B are points of one Sobol sequence, two dimensions for each key.
    """
    size, names = block_size(len(keys)), [name for key in keys for name in (key, f"{key}, again")]
    first_block, last_block = first // size, (first + count - 1) // size
    points = _sobol(names, first_block, last_block - first_block + 1, seed)
    a, b = points[:, 0::2], points[:, 1::2]
    blocks = np.repeat(a[:, None, :], size, axis=1)
    blocks[:, 1] = b
    for number in range(len(keys)):
        blocks[:, 2 + number, number] = b[:, number]
    begin = first - first_block * size
    return blocks.reshape(-1, len(keys))[begin : begin + count]


def _unit(word: int) -> float:
    """Return the middle of one of 2⁵² equal parts of (0, 1), picked by an integer of 64 bits."""
    return ((word >> (64 - BITS)) + 0.5) / 2.0**BITS


def _hypercube(key: str, first: int, count: int, total: int, seed: int) -> Real:
    """Return one key's numbers in (0, 1), (count,), of the samples from `first` on.

    Each of all `total` samples lies in another one of `total` equal parts of (0, 1).
    """
    order = _order(stream_word(seed, key), total)
    places = np.array([_unit(stream_word(seed, number, key)) for number in range(first, first + count)])
    return np.minimum((order[first : first + count] + places) / total, 1 - 2.0**-BITS)


@lru_cache(64)
def _order(word: int, total: int) -> npt.NDArray[np.int64]:
    """Return a random order of 0 … `total` − 1 for the seed `word`; it is cached: do not change the array."""
    return np.random.Generator(np.random.PCG64(word)).permutation(total)


def _sobol(keys: Sequence[str], first: int, count: int, seed: int) -> Real:
    """Return `count` points of Sobol's sequence from number `first` on, (count, keys) in (0, 1), shifted for each key.

    The shift, an exclusive or with random bits from `seed` and key, keeps the sequence's uniformity; each number is
    uniform.
    """
    from scipy.stats import qmc

    if not keys or not count:
        return np.empty((count, len(keys)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about counts that are no power of two: the rigs may grow
        engine = qmc.Sobol(len(keys), scramble=False, bits=SOBOL_BITS)
        if first:
            engine.fast_forward(first)
        points = (engine.random(count) * 2.0**SOBOL_BITS).astype(np.uint64)
    shifts = np.array([stream_word(seed, key) >> (64 - SOBOL_BITS) for key in keys], np.uint64)
    return ((points ^ shifts).astype(float) + 0.5) / 2.0**SOBOL_BITS
