"""Three indicators that a streak is no star: centre, displacement, OLAE residual (Sease 4.11-4.15 corrected).

Every star turns about one axis by one angle. A streak that misses the common centre of rotation, that turned
by another angle about it, or that leaves a residual in OLAE belongs to something else. When the axis is
nearly normal to the boresight the centre runs to infinity; the slope takes its place and the length that of
the angle.

The pinhole's projection bends slopes and lengths across a wide field by far more than their errors, so each
indicator is compared with a star in the same place, and the difference is expressed in
expected errors of an endpoint. All three are then one scale, fair to bright and faint streaks, and without an
RSO their
spread is a constant of the detector: `python -m tests.studies.bench.rso_spread` measures it, for the lower
bounds
    that
the strict 2.5 sigma rule lacks (text at Table 4.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.frame.background import MAD_TO_SIGMA
from knightcube.vision.frame.regions import line_of, positions
from knightcube.vision.objects.settings import ObjectSettings
from knightcube.vision.streaks.corners.grouping import centre_of_rotation
from knightcube.vision.streaks.corners.segmentation import Regions
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.corners.streaks import Segmented, expected_sigma, near_border

INDICATORS = ("centre", "displacement", "residual")


@dataclass(frozen=True, slots=True)
class Indicators:
    """The three indicators of n streaks, in the order of `INDICATORS`.

    Attributes:
        endpoints: (n, 2, 2) px, in the order of time in which a star would have gone.
        deviations: (n, 3) standard deviations from a star in the same place.
        fired: (n, 3) which exceed their thresholds.
        centre: (2,) px, of rotation, by least squares; worthless when `degenerate`.
        degenerate: whether slope and length stand in for centre and angle.
    """

    endpoints: FloatArray
    deviations: FloatArray
    fired: BoolArray
    centre: FloatArray
    degenerate: bool


def centre_residuals(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return by how far (n,) px the bisector of each chord misses the centre (2,): 4.11-4.13 corrected."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    length = np.linalg.norm(chord, axis=-1)
    missed = np.sum(chord * (centre - endpoints.mean(axis=1)), axis=-1)
    return np.asarray(missed / np.maximum(length, np.finfo(float).tiny))


def slopes(endpoints: FloatArray) -> FloatArray:
    """Return the direction (n,) of each chord in the image, rad: the slope m without its infinity."""
    chord = endpoints[:, 1] - endpoints[:, 0]
    return np.asarray(np.arctan2(chord[:, 1], chord[:, 0]))


def angular_displacements(endpoints: FloatArray, centre: FloatArray) -> FloatArray:
    """Return the angle (n,) rad that each streak (n, 2, 2) subtends at the centre (2,): 4.14."""
    first, second = endpoints[:, 0] - centre, endpoints[:, 1] - centre
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    # Not by the arc cosine, which is blind to small angles.
    return np.asarray(np.arctan2(np.abs(cross), np.sum(first * second, axis=-1)))


def lengths(endpoints: FloatArray) -> FloatArray:
    """Return the distance (n,) px between the ends: 4.15."""
    return np.asarray(np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=-1))


def olae_residuals(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the lengths (n,) of the OLAE residuals of directions (n, 2, 3), first to second (4.7)."""
    angle = float(np.linalg.norm(rotation))
    scale = np.tan(0.5 * angle) / angle if angle > 0.0 else 0.5
    sums, differences = vectors[:, 0] + vectors[:, 1], vectors[:, 1] - vectors[:, 0]
    return np.asarray(np.linalg.norm(np.cross(sums, scale * rotation) - differences, axis=-1))


def star_ends(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the first and last directions (n, 2, 3) of the stars whose chords have the middles of `vectors`.

    A chord's middle lies inside the circle: the part of it normal to the axis is too short by the cosine of
    half the angle turned.
    """
    angle = float(np.linalg.norm(rotation))
    middle = vectors.mean(axis=1)
    if angle > 0.0:
        axis = rotation / angle
        along = (middle @ axis)[:, None] * axis
        middle = along + (middle - along) / np.cos(0.5 * angle)
    middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
    halves = [attitude_matrix(from_rotation_vector(part * rotation)) for part in (-0.5, 0.5)]
    return np.stack([middle @ half.T for half in halves], axis=1)


def evaluate(
    endpoints: FloatArray,
    sigma: FloatArray,
    rotation: FloatArray,
    pinhole: Pinhole,
    bounds: tuple[float, float, float],
    strict: float = 2.5,
    farthest_centre: float = 3.0,
) -> Indicators:
    """Return the indicators of streaks under the rotation that the stars share.

    Args:
        endpoints: (n, 2, 2) px, without bias, in any order.
        sigma: (n,) px, expected errors of an endpoint.
        rotation: (3,) rad, camera frame, over the exposure.
        pinhole: the camera.
        bounds: least deviations at which each indicator fires, from their measured spread without an RSO.
        strict: robust standard deviations within the frame that must be exceeded too, the thesis's rule.
        farthest_centre: focal lengths from the image's middle, beyond which the centre is degenerate; taken
            of the axis, for the least squares' own centre, the thesis's trigger, falls short the more the
            farther it should be: errors and projection turn parallel chords enough to let them meet anywhere.
    """
    vectors = pinhole.unit_vectors(endpoints)
    stars = star_ends(vectors, rotation)
    backward = np.sum((vectors[:, 1] - vectors[:, 0]) * (stars[:, 1] - stars[:, 0]), axis=-1) < 0.0
    endpoints = np.where(backward[:, None, None], endpoints[:, ::-1], endpoints)
    vectors = np.where(backward[:, None, None], vectors[:, ::-1], vectors)
    error = np.sqrt(2.0) * sigma
    residual = olae_residuals(vectors, rotation) * pinhole.focal_length / error
    expected = pinhole.project(stars)
    quiet = residual <= bounds[2]
    centre = centre_of_rotation(endpoints[quiet]) if np.count_nonzero(quiet) >= 2 else np.full(2, np.nan)
    normal_to_boresight = float(np.hypot(rotation[0], rotation[1])) > farthest_centre * abs(rotation[2])
    degenerate = normal_to_boresight or not np.all(np.isfinite(centre))
    if degenerate:
        centred, displaced = _slope_and_length(endpoints, expected)
    else:
        centred, displaced = _centre_and_angle(endpoints, expected, centre)
    deviations = np.stack([centred / error, displaced / error, residual], axis=-1)
    return Indicators(endpoints, deviations, _fired(deviations, bounds, strict), centre, degenerate)


def _centre_and_angle(
    endpoints: FloatArray, expected: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return both indicators less a star's, in px across and along the streak at one end."""
    radius = np.linalg.norm(endpoints.mean(axis=1) - centre, axis=-1)
    missed = centre_residuals(endpoints, centre) - centre_residuals(expected, centre)
    turned = angular_displacements(endpoints, centre) - angular_displacements(expected, centre)
    return missed * lengths(endpoints) / np.maximum(radius, 1.0), turned * radius


def _slope_and_length(endpoints: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the stand-ins for a centre at infinity less a star's, in px across and along the streak."""
    length = lengths(endpoints)
    return np.sin(slopes(endpoints) - slopes(expected)) * length, length - lengths(expected)


def _fired(deviations: FloatArray, bounds: tuple[float, float, float], strict: float) -> BoolArray:
    """Return which deviations (n, 3) exceed both the bound and `strict` times the frame's own spread.

    The spread is the median absolute deviation: an RSO would widen the standard deviation that is to find it,
    of ten streaks so far that none could exceed 2.85 of it.
    """
    if not len(deviations):
        return np.zeros((0, 3), dtype=np.bool_)
    spread = MAD_TO_SIGMA * np.median(np.abs(deviations), axis=0)
    return np.asarray(np.abs(deviations) > np.maximum(bounds, strict * spread))


# Bright parts shorter than this are points.
_LEAST_LINE_PX = 4.0


def short_regions(
    segmented: Segmented,
    rotation: FloatArray,
    pinhole: Pinhole,
    settings: StreakSettings,
    objects: ObjectSettings,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return ends (n, 2, 2), errors (n,) px and labels (n,) of bright regions too short for corners.

    Only where stars would not be short. The ends are those of the uniform line with the region's moments; a
    point's two ends coincide.
    """
    regions = segmented.regions
    noise = segmented.background.typical_noise
    chosen = (
        ~np.isin(regions.label, segmented.candidates.label)
        & (regions.length < settings.least_length)
        & (regions.flux >= objects.point_significance * noise * np.sqrt(regions.area))
        & ~near_border(regions, segmented.signal.shape, settings.border)
    )
    brightest = np.flatnonzero(chosen)[np.argsort(-regions.flux[chosen], kind="stable")]
    short = regions.select(brightest[: objects.most_points])
    ends = np.array([_line_of(segmented, short, index) for index in range(len(short))]).reshape(-1, 2, 2)
    sigma = np.hypot(1.0, expected_sigma(short, segmented.background, settings))
    expected = pinhole.project(star_ends(pinhole.unit_vectors(ends), rotation))
    # Near the axis stars are points too.
    streaked: BoolArray = np.linalg.norm(expected[:, 1] - expected[:, 0], axis=-1) >= settings.least_length
    return ends[streaked], sigma[streaked], short.label[streaked]


def _line_of(segmented: Segmented, regions: Regions, index: int) -> FloatArray:
    """Return the ends (2, 2) px of the uniform line with the moments of a region's bright part.

    Bright is above half of the brightest pixel, so that a faint star's streak under a point does not lengthen
    it.
    """
    top, bottom, left, right = regions.boxes[index]
    row, column = positions(regions.labels[top:bottom, left:right] == regions.label[index])
    weight = segmented.signal[row + top, column + left].astype(float)
    bright = weight >= 0.5 * weight.max()
    points = np.stack([column + left, row + top], axis=-1)[bright].astype(float)
    weight = weight[bright] / weight[bright].sum()
    centre = weight @ points
    offset = points - centre
    # Shorter than the point spread the moments measure noise, not length.
    return line_of(centre, (offset * weight[:, None]).T @ offset, _LEAST_LINE_PX)
