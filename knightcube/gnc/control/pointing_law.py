"""The pointing law (a dipole moment computed from a table of gains) and the recovery from large errors.

The pointing law is linear in small rotations. With a large error, the pointing law would saturate the coils
and could make a light body rotate faster than before. A new path is therefore planned if the body leaves the
planned path. Far from the planned path, the body is first damped until its rate is low. The damping torque
removes energy in any attitude. The damping torque is the component of -2 w J rate that is normal to the
magnetic field, with bandwidth w and inertia J.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, check_finite, cross_product
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError
from knightcube.gnc.control.coil_map import limited
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.estimation.estimate import of_unit_length
from knightcube.gnc.guidance.attitude_law import AttitudeReference

LARGEST_ROTATION = math.radians(20.0)
"""Largest rotation error (rad) that the pointing law uses. Larger errors are scaled down to this value,
because the pointing law is linear."""
LARGEST_RATE = math.radians(1.0)
"""Largest rate error (rad/s) that the pointing law uses; larger errors are scaled down to this value."""
_NONE: FloatArray = np.zeros(3)


@dataclass(frozen=True, slots=True, eq=False)
class PointingCommand:
    """Dipole moment (3,), A m^2, within the coils' limit, and the errors relative to the reference motion.

    The errors are a rotation vector (3,), rad, from the reference to the body, and a rate (3,), rad/s.
    """

    dipole: FloatArray
    rotation: FloatArray
    rate: FloatArray


class PointingLaw:
    """The feedback law that computes dipole moments from a pointing table.

    `pointing_job.plan_pointing` plans a path to a target and returns the law. The times of the law are in s
    after the time of the plan.
    """

    def __init__(self, table: PointingTable, limit: float | FloatArray) -> None:
        """Create the pointing law for a pointing table and the dipole limit (A m^2) along each body axis.

        The limit is equal for all axes or has shape (3,).
        """
        self._table = table
        self._limit: FloatArray = np.full(3, limit)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the pointing table, s."""
        times = self._table.path.times
        return float(times[0]), float(times[-1])

    def reference(self, time: float) -> AttitudeReference:
        """Return the planned motion at a time (s) clamped to the table's times."""
        return self._table.path.at(time)

    def wanted(self, time: float) -> AttitudeReference:
        """Return the motion commanded by the attitude law at a time (s) clamped to the table's times."""
        return self._table.wanted.at(time)

    def command(
        self,
        time: float,
        quaternion: FloatArray,
        rate: FloatArray,
        field: FloatArray,
        residual_dipole: FloatArray = _NONE,
        sizes: FloatArray | None = None,
    ) -> PointingCommand:
        """Return the command at a time (s) for an estimated attitude (4,) and rate (3,) rad/s.

        The magnetic field `field` (3,), T, is in body axes. The estimated residual dipole moment
        `residual_dipole` (3,) A m^2 is cancelled directly, except for the component along the field. The
        effects of the disturbance torques with the estimated components `sizes` (9,), N m, are reduced as far
        as the field allows; the default are the components with which the path was planned. In a field of
        zero, the dipole moment is zero. Raises ArgumentError for values that are not finite, and for an
        attitude that is not a unit quaternion.
        """
        if not math.isfinite(time):
            check_finite(time=time)
        quaternion = of_unit_length("quaternion", quaternion)
        wanted = self.reference(time)
        rotation = to_rotation_vector(multiply(quaternion, conjugate(wanted.quaternion)))
        # The rotation error rotates the reference rate into body axes, in which the rates are compared.
        missed = rate - attitude_matrix(from_rotation_vector(rotation)) @ wanted.rate
        cut_rotation, cut_rate = _cut(rotation, LARGEST_ROTATION), _cut(missed, LARGEST_RATE)
        # The gains apply to the body rate in body axes minus the reference rate in reference axes.
        error = np.concatenate([cut_rotation, cut_rate - np.cross(cut_rotation, wanted.rate)])
        k, table = self._table.path.position(time)[0], self._table
        sizes = table.sizes if sizes is None else sizes
        beyond = sizes - table.sizes
        pull = table.gain[k] @ error - table.dipole[k] + table.torque_part[k] @ beyond + residual_dipole
        # The dipole moment along the field is removed, because a dipole along the field causes no torque.
        dipole = field * (float(field @ pull) / _square(field)) - pull if field.any() else 0.0 * pull
        if not math.isfinite(float(dipole @ dipole)):  # one check per cycle instead of one for each argument
            check_finite(quaternion=quaternion, rate=rate, residual_dipole=residual_dipole, sizes=sizes)
        return PointingCommand(limited(dipole, self._limit), rotation, missed)


def _square(field: FloatArray) -> float:
    """Return the square of a magnetic field (3,). Raises ArgumentError if the square is not finite."""
    square = float(field @ field)
    if not math.isfinite(square):
        raise ArgumentError("field", f"{field.tolist()}: give a finite field in T")
    return square


def _cut(vector: FloatArray, longest: float) -> FloatArray:
    length = math.sqrt(float(vector @ vector))
    return vector if length <= longest else vector * (longest / length)


FAR = math.radians(15.0)
"""Deviation (rad) from the planned path above which the body is damped."""
LEAVING = math.radians(5.0)
"""Deviation (rad) from the planned path above which a new path is planned."""
SLOW = math.radians(0.1)
"""Rate (rad/s) below which the damping ends; the orbital rate is 0.06 deg/s."""
DAMPING_TIMEOUT = 180.0
"""Time (s) after which the damping ends although the rate is not low. The removal of momentum along the field
would take a quarter of an orbit."""
DAMPING = 0.01
"""Bandwidth w of the damping torque, rad/s."""


class PathRecovery:
    """The decision whether the body follows the planned path or is damped.

    Attributes:
        since: start time of the damping, s, or None while the body follows the path.
        ready: whether a new path may be planned.
        leaving: whether a new path should be planned because the deviation from the path is large.
    """

    def __init__(self) -> None:
        self.since: float | None = None
        self.ready = self.leaving = False

    def update(self, off: float, speed: float, now: float) -> None:
        """Update the decision by deviation from the path (rad), body rate (rad/s) and time (s)."""
        if self.since is None and off > FAR:
            self.since = now
        self.leaving = self.since is None and off > LEAVING
        self.ready = self.since is not None and (speed < SLOW or now - self.since > DAMPING_TIMEOUT)

    def planned(self) -> None:
        """End the damping and return to path following, because a new path was planned."""
        self.since, self.ready, self.leaving = None, False, False


def damping_dipole(inertia: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
    """Return the dipole (3,) A m^2 that damps a rate (3,) rad/s in a field (3,) T, body axes.

    The inertia tensor in body axes is `inertia` (3, 3), kg m^2. In a field of zero, the dipole is zero.
    Raises ArgumentError for a rate or a field that is not finite.
    """
    check_finite(rate=rate)
    if not field.any():
        return np.zeros(3)
    return np.asarray(cross_product(field, (-2.0 * DAMPING * inertia) @ rate) / _square(field))
