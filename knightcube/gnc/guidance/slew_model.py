"""The task of the slew planner: equations of motion, end conditions, exclusion cones and environment.

The state (7,) consists of attitude and body rate, and the control (3,) is the dipole moment m of the coils.
With the field b = A(q) B and the direction of the position e = A(q) r in body axes, the equations of motion
are

    q' = 1/2 [w, 0] q,    J w' = (m + residual) x b + 3 mu / r^3 e x J e + d - w x J w

The vector d is the sum of the torques of `knightcube.astro.earth.disturbance`: a constant torque in body
axes, and the aerodynamic and solar radiation torques c x A(q) v, with a constant vector c in body axes and a
pressure vector v in ICRS axes. The torque of the coils has no component along the field, so not every path is
feasible. All derivatives are analytic, because A(q) v is a quadratic form of q whose second derivatives are
twice Davenport's matrix.

Paths are cubic Hermite curves (de Boor 1978, chapter IV). This module evaluates the curves, because
scipy.interpolate would need 20 MiB of memory in each process that executes or plans a slew.

The end of a slew is either an attitude, which gives three equations, or the direction of a boresight with an
arbitrary roll, which gives two equations. The body rate at the end gives three more equations. All end
conditions are quadratic in the quaternion. An exclusion cone is a cone about a direction, such as the
direction to the Sun, that a body axis must not enter during the slew. Field, position, and the cones of Sun,
Earth and Moon are computed along a predicted orbit. Times of a slew are relative to the start of the slew,
which is `begin` s after the start of the ephemeris.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace

import erfa
import numpy as np

from knightcube.astro.arrays import FloatArray, cross_matrices, tangent_basis
from knightcube.astro.earth.disturbance import AIR, CONSTANT, LIGHT, Pressures, pressures
from knightcube.astro.earth.ephemeris import Ephemeris
from knightcube.astro.earth.figure import EARTH_RADIUS, GRAVITATIONAL_PARAMETER
from knightcube.astro.earth.orientation import terrestrial_time
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, DAY
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.attitude_law import AttitudeReferences

_EYE3: FloatArray = np.eye(3)
_AXES = np.arange(3)


def heat_matrix(weights: FloatArray) -> FloatArray:
    """Return heating powers, given as a matrix (3, 3) or its diagonal (3,), as a matrix (3, 3)."""
    return np.diag(weights) if weights.ndim == 1 else weights


def mean_squares(dipoles: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the means (k,) of m' W m over each of the k intervals between dipoles m (k + 1, 3).

    Within an interval, the dipole is a linear function of time. W is the matrix `weights` (3, 3).
    """
    left, right = dipoles[:-1], dipoles[1:]
    return np.asarray(((left @ weights) * (left + right) + (right @ weights) * right).sum(axis=1) / 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class SlewCraft:
    """The satellite as modelled by the slew planner, in body axes.

    Attributes:
        inertia: inertia tensor (3, 3), kg m^2.
        limit: dipole limit (3,) along each body axis, A m^2.
        weights: heating power per squared dipole moment (3, 3), W/(A m^2)^2, or its diagonal (3,).
        residual: residual dipole moment (3,) of the satellite, A m^2.
        torque, air, light: components (3,) of the constant, aerodynamic and solar radiation torque, N m.
    """

    inertia: FloatArray
    limit: FloatArray
    weights: FloatArray
    residual: FloatArray = field(default_factory=lambda: np.zeros(3))
    torque: FloatArray = field(default_factory=lambda: np.zeros(3))
    air: FloatArray = field(default_factory=lambda: np.zeros(3))
    light: FloatArray = field(default_factory=lambda: np.zeros(3))

    def facing(self, sizes: FloatArray) -> SlewCraft:
        """Return the satellite model with the disturbance torque components `sizes` (9,), N m."""
        return replace(self, torque=sizes[CONSTANT], air=sizes[AIR], light=sizes[LIGHT])


@dataclass(frozen=True, slots=True, eq=False)
class SlewEnvironment:
    """The magnetic field (n, 3), T, and the position (n, 3), m, of the body at n times, in ICRS axes.

    The pressure vectors of air and sunlight are None if their torques are not modelled.
    """

    field: FloatArray
    position: FloatArray
    pressures: Pressures | None = None

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return unit vectors (n, 3) along the positions, and gravity gradients 3 mu / r^3 (n,), 1/s^2."""
        radius = np.linalg.norm(self.position, axis=1)
        return self.position / radius[:, None], 3.0 * GRAVITATIONAL_PARAMETER / radius**3


EnvironmentAt = Callable[[FloatArray], SlewEnvironment]
"""Function that returns the environment at times (n,), s after the start of a slew."""


def shown(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the components A(q) v (n, 3) of vectors v in body axes.

    If q is not a unit quaternion, the result is that of the normalised quaternion multiplied by |q|^2.
    """
    v, s = q[:, :3], q[:, 3:]
    inner = np.sum(v * vector, axis=1, keepdims=True)
    square = s * s - np.sum(v * v, axis=1, keepdims=True)
    return np.asarray(square * vector + 2.0 * inner * v - 2.0 * s * cross(v, vector))


def shown_curvature(pull: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the second derivatives (n, 4, 4) with respect to q of the scalar products of `pull` and A(q) v.

    The vectors are `pull` (n, 3) and v = `vector` (n, 3). Each second derivative is twice Davenport's matrix
    of the two vectors.
    """
    curvature = np.empty((len(pull), 4, 4))
    outer = pull[:, :, None] * vector[:, None, :]
    inner = np.sum(pull * vector, axis=1)
    curvature[:, :3, :3] = outer + outer.transpose(0, 2, 1) - inner[:, None, None] * _EYE3
    curvature[:, :3, 3] = curvature[:, 3, :3] = cross(pull, vector)
    curvature[:, 3, 3] = inner
    return 2.0 * curvature


class SlewDynamics:
    """The equations of motion of a satellite at n times, with times in `scale` s and dipoles in `unit` A m^2.

    The derivative x' of the state x = (q, w) is a constant plus the quadratic form z^T H z / 2 of z = (m +
    residual, b, e, w, q). The dipole m, the magnetic field b, the scaled position direction e and the rate w
    are in body axes, and b and e are quadratic in the attitude q. One matrix product gives all derivatives.
    """

    def __init__(self, craft: SlewCraft, scale: float, unit: float, around: SlewEnvironment) -> None:
        """Store the environment. The position direction is multiplied by the root of the gravity gradient."""
        self._residual = craft.residual / unit
        down, strength = around.gradient()
        vectors = np.stack(
            [scale**2 * unit * around.field, (scale * np.sqrt(strength))[:, None] * down], axis=1
        )
        axes = np.broadcast_to(_EYE3, (len(down), 2, 3, 3)).reshape(-1, 3)
        forms = shown_curvature(axes, np.repeat(vectors.reshape(-1, 3), 3, axis=0))
        self._forms = forms.reshape(-1, 6, 4, 4)
        self._constant = np.concatenate(
            [np.zeros(4), scale**2 * np.linalg.solve(craft.inertia, craft.torque)]
        )
        self._pushes = scale**2 * _pushes(craft, around)
        self._quadratic = _quadratic(craft.inertia)
        self._parts = np.zeros((len(down), _Z, 10))
        for part, columns in ((_M, _DIPOLE), (_W, _RATE), (_Q, _ATTITUDE)):
            self._parts[:, part, columns] = np.eye(part.stop - part.start)

    def part(self, which: slice) -> SlewDynamics:
        """Return the equations of motion at the times that the slice `which` selects."""
        found = copy(self)
        found._forms, found._pushes = self._forms[which], self._pushes[which]
        found._parts = self._parts[which]
        return found

    def field(self, q: FloatArray) -> FloatArray:
        """Return the scaled magnetic field b (n, 3), body axes, at attitudes (n, 4)."""
        return np.asarray(0.5 * np.einsum("nijk,nj,nk->ni", self._forms[:, :3], q, q))

    def flow(self, x: FloatArray, m: FloatArray) -> FloatArray:
        """Return the time derivatives x' (n, 7) of states (n, 7) for dipoles (n, 3)."""
        z, _ = self._quantities(x, m)
        result = 0.5 * np.einsum("nij,nj->ni", self._steepness(z), z) + self._constant
        q = x[:, None, :4, None]
        result[:, 4:] += 0.5 * (x[:, None, None, :4] @ self._pushes @ q)[:, :, 0, 0]
        return np.asarray(result)

    def slopes(self, x: FloatArray, m: FloatArray) -> FloatArray:
        """Return the derivatives (n, 7, 10) of x' with respect to states and dipoles."""
        z, turned = self._quantities(x, m)
        result = self._steepness(z) @ self._by_unknowns(turned)
        result[:, 4:, :4] += (self._pushes @ x[:, None, :4, None])[:, :, :, 0]
        return np.asarray(result)

    def curvature(self, x: FloatArray, m: FloatArray, y: FloatArray) -> FloatArray:
        """Return the second derivatives (n, 10, 10) of y^T x' with respect to states and dipoles.

        The vectors `y` (n, 7) are the weights of the components of the state derivatives x'.
        """
        z, turned = self._quantities(x, m)
        bend = (y @ self._quadratic.reshape(7, -1)).reshape(-1, _Z, _Z)
        parts = self._by_unknowns(turned)
        result = parts.transpose(0, 2, 1) @ (bend @ parts)
        pull = (bend @ z[:, :, None])[:, _BE]
        result[:, :4, :4] += np.sum(pull[:, :, :, None] * self._forms, axis=1)
        result[:, :4, :4] += np.sum(y[:, 4:, None, None] * self._pushes, axis=1)
        return np.asarray(result)

    def _quantities(self, x: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the vectors z (n, 16), and the derivatives (n, 6, 4) of b and e with respect to q."""
        z, q = np.empty((len(x), _Z)), x[:, :4]
        turned = (self._forms.reshape(-1, 24, 4) @ q[:, :, None]).reshape(-1, 6, 4)
        z[:, _M], z[:, _W], z[:, _Q] = m + self._residual, x[:, 4:], q
        z[:, _BE] = 0.5 * (turned @ q[:, :, None])[:, :, 0]
        return z, turned

    def _steepness(self, z: FloatArray) -> FloatArray:
        """Return the derivatives (n, 7, 16) of x' with respect to the vectors z (n, 16)."""
        return np.asarray((z @ self._quadratic.reshape(-1, _Z).T).reshape(-1, 7, _Z))

    def _by_unknowns(self, turned: FloatArray) -> FloatArray:
        """Return the derivatives (n, 16, 10) of the vectors z with respect to states and dipoles.

        The next call overwrites the returned array.
        """
        self._parts[:, _BE, _ATTITUDE] = turned
        return self._parts


_Z = 16
_M, _B, _E, _W, _Q, _BE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 16), slice(3, 9)
_ATTITUDE, _RATE, _DIPOLE = slice(0, 4), slice(4, 7), slice(7, 10)


def _pushes(craft: SlewCraft, around: SlewEnvironment) -> FloatArray:
    """Return the second derivatives (n, 3, 4, 4), with respect to q, of accelerations by air and sunlight."""
    count = len(around.field)
    result = np.zeros((count, 3, 4, 4))
    if around.pressures is not None:
        for size, pressure in ((craft.air, around.pressures.air), (craft.light, around.pressures.light)):
            # The rows are the derivatives of the acceleration with respect to the pressure vector.
            rows = np.linalg.solve(craft.inertia, cross_matrices(size[None])[0])
            for row, pull in enumerate(rows):
                result[:, row] += shown_curvature(np.broadcast_to(pull, (count, 3)), pressure)
    return result


def _quadratic(inertia: FloatArray) -> FloatArray:
    """Return the symmetric matrices H (7, 16, 16) of the quadratic forms z^T H z / 2 in x'."""
    result = np.zeros((7, _Z, _Z))
    crossed = -cross_matrices(_EYE3)  # a . crossed[i] c is component i of a x c
    result[:3, _Q, _W][:, :3] = 0.5 * crossed
    result[_AXES, 15, 9 + _AXES] = 0.5
    result[3, 12 + _AXES, 9 + _AXES] = -0.5
    spun = np.linalg.inv(inertia) @ crossed.reshape(3, 9)
    result[4:, _M, _B] = spun.reshape(3, 3, 3)
    result[4:, _E, _E] = spun.reshape(3, 3, 3) @ inertia
    result[4:, _W, _W] = -spun.reshape(3, 3, 3) @ inertia
    return result + result.transpose(0, 2, 1)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross products a x b (n, 3), several times as fast as `np.cross`."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


@dataclass(frozen=True, slots=True, eq=False)
class HermiteCubic:
    """A curve through `values` (n, k) with `slopes` (n, k) at increasing `times` (n,), n > 1.

    At times outside the given range, the first or the last cubic is extrapolated.
    """

    times: FloatArray
    values: FloatArray
    slopes: FloatArray

    def __call__(self, times: FloatArray) -> FloatArray:
        """Return the interpolated values (m, k) at `times` (m,)."""
        s, span, start, step, out, into = self._parts(times)
        bend = (1.0 - s) * (span * out - step) + s * (step - span * into)
        return np.asarray(start + s * step + s * (1.0 - s) * bend)

    def derivative(self, times: FloatArray) -> FloatArray:
        """Return the slopes (m, k) of the curve at `times` (m,)."""
        s, span, _, step, out, into = self._parts(times)
        mean = 6.0 * s * (1.0 - s) * step / span
        return np.asarray(mean + (1.0 - s) * (1.0 - 3.0 * s) * out + s * (3.0 * s - 2.0) * into)

    def _parts(self, times: FloatArray) -> tuple[FloatArray, ...]:
        """Return the position (0 to 1) of each time in its interval, and data of the interval.

        The interval lies between two knots of the curve. The data are the length, the first value, the change
        of the value, and the slopes at both ends.
        """
        at = np.asarray(times, dtype=float)
        before = np.clip(np.searchsorted(self.times, at, side="right") - 1, 0, len(self.times) - 2)
        span = (self.times[before + 1] - self.times[before])[:, None]
        share = (at - self.times[before])[:, None] / span
        start = self.values[before]
        step = self.values[before + 1] - start
        return share, span, start, step, self.slopes[before], self.slopes[before + 1]


@dataclass(frozen=True, slots=True, eq=False)
class SlewPath:
    """The path of a slew, given at times (n,), s, from zero on and interpolated by the collocation cubics.

    The attitudes (n, 4) rotate ICRS into body axes. Rates (n, 3), rad/s, angular accelerations (n, 3),
    rad/s^2, and dipole moments (n, 3), A m^2, are in body axes. The dipole moments are linear between the
    times.
    """

    times: FloatArray
    quaternion: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    dipole: FloatArray

    @property
    def horizon(self) -> float:
        """The duration, s."""
        return float(self.times[-1])

    def heat(self, weights: FloatArray) -> float:
        """Return the heat (J) for heating powers (3, 3) or (3,), W/(A m^2)^2, per squared dipole moment."""
        return float(np.diff(self.times) @ mean_squares(self.dipole, heat_matrix(weights)))

    def since(self, time: float, nodes: int) -> SlewPath:
        """Return the part of the path after a given time (s), which becomes the new time zero."""
        times = np.linspace(0.0, self.horizon - time, 2 * nodes + 1)
        found = self.references(np.minimum(time + times, self.horizon))
        dipole = self.dipoles(np.minimum(time + times, self.horizon))
        return SlewPath(times, found.quaternion, found.rate, found.acceleration, dipole)

    def references(self, times: FloatArray) -> AttitudeReferences:
        """Return the commanded motion at times (m,) s.

        The body rests at the first attitude before the path, and at the last attitude after the path.
        """
        inside = np.clip(times, 0.0, self.horizon)
        turning = HermiteCubic(self.times, self.rate, self.acceleration)
        spin = np.concatenate([self.rate, np.zeros((len(self.times), 1))], axis=1)
        v, s = self.quaternion[:, :3], self.quaternion[:, 3:]
        slope = np.empty_like(self.quaternion)
        slope[:, :3] = 0.5 * (np.cross(v, spin[:, :3]) + s * spin[:, :3])
        slope[:, 3] = -0.5 * np.sum(v * spin[:, :3], axis=1)
        attitude = normalise(HermiteCubic(self.times, self.quaternion, slope)(inside))
        flying = ((times >= 0.0) & (times <= self.horizon))[:, None]
        return AttitudeReferences(
            np.asarray(times, dtype=float),
            attitude,
            np.where(flying, turning(inside), 0.0),
            np.where(flying, turning.derivative(inside), 0.0),
        )

    def dipoles(self, times: FloatArray) -> FloatArray:
        """Return the dipole moments (m, 3), A m^2, at times (m,), s, or zero before and after the path."""
        found = [np.interp(times, self.times, part, left=0.0, right=0.0) for part in self.dipole.T]
        return np.stack(found, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """An exclusion cone: body `axis` (3,) stays at least `angle` rad away from a celestial body.

    The function `direction` returns unit vectors (n, 3) along the axis of the cone, ICRS, for times (n,), s,
    after the start of the slew. The angle is measured from this direction or, if `radius` is given, from the
    edge of a disc about it. The function `radius` returns the angular radii (n,) of the disc, rad.
    """

    name: str
    axis: FloatArray
    direction: Callable[[FloatArray], FloatArray]
    angle: float
    radius: Callable[[FloatArray], FloatArray] | None = None

    def half_angles(self, times: FloatArray) -> FloatArray:
        """Return the half angles (n,) of the cone, rad, at times (n,), s."""
        angles = np.full(len(times), self.angle)
        return angles if self.radius is None else np.asarray(angles + self.radius(times))

    def clearance(self, q: FloatArray, times: FloatArray) -> FloatArray:
        """Return the angles (n,), rad, from the cone to the axis at attitudes (n, 4).

        The angle is negative if the axis lies inside the cone.
        """
        cosine = shown(q, self.direction(times)) @ self.axis / np.sum(q * q, axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) - self.half_angles(times))


class ConeConstraints:
    """Exclusion cones at n times, expressed as inequalities g >= 0 for the attitude.

    The constraint value g is the cosine of the cone's half angle minus the cosine of the angle between body
    axis and direction. Each inequality is a quadratic form of the attitude quaternion.
    """

    def __init__(self, cones: tuple[Cone, ...], margin: FloatArray, times: FloatArray) -> None:
        """Set up cones widened by `margin`, because a path is checked only at `times` (n,), s.

        The margin (rad) is a scalar or an array (cones, n).
        """
        angles = np.array([cone.half_angles(times) for cone in cones]).reshape(-1, len(times)) + margin
        self._limits = np.cos(np.clip(angles, 0.0, np.pi))
        self.count, size = len(cones), len(times)
        found = [
            -shown_curvature(np.broadcast_to(cone.axis, (size, 3)), cone.direction(times)) for cone in cones
        ]
        self.curvatures = np.array(found).reshape(self.count, size, 4, 4)
        """Second derivatives (cones, n, 4, 4) of the cone constraints with respect to the attitude."""

    def values(self, q: FloatArray) -> FloatArray:
        """Return the values g (cones, n) at attitudes (n, 4), or g (m, cones, n) for m paths (m, 1, n, 4)."""
        return np.asarray(self._limits + 0.5 * np.sum(self.slopes(q) * q, axis=-1))

    def slopes(self, q: FloatArray) -> FloatArray:
        """Return the derivatives (cones, n, 4) of the constraints g with respect to the attitude."""
        return np.asarray((self.curvatures @ q[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeEnd:
    """End of a slew at a given attitude (4,), ICRS into body, with a body rate (3,), rad/s, ICRS axes."""

    quaternion: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return True, because an attitude with zero error is the target attitude."""
        return True

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear part (3, 4) and the quadratic part (3, 4, 4), in q, of the attitude error.

        The attitude error is the vector part of the product of q and the inverse of the target quaternion.
        """
        v, s = self.quaternion[:3], self.quaternion[3]
        linear = np.concatenate([s * np.eye(3) + cross_matrices(v[None])[0], -v[:, None]], axis=1)
        return linear, np.zeros((3, 4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class BoresightEnd:
    """End of a slew at which body `axis` (3,) points to `direction` (3,), ICRS, with an arbitrary roll.

    The body rate at the end, with all three components, is `rate` (3,), rad/s, ICRS axes.
    """

    axis: FloatArray
    direction: FloatArray
    rate: FloatArray

    def is_met(self, q: FloatArray) -> bool:
        """Return whether the boresight points along the direction if the attitude `q` (4,) has zero error.

        The sines of the pointing error are also zero if the boresight is opposite to the direction.
        """
        return float(self.axis @ shown(q[None], self.direction[None])[0]) > 0.0

    def misses(self) -> tuple[FloatArray, FloatArray]:
        """Return the linear (2, 4) and quadratic part (2, 4, 4), in q, of the sines of the pointing error."""
        across = tangent_basis(self.axis)
        return np.zeros((2, 4)), shown_curvature(across, np.broadcast_to(self.direction, (2, 3)))


End = AttitudeEnd | BoresightEnd
EndLaw = Callable[[float], End]
"""Function that returns the end conditions of a slew for the duration of the slew, s."""


class EndConditions:
    """The attitude error and the rate error of a state (7,) relative to the end of a slew."""

    def __init__(self, end: End, scale: float) -> None:
        """Set up the error equations for `end`, with times in units of `scale` s."""
        linear, forms = end.misses()
        self.count = len(linear) + 3
        self._linear = np.zeros((self.count, 7))
        self._linear[:-3, :4], self._linear[-3:, 4:] = linear, np.eye(3)
        turning = shown_curvature(np.eye(3), np.broadcast_to(-scale * end.rate, (3, 3)))
        self._forms = np.concatenate([forms, turning])

    def miss(self, x: FloatArray) -> FloatArray:
        """Return the attitude and rate errors (n,) of a state (7,)."""
        return np.asarray(self._linear @ x + 0.5 * (self._forms @ x[:4]) @ x[:4])

    def slope(self, x: FloatArray) -> FloatArray:
        """Return the derivatives (n, 7) of the errors with respect to the state."""
        result = self._linear.copy()
        result[:, :4] += self._forms @ x[:4]
        return result

    def curvature(self, pull: FloatArray) -> FloatArray:
        """Return the second derivatives (4, 4), with respect to q, of the weighted sum of the errors.

        The weights are the elements of `pull` (n,).
        """
        return np.asarray(np.tensordot(pull, self._forms, 1))


def along(
    ephemeris: Ephemeris, begin: float, areas: FloatArray | None = None, path: SlewPath | None = None
) -> EnvironmentAt:
    """Return the environment of a slew that starts `begin` s after the start of the ephemeris.

    If `areas` (3,) and `path` are given, the environment includes the pressure vectors of air and sunlight
    for the areas that a body on this path exposes.
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

    The angles `sun` and `moon` are measured from the centre of the disc, and `earth` from the Earth's limb.
    The Moon is assumed to move on a straight line; after six hours, its direction is wrong by 0.1 deg.
    """
    date = float(terrestrial_time(ephemeris.julian_date + begin / DAY))
    moon = erfa.moon98(date, 0.0)

    def towards_earth(times: FloatArray) -> FloatArray:
        position = ephemeris.position_at(begin + times)
        return np.asarray(-position / np.linalg.norm(position, axis=1, keepdims=True))

    def limb(times: FloatArray) -> FloatArray:
        distance = np.linalg.norm(ephemeris.position_at(begin + times), axis=1)
        return np.asarray(np.arcsin(np.minimum(1.0, EARTH_RADIUS / distance)))

    def towards_moon(times: FloatArray) -> FloatArray:
        at = ASTRONOMICAL_UNIT * (moon["p"] + times[:, None] / DAY * moon["v"])
        away = at - ephemeris.position_at(begin + times)
        return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))

    known = {
        "sun": (lambda times: ephemeris.sun_at(begin + times), None),
        "earth": (towards_earth, limb),
        "moon": (towards_moon, None),
    }
    return tuple(
        Cone(name.capitalize(), axis, known[name][0], angle, known[name][1]) for name, angle in angles.items()
    )


NODES = 24
"""Default number of collocation intervals. The heat of a slew differs by less than 0.1 % from the heat on 48
intervals, and the shortest duration by less than 0.6 %."""
NODES_RANGE = (8, 96)
HORIZON_RANGE = (1.0, 2e4)
_DEEP, _STILL, _CHECKED_ENDS = math.radians(5.0), 1e-4, 65
"""Depth (rad) inside an exclusion cone above which an end attitude is rejected, end rate (rad/s) below which
the end attitude counts as fixed and is checked, and number of checked durations. A task is rejected if its
end attitude is too deep for all of these durations."""
MINIMUM_TIME = math.inf
"""Value of `time_cost` that requests a minimum-time slew, for which only the duration is minimised."""


@dataclass(frozen=True, slots=True, eq=False)
class SlewTask:
    """The task of the slew planner: satellite, environment, start, end and limits of a slew.

    Attributes:
        craft: model of the satellite.
        along: function that returns the environment at times (n,), s after the start of the slew.
        quaternion, rate: attitude (4,) from ICRS into body axes and body rate (3,), rad/s, at the start.
        end: end conditions as a function of the slew's duration.
        horizon, longest: requested and longest permitted duration, s. The duration is extended if no path of
            the requested duration is found.
        time_cost: weight of the duration in the cost, W. If the time cost is None, the duration is not
            optimised; if it is MINIMUM_TIME, only the duration is minimised.
        cones: exclusion cones that are avoided throughout the slew.
        nodes: number of collocation intervals, which is one less than the number of nodes.
    """

    craft: SlewCraft
    along: EnvironmentAt
    quaternion: FloatArray
    rate: FloatArray
    end: EndLaw
    horizon: float
    longest: float
    time_cost: float | None = None
    cones: tuple[Cone, ...] = ()
    nodes: int = NODES


def check(task: SlewTask) -> None:
    """Raise PlanningError for invalid values, and for a start or end that an exclusion cone prohibits."""
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
        raise PlanningError("the values of the satellite and of the initial state must be finite")
    if abs(float(np.linalg.norm(task.quaternion)) - 1.0) > 1e-6:
        raise PlanningError(f"the start quaternion {task.quaternion} must have length 1")
    if not np.all(craft.limit > 0.0):
        raise PlanningError(f"the dipole limits are {craft.limit.tolist()} A m^2: all must be above zero")
    if np.linalg.eigvalsh(heat_matrix(craft.weights)).min() <= 0.0:
        raise PlanningError("the heating power of every dipole moment must be above zero")
    if np.linalg.eigvalsh(craft.inertia).min() <= 0.0:
        raise PlanningError("the inertia must be positive definite")
    low, high = HORIZON_RANGE
    if not low <= task.horizon <= task.longest <= high:
        raise PlanningError(
            f"horizon {task.horizon:g} s, longest {task.longest:g} s: must satisfy {low:g} <= horizon <= "
            f"longest <= {high:g} s"
        )
    if not NODES_RANGE[0] <= task.nodes <= NODES_RANGE[1]:
        raise PlanningError(f"nodes is {task.nodes}: must be {NODES_RANGE[0]} to {NODES_RANGE[1]}")
    if task.time_cost is not None and not task.time_cost > 0.0:
        raise PlanningError(f"the cost of time is {task.time_cost} W: it must be positive")
    _check_cones(task)


def _check_cones(task: SlewTask) -> None:
    """Raise PlanningError for a start inside an exclusion cone, or an end at rest deep inside a cone."""
    end = task.end(task.horizon)
    for cone in task.cones:
        inside = -math.degrees(float(cone.clearance(task.quaternion[None], np.zeros(1))[0]))
        if inside > 0.0:
            raise PlanningError(
                f"the start lies {inside:.1f} deg inside the exclusion cone of the {cone.name}: choose "
                "another start or time, or a smaller cone"
            )
        if isinstance(end, AttitudeEnd) and float(np.abs(end.rate).max()) < _STILL:
            shortest = task.horizon if task.time_cost is None else HORIZON_RANGE[0]
            times = np.linspace(shortest, task.longest, _CHECKED_ENDS)
            clearance = cone.clearance(np.tile(end.quaternion, (len(times), 1)), times)
            if float(clearance.max()) >= -_DEEP:
                continue
            raise PlanningError(
                f"the end lies inside the exclusion cone of the {cone.name}: choose another goal or a "
                "smaller cone"
            )


def blocking_cone(task: SlewTask, horizon: float) -> Cone | None:
    """Return an exclusion cone that contains the end attitude of a slew of `horizon` s, or None.

    If only the direction of a boresight is given at the end, a cone is returned that contains the end
    attitude at every roll.
    """
    end, time = task.end(horizon), np.array([horizon])
    if isinstance(end, AttitudeEnd):
        shown = end.quaternion[None]
        return next((cone for cone in task.cones if float(cone.clearance(shown, time)[0]) < 0.0), None)
    for cone in task.cones:
        # If one of two directions rotates about an axis, the largest angle between the two directions is the
        # sum of the angles between each direction and the axis.
        pairs = ((end.axis, cone.axis), (end.direction, cone.direction(time)[0]))
        apart = sum(math.acos(min(max(float(one @ other), -1.0), 1.0)) for one, other in pairs)
        if min(apart, 2.0 * math.pi - apart) < float(cone.half_angles(time)[0]):
            return cone
    return None
