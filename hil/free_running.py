"""The rig by its own clock, on a fixed fine grid of time: for nodes, which run with or without drives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rtloop.foundation.native.compiled import jit
from rtloop.hil.options import RigOptions
from rtloop.hil.rig import advance, build_rig, sample


class FreeRunningRig:
    """A rig whose time is given from outside; `drive_v` holds the outputs in V, `sample_v` the newest readings."""

    def __init__(self, options: RigOptions, axes: Sequence[str], rate_hz: float) -> None:
        """Build the rig at rest at 0 V, on a grid of `rate_hz`, and compile it.

        Raises ValueError if rig and axes do not fit together.
        """
        self._coefficients, self._state = build_rig(options, axes, 1.0 / rate_hz)
        self._rate_hz, self._index = rate_hz, 0
        self.drive_v, self.sample_v = np.zeros(len(axes)), np.zeros(len(axes))
        _advance(self._coefficients, self._state, self.drive_v, self.sample_v, 0)

    def advance_to(self, elapsed_s: float) -> None:
        """Advance the rig by whole periods to `elapsed_s` since its start with `drive_v` held.

        Then store new readings, with new noise, in `sample_v`, also if no period has passed. `elapsed_s` never falls.
        """
        index = int(elapsed_s * self._rate_hz)
        _advance(self._coefficients, self._state, self.drive_v, self.sample_v, index - self._index)
        self._index = index


@jit
def _advance(coefficients, state, drive_v, sample_v, periods):
    """Advance the rig by `periods` periods with the outputs held at `drive_v`; write the readings in V to `sample_v`.

    With 0 periods only the readings are taken, which draws noise.
    """
    for _ in range(periods):
        advance(coefficients, state, drive_v)
    for i in range(coefficients.shape[0]):
        sample_v[i] = sample(coefficients[i], state[i])
