"""A reduced control loop for tests of controllers: suspended body, filter and controller at 40 Hz."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.one_axis import AngleController
from knightcube.gnc.guidance.plant import PathSample, SingleAxisPlant
from tests.knightcube.gnc.estimation.single_axis import (
    ANGLE,
    RATE,
    Measurement,
    SingleAxisFilter,
    SingleAxisSettings,
)

PERIOD = 0.025
BELIEVED = SingleAxisPlant(1.05e-3, 80 * 0.0081 * 4.5e-4, 23.0, 0.148)


def fly(
    controller: AngleController,
    true: SingleAxisPlant,
    wanted: Callable[[float], PathSample],
    duration: float,
    start: tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
    noise: float = 1.0,
) -> FloatArray:
    """Return rows (t, theta, omega, current) of a run with `noise` times the noise of the testbed.

    The filter assumes a plant without a suspension thread. The input of the filter is the current of the
    previous cycle's command, with the uncertainty of the testbed.
    """
    rng = np.random.default_rng(seed)
    filter_ = SingleAxisFilter(BELIEVED, SingleAxisSettings(2e-3, PERIOD, 5e-4))
    angle, rate = start
    current, rows = 0.0, []
    for cycle in range(round(duration / PERIOD)):
        now_ns = round(cycle * PERIOD * 1e9)
        measured = (
            Measurement(now_ns, ANGLE, angle + noise * rng.uniform(-3.5e-3, 3.5e-3), 2.02e-3**2),
            Measurement(now_ns, RATE, rate + noise * rng.uniform(-1.75e-4, 1.75e-4), 1.01e-4**2),
        )
        if filter_.started:
            filter_.command(now_ns - round(PERIOD * 1e9), current)
            for measurement in measured:
                filter_.measure(measurement)
        else:
            filter_.start(*measured)
        now = filter_.at(now_ns)
        made = controller.command(wanted(cycle * PERIOD), now.angle, now.rate, now.disturbance)
        assert abs(made.current) <= BELIEVED.current_limit
        current = made.current
        rows.append((cycle * PERIOD, angle, rate, current))
        actual = current + noise * rng.uniform(-3.5e-3, 3.5e-3)
        for _ in range(5):
            middle = rate + 0.5 * PERIOD / 5 * true.acceleration(angle, rate, actual)
            angle_there = angle + 0.5 * PERIOD / 5 * rate
            angle += PERIOD / 5 * middle
            rate += PERIOD / 5 * true.acceleration(angle_there, middle, actual)
    return np.array(rows)


def held(angle: float) -> Callable[[float], PathSample]:
    """Return a reference path with a constant angle."""
    return lambda _: PathSample(angle, 0.0, 0.0)


def largest_error(rows: FloatArray, angle: float, last: float) -> float:
    """Return the largest |theta - angle| (deg) in the last `last` s."""
    tail = rows[rows[:, 0] > rows[-1, 0] - last, 1]
    return math.degrees(float(np.abs(tail - angle).max()))
