"""Simulated images of lenses of which the star tracker knows only the field of view."""

from __future__ import annotations

import math

import numpy as np

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_matrix, multiply, normalise
from knightcube.vision.camera.lens import Lens
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings, solve_places
from knightcube.vision.startracker.survey import FrameKind
from tests.knightcube.vision.startracker.frames import EPOCH, sky
from tests.support.photographs import FIELD_SHARE, believed

_SEED = 14_005


_PIXELS = 1024


_MOST_STARS = 40


_NOISE_PX = 0.1


_FIELDS_DEG = 8.0, 30.0


# Standard deviations of the lens centre (px of 1024), and of the distortion at the corner relative to the
# radius.
LENSES = {"perfect": (0.0, 0.0), "usual": (10.0, 0.005), "poor": (25.0, 0.02)}


def drawn_lens(kind: str, rng: np.random.Generator) -> Lens:
    """Return a random lens of a kind in LENSES."""
    off, bent = LENSES[kind]
    field = math.radians(rng.uniform(*_FIELDS_DEG))
    focal_length = 0.5 * _PIXELS / math.tan(0.5 * field)
    corner = math.tan(0.5 * field) * math.sqrt(2.0)
    centre = 0.5 * (_PIXELS - 1) + off * rng.standard_normal(2)
    k1 = bent * float(np.clip(rng.standard_normal(), -2.5, 2.5)) / corner**2
    return Lens(_PIXELS, _PIXELS, focal_length, (float(centre[0]), float(centre[1])), k1)


def of_the_middle(lens: Lens, attitude: FloatArray) -> FloatArray:
    """Return the attitude (4,) of a camera whose axis passes through the image centre."""
    middle = np.array([[0.5 * (lens.columns - 1), 0.5 * (lens.rows - 1)]])
    z = lens.unit_vectors(middle)[0]
    right = (
        lens.unit_vectors(middle + np.array([1.0, 0.0]))[0]
        - lens.unit_vectors(middle - np.array([1.0, 0.0]))[0]
    )
    down = (
        lens.unit_vectors(middle + np.array([0.0, 1.0]))[0]
        - lens.unit_vectors(middle - np.array([0.0, 1.0]))[0]
    )
    # The deviation of the image axes from a right angle is divided equally between both axes, as in a fit.
    one, other = (side - z * (side @ z) for side in (right, down))
    x = one / np.linalg.norm(one) + np.cross(other / np.linalg.norm(other), z)
    x /= np.linalg.norm(x)
    return multiply(from_matrix(np.stack([x, np.cross(z, x), z])), attitude)


def drawn(kind: str, number: int) -> tuple[FrameSolution, FloatArray]:
    """Return the solution of a simulated image, and the true attitude (4,) of the image centre."""
    rng = np.random.default_rng([_SEED, number, *kind.encode()])
    lens, attitude = drawn_lens(kind, rng), normalise(rng.standard_normal(4))
    stars = catalogue.load()
    places = lens.project(stars.directions_at(EPOCH) @ attitude_matrix(attitude).T)
    inside = np.flatnonzero(lens.contains(places))
    chosen = inside[np.argsort(stars.magnitude[inside], kind="stable")][:_MOST_STARS]
    points = places[chosen] + _NOISE_PX * rng.standard_normal((len(chosen), 2))
    covariance = np.broadcast_to(_NOISE_PX**2 * np.eye(2), (len(chosen), 2, 2)).copy()
    field = 2.0 * math.degrees(math.atan(0.5 * _PIXELS / lens.focal_length))
    flux = 10.0 ** (-0.4 * stars.magnitude[chosen])
    shown = np.zeros((_PIXELS, _PIXELS), dtype=np.uint8)
    camera, scale = believed(shown, field, field * (1.0 - FIELD_SHARE), field * (1.0 + FIELD_SHARE))
    found = solve_places(
        points, covariance, FrameKind.POINTS, camera, scale, sky(), SolveSettings(), None, flux
    )
    return found, of_the_middle(lens, attitude)
