"""A horizon hypothesis: a limb fitted to edges of the image, and the evidence for and against it.

Other edges, such as coasts and the borders of clouds, can form a horizon by chance. The significance of a
horizon is an upper bound on the expected number of equally good chance horizons. The density of chance edges
is estimated from the number of edges beside the limb. A coast or cloud border that is tangent to the limb and
has the radius of curvature R stays within a distance g of the limb over a length of 2 sqrt(2 g R). Scan lines
that cross the same segment of a coast or cloud are not independent. The test therefore counts limb segments
of the length 2 sqrt(2 g R) instead of scan lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, select
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.edges import Observation
from knightcube.vision.horizon.illumination import (
    DAYLIGHT,
    GLARE,
    Agreement,
    agreement,
    limb_rays,
    sun_elevation,
    why_not_space,
)
from knightcube.vision.horizon.initial_guess import (
    SPHERE_ALTITUDE_SIGMA,
    InitialGuess,
    limb_tilt_sigma,
    sun_from,
)
from knightcube.vision.horizon.limb import (
    SCALE_HEIGHT,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    FittedLimb,
    LimbView,
    Prior,
    blur_factor,
    fit_limb,
    fit_profiles,
    limb_gradients,
    limb_residuals,
    stepped,
)
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

_GRAZING = 0.3
"""Minimum cosine of the angle between scan line and limb normal. Edges at smaller cosines are inaccurate."""
_LOWEST_SUN = np.radians(1.0)
"""Minimum elevation of the Sun (rad) at a limb point; with a lower Sun the limb appears too high."""
_FINE = SCALE_HEIGHT / 6.0
"""Pixel size at the limb (m) below which the samples do not cover the atmosphere's brightness profile."""
_CORRELATED = 10.0
"""Correlation length (px), along the limb, of the brightness of the ground behind the limb."""
_PIXEL_SIGMA = 12.0**-0.5
"""Standard deviation (px) of the blur due to the averaging of light over a square pixel."""
_LEAST_SPREAD = 0.03
"""Minimum assumed standard deviation (px) of a limb position that is fitted to a brightness profile."""
_OTHER_AIR = 500.0
"""Error of the limb height (m) due to the unknown brightness of the ground and density of the atmosphere."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbPoints:
    """The n points on the limb, from the edges assigned to the limb.

    Attributes:
        index: indices of the limb's edges among the edges of the image (n,).
        rays: unit vectors to the limb points (n, 3), camera axes.
        sigma: standard deviations of the limb points normal to the limb (n,), rad.
        pixel: angular size of a pixel normal to the limb (n,), rad.
        inward: cosine of the angle between the scan line and the limb normal at each point (n,).
        residuals, gradients: residuals (n,), rad, and their gradients (n, 5) from `limb_gradients`.
    """

    index: IntArray
    rays: FloatArray
    sigma: FloatArray
    pixel: FloatArray
    inward: FloatArray
    residuals: FloatArray
    gradients: FloatArray


def near_limb(view: LimbView, observation: Observation, tolerance: float) -> BoolArray:
    """Return which edges (n,) are within `tolerance` px of the limb with their bright side towards nadir."""
    near = np.abs(limb_residuals(view, observation.rays.rays)) < tolerance * observation.rays.pixel
    return np.asarray(near & (observation.rays.brighter @ view.nadir > 0.0))


def _limb_points(
    view: LimbView, observation: Observation, members: BoolArray, sun: FloatArray | None
) -> LimbPoints:
    """Return limb points from the sunlit edges in the mask `members` (n,), except on oblique scan lines."""
    chosen = np.flatnonzero(members)
    rays = observation.rays.rays[chosen]
    if sun is not None:
        day = sun_elevation(view, rays, sun) > _LOWEST_SUN
        chosen, rays = chosen[day], rays[day]
    residuals, gradients = limb_gradients(view, rays)
    # A small change s of a unit vector u changes the residual as much as the rotation s x u of the view.
    # The array `slopes` (n, 2) is the change of the residual per pixel to the right and per pixel downwards.
    turns = np.cross(gradients[:, :3], rays)
    steps = observation.across[chosen], observation.down[chosen]
    slopes = -np.stack([np.einsum("ij,ij->i", turns, step) for step in steps], axis=1)
    size = np.sqrt(np.einsum("ij,ij->i", slopes, slopes))
    inward = -np.einsum("ij,ij->i", slopes, observation.edges.towards[chosen]) / size
    sigma = observation.edges.sigma[chosen] * inward * size
    points = LimbPoints(chosen, rays, sigma, size, inward, residuals, gradients)
    return select(points, inward > _GRAZING)


def _placed_by_profile(
    view: LimbView, observation: Observation, limb: LimbPoints, settings: HorizonSettings
) -> LimbPoints:
    """Return limb points at positions fitted to their brightness profiles, if the pixels are large enough."""
    metres = limb.pixel * view.limb_distance
    if not len(metres) or float(np.median(metres)) < _FINE:
        return limb
    blur = np.hypot(settings.edges.psf_sigma, _PIXEL_SIGMA) * metres
    edges = select(observation.edges, limb.index)
    given = edges.profile, edges.profile_steps, metres * limb.inward
    fits = fit_profiles(*given, blur)
    if (factor := blur_factor(*given, blur)) > 1.0:
        fits = fit_profiles(*given, factor * blur)
    rays = limb.rays + fits.place[:, None] * observation.rays.brighter[limb.index]
    rays /= np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]
    # Scan lines whose spacing is smaller than the ground features are not independent.
    correlated = np.sqrt(max(1.0, _CORRELATED / observation.space))
    least = np.hypot(_LEAST_SPREAD, _OTHER_AIR / (metres * limb.inward))
    sigma = correlated * np.hypot(fits.sigma, least) * limb.inward * limb.pixel
    return select(replace(limb, rays=rays, sigma=sigma), fits.valid)


_GATES = (0.25, 0.5, 1.0, 2.0)
"""Trial distances (px) from the limb within which edges are counted.

The trial distance with the most significant result is used.
"""
_ROUND = 0.1
"""Assumed radius of curvature of coasts and other lines that are not a limb, as a fraction of the image size.
"""
_BESIDE = 0.05
"""Distance from the limb within which edges beside the limb are counted, as a fraction of the image size.

The number of edges beside the limb determines the density of chance edges.
"""


@dataclass(frozen=True, slots=True)
class LimbInView:
    """Length (px) of the part of a limb that should show edges in an image, and crossings with scan lines.

    The scan lines cross that part `crossings` times, and the whole limb in the image `all_crossings` times.
    """

    length: float
    crossings: float
    all_crossings: float


def limb_in_view(
    points: FloatArray, inside: BoolArray, due: BoolArray, space: tuple[float, float]
) -> LimbInView:
    """Return the length of a limb in the image and the number of its crossings with scan lines.

    The points (n, 2), px, follow the closed limb. The masks (n,) mark the points inside the image, and the
    points at which the limb should show an edge. The distances between scanned columns and between scanned
    rows are `space` (2,), px.
    """
    with np.errstate(invalid="ignore"):
        step = np.abs(np.roll(points, -1, axis=0) - points)
    both = [kept & np.roll(kept, -1) for kept in (inside & due, inside)]
    size = np.hypot(step[:, 0], step[:, 1])
    # The x and y components of a step along the limb give the numbers of crossed columns and rows.
    crossings = np.sum(step * (step > _GRAZING * size[:, None]) / np.array(space), axis=1)
    return LimbInView(
        *(float(np.sum(each)) for each in (size[both[0]], crossings[both[0]], crossings[both[1]]))
    )


def log10_chance(
    limb: LimbInView, residuals: FloatArray, others: FloatArray, camera: CameraModel, unknowns: int
) -> float:
    """Return log10 of an upper bound on the expected number of limbs that fit equally well by chance.

    The distances from the fitted limb, px, are `residuals` (k,) for the edges that belong to the limb, and
    `others` (m,) for all other edges. The number of fitted `unknowns` is 2 for the nadir, and 3 for nadir and
    altitude.
    """
    size = float(max(camera.columns, camera.rows))
    lines = max(limb.crossings, float(len(residuals)), 1.0)
    beside = _BESIDE * size
    # One edge is added, so that the density of chance edges is positive even without edges near the limb.
    near = np.count_nonzero(np.abs(others) < beside) + 1.0
    density = near / (2.0 * beside * max(limb.all_crossings, lines))
    best = math.inf
    for gate in _GATES:
        share = np.count_nonzero(np.abs(residuals) <= gate) / lines
        pieces = min(lines, limb.length / (2.0 * math.sqrt(2.0 * gate * _ROUND * size)))
        chance = min(2.0 * gate * density, 0.5)
        cones = math.log10(len(_GATES)) + unknowns * math.log10(size / gate)
        # Chernoff's bound (log10) on the probability of chance edges on the fraction `share` of the segments.
        tail = 0.0
        if share > chance:
            rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - chance))
            tail = -pieces * (share * math.log(share / chance) + rest) / math.log(10.0)
        best = min(best, cones + tail)
    return best


_UNKNOWN_TURN = 1.0
"""Prior standard deviation (rad) of an unknown rotation about nadir.

For a spherical Earth, the rotation about nadir has no effect.
"""
_NIGHT = np.radians(-8.0)
"""Elevation of the Sun at a limb point (rad) below which the limb is too dark to show an edge."""
_LIMB_RAYS, _FINE_RAYS = 120, 720
"""Numbers of points that represent the limb.

`_LIMB_RAYS` points are used to compute the coverage of the limb by edges, and `_FINE_RAYS` points to compute
the length of the limb in the image.
"""
_BORDER = 8.0
"""Width of the zone along the image border (px) in which no edges of the limb are expected."""
_NEAR = 0.0375
"""Largest distance from an edge at which a limb point counts as covered, as a fraction of the image size."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A fitted horizon, with the evidence for and against this horizon.

    Attributes:
        fit: the fitted limb.
        members: mask of the image's edges that lie on the fitted horizon (n,).
        squares: squared distance of each edge from the fitted horizon (n,), relative to its variance. The
            value is infinite far from the horizon, and NaN for an edge nearby that is not a limb point.
        limb: limb points from the edges on the fitted horizon.
        residual: rms distance of the fitted edges from the limb, px.
        guess: initial guess from which the fit started.
        lighting: agreement of the image's brightness with the view of the Earth that the horizon implies.
        coverage: fraction of the sunlit limb in the image that has an edge nearby; 1 without a sunlit limb.
        night: fraction of the edges on the fitted limb at which the Sun's elevation is below `_NIGHT`.
        allowance: standard deviation of the nadir per axis, rad, due to unmodelled effects.
        chance: log10 of the expected number of horizons that fit equally well by chance and agree with the
            known directions.
        breadth: ratio of the median width of the edges on the horizon to the width expected from the
            brightness profile of the atmosphere.
        not_space: why the image beyond the horizon is not space, or an empty string if it may be space.
        altitude_off: difference, in standard deviations, between `implied_altitude` and the known altitude.
            If the altitude is unknown, the distance to the range `HorizonSettings.altitudes` is used.
        implied_altitude: altitude that the edges imply, m; NaN if the edges do not determine an altitude.
    """

    fit: FittedLimb
    members: BoolArray
    squares: FloatArray
    limb: LimbPoints
    residual: float
    guess: InitialGuess
    lighting: Agreement
    coverage: float
    night: float
    allowance: float
    chance: float
    breadth: float
    not_space: str
    altitude_off: float
    implied_altitude: float

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) of the nadir, rad^2, including the allowance for unmodelled effects.

        If the edges contradict a known altitude by more than one standard deviation, the limb height or the
        focal length is wrong. This error also displaces the nadir, so that the covariance is multiplied by
        the square of `altitude_off`.
        """
        nadir = self.fit.view.nadir
        across = np.eye(3) - np.outer(nadir, nadir)
        covariance = np.asarray(self.fit.nadir_covariance + self.allowance**2 * across)
        if self.guess.place.altitude_sigma >= UNKNOWN:
            return covariance
        return max(1.0, self.altitude_off**2) * covariance


def prior_of(settings: HorizonSettings, turn: float, altitude: float) -> Prior:
    """Return the prior of a limb fit, with the standard deviations of rotation about nadir and altitude."""
    limb = settings.limb_height_sigma, altitude, settings.uneven_limb_sigma
    return Prior(min(turn, _UNKNOWN_TURN), *limb)


def examine(
    guess: InitialGuess,
    observation: Observation,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
) -> Hypothesis | None:
    """Return the horizon hypothesis fitted from an initial guess, or None if no limb can be fitted."""
    place, stand = guess.place, guess.orientation
    sun = sun_from(place, knowledge)
    prior = prior_of(settings, stand.sigma, place.altitude_sigma)
    fitted = _fitted(guess, observation, sun, settings, prior)
    if fitted is None:
        return None
    fit, limb = fitted
    view, altitude_known = fit.view, place.altitude_sigma < UNKNOWN
    members = near_limb(view, observation, settings.tolerance)
    used = np.zeros(len(observation.edges), dtype=bool)
    used[limb.index[fit.used]] = True
    squares = np.where(members, np.nan, np.inf)
    squares[limb.index] = (fit.residuals / limb.sigma) ** 2
    pixel = float(np.median(observation.rays.pixel[used]))
    air = UNIT_DEPTH_HEIGHT / (view.limb_distance * pixel)
    # No edges are expected on the part of the limb that is known to be on the night side.
    rays = limb_rays(view, _FINE_RAYS)
    points = camera.project(rays)
    inside = camera.contains(points, -_BORDER) & observation.visible(points)
    due: BoolArray = inside if sun is None else sun_elevation(view, rays, sun) > _LOWEST_SUN
    columns, rows = (max(1.0, size / settings.edges.lines) for size in (camera.columns, camera.rows))
    others = (limb_residuals(view, observation.rays.rays) / observation.rays.pixel)[~used]
    residuals = (fit.residuals / limb.pixel)[fit.used]
    in_view = limb_in_view(points, inside, due, (columns, rows))
    chance = log10_chance(in_view, residuals, others, camera, 2 if altitude_known else 3)
    return Hypothesis(
        fit,
        used,
        squares,
        select(limb, fit.used),
        float(np.sqrt(np.mean(residuals**2))),
        guess,
        agreement(view, sun, observation.samples),
        _coverage(view, observation, used, sun, camera),
        _night_share(view, observation.rays.rays[members], sun),
        limb_tilt_sigma(view, stand, settings),
        chance + math.log10(stand.share),
        float(np.median(observation.edges.scale[used])) / (air + 1.0 + settings.edges.psf_sigma),
        why_not_space(view, sun, observation.samples, pixel),
        *_altitude_off(fit, limb, prior, settings.altitudes),
    )


def _night_share(view: LimbView, rays: FloatArray, sun: FloatArray | None) -> float:
    """Return the fraction of limb points at `rays` (n, 3) at which the Sun's elevation is below `_NIGHT`."""
    if sun is None or not len(rays):
        return 0.0
    return float(np.mean(sun_elevation(view, rays, sun) < _NIGHT))


def _altitude_off(
    fit: FittedLimb, limb: LimbPoints, prior: Prior, altitudes: tuple[float, float]
) -> tuple[float, float]:
    """Return the distance (sigma) of the implied altitude from prior knowledge, and the implied altitude, m.

    A known altitude is compared with the altitude of a fit in which the altitude is unknown. If no altitude
    is known, the fitted altitude is compared with the range `altitudes`, m.
    """
    if prior.altitude >= UNKNOWN:
        (low, high), altitude = altitudes, fit.view.surface.height_of(fit.view.position)
        off = max(low - altitude, altitude - high, 0.0)
        return off / fit.altitude_sigma(SPHERE_ALTITUDE_SIGMA), altitude
    free = fit_limb(fit.view, limb.rays, limb.sigma, replace(prior, altitude=UNKNOWN))
    if free is None:
        return 0.0, math.nan
    known, altitude = (each.view.surface.height_of(each.view.position) for each in (fit, free))
    sigma = math.hypot(free.altitude_sigma(SPHERE_ALTITUDE_SIGMA), prior.altitude)
    return abs(altitude - known) / sigma, altitude


def _fitted(
    guess: InitialGuess,
    observation: Observation,
    sun: FloatArray | None,
    settings: HorizonSettings,
    prior: Prior,
) -> tuple[FittedLimb, LimbPoints] | None:
    """Return the limb fitted to the edges of an initial guess, and the limb points, or None if the fit fails.

    The first Gauss-Newton step of the fit uses the steepest points of the edges. The following steps use limb
    positions from the brightness profiles of the edges.
    """
    limb = _limb_points(guess.view, observation, guess.members, sun)
    if len(limb.index) < settings.least_edges:
        return None
    start = stepped(guess.view, limb.residuals, limb.gradients, limb.sigma, prior)
    if start is None:
        return None
    limb = _limb_points(start, observation, near_limb(start, observation, settings.tolerance), sun)
    limb = _placed_by_profile(start, observation, limb, settings)
    if len(limb.index) < settings.least_edges:
        return None
    fit = fit_limb(start, limb.rays, limb.sigma, prior)
    if fit is None or np.count_nonzero(fit.used) < settings.least_edges:
        return None
    return fit, limb


def _coverage(
    view: LimbView, observation: Observation, used: BoolArray, sun: FloatArray | None, camera: CameraModel
) -> float:
    """Return the fraction of the limb in the image that is near an edge in the mask `used` (n,).

    If the Sun is known, only the sunlit limb away from the Sun's glare is counted.
    """
    rays = limb_rays(view, _LIMB_RAYS)
    if sun is not None:
        plain = (sun_elevation(view, rays, sun) > DAYLIGHT) & (rays @ (view.rotation @ sun) < np.cos(GLARE))
        rays = rays[plain]
    points = camera.project(rays)
    points = points[camera.contains(points, -_BORDER) & observation.visible(points)]
    if not len(points):
        return 1.0
    edges = observation.edges.points[used]
    apart = np.maximum(np.abs(points[:, :1] - edges[:, 0]), np.abs(points[:, 1:] - edges[:, 1]))
    space = _NEAR * max(camera.columns, camera.rows)
    return float(np.mean(apart.min(axis=1, initial=np.inf) < space))
