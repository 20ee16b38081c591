"""The check of the repetitive controller has the loop's delay: a simulation with scipy shows whether errors grow."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import cont2discrete

from rtloop.configuration.file import parse
from rtloop.configuration.prepare import prepare
from rtloop.errors import ConfigError
from tests.laws.test_shipped import EXAMPLES
from tests.paper_dynamics import paper_dynamics

PERIOD_S, REPEAT, LEAD, WIDTH, KI_PER_S, GAIN = 1e-4, 1000, 4, 30, 150.0, 0.9
"""The options of the shipped example."""
PERIODS = 40


def largest_errors_um(delay_ticks: int) -> list[float]:
    """Return the largest error of each period after a step of 1 µm, with the plant behind `delay_ticks` samples."""
    plant = paper_dynamics()
    a, b, c, *_ = cont2discrete((plant.A, plant.B, plant.C, plant.D), PERIOD_S)
    weights = GAIN * np.concatenate([np.arange(1, WIDTH + 2), np.arange(WIDTH, 0, -1)]) / (WIDTH + 1) ** 2
    state, integral_um, commands_um = np.zeros(len(a)), 0.0, [0.0] * delay_ticks
    memory_um, errors_um = np.zeros(REPEAT + WIDTH + PERIODS * REPEAT), np.zeros(PERIODS * REPEAT)
    for tick in range(PERIODS * REPEAT):
        errors_um[tick] = 1.0 - (c @ state)[0]
        commands_um.append(integral_um)
        state = a @ state + b[:, 0] * commands_um.pop(0)
        led_um = weights @ memory_um[tick + LEAD : tick + LEAD + weights.size]
        memory_um[REPEAT + WIDTH + tick] = errors_um[tick] + weights @ memory_um[tick : tick + weights.size]
        integral_um += KI_PER_S * PERIOD_S * (errors_um[tick] + led_um)
    return [float(np.abs(part).max()) for part in errors_um.reshape(PERIODS, REPEAT)]


@pytest.mark.parametrize(("delay_ticks", "grows"), [(0, False), (2, False), (8, True), (16, True)])
def test_the_delay_of_the_driver_counts_where_the_model_states_none(delay_ticks: int, grows: bool) -> None:
    largest_um = largest_errors_um(delay_ticks)
    assert (largest_um[-1] > 1.5 * largest_um[PERIODS // 2]) == grows
    text = EXAMPLES["repetitive"].read_text().replace("seed = 1", f"seed = 1\nlatency_ticks = {delay_ticks}")
    configuration = parse(text, "test", EXAMPLES["repetitive"].parent, "test")
    if not grows:
        prepare(configuration)
        return
    with pytest.raises(ConfigError, match=r"axis\.x\.controller\.gain: at \d+.* Hz an error grows"):
        prepare(configuration)
