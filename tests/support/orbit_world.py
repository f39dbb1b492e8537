"""The simulated satellite of the campaign `orbit-attitude`, and its sensors.

The simulation covers one revolution that ends with an eclipse, with a random date and node. The body follows
the local vertical, with two side cameras on the Sun's side of the orbit. Random-walk torques disturb the
attitude (3 deg rms), and a control law corrects it. The filter knows neither of the two. The sensors have the
noise of the suite. The sensors are gyros with a random walk of the bias, a magnetometer with hard iron, and
cameras that give the directions of Sun and nadir if these are in the field of view. The true field is IGRF-14
with a ring current and an ionosphere (first-order Gauss-Markov); the filter uses WMM2025.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.almanac import apparent_sun
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, sunlit_share
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_matrix,
    from_rotation_vector,
    multiply,
)
from knightcube.astro.quaternion import to_rotation_vector as rotation_vector
from sim_hal.worlds.orbit import magnetic_field, ring_current
from tests.support.orbit_geometry import (
    Pass,
    in_field,
    limb,
    limb_in_daylight,
    local_frame,
    revolution,
)
from tests.support.sensor_suite import SensorSuite

STEP = 0.5
"""Time step (s) of the truth and of the gyros."""
FIRST_DATE = 2_461_041.5
"""2026 January 1."""
AGILITY = 0.005
"""Bandwidth (rad/s) of the control law."""
SWAY = np.radians(3.0)
"""Deviation (rad rms per axis) from the local vertical."""
PUSH_WALK = SWAY * np.sqrt(16.0 * AGILITY**5 / 3.0)
"""Random walk of the angular acceleration (rad/s^2 per sqrt(s)).

This random walk causes a deviation of SWAY in a control loop with three equal poles.
"""
RING_CURRENT, IONOSPHERE, IONOSPHERE_TIME = 20e-9, 20e-9, 400.0
"""Standard deviations of ring current and ionosphere (T), and time constant of the ionosphere (s)."""
OPTICAL_SIGMA = np.radians(0.02)
"""Standard deviation (rad per axis) of Sun and nadir."""
LEAST_LIMB = 30
"""Smallest number of lit limb points in one camera's field for a nadir reading: 30 of 720, or 15 deg."""
_COARSE = 20
"""Number of time steps (together 10 s) between two checks of the fields of view."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """True states at n instants at intervals of STEP, and whether the cameras can measure Sun and nadir.

    Attributes:
        pass_: orbit of the satellite.
        attitudes: (n, 4); `rates` (n, 3), rad/s, is the mean over the previous step.
        sun: apparent directions (n, 3), ICRS; `field` (n, 3) is in T, ICRS.
        sunlit: (n,); `sun_in_field` and `nadir_in_field` (n,) state whether a camera could measure Sun and
            nadir.
    """

    pass_: Pass
    attitudes: FloatArray
    rates: FloatArray
    sun: FloatArray
    field: FloatArray
    sunlit: BoolArray
    sun_in_field: BoolArray
    nadir_in_field: BoolArray


def world(suite: SensorSuite, rng: np.random.Generator, seconds: float | None = None) -> World:
    """Return a random world.

    If `seconds` is given, the world covers only an interval of this length around sunset.
    """
    pass_ = _revolution_to_eclipse(rng, seconds)
    frame = local_frame(pass_.positions, pass_.velocities)
    sun = _sun(pass_)
    # The first camera looks away from the Sun, normal to the orbit, so that the other two cameras look to the
    # Sun's side.
    away = -np.sign(np.sum(frame[:, 1] * sun))
    attitudes = multiply(from_rotation_vector(np.array([0.0, 0.0, 0.5 * np.pi * away])), _sway(frame, rng))
    turns = rotation_vector(multiply(attitudes[1:], conjugate(attitudes[:-1]))) / STEP
    rates = np.concatenate([turns[:1], turns])
    lit = _sunlit(pass_, sun)
    sun_in_field, nadir_in_field = _in_fields(suite, pass_, frame, attitudes, sun)
    return World(pass_, attitudes, rates, sun, _field(pass_, rng), lit, sun_in_field & lit, nadir_in_field)


def _revolution_to_eclipse(rng: np.random.Generator, seconds: float | None) -> Pass:
    """Return a revolution that ends at sunrise, for a random date and node with an eclipse."""
    while True:
        date, node = FIRST_DATE + rng.uniform(0.0, 730.0), rng.uniform(0.0, 2.0 * np.pi)
        whole = revolution(date, node, 5.0)
        lit = _sunlit(whole, _sun(whole))
        rises = np.flatnonzero(lit & ~np.roll(lit, 1))
        if rises.size and np.count_nonzero(~lit) * 5.0 > 1500.0:
            break
    # The revolution lasts from a sunrise until shortly before the next sunrise.
    found = revolution(date, node, STEP, begin=float(whole.times[rises[0]]))
    found = Pass(date, found.times - found.times[0], found.positions, found.velocities)
    dark = np.flatnonzero(~_sunlit(found, _sun(found)))
    found = _piece(found, 0, int(dark[-1]) + 1)
    if seconds is not None:
        begin = max(0, int(dark[0]) - round(0.6 * seconds / STEP))
        found = _piece(found, begin, min(len(found.times), begin + round(seconds / STEP)))
    return found


def _piece(pass_: Pass, begin: int, end: int) -> Pass:
    return Pass(
        pass_.julian_date, pass_.times[begin:end], pass_.positions[begin:end], pass_.velocities[begin:end]
    )


def dates(pass_: Pass) -> FloatArray:
    """Return the Julian dates UTC (n,)."""
    return np.asarray(pass_.julian_date + pass_.times / 86_400.0)


def _sunlit(pass_: Pass, sun: FloatArray) -> BoolArray:
    # The directions of the Sun from the satellite and from the Earth's centre are so similar that the shadow
    # is the same.
    return np.asarray(sunlit_share(pass_.positions, ASTRONOMICAL_UNIT * sun) > 0.5)


def _sun(pass_: Pass) -> FloatArray:
    """Return the Sun's apparent directions (n, 3), interpolated linearly from instants 10 s apart."""
    every = max(1, len(pass_.times) // 600)
    nodes = np.unique(np.append(np.arange(0, len(pass_.times), every), len(pass_.times) - 1))
    known = np.array(
        [apparent_sun(dates(pass_)[k], pass_.positions[k], pass_.velocities[k])[0] for k in nodes]
    )
    between = np.stack([np.interp(pass_.times, pass_.times[nodes], part) for part in known.T], axis=-1)
    return np.asarray(between / np.linalg.norm(between, axis=-1, keepdims=True))


def _sway(frame: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return random attitudes (n, 4) near the local frame (n, 3, 3): white jerk, filtered by three poles."""
    a = AGILITY
    chain = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-(a**3), -3.0 * a**2, -3.0 * a]])
    # The matrix is the stationary covariance of a system with three equal poles under white jerk of density
    # q^2.
    q2 = PUSH_WALK**2
    p0, p1, p2 = 3.0 * q2 / (16.0 * a**5), q2 / (16.0 * a**3), 3.0 * q2 / (16.0 * a)
    stationary = np.array([[p0, 0.0, -p1], [0.0, p1, 0.0], [-p1, 0.0, p2]])
    state = np.linalg.cholesky(stationary) @ rng.standard_normal((3, 3))
    step = np.eye(3) + STEP * chain + 0.5 * STEP**2 * chain @ chain + STEP**3 / 6.0 * chain @ chain @ chain
    kick = PUSH_WALK * np.sqrt(STEP) * rng.standard_normal((len(frame), 3))
    angles = np.empty((len(frame), 3))
    for k in range(len(frame)):
        angles[k] = state[0]
        state = step @ state
        state[2] += kick[k]
    local = np.array([from_matrix(matrix) for matrix in frame])
    return np.asarray(multiply(from_rotation_vector(angles), local))


def _field(pass_: Pass, rng: np.random.Generator) -> FloatArray:
    """Return the true field (n, 3), T: IGRF, a ring current and the ionosphere."""
    when = dates(pass_)
    disturbance = RING_CURRENT * abs(rng.standard_normal())
    keep = np.exp(-STEP / IONOSPHERE_TIME)
    kicks = np.sqrt(1.0 - keep**2) * rng.standard_normal((len(when), 3))
    kicks[0] = rng.standard_normal(3)
    walk = np.empty_like(kicks)
    now = np.zeros(3)
    for k, kick in enumerate(kicks):
        now = keep * now + kick
        walk[k] = now
    core = magnetic_field(when, pass_.positions)
    return np.asarray(core + ring_current(when, disturbance) + IONOSPHERE * walk)


def _in_fields(
    suite: SensorSuite, pass_: Pass, frame: FloatArray, attitudes: FloatArray, sun: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return whether a camera sees the Sun (n,), and whether a camera sees enough of the lit limb (n,)."""
    turn = attitude_matrix(attitudes)
    sun_body = np.einsum("nij,nj->ni", turn, sun)
    sees_sun = np.zeros(len(sun), bool)
    coarse = slice(None, None, _COARSE)
    positions, local = pass_.positions[coarse], frame[coarse]
    edge = limb(positions)
    lit = limb_in_daylight(positions, edge, np.einsum("nij,nj->ni", local, sun[coarse]))
    edge_body = np.einsum("nij,nkj,npk->npi", turn[coarse], local.transpose(0, 2, 1), edge)
    sees_limb = np.zeros(len(positions), bool)
    for camera in suite.cameras:
        if camera.sun:
            sees_sun |= in_field(camera, sun_body)
        sees_limb |= np.count_nonzero(lit & in_field(camera, edge_body), axis=-1) >= LEAST_LIMB
    return sees_sun, np.repeat(sees_limb, _COARSE)[: len(sun)]


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Sensor readings at each of the n instants, and the true biases.

    `gyro` (n, 3), rad/s, is the mean rate over the previous step; `magnetometer` (n, 3) is in T; `sun` and
    `nadir` (n, 3) are body directions.
    """

    gyro: FloatArray
    gyro_bias: FloatArray
    magnetometer: FloatArray
    hard_iron: FloatArray
    sun: FloatArray
    nadir: FloatArray


def readings(suite: SensorSuite, truth: World, rng: np.random.Generator) -> Readings:
    """Return random readings at all instants. `truth` states when Sun and nadir can be measured."""
    gyros, magnetometer = suite.gyros, suite.magnetometer
    if gyros is None or magnetometer is None:
        raise ValueError(f"suite {suite.name} lacks gyros or a magnetometer")
    n = len(truth.attitudes)
    walk = gyros.bias_walk * np.sqrt(STEP) * rng.standard_normal((n, 3))
    walk[0] = gyros.bias_start * rng.standard_normal(3)
    bias = np.cumsum(walk, axis=0)
    turn = attitude_matrix(truth.attitudes)
    hard_iron = magnetometer.bias_start * rng.standard_normal(3)
    down = -truth.pass_.positions / np.linalg.norm(truth.pass_.positions, axis=-1, keepdims=True)
    return Readings(
        truth.rates + bias + gyros.noise / np.sqrt(STEP) * rng.standard_normal((n, 3)),
        bias,
        np.einsum("nij,nj->ni", turn, truth.field)
        + hard_iron
        + magnetometer.noise * rng.standard_normal((n, 3)),
        hard_iron,
        _seen(turn, truth.sun, rng),
        _seen(turn, down, rng),
    )


def _seen(turn: FloatArray, directions: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return directions (n, 3) in body axes, with errors of OPTICAL_SIGMA per axis."""
    there = np.einsum("nij,nj->ni", turn, directions)
    off = there + OPTICAL_SIGMA * rng.standard_normal(there.shape)
    return np.asarray(off / np.linalg.norm(off, axis=-1, keepdims=True))
