"""A field at one assumed scale of the image: directions to be compared with the catalogue's."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.errors import FlightError
from knightcube.reference.star_identification.pair_table import angles
from knightcube.reference.star_identification.settings import ClassicalSettings
from knightcube.vision.startracker.identification.field import StarField
from knightcube.vision.startracker.identification.refinement import stretched


class FieldUnknown(FlightError):
    """A field of view too uncertain for the classical methods; the default method solves those."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A field at one scale.

    Attributes:
        field: as given.
        scale: by which its tangents are multiplied here.
        direction: (n, 3) unit vectors, so multiplied.
        sigma: (n,) rad.
        slack: relative error of angles by the scale.
        stars: number of the brightest stars that patterns are made of.
    """

    field: StarField
    scale: float
    direction: FloatArray
    sigma: FloatArray
    slack: float
    stars: int

    def angles(
        self, one: IntArray, other: IntArray, tolerance: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the angles (k,) between observed stars, and the limits (k,), (k,) of the true ones.

        The limits are `tolerance` sigmas (31: the variances of the two along their arc add up) and the slack.
        """
        angle = angles(self.direction[one], self.direction[other])
        off = tolerance * np.hypot(self.sigma[one], self.sigma[other]) + self.slack * angle
        return angle, angle - off, angle + off


def views(field: StarField, settings: ClassicalSettings) -> Iterator[View]:
    """Yield the field at the scales that cover its range, the likeliest first.

    Raises FieldUnknown when the range needs more of them than the settings allow.
    """
    low, high = (math.log(edge) for edge in field.scale)
    steps = max(1, math.ceil((high - low) / (2.0 * settings.scale_step) - 1e-9))
    if steps > settings.scales:
        known = 100.0 * settings.scales * settings.scale_step
        raise FieldUnknown(
            f"scale known to {50.0 * (high - low):.1f} %: the classical methods need {known:.1f} %;"
            " the default method takes any"
        )
    edges = np.linspace(low, high, steps + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    for middle in middles[np.argsort(np.abs(middles - 0.5 * (low + high)), kind="stable")]:
        scale = math.exp(middle)
        yield View(
            field,
            scale,
            stretched(field.direction, scale),
            field.sigma * scale,
            0.5 * (high - low) / steps,
            min(settings.brightest, len(field)),
        )
