"""Two properties of a triangle of stars that are invariant under rotation, with their errors."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TriangleShape:
    """Properties of t triangles.

    Attributes:
        area: (t,) sr.
        moment: (t,) polar moment about the centroid, rad^4.
        sigma_area, sigma_moment: (t,) their standard deviations.
    """

    area: FloatArray
    moment: FloatArray
    sigma_area: FloatArray
    sigma_moment: FloatArray
