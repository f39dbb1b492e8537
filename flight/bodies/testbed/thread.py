"""The turn about the thread: the plant model of a configuration, the estimate, and the attitude law."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flight.loop.body import Target
from flight.schema.testbed import TestbedConfig
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, angle_about_axis_y
from knightcube.gnc.estimation.estimate import NOMINAL, PARAMETERS, Estimate, Parameters
from knightcube.gnc.guidance.one_axis.plant import SingleAxisPlant, angle_of


def plant_of(config: TestbedConfig) -> SingleAxisPlant:
    """Return the plant model that planner, tracker and filter use."""
    section = config.plant
    return SingleAxisPlant(
        inertia=section.inertia,
        torque_constant=section.coil_turns * section.coil_area * section.field,
        resistance=config.coils.resistance[0],
        current_limit=min(
            config.coils.current_limit, config.coils.supply_voltage / config.coils.resistance[0]
        ),
        stiffness=section.thread_stiffness,
        damping=section.thread_damping,
    )


def angular_acceleration_psd_of(config: TestbedConfig, plant: SingleAxisPlant) -> float:
    """Return the power spectral density of the angular acceleration due to current noise, rad^2/s^3."""
    noise = plant.torque_constant / plant.inertia * config.estimation.current_noise
    return noise**2 / config.executive.control_rate_hz


LEAST_GAIN, MOST_GAIN = 0.5, 2.0
"""Limits of the estimated coil gain: beyond them the filter has not converged."""


@dataclass(frozen=True, slots=True, eq=False)
class ThreadEstimate:
    """Angle, rate and disturbance about the thread at `time_ns`: rad, rad/s, rad/s^2; covariance (3, 3).

    `measured_ns` is the time of the newest measurement used.
    """

    time_ns: int
    angle: float
    rate: float
    disturbance: float
    covariance: FloatArray
    measured_ns: int

    @property
    def q2(self) -> float:
        """The second quaternion component."""
        return math.sin(0.5 * self.angle)


def about_thread(estimate: Estimate, model: Parameters = NOMINAL) -> ThreadEstimate:
    """Return the turn about the thread; exact for a suspended body.

    The disturbance is the acceleration that a plant with the parameters of `model` does not explain, scaled
    so that the holding current of that plant is the holding current of the body.
    """
    angle, rate = angle_about_axis_y(estimate.quaternion), float(estimate.rate[1])
    torsion, damping, gain = estimate.parameters
    scale = model.gain / min(max(gain, LEAST_GAIN), MOST_GAIN)
    torque = scale * (float(estimate.disturbance[1]) - torsion * angle - damping * rate)
    rows = np.zeros((3, len(estimate.covariance)))
    rows[0, 1] = rows[1, 4] = 1.0
    rows[2, 10] = scale
    rows[2, 1], rows[2, 4] = model.torsion - scale * torsion, model.damping - scale * damping
    rows[2, PARAMETERS] = -scale * angle, -scale * rate, -torque * scale / model.gain
    return ThreadEstimate(
        estimate.time_ns,
        angle,
        rate,
        torque + model.torsion * angle + model.damping * rate,
        rows @ estimate.covariance @ rows.T,
        estimate.measured_ns,
    )


class ThreadReader:
    """Computes the turn about the thread from an estimate, once for each estimate."""

    def __init__(self, model: Parameters) -> None:
        self._model = model
        self._last: tuple[Estimate, ThreadEstimate] | None = None

    def read(self, estimate: Estimate) -> ThreadEstimate:
        """Return the turn about the thread."""
        if self._last is None or self._last[0] is not estimate:
            self._last = estimate, about_thread(estimate, self._model)
        return self._last[1]


@dataclass(frozen=True, slots=True)
class ThreadLaw:
    """Reach `q2` at `rate` rad/s and keep that rate; zero holds the attitude."""

    q2: float
    rate: float = 0.0

    @property
    def text(self) -> str:
        """The law in words, for events."""
        return f"q2 {self.q2:+.3f}"

    def quaternion(self, now_ns: int) -> FloatArray:
        """Return the attitude (4,) to be reached, reference into body."""
        return about_axis_y(angle_of(self.q2))


def law_of(target: Target) -> ThreadLaw:
    """Return the law of a target of the testbed."""
    law = target.law
    assert isinstance(law, ThreadLaw), "only the testbed's own targets reach its planner"
    return law
