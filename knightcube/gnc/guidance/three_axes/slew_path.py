"""The path of a slew in time: attitude, rate, acceleration and dipole, as the tracker samples them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import normalise
from knightcube.gnc.guidance.hermite import HermiteCubic
from knightcube.gnc.guidance.three_axes.attitude_law import References


@dataclass(frozen=True, slots=True, eq=False)
class SlewPath:
    """A path from 0 to its last time; between the times it is the cubic of the collocation.

    Attributes:
        times: (n,) s; quaternion: (n, 4) ICRS into body; rate: (n, 3) rad/s; acceleration: (n, 3) rad/s^2.
        dipole: (n, 3) A m^2, straight lines between the times; all in body axes.
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

    def references(self, times: FloatArray) -> References:
        """Return the wanted motion at times (m,) s; outside the path that of its ends, at rest from there."""
        inside = np.clip(times, 0.0, self.horizon)
        turning = HermiteCubic(self.times, self.rate, self.acceleration)
        spin = np.concatenate([self.rate, np.zeros((len(self.times), 1))], axis=1)
        v, s = self.quaternion[:, :3], self.quaternion[:, 3:]
        slope = np.empty_like(self.quaternion)
        slope[:, :3] = 0.5 * (np.cross(v, spin[:, :3]) + s * spin[:, :3])
        slope[:, 3] = -0.5 * np.sum(v * spin[:, :3], axis=1)
        attitude = normalise(HermiteCubic(self.times, self.quaternion, slope)(inside))
        flying = ((times >= 0.0) & (times <= self.horizon))[:, None]
        return References(
            np.asarray(times, dtype=float),
            attitude,
            np.where(flying, turning(inside), 0.0),
            np.where(flying, turning.derivative(inside), 0.0),
        )

    def dipoles(self, times: FloatArray) -> FloatArray:
        """Return the dipoles (m, 3) A m^2 at times (m,) s; zero outside the path."""
        found = [np.interp(times, self.times, part, left=0.0, right=0.0) for part in self.dipole.T]
        return np.stack(found, axis=1)
