"""Noise and limits of the filter of a free satellite, and what noise they give its acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.gnc.estimation.free_motion import FreeMotion, crossed

LASTING = 20.0
"""s, for which an error of the coils or of the inertia keeps its sign: as white noise it has this density."""
CONSTANT_SHARE, AIR_SHARE, LIGHT_SHARE = 0.03, 1.0, 0.5
"""Of the size that is expected of the air's torque, by shape. What is constant in body axes is next to
nothing, as the principal axes have a turn of their own; a body held at one attitude can not tell the shapes
apart, and a torque of the air that passes for a constant one is wrong in every other attitude."""
BELIEVED = 4.0
"""Deviations at the start: a slow state that lies farther off is not believed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeFilterSettings:
    """Noise and limits; a pair is the standard deviation at the start and the random walk per sqrt(s).

    Attributes:
        gyro: rad/s.
        dipole, sunlit: A m^2, of the residual dipole's parts.
        magnet: T, of the magnetometer.
        field: T of an axis, of the field's model before its error is learned.
        field_memory: s, for which that error keeps its sign.
        torque: N m, of the air's size; of the others by their shares at the start.
        torque_noise: N m sqrt(s), white, of what has no shape.
        coil_error: share of the coils' dipole that is uncertain for tens of seconds, in any direction.
        coil_noise: A m^2 sqrt(s), white, of each coil while the coils are driven.
        axes: rad, of the principal axes.
        inertia_error: share of the gyroscopic torque that no turn of the axes explains.
        rate_start: rad/s, of the first rate.
        fine, coarse: rad, largest sigma of the worst axis that is called so.
        gate_sigma: a measurement less likely than this many sigma of one component is refused.
    """

    gyro: tuple[float, float] = (1e-3, 2e-6)
    dipole: tuple[float, float] = (1e-3, 1.5e-6)
    sunlit: tuple[float, float] = (3e-4, 2e-7)
    magnet: tuple[float, float] = (3e-7, 3e-10)
    field: float = 5e-8
    field_memory: float = 600.0
    torque: tuple[float, float] = (3e-9, 5e-12)
    torque_noise: float = 1e-9
    coil_error: float = 0.04
    coil_noise: float = 0.0
    axes: tuple[float, float] = (0.03, 0.0)
    inertia_error: float = 0.003
    rate_start: float = 1e-3
    fine: float = math.radians(0.1)
    coarse: float = math.radians(5.0)
    gate_sigma: float = 5.0

    def of_slow(self, which: int) -> FloatArray:
        """Return the deviations at the start (0), or the walks (1), of the states (24,) after the rate."""
        start, walk = self.torque
        torques = [(share * start, walk) for share in (CONSTANT_SHARE, AIR_SHARE, LIGHT_SHARE)]
        pairs = [self.gyro, self.dipole, self.sunlit, self.magnet, *torques, self.axes]
        return np.repeat([pair[which] for pair in pairs], 3)

    def believes(self, values: FloatArray, at: IntArray | slice = slice(None)) -> BoolArray:
        """Return which `values` (k,) of the slow states `at` these places, all by default, may be true."""
        return np.asarray(np.abs(values) <= BELIEVED * self.of_slow(0)[at])


def acceleration_noise(
    settings: FreeFilterSettings,
    motion: FreeMotion,
    rate: FloatArray,
    field: FloatArray,
    dipole: FloatArray,
    doubt: float,
) -> FloatArray:
    """Return the density (3, 3) rad^2/s^3 of the noise of the acceleration, body axes.

    Args:
        settings: of the filter.
        motion: of the body.
        rate: (3,) rad/s, body axes.
        field: (3,) T, body axes.
        dipole: (3,) A m^2, of the coils.
        doubt: A m^2, standard deviation of an axis of a dipole that may not have flown.
    """
    s, square = settings, float(dipole @ dipole)
    coils = LASTING * (s.coil_error**2 * square / 3.0 + doubt**2) + (s.coil_noise**2 if square else 0.0)
    # The gyroscopic error turns with the body: on each side it lasts for the time of a radian.
    speed = math.sqrt(float(rate @ rate))
    gyroscopic = speed**2 * s.inertia_error * motion.largest_difference
    lasting = LASTING if LASTING * speed < 2.0 else 2.0 / speed
    density = (s.torque_noise**2 + lasting * gyroscopic**2) * motion.by_torque
    if coils:
        across = motion.inverse @ crossed(field)
        density = density + coils * (across @ across.T)
    return np.asarray(density)
