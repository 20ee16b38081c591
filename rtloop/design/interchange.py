"""Conversion to and from python-control: plants, controllers, loops, measured frequency responses.

Systems are converted to state spaces, never to quotients of expanded polynomials: multiplied out, the eight poles of
eq (5) of the paper span 43 powers of ten, and a zero-order hold of that quotient is off by up to 2 %.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rtloop.analysis.closed_loop import Loop, realise_transfer
from rtloop.design.identification.frequency_response import FrequencyResponse
from rtloop.foundation.trusted import standing_elsewhere
from rtloop.linear.discretise import DiscreteController
from rtloop.linear.realisation import System
from rtloop.linear.transfer import Transfer

with standing_elsewhere():
    import control

library: Any = control  # its annotations do not describe its functions


def to_control(
    system: Transfer | DiscreteController | Loop | FrequencyResponse,
) -> control.StateSpace | control.FrequencyResponseData:
    """Return a frequency response as FrequencyResponseData in rad/s, without coherence, any other system as StateSpace
    whose `dt` is the period in s, or 0 if continuous.

    A loop becomes L = C·D, cut open, with its delay.
    """
    if isinstance(system, FrequencyResponse):
        return library.FrequencyResponseData(system.response, 2 * np.pi * system.hz)
    if isinstance(system, Transfer):
        return _state_space(realise_transfer(system), 0)
    if isinstance(system, DiscreteController):
        return _state_space(system.system, system.period_s)
    dt = system.period_s or 0
    return library.series(_state_space(system.controller, dt), _state_space(system.plant, dt))


def from_control(system: Any) -> Transfer | FrequencyResponse:
    """Return a continuous plant or controller as zeros, poles and gain, or a frequency response.

    A response, which has no coherence in python-control, gets a coherence of 1, and as resolution the largest distance
    of its frequencies. Raises ValueError for another class than
    StateSpace, TransferFunction and FrequencyResponseData, for several inputs or outputs, for discrete time
    (`discretise_controller` makes C(z) of C(s)), and for an improper system.
    """
    if not isinstance(system, library.StateSpace | library.TransferFunction | library.FrequencyResponseData):
        raise ValueError(
            f"system: a {type(system).__name__}; allowed: StateSpace, TransferFunction, FrequencyResponseData of "
            "python-control"
        )
    if (system.ninputs, system.noutputs) != (1, 1):
        raise ValueError(f"system: {system.ninputs} inputs and {system.noutputs} outputs; allowed: one of each")
    if isinstance(system, library.FrequencyResponseData):
        hz = np.asarray(system.omega) / (2 * np.pi)
        resolution_hz = float(np.max(np.diff(np.sort(hz)), initial=0.0))
        return FrequencyResponse(hz, np.asarray(system.frdata)[0, 0], np.ones(hz.size), resolution_hz)
    if system.dt not in (None, 0):
        raise ValueError(f"dt = {system.dt}: discrete time; allowed: continuous time (dt = 0)")
    if isinstance(system, library.TransferFunction):
        return Transfer.from_transfer_function(system.num_array[0, 0], system.den_array[0, 0])
    return Transfer.from_state_space(system.A, system.B, system.C, system.D)


def _state_space(system: System, dt: float) -> control.StateSpace:
    """Return a system with one input and one output for python-control; `dt` is the period in s, 0 if continuous."""
    column, row = system.b[:, None], system.c[None, :]
    return library.ss(system.a, column, row, np.array([[system.d]]), dt, remove_useless_states=False)
