"""One possible horizon: its edges on the limb, the fit, and the evidence for and against it.

The significance of a horizon is an upper bound of the expected number of cones, among all that differ in the
image, near which chance edges lie as often and as closely. The density of chance edges is that of the edges
beside the limb. These edges lie on curves: a coast or the rim of a cloud with radius R that touches the limb
stays within the gate g of it over 2 sqrt(2 g R). Scan lines across one piece of such a curve are not
independent, so that pieces are counted instead of scan lines.
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
)
from knightcube.vision.horizon.initial_guess import SPHERE_ALTITUDE_SIGMA, InitialGuess, sun_from
from knightcube.vision.horizon.limb import (
    SCALE_HEIGHT,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    FittedLimb,
    LimbView,
    Prior,
    fit_limb,
    fit_profiles,
    limb_gradients,
    limb_residuals,
    stepped,
)
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

_GRAZING = 0.3
"""Minimum cosine of the angle between a scan line and the normal of the limb. More oblique lines are
inaccurate."""
_LOWEST_SUN = np.radians(1.0)
"""Minimum elevation of the Sun at a limb point (rad), because the limb appears higher if the Sun is lower."""
_FINE = SCALE_HEIGHT / 6.0
"""Pixel size (m) below which the steepest point of an edge is used, because the profile extends beyond the
stored samples."""
_CORRELATED = 10.0
"""Correlation length (px) of the brightness behind the limb."""
_PIXEL_SIGMA = 12.0**-0.5
"""Standard deviation of the blur by a square pixel (px)."""
_LEAST_SPREAD = 0.03
"""Minimum error of a limb position that is fitted to a brightness profile (px)."""
_OTHER_AIR = 500.0
"""Difference (m) of the limb's apparent height between bright and dark ground that an unknown density of the
air causes."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbPoints:
    """The edges assigned to the limb.

    Attributes:
        index: indices of the limb's edges among the edges of the image (n,).
        rays: directions (n, 3).
        sigma: standard deviations normal to the limb (n,), rad.
        pixel: size of a pixel normal to the limb (n,), rad.
        inward: cosine of the angle between the scan line and the normal of the limb (n,).
        residuals, gradients: residuals (n,) and their gradients (n, 5), see `limb_gradients`.
    """

    index: IntArray
    rays: FloatArray
    sigma: FloatArray
    pixel: FloatArray
    inward: FloatArray
    residuals: FloatArray
    gradients: FloatArray


def near_limb(view: LimbView, observation: Observation, tolerance: float) -> BoolArray:
    """Return which edges (n,) lie within `tolerance` px of the limb, with their bright side towards nadir."""
    near = np.abs(limb_residuals(view, observation.rays.rays)) < tolerance * observation.rays.pixel
    return np.asarray(near & (observation.rays.brighter @ view.nadir > 0.0))


def _limb_points(
    view: LimbView, observation: Observation, members: BoolArray, sun: FloatArray | None
) -> LimbPoints:
    """Return the members in daylight whose scan line is not too oblique to the limb."""
    chosen = np.flatnonzero(members)
    rays = observation.rays.rays[chosen]
    if sun is not None:
        day = sun_elevation(view, rays, sun) > _LOWEST_SUN
        chosen, rays = chosen[day], rays[day]
    residuals, gradients = limb_gradients(view, rays)
    # A step s of the ray u changes the residual as the rotation d = u x s does. The slopes (n, 2) are per
    # pixel to the right and downwards.
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
    """Return the points at the positions that a fit of their profiles gives, if pixels are coarse enough."""
    metres = limb.pixel * view.limb_distance
    if not len(metres) or float(np.median(metres)) < _FINE:
        return limb
    blur = np.hypot(settings.edges.psf_sigma, _PIXEL_SIGMA) * metres
    edges = select(observation.edges, limb.index)
    shift, spread, sound = fit_profiles(edges.profile, edges.profile_steps, metres * limb.inward, blur)
    rays = limb.rays + shift[:, None] * observation.rays.brighter[limb.index]
    rays /= np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]
    # Scan lines that are closer than the size of ground features are not independent.
    correlated = np.sqrt(max(1.0, _CORRELATED / observation.space))
    least = np.hypot(_LEAST_SPREAD, _OTHER_AIR / (metres * limb.inward))
    sigma = correlated * np.hypot(spread, least) * limb.inward * limb.pixel
    return select(replace(limb, rays=rays, sigma=sigma), sound)


_GATES = (0.25, 0.5, 1.0, 2.0)
"""Trial half widths (px) of the gate. The gate with the smallest expected number of chance cones is used."""
_ROUND = 0.1
"""Radius of the curves on which chance edges lie, as a fraction of the image size."""
_BESIDE = 0.05
"""Distance from the limb within which other edges give the density, as a fraction of the image size."""


@dataclass(frozen=True, slots=True)
class LimbInView:
    """The limb in an image.

    Attributes:
        length: length of the part that should show edges, px.
        crossings: number of crossings of that part with the scan lines.
        all_crossings: number of crossings of the whole limb in the image with the scan lines.
    """

    length: float
    crossings: float
    all_crossings: float


def limb_in_view(
    points: FloatArray, inside: BoolArray, due: BoolArray, space: tuple[float, float]
) -> LimbInView:
    """Return the limb in an image.

    Args:
        points: a closed limb (n, 2), px.
        inside: which points of the limb are inside the image (n,).
        due: which points of the limb should show an edge (n,).
        space: distance between the columns that are read, and between the rows, px.
    """
    with np.errstate(invalid="ignore"):
        step = np.abs(np.roll(points, -1, axis=0) - points)
    both = [kept & np.roll(kept, -1) for kept in (inside & due, inside)]
    size = np.hypot(step[:, 0], step[:, 1])
    # A step along x crosses columns, and a step along y crosses rows.
    crossings = np.sum(step * (step > _GRAZING * size[:, None]) / np.array(space), axis=1)
    return LimbInView(
        *(float(np.sum(each)) for each in (size[both[0]], crossings[both[0]], crossings[both[1]]))
    )


def log10_chance(
    limb: LimbInView, residuals: FloatArray, others: FloatArray, camera: CameraModel, unknowns: int
) -> float:
    """Return log10 of the bound of the number of chance cones that fit equally well as a limb.

    Args:
        limb: the limb in the image.
        residuals: residuals of the limb's edges (k,), px.
        others: distances of all other edges from the limb (m,), px.
        camera: the camera.
        unknowns: number of fitted parameters: 2 for nadir, 3 with the altitude.
    """
    size = float(max(camera.columns, camera.rows))
    lines = max(limb.crossings, float(len(residuals)), 1.0)
    beside = _BESIDE * size
    # One edge is added, so that the density of chance edges is positive if no edge lies beside the limb.
    near = np.count_nonzero(np.abs(others) < beside) + 1.0
    density = near / (2.0 * beside * max(limb.all_crossings, lines))
    best = math.inf
    for gate in _GATES:
        share = np.count_nonzero(np.abs(residuals) <= gate) / lines
        pieces = min(lines, limb.length / (2.0 * math.sqrt(2.0 * gate * _ROUND * size)))
        chance = min(2.0 * gate * density, 0.5)
        cones = math.log10(len(_GATES)) + unknowns * math.log10(size / gate)
        # The probability that this share of the pieces or more is hit by chance (Chernoff's bound).
        tail = 0.0
        if share > chance:
            rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - chance))
            tail = -pieces * (share * math.log(share / chance) + rest) / math.log(10.0)
        best = min(best, cones + tail)
    return best


_UNKNOWN_TURN = 1.0
"""Prior standard deviation of an unknown rotation about nadir (rad); it has no effect on a sphere."""
_NIGHT = np.radians(-8.0)
"""Elevation of the Sun (rad) below which an edge is not the limb."""
_LIMB_RAYS, _FINE_RAYS = 120, 720
"""Numbers of points along the limb for its coverage and for its significance."""
_BORDER = 8.0
"""Distance from the image border (px) within which the limb needs no edges."""
_NEAR = 0.0375
"""Distance within which an edge covers the limb, as a fraction of the image size: about two scan lines."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A fitted horizon and the evidence for and against it.

    Attributes:
        fit: the fitted limb.
        members: which edges of the image lie on the fitted horizon (n,).
        limb: members at their fitted positions.
        residual: rms distance of the members from the limb, px.
        guess: start of the fit.
        lighting: agreement with the brightness of the image.
        coverage: fraction of the sunlit limb in the image that has a member nearby; 1 if no such limb is in
            the image.
        night: fraction of the members at which the Sun is well below the horizon.
        allowance: standard deviation per axis of unmodelled effects, rad.
        chance: log10 of the expected number of chance cones that fit equally well, see `log10_chance`.
        breadth: median width of the members' edges, relative to the width expected from the air.
        altitude_off: distance of a fitted altitude from `HorizonSettings.altitudes`, in its standard
            deviations; 0 for a known altitude.
    """

    fit: FittedLimb
    members: BoolArray
    limb: LimbPoints
    residual: float
    guess: InitialGuess
    lighting: Agreement
    coverage: float
    night: float
    allowance: float
    chance: float
    breadth: float
    altitude_off: float

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) of the nadir, rad^2, including the allowance."""
        nadir = self.fit.view.nadir
        across = np.eye(3) - np.outer(nadir, nadir)
        return np.asarray(self.fit.nadir_covariance + self.allowance**2 * across)


def examine(
    guess: InitialGuess,
    observation: Observation,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
) -> Hypothesis | None:
    """Return the horizon fitted from a guess, with the evidence; None if no limb can be fitted."""
    place, stand = guess.place, guess.orientation
    sun = sun_from(place, knowledge)
    prior = Prior(min(stand.sigma, _UNKNOWN_TURN), settings.limb_height_sigma, place.altitude_sigma)
    fitted = _fitted(guess, observation, sun, settings, prior)
    if fitted is None:
        return None
    fit, limb = fitted
    view, altitude_known = fit.view, place.altitude_sigma < UNKNOWN
    members = near_limb(view, observation, settings.tolerance)
    used = np.zeros(len(observation.edges), dtype=bool)
    used[limb.index[fit.used]] = True
    night = 0.0
    if sun is not None and np.any(members):
        night = float(np.mean(sun_elevation(view, observation.rays.rays[members], sun) < _NIGHT))
    air = UNIT_DEPTH_HEIGHT / (view.limb_distance * float(np.median(observation.rays.pixel[used])))
    altitude_off = 0.0
    if not altitude_known:
        (low, high), altitude = settings.altitudes, view.surface.height_of(view.position)
        altitude_off = max(low - altitude, altitude - high, 0.0) / fit.altitude_sigma(SPHERE_ALTITUDE_SIGMA)
    # The part of the limb that is known to lie in the night needs no edges.
    rays = limb_rays(view, _FINE_RAYS)
    points = camera.project(rays)
    inside = camera.contains(points, -_BORDER)
    due: BoolArray = inside if sun is None else sun_elevation(view, rays, sun) > _LOWEST_SUN
    columns, rows = (max(1.0, size / settings.edges.lines) for size in (camera.columns, camera.rows))
    others = (limb_residuals(view, observation.rays.rays) / observation.rays.pixel)[~used]
    residuals = (fit.residuals / limb.pixel)[fit.used]
    in_view = limb_in_view(points, inside, due, (columns, rows))
    chance = log10_chance(in_view, residuals, others, camera, 2 if altitude_known else 3)
    return Hypothesis(
        fit,
        used,
        select(limb, fit.used),
        float(np.sqrt(np.mean(residuals**2))),
        guess,
        agreement(view, sun, observation.samples),
        _coverage(view, observation, used, sun, camera),
        night,
        settings.sphere_sigma if np.isinf(stand.sigma) else 0.0,
        chance + math.log10(stand.share),
        float(np.median(observation.edges.scale[used])) / (air + 1.0 + settings.edges.psf_sigma),
        altitude_off,
    )


def _fitted(
    guess: InitialGuess,
    observation: Observation,
    sun: FloatArray | None,
    settings: HorizonSettings,
    prior: Prior,
) -> tuple[FittedLimb, LimbPoints] | None:
    """Return the limb fitted to the members of a guess, and the fitted points; None if the fit fails.

    One step uses the steepest points of the edges; the fit that follows uses their profiles.
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
    """Return the fraction of the limb in view, of the sunlit limb if the Sun is known, near a used edge."""
    rays = limb_rays(view, _LIMB_RAYS)
    if sun is not None:
        plain = (sun_elevation(view, rays, sun) > DAYLIGHT) & (rays @ (view.rotation @ sun) < np.cos(GLARE))
        rays = rays[plain]
    points = camera.project(rays)
    points = points[camera.contains(points, -_BORDER)]
    if not len(points):
        return 1.0
    edges = observation.edges.points[used]
    apart = np.maximum(np.abs(points[:, :1] - edges[:, 0]), np.abs(points[:, 1:] - edges[:, 1]))
    space = _NEAR * max(camera.columns, camera.rows)
    return float(np.mean(apart.min(axis=1, initial=np.inf) < space))
