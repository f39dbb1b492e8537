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
    """An exclusion cone: body `axis` (3,) stays at least `angle` rad away from a direction.

    Attributes:
        name: for messages.
        direction: function from times (n,), s after the start, to unit vectors (n, 3), ICRS.
    """

    name: str
    axis: FloatArray
    direction: Callable[[FloatArray], FloatArray]
    angle: float

    def clearance(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return the angles (n,) rad by which the axis lies outside the cone at attitudes (n, 4)."""
        cosine = shown(q, self.direction(times)) @ self.axis / np.sum(q * q, axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) - self.angle)


class ConeConstraints:
    """Exclusion cones at n times as inequalities g >= 0.

    g is the cosine of the limit minus the cosine of the angle between axis and direction, a quadratic form of
    the attitude.
    """

    def __init__(self, cones: tuple[Cone, ...], margin: FloatArray, times: FloatArray) -> None:
        """Add `margin` rad to the cones at `times` (n,) s, for the path between the times.

        The margin is a scalar or (cones, n).
        """
        angles = np.array([cone.angle for cone in cones]).reshape(-1, 1) + margin
        self._limits = np.cos(np.clip(angles, 0.0, np.pi))
        self.count, size = len(cones), len(times)
        found = [
            -shown_curvature(np.broadcast_to(cone.axis, (size, 3)), cone.direction(times)) for cone in cones
        ]
        self.curvatures = np.array(found).reshape(self.count, size, 4, 4)
        """(cones, n, 4, 4), the second derivative by the attitude."""

    def values(self, q: FloatArray) -> FloatArray:
        """Return g (cones, n) at attitudes (n, 4), or g (m, cones, n) of m paths (m, 1, n, 4)."""
        return np.asarray(self._limits + 0.5 * np.sum(self.slopes(q) * q, axis=-1))

    def slopes(self, q: FloatArray) -> FloatArray:
        """Return the derivatives (cones, n, 4) of g by the attitude."""
        return np.asarray((self.curvatures @ q[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeEnd:
    """An end at a full attitude: quaternion (4,) ICRS into body, and rate (3,) rad/s in ICRS axes."""

    quaternion: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return True, because an attitude with zero error is the target."""
        return True

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return linear part (3, 4) and quadratic part (3, 4, 4) of the attitude error as a function of q.

        The error is the vector part of q times the inverse of the target, half the sine of the error angle.
        """
        v, s = self.quaternion[:3], self.quaternion[3]
        linear = np.concatenate([s * np.eye(3) + cross_matrices(v[None])[0], -v[:, None]], axis=1)
        return linear, np.zeros((3, 4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class BoresightEnd:
    """An end at which body `axis` (3,) points to `direction` (3,), ICRS, with a free roll.

    `rate` (3,) rad/s, ICRS axes, is the full body rate.
    """

    axis: FloatArray
    direction: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return whether an attitude (4,) with zero error points to the direction and not opposite to it."""
        return float(self.axis @ shown(q[None], self.direction[None])[0]) > 0.0

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return linear part (2, 4) and quadratic part (2, 4, 4) of the error's sines as a function of q."""
        across = tangent_basis(self.axis)
        return np.zeros((2, 4)), shown_curvature(across, np.broadcast_to(self.direction, (2, 3)))


End = AttitudeEnd | BoresightEnd
EndLaw = Callable[[float], End]
"""Function from the duration of a slew, s, to its end."""


class EndConditions:
    """The equations of an end: the error of a state (7,), attitude first, then rate (3,)."""

    def __init__(self, end: End, scale: float) -> None:
        """Set up the equations of `end` for times in units of `scale` s."""
        linear, forms = end.misses()
        self.count = len(linear) + 3
        self._linear = np.zeros((self.count, 7))
        self._linear[:-3, :4], self._linear[-3:, 4:] = linear, np.eye(3)
        turning = shown_curvature(np.eye(3), np.broadcast_to(-scale * end.rate, (3, 3)))
        self._forms = np.concatenate([forms, turning])

    def miss(self, x: FloatArray) -> FloatArray:
        """Return the errors (n,) of a state (7,)."""
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
    """Return the environment of a slew that starts at `begin` s of the ephemeris.

    With `areas` and `path`, air and sunlight act on the `areas` (3,) that a body on `path` exposes to them.
    """

    def around(times: FloatArray) -> SlewEnvironment:
        since = begin + times
        pressed = pressures(ephemeris, since)
        if areas is not None and path is not None:
            pressed = pressed.facing(areas, attitude_matrix(path.references(times).quaternion))
        return SlewEnvironment(ephemeris.field_at(since), ephemeris.position_at(since), pressed)

    return around


def cones(ephemeris: Ephemeris, begin: float, axis: FloatArray, **angles: float) -> tuple[Cone, ...]:
    """Return the exclusion cones of a body `axis` (3,), one for each of `angles`, rad.

    The names are `sun` and `moon`, measured from the centre, and `earth`, measured from the limb.
    """
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
"""Depth (rad) inside a cone, and rate (rad/s) below which a target is at rest among the stars."""
LEAST_TIME = math.inf
"""Time cost at which only the duration counts."""


@dataclass(frozen=True, slots=True, eq=False)
class SlewTask:
    """The task of the slew planner.

    Attributes:
        craft, along: the model; `along` counts times from the start of the slew.
        quaternion, rate: the start, (4,) ICRS into body and (3,) rad/s, body axes.
        end: the end of a slew as a function of its duration.
        horizon, longest: s; the horizon is stretched up to `longest` if no path over it is found.
        time_price: cost of time, W; None keeps the horizon, LEAST_TIME minimises it.
        cones: exclusion cones kept during the whole slew.
        nodes: intervals of the collocation.
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
    """Raise PlanningError if no path can fulfil the task."""
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
        raise PlanningError("the values of the satellite and of the start must be finite")
    if abs(float(np.linalg.norm(task.quaternion)) - 1.0) > 1e-6:
        raise PlanningError(f"the start quaternion {task.quaternion} must have length 1")
    if not (np.all(craft.limit > 0.0) and np.all(craft.weights > 0.0)):
        raise PlanningError("every coil needs a limit and a weight above zero")
    if np.linalg.eigvalsh(craft.inertia).min() <= 0.0:
        raise PlanningError("the inertia must be positive definite")
    low, high = HORIZON_RANGE
    if not low <= task.horizon <= task.longest <= high:
        raise PlanningError(
            f"horizon {task.horizon:g} s, longest {task.longest:g} s: must rise from {low:g} to {high:g} s"
        )
    if not NODES_RANGE[0] <= task.nodes <= NODES_RANGE[1]:
        raise PlanningError(f"nodes is {task.nodes}: must be {NODES_RANGE[0]} to {NODES_RANGE[1]}")
    if task.time_price is not None and not task.time_price > 0.0:
        raise PlanningError(f"the cost of time is {task.time_price} W: it must be positive")
    end = task.end(task.horizon)
    for cone in task.cones:
        inside = -math.degrees(float(cone.clearance(task.quaternion[None], np.zeros(1))[0]))
        if inside > 0.0:
            raise PlanningError(
                f"the start lies {inside:.1f} deg inside the exclusion cone of the {cone.name}"
            )
        # The cones move by some degrees during a slew. For an end deep inside no other horizon helps.
        if isinstance(end, AttitudeEnd) and _is_deep_inside(end, cone, task.horizon):
            raise PlanningError(f"the end lies inside the exclusion cone of the {cone.name}")


def blocking_cone(task: SlewTask, horizon: float) -> Cone | None:
    """Return an exclusion cone that contains the end of a slew over `horizon` s; None if there is none.

    Only ends at a full attitude are checked.
    """
    end = task.end(horizon)
    if not isinstance(end, AttitudeEnd):
        return None
    shown, time = end.quaternion[None], np.array([horizon])
    return next((cone for cone in task.cones if float(cone.clearance(shown, time)[0]) < 0.0), None)


def _is_deep_inside(end: AttitudeEnd, cone: Cone, time: float) -> bool:
    """Return whether an end at rest among the stars lies deep inside a cone."""
    inside = float(cone.clearance(end.quaternion[None], np.array([time]))[0])
    return inside < -_DEEP and float(np.abs(end.rate).max()) < _STILL
