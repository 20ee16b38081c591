"""Options of the shipped laws in a configuration."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rtloop.foundation.options import Numbers
from rtloop.hysteresis.play_model import PlayModel, play_model
from rtloop.laws.options import ControllerOptions, FeedforwardOptions
from rtloop.linear.options import Matrix, TransferOptions


class PrandtlIshlinskiiOptions(FeedforwardOptions):
    """Inverse hysteresis: the forward model's thresholds and weights (inverted by formula), or an explicit inverse."""

    kind: str = "prandtl_ishlinskii"
    thresholds_v: Numbers = ()
    """Thresholds of the identified play operators, in ascending order from 0 or more; the inverse is computed from
    them."""
    weights_um_per_v: Numbers = ()
    """Weights of the identified play operators, one for each threshold."""
    inverse_thresholds_um: Numbers = ()
    """Thresholds of an inverse of one's own, in ascending order, the first of them 0; in place of `thresholds_v`."""
    inverse_weights_v_per_um: Numbers = ()
    """Weights of an inverse of one's own, one for each of its thresholds."""
    dead_band: Literal["none", "exact"] = "none"
    """Treatment of a first threshold r_0 > 0. `exact` leaves no residual but jumps by 2 r_0 at each reversal: it suits
    smooth commands that are known beforehand; a noisy command (closed loop) makes it chatter."""
    dead_band_threshold_v: float = Field(default=1e-6, ge=0)
    """`exact` reverses only when the drive without dead band has turned by more than this."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require either an invertible forward model or an inverse; `dead_band` = "exact" needs the forward model."""
        self.models()
        if self.dead_band == "exact" and not self.thresholds_v:
            raise ValueError("dead_band: 'exact' needs thresholds_v; add it, or use dead_band = 'none'")
        return self

    def actuator(self) -> PlayModel:
        """Return the identified forward model, from V to µm, with its dead band (a first threshold above 0).

        If the options have an explicit inverse instead, return the forward model that this inverse compensates, without
        dead band.
        """
        if self.thresholds_v:
            return PlayModel(np.array(self.thresholds_v), np.array(self.weights_um_per_v))
        return self.models()[0]

    def models(self) -> tuple[PlayModel, PlayModel]:
        """Return forward model (V to µm) and inverse (µm to V), consistent with each other.

        The forward model has its dead band only if `dead_band` is "exact"; else all its thresholds are lowered by the
        first one. The inverse never has a dead band.
        """
        return self._models

    @cached_property
    def _models(self) -> tuple[PlayModel, PlayModel]:
        """Forward model and inverse, computed once by the check.

        Raises ValueError if the options give both or neither, if a model has no inverse, and if the first threshold of
        a given inverse is not 0.
        """
        if bool(self.thresholds_v) == bool(self.inverse_thresholds_um):
            raise ValueError(
                "the model of the hysteresis is missing or is given twice; allowed: either thresholds_v with "
                "weights_um_per_v, or inverse_thresholds_um with inverse_weights_v_per_um"
            )
        if self.inverse_thresholds_um:
            inverse = play_model("inverse", self.inverse_thresholds_um, self.inverse_weights_v_per_um)
            if inverse.thresholds[0] != 0:
                raise ValueError(f"inverse_thresholds_um: the first is {inverse.thresholds[0]:g} µm; allowed: 0")
            return inverse.inverse(), inverse
        forward = play_model("forward model", self.thresholds_v, self.weights_um_per_v)
        lowered = forward.remove_dead_band()
        return (forward if self.dead_band == "exact" else lowered), lowered.inverse()


class SampledTransferOptions(TransferOptions):
    """C(s) and how it becomes C(z)."""

    method: Literal["matched", "tustin", "foh", "zoh"] = "matched"
    """Rule that makes C(z) of C(s): "matched" maps poles and zeros by z = exp(s T), "tustin" is the bilinear rule,
    "foh" and "zoh" are exact for an input that is linear or constant between ticks."""
    prewarp_hz: float | None = Field(default=None, gt=0)
    """Frequency at which "tustin" keeps the response of C(s), for example a notch's; with other methods it is
    refused."""


class TransferControllerOptions(ControllerOptions, SampledTransferOptions):
    """C(s), its discretisation, and the anti-windup of its states."""

    kind: str = "transfer"
    tracking_s: float = Field(default=0.0005, ge=0)
    """Anti-windup: time constant with which the states follow a limited command, short against the loop's response.
    With 0 they follow at once: a single limited tick then displaces the slow states."""


class CoupledOptions(ControllerOptions):
    """Controller of several axes: `loops`, a transfer function for each axis, or a state space in s from errors to
    commands; `decoupling` follows either.
    """

    kind: str = "coupled"
    loops: Annotated[tuple[SampledTransferOptions, ...], Field(strict=False)] = ()
    """Transfer functions from error to command before the decoupling, one for each axis in the order of `axes`."""
    a: Matrix = ()
    """Matrix A of a state space in s from errors to commands, a list of rows, in place of `loops`."""
    b: Matrix = ()
    """Matrix B of the state space, with a column for each axis."""
    c: Matrix = ()
    """Matrix C of the state space, with a row for each axis."""
    d: Matrix = ()
    """Matrix D of the state space, with a row and a column for each axis; required with a state space."""
    prewarp_hz: float | None = Field(default=None, gt=0)
    """Frequency at which Tustin's rule keeps the response of the state space."""
    decoupling: Matrix = ()
    """Commands per output of the loops, a row for each axis: the inverse of the stage's coupling. Empty: identity."""
    tracking_s: float = Field(default=0.0005, ge=0)
    """Anti-windup, as for `transfer`."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Require `loops`, one for each axis, or a state space whose matrices fit, and an invertible `decoupling`."""
        count = len(self.axes)
        if bool(self.loops) == bool(self.d):
            raise ValueError(
                "the controller is missing or is given twice; allowed: either loops, one for each axis, or a state "
                "space a, b, c, d"
            )
        if self.loops and len(self.loops) != count:
            raise ValueError(f"{len(self.loops)} loops for {count} axes; allowed: one loop for each axis")
        if self.loops and (self.a or self.b or self.c or self.prewarp_hz is not None):
            raise ValueError(
                "a, b, c, prewarp_hz: not allowed together with loops; remove these keys, or remove loops and use a "
                "state space a, b, c, d"
            )
        order = len(self.a)
        shapes = {"a": (order, order), "b": (order, count), "c": (count, order), "d": (count, count)}
        for name, shape in {**shapes, "decoupling": (count, count)}.items():
            rows = getattr(self, name)
            if rows and (len(rows) != shape[0] or any(len(row) != shape[1] for row in rows)):
                raise ValueError(f"{name}: the matrix has a wrong size; allowed: {shape[0]} rows of {shape[1]} numbers")
        if order and not (self.b and self.c):
            raise ValueError("a: needs the matrices b and c; add the missing one")
        if self.decoupling and np.linalg.matrix_rank(np.array(self.decoupling)) < count:
            raise ValueError("decoupling: the rows depend on each other; allowed: an invertible matrix")
        return self
