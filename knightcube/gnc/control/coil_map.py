"""Dipole moment and torque of a satellite's coils, and the coil currents that produce them.

Column k of the matrix D (3, n) is the dipole moment of coil k per ampere, so the currents i produce the
dipole moment D i. If a satellite has more than three coils, different currents can produce the same dipole
moment. Of all possible currents i, the currents with the least heat i' R i are used, where R is the diagonal
matrix of the coils' resistances. Without current limits, the currents of least heat for a dipole moment m are
P m, with the weighted pseudo-inverse P of D. If an element of P m exceeds the current limit of its coil, the
other coils produce the remainder of the dipole moment. Control laws and planners need only dipole moments in
body axes and one limit per body axis. The limits per body axis define the largest box of dipole moments that
the coils can produce. The heating power of a dipole moment m is m' H m with H = P' R P.

A dipole moment m causes the torque m x B, which has no component along the field B (Wertz 1978, section
18.1). For three equal coils, the smallest dipole moment that produces a torque T normal to B is B x T / B^2.
For any scalar lambda, the dipole moment m + lambda B causes the same torque as m. If one coil has failed,
lambda is chosen so that the failed coil needs no current, which is possible unless the axis of the failed
coil is normal to the field. If the coils cannot produce a requested torque, the function `allocate` projects
the torque onto the space of torques that they can produce. If a current exceeds its limit, one factor scales
all currents. This preserves the direction of the torque (the idea of CMU's Argus flight software).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, brief, finite_array, float_rows
from knightcube.errors import ArgumentError, KnightCubeError, UsageError

_PERMEABILITY = 1e-7
"""Vacuum permeability divided by 4 pi, T m/A."""
_SEGMENTS = 128
"""Number of straight segments that approximate a circular coil."""
LEAST_SPREAD = 0.05
"""Singular value of the unit vectors along the coil axes below which the axes count as coplanar."""
_STEPS = 200
"""Number of iterations that compute the largest box of dipole moments."""
_PARALLEL = 1e-6
"""Sine of the angle between two coil axes below which the coils count as parallel."""
_NEWTON_STEPS, _EXACT = 60, 1e-9
"""Maximum number of Newton steps for limited currents, and tolerance of the resulting dipole moment as a
fraction of the moment."""
_SATURATED = 1e-4
"""Weight in the Newton matrix of a coil at its current limit, relative to a coil below its limit."""
_WEAKEST = 0.15
"""Torque at the current limits below which a torque direction is discarded, as a fraction of the largest such
torque in any direction. A torque in a discarded direction would need the full current, and scaling all
currents to the limit would then reduce the torque in the other directions."""


def coil_field(moment: FloatArray, offset: FloatArray, area: float | None = None) -> FloatArray:
    """Return the magnetic field (3,), T, of a coil with the dipole moment `moment` (3,), A m^2.

    The field is computed at the point with the vector `offset` (3,), m, from the coil's centre. If `area`
    (m^2) is given, the coil is modelled as a circular loop (Biot-Savart law, summed over segments), and
    otherwise as a point dipole.
    """
    size = float(np.linalg.norm(moment))
    axis = moment / size
    if area is None:
        distance = float(np.linalg.norm(offset))
        along = offset / distance
        return np.asarray(_PERMEABILITY * (3.0 * along * (along @ moment) - moment) / distance**3)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    angles = 2.0 * np.pi * np.arange(_SEGMENTS)[:, None] / _SEGMENTS
    radial = np.cos(angles) * across + np.sin(angles) * np.cross(axis, across)
    radius = np.sqrt(area / np.pi)
    elements = np.cross(axis, radial) * (2.0 * np.pi * radius / _SEGMENTS)
    away = offset - radius * radial
    cubes = np.linalg.norm(away, axis=1, keepdims=True) ** 3
    return np.asarray(_PERMEABILITY * size / area * np.sum(np.cross(elements, away) / cubes, axis=0))


def missing_direction(dipoles: FloatArray) -> FloatArray | None:
    """Return the unit vector (3,) normal to coplanar coil axes, or None if the axes span three dimensions.

    Column k of `dipoles` (3, n) is along the axis of coil k. Raises UsageError if all coils are parallel.
    """
    lengths = np.linalg.norm(dipoles, axis=0)
    directions, sizes, _ = np.linalg.svd(dipoles / lengths)
    if dipoles.shape[1] < 2 or sizes[1] < LEAST_SPREAD:
        axis = ", ".join(f"{component:.2f}" for component in dipoles[:, 0] / lengths[0])
        raise UsageError(
            f"all coils lie along [{axis}]: give at least one of them another axis, because parallel coils "
            "can make a torque about only one axis at a time"
        )
    if len(sizes) == 3 and sizes[2] >= LEAST_SPREAD:
        return None
    return np.asarray(directions[:, 2])


class CoilMap:
    """The coils of a satellite.

    Attributes:
        dipoles: dipole moment of each coil per ampere (3, n), m^2, body axes, one column per coil.
        current_limits: largest current of each coil (n,), A.
        resistance: resistance of each coil (n,), ohm.
        limits: largest dipole moment along each body axis (3,), A m^2. The coils can produce all dipole
            moments within the three limits `limits`.
        heat: heating power per squared dipole moment (3, 3), W/(A m^2)^2, body axes, without saturation.
    """

    def __init__(self, dipoles: FloatArray, current_limits: FloatArray, resistance: FloatArray) -> None:
        """Raise UsageError if the coils cannot produce a dipole moment in every direction.

        Raises ArgumentError for arrays of another shape, limits or resistances that are not positive, and a
        coil without dipole moment.
        """
        dipoles = float_rows("dipoles", finite_array("dipoles", dipoles).T, 3).T
        if dipoles.ndim != 2 or not np.any(dipoles, axis=0).all():
            raise ArgumentError(
                "dipoles", f"{brief(dipoles.tolist())}: give one column (3,), not zero, for each coil"
            )
        counts = dipoles.shape[1:]
        current_limits = finite_array("current_limits", current_limits, counts)
        resistance = finite_array("resistance", resistance, counts)
        for name, values in (("current_limits", current_limits), ("resistance", resistance)):
            if not (values > 0.0).all():
                raise ArgumentError(name, f"{values.tolist()}: all must be above zero")
        normal = missing_direction(dipoles)
        if normal is not None:
            axis = ", ".join(f"{component:.2f}" for component in normal)
            raise UsageError(f"the coils lie in one plane and make no dipole along its normal [{axis}]")
        self.dipoles, self.current_limits, self.resistance = dipoles, current_limits, resistance
        self._strength: FloatArray | None = None
        if np.count_nonzero(dipoles) == 3 and dipoles.shape == (3, 3) and np.diag(dipoles).all():
            self._strength = np.diag(dipoles).copy()
        weights = np.sqrt(resistance / resistance.max())
        self._inverse: FloatArray = np.asarray(np.linalg.pinv(dipoles / weights) / weights[:, None])
        self.limits = self._box()
        self.heat: FloatArray = self.per_dipole(self.per_dipole(np.diag(resistance)).T)

    @classmethod
    def equal(cls, dipole_per_ampere: float, current_limit: float, resistance: float = 1.0) -> CoilMap:
        """Return the map of three equal coils along the body axes."""
        limits, ohms = np.full(3, current_limit), np.full(3, resistance)
        return cls(dipole_per_ampere * np.eye(3), limits, ohms)

    @property
    def is_redundant(self) -> bool:
        """Whether more than one set of currents can produce the same dipole moment."""
        return len(self.current_limits) > 3

    def working(self, used: BoolArray, assumed: float = 0.5) -> CoilMap:
        """Return the map of the coils `used` (n,), with the limits and the heating power of these coils.

        If the axes of the working coils lie in a plane, a coil along the normal of the plane is assumed. Its
        dipole moment is the fraction `assumed` of the dipole moment of the weakest coil. To produce the same
        torque without a dipole moment along the normal, the allocation adds a dipole moment along the
        magnetic field, which causes no torque. Raises UsageError if all working coils are parallel.
        """
        if used.all():
            return self
        if not used.any():
            raise UsageError("no coil works")
        dipoles, limits = self.dipoles[:, used], self.current_limits[used]
        resistance = self.resistance[used]
        normal = missing_direction(dipoles)
        if normal is not None:
            weakest = int(np.argmin(np.linalg.norm(dipoles, axis=0) * limits))
            strength = assumed * float(np.linalg.norm(dipoles[:, weakest]))
            dipoles = np.column_stack([dipoles, strength * normal])
            limits = np.append(limits, limits[weakest])
            resistance = np.append(resistance, resistance[weakest])
        return CoilMap(dipoles, limits, resistance)

    def currents(self, dipole: FloatArray) -> FloatArray:
        """Return the currents (n,), A, of least heat that produce a dipole moment (3,), A m^2.

        The currents of more than three coils are within their limits if the dipole moment is within `limits`.
        """
        if self._strength is not None:
            return np.asarray(dipole / self._strength)
        found = np.asarray(self._inverse @ dipole)
        if self.is_redundant and (np.abs(found) > self.current_limits).any():
            return self._limited_currents(dipole)
        return found

    def _limited_currents(self, dipole: FloatArray) -> FloatArray:
        """Return the currents (n,), A, of least heat within the limits that produce a dipole moment (3,).

        By duality, the currents are R^-1 D' y, clipped to the limits, for a vector y (3,) of Lagrange
        multipliers. The multipliers maximise a concave function, whose gradient is the difference between the
        requested and the produced dipole moment. The multipliers are found by Newton's method with a line
        search.
        """
        limits, resistance = self.current_limits, self.resistance

        def at(multipliers: FloatArray) -> tuple[float, FloatArray, FloatArray]:
            pull = multipliers @ self.dipoles
            free = pull / resistance
            held = np.clip(free, -limits, limits)
            value = float(multipliers @ dipole - held @ pull + 0.5 * resistance @ held**2)
            return value, held, np.where(np.abs(free) < limits, 1.0, _SATURATED) / resistance

        multipliers = self.heat @ dipole
        value, held, weights = at(multipliers)
        for _ in range(_NEWTON_STEPS):
            missing = dipole - self.dipoles @ held
            if float(np.abs(missing).max()) <= _EXACT * float(np.abs(dipole).max()):
                break
            step = np.linalg.solve((self.dipoles * weights) @ self.dipoles.T, missing)
            size, gain = 1.0, 0.1 * float(step @ missing)
            while size > _EXACT and at(multipliers + size * step)[0] < value + size * gain:
                size *= 0.5
            multipliers = multipliers + size * step
            value, held, weights = at(multipliers)
        return held

    def linear_shares(self, used: BoolArray) -> FloatArray:
        """Return the matrix (n, n) that maps currents to the currents of least heat with equal dipole moment.

        The currents of least heat flow only in the coils marked in `used` (n,), and depend linearly on the
        given currents because current limits are ignored.
        """
        weights = np.sqrt(self.resistance / self.resistance.max())
        inverse = np.linalg.pinv(self.dipoles * used / weights) / weights[:, None]
        return np.asarray(inverse @ self.dipoles)

    def dipole(self, currents: FloatArray) -> FloatArray:
        """Return the dipole moment (3,), A m^2, of currents (n,), A."""
        if self._strength is not None:
            return np.asarray(self._strength * currents)
        return np.asarray(self.dipoles @ currents)

    def per_dipole(self, matrix: FloatArray) -> FloatArray:
        """Return derivatives (k, 3) per A m^2 of dipole moment from derivatives (k, n) per ampere."""
        if self._strength is not None:
            return np.asarray(matrix / self._strength)
        return np.asarray(matrix @ self._inverse)

    @property
    def aligned(self) -> bool:
        """Whether three coils lie along the body axes x, y and z, in this order."""
        return self._strength is not None

    def error_covariance(self, gain: float | FloatArray, axes: float) -> FloatArray:
        """Return the covariance (9, 9) of the elements of the matrix from commanded to actual dipole moment.

        The elements are listed row by row. The errors of the coils are independent and uniformly distributed.
        The largest relative error of a coil's dipole moment is `gain`, a single number for all coils or an
        array (n,). The largest misalignment of a coil axis is `axes` (rad) in each of the two directions
        normal to the axis.
        """
        found: FloatArray = np.zeros((3, 3, 3, 3))
        gains = np.broadcast_to(gain, len(self.current_limits))
        for dipole, current, error in zip(self.dipoles.T, self._inverse, gains, strict=True):
            along = np.outer(dipole, dipole)
            across = float(dipole @ dipole) * np.eye(3) - along
            own = (error**2 * along + axes**2 * across) / 3.0
            found += np.einsum("ik,j,l->ijkl", own, current, current)
        return found.reshape(9, 9)

    def _box(self) -> FloatArray:
        """Return the half lengths (3,), A m^2, of the largest box of dipole moments that the coils can reach.

        The set of dipole moments that the coils can produce is a zonotope, and the normal of each face is the
        cross product of two coil axes.
        """
        if self._strength is not None:
            return np.abs(self._strength) * self.current_limits
        units = self.dipoles / np.linalg.norm(self.dipoles, axis=0)
        normals = np.array([np.cross(one, other) for one, other in combinations(units.T, 2)])
        normals = normals[np.linalg.norm(normals, axis=1) > _PARALLEL]
        reached = np.abs(normals @ self.dipoles) @ self.current_limits
        # The array `use @ box` contains, for each face of the zonotope, the extent of the box along the
        # face's normal, divided by the distance of the face from the origin. Each iteration scales the
        # multiplier of a face by this ratio (iterative proportional fitting).
        use = np.abs(normals) / reached[:, None]
        multipliers = np.full(len(use), 3.0 / len(use))
        for _ in range(_STEPS):
            box = 1.0 / (multipliers @ use)
            multipliers = multipliers * (use @ box)
        box = 1.0 / (multipliers @ use)
        return np.asarray(box / float((use @ box).max()))


def limited(dipole: FloatArray, limits: FloatArray) -> FloatArray:
    """Return a dipole moment (3,), scaled down by one factor to satisfy the limits (3,) of the body axes.

    The scaling preserves the direction of the dipole moment and of its torque.
    """
    sizes = np.abs(dipole)
    beyond = sizes > limits
    if not beyond.any():
        return dipole
    return dipole * float((limits[beyond] / sizes[beyond]).min())


@dataclass(frozen=True, slots=True)
class Allocation:
    """Allocated currents of the coils, and the torque of these currents.

    Attributes:
        currents: coil currents (n,), zero for coils that are not available, A.
        torque: torque (3,) of the allocated currents, N m.
        share: component of the torque along the requested torque, as a fraction (0 to 1) of the requested
            torque.
    """

    currents: FloatArray
    torque: FloatArray
    share: float


def allocate(
    torque: FloatArray,
    field: FloatArray,
    dipoles: FloatArray,
    limits: FloatArray,
    available: FloatArray | None = None,
    free: FloatArray | None = None,
    resistance: FloatArray | None = None,
) -> Allocation:
    """Return the coil currents for a torque (3,), N m, in a magnetic field (3,), T, body axes.

    Column k of `dipoles` (3, n) is the dipole moment of coil k per ampere, m^2. The current limits of the
    coils are `limits` (n,), A, and the mask `available` (n,) marks the coils that may be used. The mask
    `free` (3,) marks the axes about which the body can rotate, because a suspension thread may prevent
    rotation about the other axes. Of all currents that produce the torque, the currents with the least heat
    in the coil resistances `resistance` (n,), ohm, are chosen. Without the argument `resistance`, the
    resistances are assumed to be equal. Raises KnightCubeError for an input that is not finite.
    """
    wanted = np.asarray(torque, dtype=np.float64)
    if not (np.isfinite(wanted).all() and np.isfinite(field).all()):
        raise KnightCubeError(f"allocation: torque {wanted} or field {field} is not finite")
    turns = np.ones(3) if free is None else np.asarray(free, dtype=np.float64)
    limits = np.asarray(limits, dtype=np.float64)
    usable = np.ones(len(limits)) if available is None else np.asarray(available, dtype=np.float64)
    usable = usable * (limits > 0.0)
    # Column i of the matrix `effect` is the torque about the free axes that one ampere in coil i causes.
    effect = turns[:, None] * np.cross(dipoles.T, field).T * usable
    wanted = wanted * turns
    at_limits = effect * limits
    squares, directions = np.linalg.eigh(at_limits @ at_limits.T)  # squared torques, in ascending order
    kept = directions[:, squares > _WEAKEST**2 * squares[-1]].T
    # The currents of least norm in these units cause the least heat.
    weights = np.ones(len(usable)) if resistance is None else np.sqrt(resistance / resistance.max())
    scaled = kept @ effect / weights
    currents = scaled.T @ np.linalg.solve(scaled @ scaled.T, kept @ wanted) / weights * usable
    excess = float(np.max(np.abs(currents) / np.where(limits > 0.0, limits, 1.0)))
    if excess > 1.0:
        currents = currents / excess
    made = effect @ currents
    length = float(wanted @ wanted)
    share = float(made @ wanted) / length if length > 0.0 else 1.0
    return Allocation(currents, made, min(max(share, 0.0), 1.0))
