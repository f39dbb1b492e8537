"""The task of a slew: start, end conditions, exclusion cones and environment, and the check of its values.

The end is an attitude, which gives three equations, or the direction of a boresight with a free roll, which
gives two. The body rate at the end gives three more. All are quadratic in the quaternion, so that their
derivatives are exact. An exclusion cone is a direction from which a body axis stays away during the slew.

Field, position, and the cones of Sun, Earth and Moon are taken from the prediction of an orbit. Times of a
slew count from `begin`, s of the ephemeris.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import erfa
import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.directions import cross_matrices, tangent_basis
from knightcube.astro.earth.disturbance import pressures
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_model import (
    EnvironmentAt,
    SlewCraft,
    SlewEnvironment,
    SlewPath,
    shown,
    shown_curvature,
)


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """Body `axis` (3,) stays `angle` rad or more away from a direction.

    Attributes:
        name: for messages.
        direction: gives unit vectors (n, 3), ICRS, at times (n,) s after the start.
    """

    name: str
    axis: FloatArray
    direction: Callable[[FloatArray], FloatArray]
    angle: float

    def clearance(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return how far outside (n,) rad the axis lies at attitudes (n, 4)."""
        cosine = shown(q, self.direction(times)) @ self.axis / np.sum(q * q, axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) - self.angle)


class ConeConstraints:
    """Cones as inequalities g >= 0 at n times: the limit's cosine less that of axis and direction.

    That cosine is a quadratic form of the attitude.
    """

    def __init__(self, cones: tuple[Cone, ...], margin: FloatArray, times: FloatArray) -> None:
        """`margin` rad, of all or (cones, n), is added for the way between the `times` (n,) s."""
        angles = np.array([cone.angle for cone in cones]).reshape(-1, 1) + margin
        self._limits = np.cos(np.clip(angles, 0.0, np.pi))
        self.count, size = len(cones), len(times)
        found = [
            -shown_curvature(np.broadcast_to(cone.axis, (size, 3)), cone.direction(times)) for cone in cones
        ]
        self.curvatures = np.array(found).reshape(self.count, size, 4, 4)
        """(cones, n, 4, 4), the second derivative by the attitude."""

    def values(self, q: FloatArray) -> FloatArray:
        """Return g (cones, n) at attitudes (n, 4); of many paths (m, 1, n, 4) (m, cones, n)."""
        return np.asarray(self._limits + 0.5 * np.sum(self.slopes(q) * q, axis=-1))

    def slopes(self, q: FloatArray) -> FloatArray:
        """Return the derivative (cones, n, 4) by the attitude."""
        return np.asarray((self.curvatures @ q[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeEnd:
    """The attitude (4,) and the rate (3,) rad/s of the wanted frame, ICRS axes, at one time."""

    quaternion: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return True: an attitude that misses by nothing is the target."""
        return True

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear (3, 4) and the quadratic part (3, 4, 4) of half the sines that q misses by.

        They are the vector part of q times the target's inverse.
        """
        v, s = self.quaternion[:3], self.quaternion[3]
        linear = np.concatenate([s * np.eye(3) + cross_matrices(v[None])[0], -v[:, None]], axis=1)
        return linear, np.zeros((3, 4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class BoresightEnd:
    """A body axis (3,) to a direction (3,), with a free roll; the `rate` (3,) rad/s is whole. Both ICRS."""

    axis: FloatArray
    direction: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return whether an attitude (4,) that misses by nothing points to it, not away from it."""
        return float(self.axis @ shown(q[None], self.direction[None])[0]) > 0.0

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear (2, 4) and the quadratic part (2, 4, 4) of the sines that q misses by."""
        across = tangent_basis(self.axis)
        return np.zeros((2, 4)), shown_curvature(across, np.broadcast_to(self.direction, (2, 3)))


End = AttitudeEnd | BoresightEnd
EndLaw = Callable[[float], End]
"""Gives the end of a slew that lasts so long, s."""


class EndConditions:
    """The equations of an end: by how much a state (7,) misses it, attitude, then rate (3,)."""

    def __init__(self, end: End, scale: float) -> None:
        """Take the end, and the unit of times, s."""
        linear, forms = end.misses()
        self.count = len(linear) + 3
        self._linear = np.zeros((self.count, 7))
        self._linear[:-3, :4], self._linear[-3:, 4:] = linear, np.eye(3)
        turning = shown_curvature(np.eye(3), np.broadcast_to(-scale * end.rate, (3, 3)))
        self._forms = np.concatenate([forms, turning])

    def miss(self, x: FloatArray) -> FloatArray:
        """Return by how much a state misses."""
        return np.asarray(self._linear @ x + 0.5 * (self._forms @ x[:4]) @ x[:4])

    def slope(self, x: FloatArray) -> FloatArray:
        """Return the derivative (n, 7) of `miss`."""
        result = self._linear.copy()
        result[:, :4] += self._forms @ x[:4]
        return result

    def curvature(self, pull: FloatArray) -> FloatArray:
        """Return the second derivative (4, 4) of pull . miss by the quaternion."""
        return np.asarray(np.tensordot(pull, self._forms, 1))


def along(
    ephemeris: Ephemeris, begin: float, areas: FloatArray | None = None, path: SlewPath | None = None
) -> EnvironmentAt:
    """Return field, position, air and light over the time of a slew.

    Air and light press by the `areas` (3,) that a body on `path` shows to them.
    """

    def around(times: FloatArray) -> SlewEnvironment:
        since = begin + times
        pressed = pressures(ephemeris, since)
        if areas is not None and path is not None:
            pressed = pressed.facing(areas, attitude_matrix(path.references(times).quaternion))
        return SlewEnvironment(ephemeris.field_at(since), ephemeris.position_at(since), pressed)

    return around


def cones(ephemeris: Ephemeris, begin: float, axis: FloatArray, **angles: float) -> tuple[Cone, ...]:
    """Return the cones that body `axis` (3,) keeps, rad: `sun` and `moon` from centre, `earth` from limb."""
    date = float(terrestrial_time(ephemeris.julian_date + begin / 86_400.0))
    moon = ASTRONOMICAL_UNIT * np.asarray(erfa.moon98(date, 0.0)["p"], dtype=float)

    def towards_earth(times: FloatArray) -> FloatArray:
        place = ephemeris.position_at(begin + times)
        return np.asarray(-place / np.linalg.norm(place, axis=1, keepdims=True))

    def towards_moon(times: FloatArray) -> FloatArray:
        away = moon - ephemeris.position_at(begin + times)
        return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))

    distance = float(np.linalg.norm(ephemeris.position_at(np.array([begin]))[0]))
    limb = math.asin(min(1.0, EARTH_RADIUS / distance))
    known = {
        "sun": (lambda times: ephemeris.sun_at(begin + times), 0.0),
        "earth": (towards_earth, limb),
        "moon": (towards_moon, 0.0),
    }
    return tuple(
        Cone(name.capitalize(), axis, known[name][0], known[name][1] + angle)
        for name, angle in angles.items()
    )


NODES = 24
"""Intervals of the dipole. The heat is within 0.1 % of that on 48, the least time within 0.6 %."""
NODES_RANGE = (8, 96)
HORIZON_RANGE = (1.0, 2e4)
_DEEP, _STILL = math.radians(5.0), 1e-4
"""rad within a cone, and rad/s of a target at rest among the stars."""
LEAST_TIME = math.inf
"""A price of time at which only time counts."""


@dataclass(frozen=True, slots=True, eq=False)
class SlewTask:
    """What is asked for.

    Attributes:
        craft, along: the model; `along` counts times from the start of the slew.
        quaternion, rate: the start, (4,) ICRS into body and (3,) rad/s, body axes.
        end: the end of a slew of a given duration.
        horizon, longest: s; the horizon is stretched up to `longest` where it does not suffice.
        time_price: W; None keeps the horizon, LEAST_TIME wants the least one.
        cones: kept all the way.
    """

    craft: SlewCraft
    along: EnvironmentAt
    quaternion: FloatArray
    rate: FloatArray
    end: EndLaw
    horizon: float
    longest: float
    time_price: float | None = None
    cones: tuple[Cone, ...] = ()
    nodes: int = NODES


def check(task: SlewTask) -> None:
    """Raise PlanningError for a task that no path can fulfil."""
    craft = task.craft
    arrays = (
        craft.inertia,
        craft.limit,
        craft.weights,
        craft.residual,
        craft.torque,
        craft.air,
        craft.light,
        task.quaternion,
        task.rate,
    )
    if not all(np.isfinite(part).all() for part in arrays):
        raise PlanningError("a slew needs a craft and a start that are finite")
    if abs(float(np.linalg.norm(task.quaternion)) - 1.0) > 1e-6:
        raise PlanningError(f"the start {task.quaternion} is no attitude: its length must be 1")
    if not (np.all(craft.limit > 0.0) and np.all(craft.weights > 0.0)):
        raise PlanningError("every coil needs a limit and a weight above zero")
    if np.linalg.eigvalsh(craft.inertia).min() <= 0.0:
        raise PlanningError("the inertia must be positive definite")
    low, high = HORIZON_RANGE
    if not low <= task.horizon <= task.longest <= high:
        raise PlanningError(f"horizon {task.horizon:g} s, longest {task.longest:g} s: {low:g} to {high:g} s")
    if not NODES_RANGE[0] <= task.nodes <= NODES_RANGE[1]:
        raise PlanningError(f"{task.nodes} nodes: {NODES_RANGE[0]} to {NODES_RANGE[1]}")
    if task.time_price is not None and not task.time_price > 0.0:
        raise PlanningError(f"a price of time of {task.time_price} W: it must be positive")
    end = task.end(task.horizon)
    for cone in task.cones:
        inside = -math.degrees(float(cone.clearance(task.quaternion[None], np.zeros(1))[0]))
        if inside > 0.0:
            raise PlanningError(f"the start lies within the cone of the {cone.name}, by {inside:.1f} deg")
        # The cones move by some degrees over a slew: deep inside, no other horizon helps.
        if isinstance(end, AttitudeEnd) and _is_deep_inside(end, cone, task.horizon):
            raise PlanningError(f"the end lies within the cone of the {cone.name}")


def in_the_way(task: SlewTask, horizon: float) -> Cone | None:
    """Return a cone within which a slew over `horizon` s would end, by its whole attitude; None without."""
    end = task.end(horizon)
    if not isinstance(end, AttitudeEnd):
        return None
    shown, time = end.quaternion[None], np.array([horizon])
    return next((cone for cone in task.cones if float(cone.clearance(shown, time)[0]) < 0.0), None)


def _is_deep_inside(end: AttitudeEnd, cone: Cone, time: float) -> bool:
    """Return whether an end at rest lies far within a cone."""
    inside = float(cone.clearance(end.quaternion[None], np.array([time]))[0])
    return inside < -_DEEP and float(np.abs(end.rate).max()) < _STILL
