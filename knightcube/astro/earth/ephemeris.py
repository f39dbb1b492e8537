"""Predictions of position, velocity, geomagnetic field and Sun along an orbit.

The function `predict` computes an `Ephemeris` outside the control loop, in 0.1 ms per time step. Positions
are interpolated by cubic Hermite polynomials, and the field and the Sun linearly. With steps of 10 s, the
interpolation errors are 1 mm and 3 nT.

The class `FieldAhead` runs in the control loop and predicts the geomagnetic field up to an hour ahead.
Because the full model takes 0.2 ms for a single time, each call adds only a few nodes at intervals of one
minute, between which the field is interpolated linearly. For times after the last node a dipole model is
used, whose field direction has an RMS error of 9 deg.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import (
    FloatArray,
    IntArray,
    brief,
    check_finite,
    checked_number,
    finite_array,
    real_number,
)
from knightcube.astro.earth.geomagnetism import field, fields
from knightcube.astro.earth.orbit_knowledge import (
    LONGEST,
    LOWEST_RADIUS,
    OrbitError,
    OrbitState,
    propagated,
)
from knightcube.astro.earth.orientation import ROTATION_RATE, celestial_to_terrestrial, terrestrial_time
from knightcube.astro.earth.sun import DAY, earth_from_sun, sunlit_share
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import ArgumentError

STEP = 10.0
"""Default time step of an ephemeris, s."""
_MOST_STEPS = 1_000_000
"""Largest number of steps of an ephemeris, whose computation takes minutes."""
_Index = slice | IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Ephemeris:
    """Predictions along an orbit at equidistant times. All vectors are in ICRS axes.

    Attributes:
        julian_date: Julian date UTC of the start of the prediction.
        times: (n,) times after the start, s.
        position, velocity: (n, 3) geocentric position, m, and velocity, m/s.
        field: (n, 3) geomagnetic field, T.
        sun: (n, 3) geocentric position of the Sun, m.
        sunlit: (n,) visible fraction of the Sun's disc.
    """

    julian_date: float
    times: FloatArray
    position: FloatArray
    velocity: FloatArray
    field: FloatArray
    sun: FloatArray
    sunlit: FloatArray

    def position_at(self, times: FloatArray) -> FloatArray:
        """Return the positions (m, 3), m, at times (m,), s. Raises OrbitError for unpredicted times."""
        low, high, s, span = self._interval(times)
        start, end = self.position[low], self.position[high]
        out, into = span * self.velocity[low], span * self.velocity[high]
        bend = (1.0 - s) * (out - (end - start)) + s * ((end - start) - into)
        return np.asarray(start + s * (end - start) + s * (1.0 - s) * bend)

    def velocity_at(self, times: FloatArray) -> FloatArray:
        """Return the velocities (m, 3), m/s, at times (m,), s, as the derivative of `position_at`."""
        low, high, s, span = self._interval(times)
        start, end = self.position[low], self.position[high]
        out, into = self.velocity[low], self.velocity[high]
        mean = (end - start) / span
        return np.asarray(
            (1.0 - 4.0 * s + 3.0 * s * s) * out + (3.0 * s * s - 2.0 * s) * into + 6.0 * s * (1.0 - s) * mean
        )

    def field_at(self, times: FloatArray) -> FloatArray:
        """Return the geomagnetic field (m, 3), T, at times (m,), s."""
        return self.interpolated(self.field, times)

    def sun_at(self, times: FloatArray) -> FloatArray:
        """Return the unit vectors (m, 3) from the satellite to the Sun at times (m,), s."""
        towards = self.interpolated(self.sun, times) - self.position_at(times)
        return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))

    def sunlit_at(self, times: FloatArray) -> FloatArray:
        """Return the visible fraction (m,) of the Sun's disc at times (m,), s."""
        return self.interpolated(self.sunlit[:, None], times)[:, 0]

    def interpolated(self, values: FloatArray, times: FloatArray) -> FloatArray:
        """Return `values` (n, k) of the n predicted times, interpolated linearly to `times` (m,), s."""
        low, high, s, _ = self._interval(times)
        return np.asarray((1.0 - s) * values[low] + s * values[high])

    def _interval(self, times: FloatArray) -> tuple[_Index, _Index, FloatArray, float]:
        """Return the nodes before and after each time (m,), the fractions (m, 1) between them, and the step.

        The nodes are index arrays (m,) or, for a single time, slices, because numpy is four times as fast
        with slices.
        """
        times = np.atleast_1d(times)
        first, last = float(self.times[0]), len(self.times) - 2
        step = float(self.times[1]) - first
        position = (times - first) / step
        if not (position.min(initial=0.0) >= -1e-6 and position.max(initial=0.0) <= last + 1.0 + 1e-6):
            raise OrbitError(
                f"{times[0]:.0f} to {times[-1]:.0f} s: the orbit is predicted for "
                f"{self.times[0]:.0f} to {self.times[-1]:.0f} s"
            )
        if len(times) == 1:
            place = min(max(int(position[0]), 0), last)
            return slice(place, place + 1), slice(place + 1, place + 2), position[:, None] - place, step
        before = np.clip(position.astype(np.int64), 0, last)
        return before, before + 1, (position - before)[:, None], step


def predict(state: OrbitState, duration: float, step: float = STEP) -> Ephemeris:
    """Return the ephemeris from an orbit state to `duration` s later in steps of `step` s, with the term J2.

    The neglected drag and higher gravity terms shift a satellite by one kilometre in two revolutions, which
    changes the field by 15 nT. The field is extrapolated outside the years of its model. Raises ArgumentError
    for a state within the Earth or with values that are not finite, for a duration or a step of more than 30
    days, and for a step that is not positive or too short.
    """
    position = finite_array("state.position", state.position, (3,))
    velocity = finite_array("state.velocity", state.velocity, (3,))
    check_finite(**{"state.julian_date": state.julian_date})
    if float(np.linalg.norm(position)) < LOWEST_RADIUS:
        raise ArgumentError("state.position", f"{position.tolist()}: within the Earth: give metres")
    if not 0.0 <= real_number(duration) <= LONGEST:
        raise ArgumentError("duration", f"{brief(duration)}: give 0 to {LONGEST:g} s, 30 days")
    if not checked_number("step", step, "s") >= duration / _MOST_STEPS:
        raise ArgumentError("step", f"{step:g}: give at least {duration / _MOST_STEPS:g} s")
    times: FloatArray = step * np.arange(np.ceil(duration / step) + 2.0)
    dates = state.julian_date + times / DAY
    states = [np.concatenate([position, velocity])]
    for _ in times[1:]:
        states.append(propagated(states[-1], step))
    along = np.array(states)
    position = along[:, :3]
    first, last = (-earth_from_sun(float(terrestrial_time(date)))[0] for date in dates[[0, -1]])
    sun = first + np.linspace(0.0, 1.0, len(dates))[:, None] * (last - first)
    return Ephemeris(
        state.julian_date,
        times,
        position,
        along[:, 3:],
        fields(dates, position),
        sun,
        sunlit_share(position, sun),
    )


_DIPOLE = 1e-9 * np.array([-1410.8, 4545.4, -29351.8])
"""Dipole coefficients g11, h11 and g10 of WMM2025 (NOAA NCEI and British Geological Survey 2025), T."""
_REFERENCE_RADIUS = 6_371_200.0
"""Reference radius of the dipole coefficients, m."""
_CORRECTION_TIME = 400.0
"""Time constant (s) of the decay of the correction that fits the dipole field to the current field."""
NODE_STEP = 60.0
"""Time between two nodes of the field prediction, s.

Between two nodes the field rotates by 8 deg, and the linearly interpolated field is at most 0.2 % too weak.
"""
NODES_PER_CALL = 5
"""Maximum number of nodes that one call adds to the field prediction."""
LARGEST_JUMP = 50e3
"""Change (m) of the satellite's position above which all nodes are discarded, for example after a clock
error."""


def dipole_field_ahead(state: OrbitState, field: FloatArray, times: FloatArray) -> FloatArray:
    """Return the field (n, 3) in ICRS axes, T, predicted by a dipole model for `times` (n,) after now, s.

    The satellite is assumed to move along a circle with its current position, direction and angular rate. The
    dipole field is rotated and scaled to agree with the current field (3,); the correction decays with time.
    """
    all_times = np.concatenate([[0.0], times])
    distance = float(np.linalg.norm(state.position))
    up = state.position / distance
    normal = np.cross(state.position, state.velocity)
    ahead = np.cross(normal, up) / np.linalg.norm(normal)
    angle = float(np.linalg.norm(normal)) / distance**2 * all_times[:, None]
    direction = np.cos(angle) * up + np.sin(angle) * ahead
    x, y, z = (_DIPOLE @ celestial_to_terrestrial(state.julian_date)).tolist()
    sine, cosine = np.sin(ROTATION_RATE * all_times), np.cos(ROTATION_RATE * all_times)
    dipole = np.stack([cosine * x - sine * y, sine * x + cosine * y, np.full(len(all_times), z)], axis=1)
    along = np.einsum("ni,ni->n", dipole, direction)[:, None]
    found = np.asarray((_REFERENCE_RADIUS / distance) ** 3 * (3.0 * along * direction - dipole))
    first = found[0]
    across = np.cross(field, first)  # along the axis of the rotation from `first` to `field`
    length = float(np.linalg.norm(across))
    weight = np.exp(-times / _CORRECTION_TIME)[:, None]
    angle_off = math.atan2(length, float(first @ field))
    rotation = attitude_matrix(from_rotation_vector(weight * (across * (angle_off / max(length, 1e-30)))))
    scale = 1.0 + weight * (float(np.linalg.norm(field) / np.linalg.norm(first)) - 1.0)
    return np.asarray(scale * np.einsum("nij,nj->ni", rotation, found[1:]))


class FieldAhead:
    """Predictor of the geomagnetic field along an orbit, which stores the computed nodes between calls."""

    def __init__(self) -> None:
        self._begin = 0.0
        self._states: list[FloatArray] = []
        self._fields: list[FloatArray] = []

    def along(self, state: OrbitState, times: FloatArray) -> FloatArray:
        """Return the geomagnetic field (n, 3), ICRS axes, T, at increasing times (n,) since `state`, s."""
        since = self._restart(state)
        last = since + float(times[-1])
        for _ in range(NODES_PER_CALL):
            if self._span >= last:
                break
            self._extend()
        at = since + times
        inside = at <= self._span
        found = np.empty((len(times), 3))
        nodes = np.array(self._fields)
        position = at[inside] / NODE_STEP
        before = np.minimum(position.astype(np.int64), max(len(nodes) - 2, 0))
        share = (position - before)[:, None]
        found[inside] = (1.0 - share) * nodes[before] + share * nodes[np.minimum(before + 1, len(nodes) - 1)]
        if not inside.all():
            end = self._states[-1]
            there = OrbitState(self._begin + self._span / DAY, end[:3], end[3:], state.sigma)
            found[~inside] = dipole_field_ahead(there, nodes[-1], at[~inside] - self._span)
        return found

    @property
    def _span(self) -> float:
        return NODE_STEP * (len(self._fields) - 1)

    def _restart(self, state: OrbitState) -> float:
        """Discard past nodes, or all nodes after a jump; return the time (s) since the first node."""
        since = (state.julian_date - self._begin) * DAY
        fits = 0.0 <= since <= self._span
        if fits:
            before = min(int(since / NODE_STEP), len(self._states) - 1)
            here = propagated(self._states[before], since - NODE_STEP * before)[:3]
            fits = float(np.linalg.norm(here - state.position)) < LARGEST_JUMP
        if not fits:
            self._begin = state.julian_date
            self._states = [np.concatenate([state.position, state.velocity])]
            self._fields = [field(state.julian_date, state.position)]
            return 0.0
        while since >= NODE_STEP and len(self._fields) > 1:
            del self._states[0], self._fields[0]
            self._begin += NODE_STEP / DAY
            since -= NODE_STEP
        return since

    def _extend(self) -> None:
        """Add one node."""
        after = propagated(self._states[-1], NODE_STEP)
        there = field(self._begin + (self._span + NODE_STEP) / DAY, after[:3])
        self._states.append(after)
        self._fields.append(there)
