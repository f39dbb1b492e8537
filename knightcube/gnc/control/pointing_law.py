"""The pointing law: from an estimate and a table of gains to a dipole, and the recovery of a body far off.

The law is linear in small rotations. If the law led a light body back from far off, its coils would follow
the path at their limits and make the body rotate faster than before. A body that leaves its path is therefore
planned for again, and a body far off is first damped until it is slow. Damping cannot accelerate the body:
its torque is the component of -2 w J rate normal to the field, which removes energy in any attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, cross_product
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.gnc.control.pointing_table import PointingTable
from knightcube.gnc.guidance.three_axes.attitude_law import AttitudeReference

LARGEST_ROTATION = math.radians(20.0)
"""Largest rotation error (rad); a larger one is shortened, because the law is linear in small rotations."""
LARGEST_RATE = math.radians(1.0)
"""Largest rate error (rad/s); a larger one is shortened."""


@dataclass(frozen=True, slots=True, eq=False)
class PointingCommand:
    """A command of the pointing law.

    Attributes:
        dipole: (3,) A m^2, within the limit.
        rotation: (3,) rad, rotation error of the body relative to the reference.
        rate: (3,) rad/s, rate error of the body relative to the reference.
    """

    dipole: FloatArray
    rotation: FloatArray
    rate: FloatArray


class PointingLaw:
    """Computes dipoles from a table; stateless apart from the table."""

    def __init__(self, table: PointingTable, limit: float) -> None:
        """Use `table` with coils of `limit` A m^2 each."""
        self._table = table
        self._limit = limit

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of the table, s; the gains of the last revolution have less preview."""
        times = self._table.path.times
        return float(times[0]), float(times[-1])

    def reference(self, time: float) -> AttitudeReference:
        """Return the path at a time, s, clamped to the times of the table."""
        return self._table.path.at(time)

    def wanted(self, time: float) -> AttitudeReference:
        """Return the attitude law at a time, s, clamped to the times of the table."""
        return self._table.wanted.at(time)

    def command(
        self,
        time: float,
        quaternion: FloatArray,
        rate: FloatArray,
        field: FloatArray,
        residual_dipole: FloatArray,
        sizes: FloatArray,
    ) -> PointingCommand:
        """Return the command at `time` s for an attitude (4,) and a rate (3,) rad/s.

        `field` (3,) T is in body axes. `residual_dipole` (3,) A m^2 and `sizes` (n,) of the torques are the
        estimated disturbances: the dipole is cancelled at once, the torques as the field allows.
        """
        wanted = self.reference(time)
        rotation = to_rotation_vector(multiply(quaternion, conjugate(wanted.quaternion)))
        # Both rates in body axes: for a large rotation error they differ from the reference's axes.
        missed = rate - attitude_matrix(from_rotation_vector(rotation)) @ wanted.rate
        cut_rotation, cut_rate = _cut(rotation, LARGEST_ROTATION), _cut(missed, LARGEST_RATE)
        # The rate error of the table is the difference of components in the axes of each.
        error = np.concatenate([cut_rotation, cut_rate - np.cross(cut_rotation, wanted.rate)])
        k, table = self._table.path.position(time)[0], self._table
        beyond = sizes - table.sizes
        pull = table.gain[k] @ error - table.dipole[k] + table.torque_part[k] @ beyond
        # A dipole along the field makes no torque.
        dipole = field * (float(field @ pull) / float(field @ field)) - pull - residual_dipole
        # Scaled as a whole, so that the direction of the torque is kept.
        largest = float(np.abs(dipole).max())
        limited = dipole if largest <= self._limit else dipole * (self._limit / largest)
        return PointingCommand(limited, rotation, missed)


def _cut(vector: FloatArray, longest: float) -> FloatArray:
    length = math.sqrt(float(vector @ vector))
    return vector if length <= longest else vector * (longest / length)


FAR = math.radians(15.0)
"""Deviation (rad) from the path beyond which a body is damped."""
LEAVING = math.radians(5.0)
"""Deviation (rad) from the path beyond which a new path is planned, because the torques are not as
predicted."""
SLOW = math.radians(0.1)
"""Rate (rad/s) below which a body is slow; the orbital rate is 0.06 deg/s."""
DAMPING_TIMEOUT = 180.0
"""Time (s) after which a path is planned although the body is not slow: the momentum along the field takes a
quarter of an orbit."""
DAMPING = 0.01
"""Bandwidth w of the damping, rad/s."""


class PathRecovery:
    """Decides between path following and damping.

    Attributes:
        since: start of the damping, s; None while the path is flown.
        ready: whether a new path may be planned.
        leaving: whether a new path should be planned although the path is still flown.
    """

    def __init__(self) -> None:
        self.since: float | None = None
        self.ready = self.leaving = False

    def update(self, off: float, speed: float, now: float) -> None:
        """Update with the deviation from the path, rad, and the rate, rad/s, at a time, s."""
        if self.since is None and off > FAR:
            self.since = now
        self.leaving = self.since is None and off > LEAVING
        self.ready = self.since is not None and (speed < SLOW or now - self.since > DAMPING_TIMEOUT)

    def planned(self) -> None:
        """Return to path following after a new plan."""
        self.since, self.ready, self.leaving = None, False, False


def damping_dipole(inertia: FloatArray, rate: FloatArray, field: FloatArray) -> FloatArray:
    """Return the dipole (3,) A m^2 that damps a rate (3,) rad/s in a field (3,) T, body axes.

    `inertia` (3,) kg m^2 of the body axes.
    """
    return np.asarray(cross_product(field, -2.0 * DAMPING * inertia * rate) / float(field @ field))
