"""Synthesis of a runnable controller from a plant and weights: augmented plant, H∞ controller, reduction.

The controller is written in s, and the loop discretises it at its own rate to C(z). The controller of
`synthesise_design` gives a stable loop at that rate; `synthesise` alone knows no rate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rtloop.design.synthesis.hinf.augment import GeneralisedPlant, augment
from rtloop.design.synthesis.hinf.norm import weighted_norm
from rtloop.design.synthesis.hinf.normal_form import normalise
from rtloop.design.synthesis.hinf.solver import Hinf, NoController, smallest_gamma, synthesise_hinf
from rtloop.design.synthesis.rate_limits import LARGEST_SENSITIVITY, dead_time, drop_fast_roots, is_runnable
from rtloop.design.synthesis.reduce import ReductionMethod, hankel_singular_values, reduce_order
from rtloop.design.synthesis.specification import DesignOptions, build_weights
from rtloop.design.synthesis.weights import Weights
from rtloop.foundation.arrays import Real
from rtloop.linear.transfer import Transfer


class NotRunnable(NoController):
    """There is a controller in continuous time, but none that can run."""


class Synthesis(NamedTuple):
    """`controller` is the one to run, `achieved` the norm of the weighted loop with it; `hinf` and `full` are the
    synthesis and its controller before reduction. `hankel` (n,) are the full controller's Hankel singular values.
    """

    controller: Transfer
    full: Transfer
    achieved: float
    weights: Weights
    hinf: Hinf
    hankel: Real


def synthesise(
    plant: Transfer,
    weights: Weights,
    *,
    order: int | None = None,
    reduction: ReductionMethod = "residualise",
    backoff: float = 0.004,
    largest_loss: float = 0.1,
    largest_gamma: float = np.inf,
    finish: Callable[[Transfer], Transfer | None] = lambda controller: controller,
) -> Synthesis:
    """Run the whole synthesis: weighted plant, H∞ controller, reduction.

    γ is (1 + `backoff`)·γ_opt. `order` is the order of the reduced controller; None takes the lowest whose weighted
    loop has a norm of at most (1 + `largest_loss`)·γ, or the best there is. `finish` turns a reduced controller into
    the written one, or None if it would not run. Raises NoController, also if γ_opt exceeds `largest_gamma`;
    NotRunnable if no order gives a controller that `finish` accepts in a stable loop; ValueError for an `order` that is
    out of range or gives no such controller, for a plant with direct feedthrough, and for a full controller with
    repeated poles beside unstable ones.
    """
    augmented_plant = augment(plant, weights)
    hinf = synthesise_hinf(augmented_plant, backoff=backoff)
    if hinf.gamma_opt > largest_gamma:
        raise NoController(_explain_contradiction(plant, weights, hinf.gamma_opt, largest_gamma))
    full = Transfer.from_state_space(*hinf.controller)
    allowed = np.inf if order is not None else (1 + largest_loss) * hinf.gamma
    lowest = int(np.sum(full.poles.real >= 0))
    candidates: list[tuple[float, Transfer]] = []
    for candidate_order in range(lowest, full.order + 1) if order is None else [order]:
        controller, achieved = _reduce_and_finish(augmented_plant, full, candidate_order, reduction, finish)
        if np.isfinite(achieved):
            candidates.append((achieved, controller))
        if achieved <= allowed:
            break
    if candidates:
        achieved, controller = min(candidates, key=lambda pair: pair[0])
        return Synthesis(controller, full, achieved, weights, hinf, hankel_singular_values(full))
    if order is not None:
        raise ValueError(
            f"synthesis.order: with order {order} and reduction {reduction!r}, the loop is unstable or has max |S| "
            f"above {LARGEST_SENSITIVITY:g}; use a higher order, or remove synthesis.order, so that rtloop finds the "
            "lowest suitable order"
        )
    raise NotRunnable(
        f"specification: γ = {hinf.gamma:.4g} can be reached in continuous time, but no controller of order {lowest} "
        f"to {full.order} gives a stable sampled loop with max |S| ≤ {LARGEST_SENSITIVITY:g}; use a longer "
        "settling_ms, a smaller bandwidth_hz or a higher controller.rate_hz"
    )


def _reduce_and_finish(
    standard: GeneralisedPlant,
    full: Transfer,
    order: int,
    method: ReductionMethod,
    finish: Callable[[Transfer], Transfer | None],
) -> tuple[Transfer, float]:
    """Return the reduced, finished controller and the weighted loop's norm with it; `full` and inf if `finish` returns
    None, and if numpy fails to compute them.

    The norm is infinite if the weighted loop is unstable. Raises ValueError for an order that `reduce_order` refuses.
    """
    try:
        controller = finish(full if order == full.order else reduce_order(full, order, method).transfer)
        return (full, np.inf) if controller is None else (controller, weighted_norm(standard, controller))
    except np.linalg.LinAlgError:
        return full, np.inf


def synthesise_design(design: DesignOptions) -> Synthesis:
    """Synthesise the controller of SPEC.toml, for a loop stable at [controller] rate_hz behind the plant's delay.

    The synthesis takes the plant with its delay and half a period for the hold as dead time. A plant without delay gets
    the half period only if no controller runs without it. Raises as `synthesise`: NoController, with a remedy, for a
    contradictory specification; ValueError for an order or a plant that is not allowed, and for an incomplete
    specification.
    """
    plant, weights, options = design.required_plant.transfer(), build_weights(design), design.synthesis
    _require_possible(plant, design)
    ticks, output = design.required_plant.delay_ticks, design.controller

    def finish(controller: Transfer) -> Transfer | None:
        """Return the controller without roots far beyond the rate; None if it is not runnable (`is_runnable`)."""
        reduced = drop_fast_roots(controller, output.rate_hz)
        sensed_plant = design.sensor.add_sensor_lag(plant)
        return (
            reduced
            if is_runnable(reduced, sensed_plant, output.rate_hz, output.method, output.prewarp_hz, ticks)
            else None
        )

    def synthesise_delayed(delay_s: float) -> Synthesis:
        """Synthesise for the plant with `delay_s` of dead time."""
        return synthesise(
            plant * dead_time(delay_s, ticks + 1), weights, order=options.order, reduction=options.reduction,
            backoff=options.backoff_percent / 100, largest_loss=options.largest_loss_percent / 100,
            largest_gamma=options.largest_gamma, finish=finish,
        )  # fmt: skip

    hold_delay_s = (ticks + 0.5) / output.rate_hz
    if ticks:
        return synthesise_delayed(hold_delay_s)
    try:
        return synthesise_delayed(0.0)
    except NotRunnable:
        return synthesise_delayed(hold_delay_s)


def _require_possible(plant: Transfer, design: DesignOptions) -> None:
    """Raise NoController for a static error that no controller can meet: the plant has no gain at 0 Hz, or the largest
    command cannot hold the reference within this error. Without a required static error, it does not raise.
    """
    specification, gain = design.specification, abs(plant.dc_gain)
    if specification.static_error_percent is not None and gain == 0:
        raise NoController("specification.static_error_percent: cannot be met, because the plant's gain at 0 Hz is 0")
    if specification.command is not None and specification.static_error_percent is not None:
        needed_um = specification.command.reference_um * (1 - specification.static_error_percent / 100) / gain
        if specification.command.command_um < needed_um:
            raise NoController(
                f"specification.command.command_um: {specification.command.command_um:g} µm cannot hold reference_um = "
                f"{specification.command.reference_um:g} µm within {specification.static_error_percent:g} %, because "
                f"the plant has the gain {gain:.6g} at 0 Hz; allowed: at least {needed_um:.6g} µm, or a smaller "
                "reference_um"
            )


def _explain_contradiction(plant: Transfer, weights: Weights, gamma: float, largest: float) -> str:
    """Return a message that γ_opt, `gamma`, exceeds `largest`, with γ_opt for each weight relaxed alone.

    The message names as the hardest requirement the weight whose relaxation gives the least γ_opt.
    """
    w1, w2, w3 = weights
    slower = Transfer(w1.zeros / 10, w1.poles / 10, w1.gain)
    relaxed_weights = {
        "disturbance": Weights(w1, w2, Transfer.from_zpk([], [], 0.0)),
        "command": Weights(w1, Transfer(w2.zeros, w2.poles, w2.gain / 100), w3),
        "tracking (ten times slower)": Weights(slower, w2, w3),
    }
    gammas = {name: _smallest_gamma(plant, relaxed) for name, relaxed in relaxed_weights.items()}
    hardest = min(gammas, key=lambda name: gammas[name])
    gamma_list = ", ".join(f"{name} {value:.4g}" for name, value in gammas.items())
    zeros = plant.zeros[plant.zeros.real > 0]
    zero = zeros.real.min(initial=np.inf)
    nearest = (
        f"; the plant's zero at {zero:.4g} rad/s allows a bandwidth of about {0.5 * zero:.4g} rad/s"
        if zeros.size
        else ""
    )
    return (
        f"specification: the best controller misses each requirement by a factor of up to γ_opt = {gamma:.4g}; allowed "
        f"by synthesis.largest_gamma: {largest:g}. The requirements contradict each other or the plant. γ_opt with "
        f"one requirement relaxed: {gamma_list}. Relax the hardest requirement: {hardest}{nearest}"
    )


def _smallest_gamma(plant: Transfer, weights: Weights) -> float:
    """Return γ_opt to 1e-4 of it; infinite if no controller exists."""
    try:
        return smallest_gamma(normalise(augment(plant, weights)), 1e-4)[0]
    except NoController:
        return float("inf")
