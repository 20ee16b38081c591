"""A synthesised controller as the section [axis.controller], with comments on its origin.

It is written alone, or in a whole configuration around a simulated rig of its plant.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from rtloop.design.synthesis.specification import DesignOptions, OutputOptions
from rtloop.design.synthesis.synthesise import Synthesis
from rtloop.design.toml_text import write_section, zpk_values
from rtloop.foundation.arrays import Complex
from rtloop.foundation.modal import RepeatedPoles, modal_sum
from rtloop.hysteresis.play_model import PlayModel
from rtloop.linear.transfer import Transfer
from rtloop.version import __version__

RIG_UM_PER_V = 4.3
"""Gain of the proportional actuator of the rig that is written around a controller."""
POLE_SPACING = 1e-5
"""Relative distance that replaces repeated poles on a rig, which cannot represent them."""
_METHODS = {"residualise": "balanced residualisation", "truncate": "balanced truncation"}


def controller_section(synthesis: Synthesis, design: DesignOptions, source: str, text: str) -> str:
    """Return [axis.controller] as TOML, to insert below an [[axis]].

    `source` is the specification's name, `text` its content. Numbers read back to the same bits; there is no date, so
    that the same input gives the same text.
    """
    return commented_section(synthesis.controller, design.controller, provenance(synthesis, design, source, text))


def commented_section(controller: Transfer, output: OutputOptions, lines: Sequence[str]) -> str:
    """Return [axis.controller] as TOML, below the comment `lines`, without #."""
    return write_section("axis.controller", controller_values(controller, output), lines)


def controller_configuration(
    synthesis: Synthesis, design: DesignOptions, source: str, text: str, axis: str, specification: str,
    actuator: PlayModel | None = None,
) -> str:  # fmt: skip
    """Return a configuration as TOML with the controller on axis `axis`, for `check`, `run` and `ctl controller`.

    Its rig is the plant of `design`. `source` is the specification's name, `text` its content, `specification` its path
    relative to the configuration, `actuator` the identified one, None a placeholder.
    """
    lines = provenance(synthesis, design, source, text)
    return configuration_around(synthesis.controller, design, lines, axis, specification, actuator)


def configuration_around(
    controller: Transfer, design: DesignOptions, lines: Sequence[str], axis: str, specification: str,
    actuator: PlayModel | None = None,
) -> str:  # fmt: skip
    """Return TOML, below the comment `lines`, without #: `controller` on axis `axis`, and a simulated rig of the plant
    of `design`.

    Feedforward and rig have the `actuator`; None: a placeholder of RIG_UM_PER_V. `specification` is its file's path,
    relative to the configuration.
    """
    plant, delay_ticks = design.required_plant.transfer(), design.required_plant.delay_ticks
    feedforward = {"thresholds_v": [0.0], "weights_um_per_v": [RIG_UM_PER_V]}
    placeholders = (
        "Driver, feedforward and limits are placeholders. They describe a simulated rig: the plant behind an actuator "
        f"of {RIG_UM_PER_V} µm/V."
    )
    if actuator is not None:
        feedforward = {key: values.tolist() for key, values in actuator.for_json().items()}
        placeholders = "Driver and limits are placeholders. They describe a simulated rig: the plant and its actuator."
    values = {
        "loop": {"rate_hz": design.controller.rate_hz},
        "driver": {
            "kind": "sim",
            "latency_ticks": delay_ticks,
            "channels": {axis: {"input": "adc0", "output": "dac0", "um_per_v": 10.0}},
            "plant": {"hysteresis": {"truth": "custom", **feedforward}, "dynamics": zpk_values(_separate_poles(plant))},
        },
        "axis": [
            {
                "name": axis,
                "specification": specification,
                "feedforward": feedforward,
                "controller": controller_values(controller, design.controller),
                "model": {**zpk_values(plant), "delay_ticks": delay_ticks},
            }
        ],
    }
    heading = [
        *lines,
        "",
        placeholders,
        "To use the controller, copy [axis.controller] into your configuration, or load this file into a running loop: "
        f"`rtloop ctl controller {axis} FILE`.",
    ]
    return write_section("", values, heading)


def _separate_poles(plant: Transfer) -> Transfer:
    """Return the plant; if poles repeat, a copy in which the real poles, and likewise the pairs, are multiplied one
    after the other by 1, 1 + POLE_SPACING, 1 + 2·POLE_SPACING …, with the static gain preserved.
    """
    try:
        modal_sum(plant.zeros, plant.poles, plant.gain)
    except RepeatedPoles:
        reals = int(np.sum(plant.poles.imag == 0))
        root_numbers = np.concatenate(
            [np.arange(reals), np.arange(plant.order - reals) // 2]
        )  # pairs stand side by side
        factors = 1 + POLE_SPACING * root_numbers
        return Transfer(plant.zeros, factors * plant.poles, plant.gain * float(np.prod(factors)))
    return plant


def provenance(synthesis: Synthesis, design: DesignOptions, source: str, text: str) -> list[str]:
    """Return comment lines, without #, on the origin of the controller; `source` and `text` are the specification's
    name and content, whose SHA-256 is in the first line.
    """
    hinf, weights = synthesis.hinf, synthesis.weights
    order, full_order = synthesis.controller.order, synthesis.full.order
    digest = hashlib.sha256(text.encode()).hexdigest()
    lines = [
        f"Synthesised by rtloop {__version__} from {source} (SHA-256 {digest[:16]}…)",
        *(f"plant: {formula(plant.transfer())}" for plant in [design.plant] if plant),
        f"W1 = {formula(weights.tracking)}",
        f"W2 = {formula(weights.command)}",
        f"W3 = {formula(weights.disturbance)}",
        f"H∞ (Glover & Doyle 1988): γ_opt = {hinf.gamma_opt:.6g}, γ = {hinf.gamma:.6g}, "
        f"‖F_l(P, C)‖∞ = {hinf.achieved:.6g} at order {full_order}",
        "each requirement is relaxed by a factor of up to γ",
        "Hankel singular values: " + ", ".join(f"{value:.4g}" for value in synthesis.hankel),
    ]
    if order < full_order:
        method = _METHODS[design.synthesis.reduction]
        lines.append(f"reduced to order {order} by {method}: ‖F_l(P, C)‖∞ = {synthesis.achieved:.6g}")
    return lines


def controller_values(controller: Transfer, output: OutputOptions) -> dict[str, object]:
    """Return [axis.controller] as {"form": "zpk", "gain", "zeros", "poles", "method"} and, if set, "prewarp_hz"; each
    root in rad/s as a pair [real, imaginary].
    """
    prewarp = {} if output.prewarp_hz is None else {"prewarp_hz": output.prewarp_hz}
    return {**zpk_values(controller), "method": output.method, **prewarp}


def formula(transfer: Transfer) -> str:
    """Return gain and real factors of zeros and poles as text, six digits each: "0.5 (s + 3)/(s² + 2 s + 5)"."""
    numerator = "".join(_factors(transfer.zeros)) or "1"
    denominator = "".join(_factors(transfer.poles))
    return f"{transfer.gain:.6g} {numerator}/{denominator}" if denominator else f"{transfer.gain:.6g}"


def _factors(roots: Complex) -> list[str]:
    """Return one factor as text for each real root and each pair, six digits each."""
    factors = []
    for root in roots:
        if root.imag == 0:
            factors.append(f"(s {'−' if root.real > 0 else '+'} {abs(root.real):.6g})")
        elif root.imag > 0:
            middle = -2 * root.real
            factors.append(f"(s² {'−' if middle < 0 else '+'} {abs(middle):.6g} s + {abs(root) ** 2:.6g})")
    return factors
