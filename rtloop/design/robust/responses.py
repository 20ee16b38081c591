"""Responses of a loop to its two references, also between ticks: the columns combined by taps.

    v[k] = w[k] + C(z)·(q[k] − x[k])          q: the filtered reference, w: straight into the command

The plant's input is held over a tick: x between ticks follows exactly from a discretisation at a fraction of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rtloop.design.robust.scenarios import Family, Scenario
from rtloop.foundation.arrays import Real
from rtloop.linear.discretise import DiscreteController, zero_order_hold
from rtloop.linear.sampled import SampledController
from rtloop.linear.transfer import Transfer

TIME_CONSTANTS = 8.0
"""Horizon after the last tap, in time constants of the slowest closed-loop mode: 0.03 % then remains."""
MOST_TICKS = 2000


class Responses(NamedTuple):
    """Responses to unit steps from tick 0 on, of q, the filtered reference, and of w, which is added to the command.

    `position` x (2, ticks·points) is at (i + 1)/points ticks, `command` v (2, ticks) at the ticks; q is in row 0.
    """

    position: Real
    command: Real
    static_command: float
    """Static ratio of v to x, 1/D(0)."""


def step_responses(
    controller: DiscreteController | SampledController, plant: Transfer, delay_ticks: int, points: int, ticks: int
) -> Responses:
    """Return the responses of one loop for `ticks` ticks, x at `points` per tick. Raises ValueError for an unstable
    loop.
    """
    a, b, c, d = _loop_matrices(controller, plant, delay_ticks, points)
    order = a.shape[0]
    if not np.all(np.abs(np.linalg.eigvals(a)) < 1):
        raise ValueError("the loop is unstable")
    states = np.zeros((order, 2))
    outputs = np.empty((ticks, points + 1, 2))
    for k in range(ticks):
        outputs[k] = c @ states + d
        states = a @ states + b
    position = outputs[:, 1:].reshape(-1, 2).T
    return Responses(position, outputs[:, 0].T, 1 / plant.dc_gain)


def horizon_ticks(
    controller: DiscreteController | SampledController, family: Family, scenarios: list[Scenario], taps: int
) -> int:
    """Return the tick by which the slowest mode of all scenarios' loops has decayed after the last tap
    (TIME_CONSTANTS), and 20 ticks more; at most MOST_TICKS. If one of the loops is unstable, no time is added for
    decay.
    """
    radius = 0.0
    for scenario in scenarios:
        a, *_ = _loop_matrices(controller, family.plant(scenario), scenario.delay_ticks, 1)
        radius = max(radius, float(np.max(np.abs(np.linalg.eigvals(a)))))
    decay = -1 / math.log(radius) if 0 < radius < 1 else 0.0
    return min(taps + 20 + math.ceil(TIME_CONSTANTS * decay), MOST_TICKS)


def delayed_columns(steps: Real, taps: int, stride: int) -> Real:
    """Return a step's response (k,), delayed by 0 … taps − 1 ticks of `stride` values each, (k, taps)."""
    padded = np.concatenate([np.zeros((taps - 1) * stride), steps])
    return np.stack([padded[(taps - 1 - i) * stride :][: steps.size] for i in range(taps)], axis=1)


def _loop_matrices(
    controller: DiscreteController | SampledController, plant: Transfer, delay_ticks: int, points: int
) -> tuple[Real, Real, Real, Real]:
    """Return A, b (n, 2), C (1 + points, n), D (1 + points, 2) from (q, w) to v, then x at the points of a tick.

    q is the filtered reference, w is added to the command. States: controller, commands in the delay (the oldest
    first), plant.
    """
    ac, bc, cc, dc = controller.system
    fine_plant = zero_order_hold(plant, controller.period_s / points)
    nc, n = bc.size, fine_plant.b.size
    plant_start, order = nc + delay_ticks, nc + delay_ticks + n
    output_row = np.zeros(order)
    output_row[plant_start:] = fine_plant.c
    command = np.concatenate([cc, np.zeros(order - nc)]) - dc * output_row
    direct = np.array([dc, 1.0])
    oldest_command = np.eye(order)[nc] if delay_ticks else command
    oldest_direct = np.zeros(2) if delay_ticks else direct
    plant_rows, plant_direct = np.eye(n, order, plant_start), np.zeros((n, 2))
    rows, rows_direct = [command], [direct]
    for _ in range(points):
        plant_rows = fine_plant.a @ plant_rows + np.outer(fine_plant.b, oldest_command)
        plant_direct = fine_plant.a @ plant_direct + np.outer(fine_plant.b, oldest_direct)
        rows.append(fine_plant.c @ plant_rows)
        rows_direct.append(fine_plant.c @ plant_direct)
    a, b = np.zeros((order, order)), np.zeros((order, 2))
    a[:nc, :nc], a[:nc, plant_start:], b[:nc, 0] = ac, -np.outer(bc, fine_plant.c), bc
    for i in range(delay_ticks):
        last = i + 1 == delay_ticks
        a[nc + i] = command if last else np.eye(order)[nc + i + 1]
        b[nc + i] = direct if last else 0.0
    a[plant_start:], b[plant_start:] = plant_rows, plant_direct
    return a, b, np.array(rows), np.array(rows_direct)
