"""The linear map between the dipole moment of a satellite and the currents of its coils.

Column k of the matrix D (3, n) is the dipole moment of coil k per ampere, so the currents i make the dipole
moment D i. Of all currents that make a dipole moment m, the currents P m with the pseudo-inverse P of D have
the smallest norm. Control laws and planners need only dipole moments in body axes and one limit per body
axis. The limits span the largest box of dipole moments that the coils can make. The heat of a dipole moment m
is m' H m with H = P' R P, where R is the diagonal matrix of the coils' resistances.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import UsageError

LEAST_SPREAD = 0.05
"""Smallest singular value of the unit vectors along the coils. Below it, the coils lie nearly in a plane."""
_STEPS = 200
"""Largest number of iterations for the box of dipole moments."""


class CoilMap:
    """The coils of a satellite.

    Attributes:
        dipoles: dipole moment of each coil per ampere (3, n), m^2, body axes, one column per coil.
        current_limits: largest current of each coil (n,), A.
        limits: largest dipole moment along each body axis (3,), A m^2. All dipole moments within these three
            limits can be made.
        heat: heating power per squared dipole moment (3, 3), W/(A m^2)^2, body axes.
    """

    def __init__(self, dipoles: FloatArray, current_limits: FloatArray, resistance: FloatArray) -> None:
        """Raise UsageError if the coils cannot make a dipole moment in every direction."""
        strength = np.linalg.norm(dipoles, axis=0)
        spread = float(np.linalg.svd(dipoles / strength, compute_uv=False)[-1])
        if dipoles.shape[1] < 3 or spread < LEAST_SPREAD:
            raise UsageError("the axes of the coils lie in one plane: along its normal they make no dipole")
        self.dipoles, self.current_limits = dipoles, current_limits
        self._strength: FloatArray | None = None
        if np.count_nonzero(dipoles) == 3 and dipoles.shape == (3, 3) and np.diag(dipoles).all():
            self._strength = np.diag(dipoles).copy()
        self._inverse: FloatArray = np.asarray(np.linalg.pinv(dipoles))
        self.limits = self._box()
        self.heat: FloatArray = self.per_dipole(self.per_dipole(np.diag(resistance)).T)

    @classmethod
    def equal(cls, dipole_per_ampere: float, current_limit: float, resistance: float = 1.0) -> CoilMap:
        """Return the map of three equal coils along the body axes."""
        limits, ohms = np.full(3, current_limit), np.full(3, resistance)
        return cls(dipole_per_ampere * np.eye(3), limits, ohms)

    def currents(self, dipole: FloatArray) -> FloatArray:
        """Return the smallest currents (n,), A, that make a dipole moment (3,), A m^2."""
        if self._strength is not None:
            return np.asarray(dipole / self._strength)
        return np.asarray(self._inverse @ dipole)

    def dipole(self, currents: FloatArray) -> FloatArray:
        """Return the dipole moment (3,), A m^2, of currents (n,), A."""
        if self._strength is not None:
            return np.asarray(self._strength * currents)
        return np.asarray(self.dipoles @ currents)

    def per_dipole(self, matrix: FloatArray) -> FloatArray:
        """Return a matrix (k, n) of effects of the currents as a matrix (k, 3) of effects of the dipole."""
        if self._strength is not None:
            return np.asarray(matrix / self._strength)
        return np.asarray(matrix @ self._inverse)

    @property
    def aligned(self) -> bool:
        """Whether three coils lie along the body axes x, y and z, in this order."""
        return self._strength is not None

    def error_covariance(self, gain: float, axes: float) -> FloatArray:
        """Return the covariance (9, 9) of the matrix from the commanded to the actual dipole, row by row.

        The errors of the coils are independent and uniform. The dipole of a coil has the largest relative
        error `gain`, and its axis the largest misalignment `axes` (rad) in each of two directions.
        """
        found: FloatArray = np.zeros((3, 3, 3, 3))
        for dipole, current in zip(self.dipoles.T, self._inverse, strict=True):
            along = np.outer(dipole, dipole)
            across = float(dipole @ dipole) * np.eye(3) - along
            own = (gain**2 * along + axes**2 * across) / 3.0
            found += np.einsum("ik,j,l->ijkl", own, current, current)
        return found.reshape(9, 9)

    def _box(self) -> FloatArray:
        """Return the half lengths (3,) of the box with the largest volume inside what the coils can make."""
        if self._strength is not None:
            return np.abs(self._strength) * self.current_limits
        # The largest current of coil k within the box b is |P_k| b. Each step shares the violation among the
        # axes, as in iterative proportional fitting, and converges to the box of largest volume.
        use = np.abs(self._inverse) / self.current_limits[:, None]
        multipliers = np.full(len(use), 3.0 / len(use))
        for _ in range(_STEPS):
            box = 1.0 / (multipliers @ use)
            multipliers = multipliers * (use @ box)
        box = 1.0 / (multipliers @ use)
        return np.asarray(box / float((use @ box).max()))


def limited(dipole: FloatArray, limits: FloatArray) -> FloatArray:
    """Return a dipole moment (3,), scaled down by one factor to the limits (3,) of the body axes.

    The scaling preserves the direction of the dipole moment and of its torque.
    """
    sizes = np.abs(dipole)
    beyond = sizes > limits
    if not beyond.any():
        return dipole
    return dipole * float((limits[beyond] / sizes[beyond]).min())
