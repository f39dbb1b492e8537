"""The motion of a satellite with coils for the slew planner, its derivatives, and the path of a slew in time.

State (7,): attitude and body rate; control (3,): the coils' dipole. With b = A(q) B and e = A(q) r:

    q' = 1/2 [w, 0] q,    J w' = (m + residual) x b + 3 mu / r^3 e x J e + d - w x J w

where d are the torques of `knightcube.astro.earth.disturbance`: one constant in body axes, and those of air
and sunlight, c x A(q) v, which rotate with the body.

The torque has no component along the field, so only some paths are feasible. All derivatives are exact:
A(q) v is a quadratic form of q, with Davenport's matrix as its curvature.

Paths are cubic Hermite curves (de Boor 1978, ch. IV), evaluated here because scipy.interpolate would cost
each process that flies or plans a slew 20 MiB for two formulas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.directions import cross_matrices
from knightcube.astro.earth.disturbance import AIR, CONSTANT, LIGHT, Pressures
from knightcube.astro.earth.figure import GRAVITATIONAL_PARAMETER
from knightcube.astro.quaternion import normalise
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeReferences

_EYE3: FloatArray = np.eye(3)
_AXES = np.arange(3)


@dataclass(frozen=True, slots=True, eq=False)
class SlewCraft:
    """The satellite as modelled by the slew planner, in body axes.

    Attributes:
        inertia: (3, 3) kg m^2.
        limit: (3,) A m^2, of each coil.
        weights: (3,) W/(A m^2)^2, heat of each coil per square of its dipole.
        residual: (3,) A m^2, the residual dipole of the satellite.
        torque, air, light: (3,) N m, sizes of the disturbance torques: constant, by air, by sunlight.
    """

    inertia: FloatArray
    limit: FloatArray
    weights: FloatArray
    residual: FloatArray = field(default_factory=lambda: np.zeros(3))
    torque: FloatArray = field(default_factory=lambda: np.zeros(3))
    air: FloatArray = field(default_factory=lambda: np.zeros(3))
    light: FloatArray = field(default_factory=lambda: np.zeros(3))

    def facing(self, sizes: FloatArray) -> SlewCraft:
        """Return the satellite with disturbance torques of the given sizes (9,) N m."""
        return replace(self, torque=sizes[CONSTANT], air=sizes[AIR], light=sizes[LIGHT])


@dataclass(frozen=True, slots=True, eq=False)
class SlewEnvironment:
    """The environment of the body at n times, in ICRS axes.

    Attributes:
        field: (n, 3) T.
        position: (n, 3) m.
        pressures: of air and sunlight; None for neither.
    """

    field: FloatArray
    position: FloatArray
    pressures: Pressures | None = None

    def part(self, which: IntArray) -> SlewEnvironment:
        """Return the environment at the times of the index array `which`."""
        found = self.pressures
        pressed = None if found is None else Pressures(found.air[which], found.light[which])
        return SlewEnvironment(self.field[which], self.position[which], pressed)

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return the directions (n, 3) of the position, and 3 mu / r^3 (n,) 1/s^2."""
        radius = np.linalg.norm(self.position, axis=1)
        return self.position / radius[:, None], 3.0 * GRAVITATIONAL_PARAMETER / radius**3


EnvironmentAt = Callable[[FloatArray], SlewEnvironment]
"""Function from times (n,), s after the start of a slew, to the environment."""


def shown(q: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the body components A(q) v (n, 3).

    Off the unit sphere they grow with |q|^2.
    """
    v, s = q[:, :3], q[:, 3:]
    inner = np.sum(v * vector, axis=1, keepdims=True)
    square = s * s - np.sum(v * v, axis=1, keepdims=True)
    return np.asarray(square * vector + 2.0 * inner * v - 2.0 * s * cross(v, vector))


def shown_curvature(pull: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the second derivative (n, 4, 4) of pull . A(q) v by q, twice Davenport's matrix."""
    curvature = np.empty((len(pull), 4, 4))
    outer = pull[:, :, None] * vector[:, None, :]
    inner = np.sum(pull * vector, axis=1)
    curvature[:, :3, :3] = outer + outer.transpose(0, 2, 1) - inner[:, None, None] * _EYE3
    curvature[:, :3, 3] = curvature[:, 3, :3] = cross(pull, vector)
    curvature[:, 3, 3] = inner
    return 2.0 * curvature


class SlewDynamics:
    """The motion of one satellite at n times, in units of `scale` s and of `unit` A m^2.

    With z = (m + residual, b, e, w, q), where b and e are quadratic in q, all terms of x' except a constant
    are quadratic in z: 1/2 z . H z. One product therefore gives the derivatives at all times at once.
    """

    def __init__(self, craft: SlewCraft, scale: float, unit: float, around: SlewEnvironment) -> None:
        """Store the environment at the n times; e is scaled with the strength of the gravity gradient."""
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
        for part, place in ((_M, _DIPOLE), (_W, _RATE), (_Q, _ATTITUDE)):
            self._parts[:, part, place] = np.eye(part.stop - part.start)

    def field(self, q: FloatArray) -> FloatArray:
        """Return the field b (n, 3) at attitudes (n, 4), in the units of the motion and body axes."""
        return np.asarray(0.5 * np.einsum("nijk,nj,nk->ni", self._forms[:, :3], q, q))

    def flow(self, x: FloatArray, m: FloatArray) -> FloatArray:
        """Return x' (n, 7) at states (n, 7) and dipoles (n, 3)."""
        z, _ = self._quantities(x, m)
        result = 0.5 * np.einsum("nij,nj->ni", self._steepness(z), z) + self._constant
        q = x[:, None, :4, None]
        result[:, 4:] += 0.5 * (x[:, None, None, :4] @ self._pushes @ q)[:, :, 0, 0]
        return np.asarray(result)

    def slopes(self, x: FloatArray, m: FloatArray) -> FloatArray:
        """Return the derivatives (n, 7, 10) of x' by the state and the dipole."""
        z, turned = self._quantities(x, m)
        result = self._steepness(z) @ self._by_unknowns(turned)
        result[:, 4:, :4] += (self._pushes @ x[:, None, :4, None])[:, :, :, 0]
        return np.asarray(result)

    def curvature(self, x: FloatArray, m: FloatArray, y: FloatArray) -> FloatArray:
        """Return the second derivative (n, 10, 10) of y . x' by state and dipole, for `y` (n, 7)."""
        z, turned = self._quantities(x, m)
        bend = (y @ self._quadratic.reshape(7, -1)).reshape(-1, _Z, _Z)
        parts = self._by_unknowns(turned)
        result = parts.transpose(0, 2, 1) @ (bend @ parts)
        pull = (bend @ z[:, :, None])[:, _BE]
        result[:, :4, :4] += np.sum(pull[:, :, :, None] * self._forms, axis=1)
        result[:, :4, :4] += np.sum(y[:, 4:, None, None] * self._pushes, axis=1)
        return np.asarray(result)

    def _quantities(self, x: FloatArray, m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z (n, 16), and the derivative (n, 6, 4) of b and e by the attitude."""
        z, q = np.empty((len(x), _Z)), x[:, :4]
        turned = (self._forms.reshape(-1, 24, 4) @ q[:, :, None]).reshape(-1, 6, 4)
        z[:, _M], z[:, _W], z[:, _Q] = m + self._residual, x[:, 4:], q
        z[:, _BE] = 0.5 * (turned @ q[:, :, None])[:, :, 0]
        return z, turned

    def _steepness(self, z: FloatArray) -> FloatArray:
        """Return the derivative (n, 7, 16) of x' by z."""
        return np.asarray((z @ self._quadratic.reshape(-1, _Z).T).reshape(-1, 7, _Z))

    def _by_unknowns(self, turned: FloatArray) -> FloatArray:
        """Return the derivative (n, 16, 10) of z by state and dipole.

        The next call overwrites the array.
        """
        self._parts[:, _BE, _ATTITUDE] = turned
        return self._parts


_Z = 16
_M, _B, _E, _W, _Q, _BE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 16), slice(3, 9)
_ATTITUDE, _RATE, _DIPOLE = slice(0, 4), slice(4, 7), slice(7, 10)


def _pushes(craft: SlewCraft, around: SlewEnvironment) -> FloatArray:
    """Return the second derivatives (n, 3, 4, 4) by the attitude of the accelerations by air and sunlight."""
    count = len(around.field)
    result = np.zeros((count, 3, 4, 4))
    if around.pressures is not None:
        for size, pressure in ((craft.air, around.pressures.air), (craft.light, around.pressures.light)):
            rows = np.linalg.solve(craft.inertia, cross_matrices(size[None])[0])  # by the direction
            for row, pull in enumerate(rows):
                result[:, row] += shown_curvature(np.broadcast_to(pull, (count, 3)), pressure)
    return result


def _quadratic(inertia: FloatArray) -> FloatArray:
    """Return the symmetric H (7, 16, 16): x' is 1/2 z . H z plus the constant torque's acceleration."""
    result = np.zeros((7, _Z, _Z))
    crossed = -cross_matrices(_EYE3)  # crossed[i] . (a, c) is the part i of a x c
    result[:3, _Q, _W][:, :3] = 0.5 * crossed
    result[_AXES, 15, 9 + _AXES] = 0.5
    result[3, 12 + _AXES, 9 + _AXES] = -0.5
    spun = np.linalg.inv(inertia) @ crossed.reshape(3, 9)
    result[4:, _M, _B] = spun.reshape(3, 3, 3)
    result[4:, _E, _E] = spun.reshape(3, 3, 3) @ inertia
    result[4:, _W, _W] = -spun.reshape(3, 3, 3) @ inertia
    return result + result.transpose(0, 2, 1)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b (n, 3); several times as fast as `np.cross`."""
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

    Times outside extrapolate the first or the last cubic.
    """

    times: FloatArray
    values: FloatArray
    slopes: FloatArray

    def __call__(self, times: FloatArray) -> FloatArray:
        """Return the values (m, k) at `times` (m,)."""
        s, span, start, step, out, into = self._parts(times)
        bend = (1.0 - s) * (span * out - step) + s * (step - span * into)
        return np.asarray(start + s * step + s * (1.0 - s) * bend)

    def derivative(self, times: FloatArray) -> FloatArray:
        """Return the slopes (m, k) at `times` (m,)."""
        s, span, _, step, out, into = self._parts(times)
        mean = 6.0 * s * (1.0 - s) * step / span
        return np.asarray(mean + (1.0 - s) * (1.0 - 3.0 * s) * out + s * (3.0 * s - 2.0) * into)

    def _parts(self, times: FloatArray) -> tuple[FloatArray, ...]:
        """Return per time: share of its span, length of the span, start value, step, and both slopes."""
        at = np.asarray(times, dtype=float)
        before = np.clip(np.searchsorted(self.times, at, side="right") - 1, 0, len(self.times) - 2)
        span = (self.times[before + 1] - self.times[before])[:, None]
        share = (at - self.times[before])[:, None] / span
        start = self.values[before]
        step = self.values[before + 1] - start
        return share, span, start, step, self.slopes[before], self.slopes[before + 1]


@dataclass(frozen=True, slots=True, eq=False)
class SlewPath:
    """The path of a slew from time 0 to its last time; between the times it is the cubic of the collocation.

    Attributes:
        times: (n,) s.
        quaternion: (n, 4) ICRS into body.
        rate: (n, 3) rad/s, body axes.
        acceleration: (n, 3) rad/s^2, body axes.
        dipole: (n, 3) A m^2, body axes, linear between the times.
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

    def references(self, times: FloatArray) -> AttitudeReferences:
        """Return the commanded motion at times (m,) s.

        Outside the path the attitude is that of the nearer end, and the body is at rest.
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
        """Return the dipoles (m, 3) A m^2 at times (m,) s; zero outside the path."""
        found = [np.interp(times, self.times, part, left=0.0, right=0.0) for part in self.dipole.T]
        return np.stack(found, axis=1)
