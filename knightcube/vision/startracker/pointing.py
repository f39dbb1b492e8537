"""A camera's attitude as right ascension, declination and roll."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_matrix


@dataclass(frozen=True, slots=True)
class Pointing:
    """A camera's attitude, rad.

    Attributes:
        right_ascension, declination: of the boresight, ICRS; right ascension in [0, 2 pi).
        roll: position angle of the image's upward direction (-y), from north towards east, [0, 2 pi).
            At a celestial pole north is that of right ascension zero.
    """

    right_ascension: float
    declination: float
    roll: float

    @classmethod
    def of(cls, quaternion: FloatArray) -> Pointing:
        """Return the pointing of an attitude (4,), ICRS to camera."""
        _, y, z = attitude_matrix(quaternion)
        declination = np.arctan2(z[2], np.hypot(z[0], z[1]))
        right_ascension = np.arctan2(z[1], z[0])
        north, east = _north_and_east(float(right_ascension), float(declination))
        roll = np.arctan2(-y @ east, -y @ north)
        full = 2.0 * np.pi
        return cls(float(right_ascension % full), float(declination), float(roll % full))

    def quaternion(self) -> FloatArray:
        """Return the attitude (4,), ICRS to camera."""
        cosine = np.cos(self.declination)
        z = np.array(
            [
                cosine * np.cos(self.right_ascension),
                cosine * np.sin(self.right_ascension),
                np.sin(self.declination),
            ]
        )
        north, east = _north_and_east(self.right_ascension, self.declination)
        y = -(np.cos(self.roll) * north + np.sin(self.roll) * east)
        return from_matrix(np.stack([np.cross(y, z), y, z]))


def _north_and_east(right_ascension: float, declination: float) -> tuple[FloatArray, FloatArray]:
    """Return the unit vectors (3,), (3,) towards north and east at a place of the sky."""
    sine, cosine = np.sin(right_ascension), np.cos(right_ascension)
    north = np.array([-np.sin(declination) * cosine, -np.sin(declination) * sine, np.cos(declination)])
    return north, np.array([-sine, cosine, 0.0])
