"""What one frame shows of objects: directions among the stars, with their errors."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The n objects, or what may be one, of a frame at one instant.

    Attributes:
        time_ns: of mid-exposure.
        directions: (n, 3) unit vectors, ICRS, free of the aberration of the stars.
        covariance: (n, 3, 3) rad^2 of the places in the image, ICRS axes; without the attitude's.
        magnitudes: (n,) by the frame's stars; NaN when unknown.
        attitude: (3, 3) rad^2, of the small turn, ICRS axes, that is common to all directions of the frame.
        observer: (3,) m from the Earth's centre, ICRS; None on the ground, or where it is not known.
    """

    time_ns: int
    directions: FloatArray
    covariance: FloatArray
    magnitudes: FloatArray
    attitude: FloatArray
    observer: FloatArray | None = None
