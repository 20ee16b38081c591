"""The weighting functions of the paper's H∞ problem, and the rules that make them of specifications.

    |S| < γ/|W1|,   |CS| < γ/|W2|,   |S| < γ/|W1 W3|,   |CS| < γ/|W2 W3|          eq (14)

    1/W1 = (s + ε ω)/(s/M + ω)      ε static error, ω = 3/t (5 % settling time t), M = 1 + overshoot     eq (15)
    1/(W1 W2) = v_max/x_max                                                                    eqs (16), (17)
    1/(W1 W3) = e_max/Ω_max                                                                          eq (18)

Two of the rules have less effect than they promise. With (16), W1·W2 = 1: the bound on |CS| is as high as 1/|S| may be,
and says nothing about the peak of the command. And (19) of the paper inverts (18): as printed, W3 = (e_max/Ω_max)/W1
has nearly no effect; as (18) implies, W3 = (Ω_max/e_max)/W1 requires |S| < 0.03 at every frequency, which no
controller achieves.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from rtloop.linear.transfer import Transfer

DisturbanceRule = Literal["printed", "implied", "none"]


class Weights(NamedTuple):
    """W1 on the error, W2 on the command, W3 on the disturbance that enters."""

    tracking: Transfer
    command: Transfer
    disturbance: Transfer


def tracking_weight(static_error: float, bandwidth: float, overshoot: float) -> Transfer:
    """Return W1 = (s/M + ω)/(s + ε ω) of eq (15), with M = 1 + `overshoot`, ε = `static_error`, ω = `bandwidth`.

    Overshoot and static error are fractions, the bandwidth is in rad/s.
    """
    peak = 1 + overshoot
    return Transfer.from_zpk([-peak * bandwidth], [-static_error * bandwidth], 1 / peak)


def command_weight(tracking: Transfer, command_per_reference: float) -> Transfer:
    """Return W2 of eqs (16) and (17): 1/W1 · x_max/v_max, from `command_per_reference` = v_max/x_max.

    Raises ValueError if W1 (`tracking`) has fewer zeros than poles.
    """
    return _scaled_inverse(tracking, 1 / command_per_reference)


def disturbance_weight(tracking: Transfer, error_per_disturbance: float, rule: DisturbanceRule) -> Transfer:
    """Return W3 from W1 (`tracking`) and `error_per_disturbance` = e_max/Ω_max by a rule.

    "printed" is (e_max/Ω_max)/W1, as (19) is printed, "implied" (Ω_max/e_max)/W1, as (18) implies, "none" 0. Raises
    ValueError if W1 has fewer zeros than poles and must be inverted.
    """
    gains = {"printed": error_per_disturbance, "implied": 1 / error_per_disturbance, "none": 0.0}
    return _scaled_inverse(tracking, gains[rule]) if gains[rule] else Transfer.from_zpk([], [], 0.0)


def _scaled_inverse(transfer: Transfer, factor: float) -> Transfer:
    """Return `factor` divided by `transfer`. Raises ValueError if `transfer` has fewer zeros than poles."""
    return Transfer(transfer.poles, transfer.zeros, factor / transfer.gain)


PAPER_WEIGHTS = Weights(
    Transfer.from_zpk([-1000.0], [-1.0], 1.0),
    Transfer.from_zpk([-1.0], [-1000.0], 1.0),
    Transfer.from_zpk([-1.0], [-1000.0], 0.026),
)
"""Eqs (15), (17) and (19) as printed."""
