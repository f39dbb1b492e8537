"""Noise and limits of the attitude filter, and what follows from them for a body."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro import chi_square
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import BIAS, DISTURBANCE, FIELD_BIAS, LATENCY
from knightcube.gnc.estimation.propagation import LONGEST_STEP, ProcessNoise
from knightcube.gnc.estimation.rigid_body import RigidBody
from knightcube.gnc.estimation.slow_prior import SlowPrior
from knightcube.gnc.estimation.state import SIZE


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterSettings:
    """Noise and limits of the filter.

    Attributes:
        current_noise: A, standard deviation of a driven coil's current about its command, drawn each cycle.
        control_period: s, the length of such a cycle.
        disturbance_walk: rad/s^2 per sqrt(s), the random walk of the unmodelled acceleration.
        disturbance_start: rad/s^2, standard deviation of that acceleration at the start.
        bias_walk: rad/s per sqrt(s), the random walk of the gyro's bias.
        bias_start: rad/s, standard deviation of that bias at the start.
        torsion_start: 1/s^2, standard deviation of the thread's torsion at the start, zero when it is known.
        damping_start: 1/s, of its damping, likewise.
        gain_start: of the coils' gain, likewise.
        latency_start: s, of the age of the inertial unit's samples at their stamp, likewise.
        latency_walk: s per sqrt(s), the random walk of that age.
        field_bias_start: T, standard deviation of the magnetometer's bias at the start, zero without one.
        field_bias_walk: T per sqrt(s), the random walk of that bias, and of the field model's error with it.
        rate_walk: rad/s per sqrt(s), white acceleration in addition to that of the coils.
        unknown_current: A, of each coil while its current is not known.
        gate_sigma: a measurement less likely than this many sigma of one component is rejected.
        history_ns: how late a measurement may arrive and still be used.
        longest_step: s, of propagation between measurements; a body that turns slowly may take longer steps.
    """

    current_noise: float
    control_period: float
    disturbance_walk: float
    disturbance_start: float = 0.02
    bias_walk: float = 1e-7
    bias_start: float
    torsion_start: float
    damping_start: float
    gain_start: float
    latency_start: float
    latency_walk: float
    field_bias_start: float = 0.0
    field_bias_walk: float = 0.0
    rate_walk: float = 0.0
    unknown_current: float = 0.0
    gate_sigma: float
    history_ns: int
    longest_step: float = LONGEST_STEP

    def gates(self) -> dict[int, float]:
        """Return the chi-square bounds of the gate by degrees of freedom, 1 to 3."""
        return {degrees: _gate(self.gate_sigma, degrees) for degrees in (1, 2, 3)}


def free_axes(body: RigidBody) -> FloatArray:
    """Return one (3,) for each body axis about which the body can turn, zero for the others."""
    return np.array([0.0, 1.0, 0.0]) if body.suspended else np.ones(3)


def process_noise(body: RigidBody, settings: FilterSettings) -> ProcessNoise:
    """Return the process noise of a body."""
    free = free_axes(body)
    walks = np.zeros(SIZE)
    walks[BIAS] = settings.bias_walk**2 * free
    walks[DISTURBANCE] = settings.disturbance_walk**2 * free
    walks[LATENCY] = settings.latency_walk**2
    walks[FIELD_BIAS] = settings.field_bias_walk**2
    return ProcessNoise(
        settings.current_noise**2 * settings.control_period,
        np.diag(settings.rate_walk**2 * free),
        walks,
        settings.unknown_current,
    )


def slow_prior(body: RigidBody, settings: FilterSettings) -> SlowPrior:
    """Return the prior of the slow states of a body of which nothing was learned yet."""
    thread = (settings.torsion_start**2, settings.damping_start**2) if body.suspended else (0.0, 0.0)
    return SlowPrior(
        bias_covariance=np.diag(settings.bias_start**2 * free_axes(body)),
        parameters=body.parameters,
        parameters_covariance=np.diag([*thread, settings.gain_start**2]),
        latency_variance=settings.latency_start**2,
    )


def _gate(sigma: float, degrees: int) -> float:
    """Return the chi-square bound of `degrees` that is exceeded as rarely as `sigma` of one component."""
    return chi_square.bound(math.erfc(sigma / math.sqrt(2.0)), degrees)
