"""The same synthesis by SLICOT's SB10AD, to check the project's own solver against. slycot is an optional extra."""

from __future__ import annotations

import numpy as np

from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, Matrices
from rtloop.errors import MissingExtra


def slicot_gamma(plant: GeneralisedPlant, start: float) -> tuple[float, Matrices]:
    """Return γ_opt by bisection down from `start`, a γ that can be reached, and the controller that reaches it, for the
    plant with D22 set to 0.

    D22 does not change γ_opt. Raises MissingExtra without slycot.
    """
    try:
        import slycot  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtra("the cross-check needs slycot: pip install 'rtloop[slycot]'") from None
    m2, p2 = plant.b2.shape[1], plant.c2.shape[0]
    b, c = np.hstack([plant.b1, plant.b2]), np.vstack([plant.c1, plant.c2])
    d = np.block([[plant.d11, plant.d12], [plant.d21, np.zeros((p2, m2))]])
    gamma, ak, bk, ck, dk, *_ = slycot.sb10ad(
        plant.a.shape[0], b.shape[1], c.shape[0], m2, p2, start, plant.a, b, c, d, job=1
    )  # fmt: skip
    return float(gamma), Matrices(ak, bk, ck, dk)
