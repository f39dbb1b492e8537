"""One possible horizon: its edges on the limb, the fit, and the evidence for and against it.

The significance of a horizon is an upper bound of the expected number of cones, among all that differ in the
image, near which chance edges lie as often and as closely. The density of chance edges is that of the edges
beside the limb. These edges lie on curves: a coast or the rim of a cloud with radius R that touches the limb
stays within the gate g of it over 2 sqrt(2 g R). Scan lines across one such piece are not independent, so
that pieces are counted instead of scan lines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
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
from knightcube.vision.horizon.initial_guess import (
    SPHERE_ALTITUDE_SIGMA,
    InitialGuess,
    Place,
    sun_from,
)
from knightcube.vision.horizon.limb import (
    SCALE_HEIGHT,
    UNIT_DEPTH_HEIGHT,
    UNKNOWN,
    FittedLimb,
    LimbView,
    Prior,
    crossed,
    fit_limb,
    fit_profiles,
    limb_gradients,
    limb_residuals,
    stepped,
)
from knightcube.vision.horizon.settings import HorizonKnowledge, HorizonSettings

_GRAZING = 0.3
"""Least cosine between a scan line and the normal of the limb: a more oblique line is inaccurate."""
LOWEST_SUN = np.radians(1.0)
"""Least elevation of the Sun at a limb point (rad): with a lower Sun the limb appears higher."""
_FINE = SCALE_HEIGHT / 6.0
"""Pixel size (m) below which the steepest point is used: the profile exceeds the samples that are kept."""
_ALIKE = 10.0
"""Correlation length (px) of the brightness behind the limb."""
_PIXEL_SIGMA = 12.0**-0.5
"""Standard deviation of the blur by a square pixel (px)."""
_LEAST_SPREAD = 0.03
"""Least error of a position fitted to the profile (px)."""
_OTHER_AIR = 500.0
"""Shift of the limb (m) between bright and dark ground, in air thicker or thinner than assumed."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbPoints:
    """The edges assigned to the limb.

    Attributes:
        index: (n,) which of the picture's edges they are.
        rays: (n, 3).
        sigma: (n,) rad, their spreads normal to the limb.
        pixel: (n,) rad, a pixel's size there normal to the limb.
        inward: (n,) cosine of the angle between scan line and the way across the limb.
        residuals, gradients: (n,) and (n, 5), of the edges, see `limb_gradients`.
    """

    index: IntArray
    rays: FloatArray
    sigma: FloatArray
    pixel: FloatArray
    inward: FloatArray
    residuals: FloatArray
    gradients: FloatArray

    def chosen(self, which: BoolArray) -> LimbPoints:
        """Return the points `which` (n,)."""
        return LimbPoints(*(getattr(self, each.name)[which] for each in fields(self)))


def near_limb(view: LimbView, observation: Observation, tolerance: float) -> BoolArray:
    """Return which edges (n,) lie within `tolerance` px of a view's limb, their bright side towards nadir."""
    near = np.abs(limb_residuals(view, observation.rays.rays)) < tolerance * observation.rays.pixel
    return np.asarray(near & (observation.rays.brighter @ view.nadir > 0.0))


def limb_points(
    view: LimbView, observation: Observation, members: BoolArray, sun: FloatArray | None
) -> LimbPoints:
    """Return the members in daylight whose scan line is not too oblique to the limb."""
    chosen = np.flatnonzero(members)
    rays = observation.rays.rays[chosen]
    if sun is not None:
        day = sun_elevation(view, rays, sun) > LOWEST_SUN
        chosen, rays = chosen[day], rays[day]
    residuals, gradients = limb_gradients(view, rays)
    slopes = _slopes(observation, chosen, rays, gradients)
    size = np.sqrt(np.einsum("ij,ij->i", slopes, slopes))
    inward = -np.einsum("ij,ij->i", slopes, observation.edges.towards[chosen]) / size
    sigma = observation.edges.sigma[chosen] * inward * size
    points = LimbPoints(chosen, rays, sigma, size, inward, residuals, gradients)
    return points.chosen(inward > _GRAZING)


def placed_by_profile(
    view: LimbView, observation: Observation, limb: LimbPoints, settings: HorizonSettings
) -> LimbPoints:
    """Return the points placed by the limb's profile if pixels are coarse enough for it."""
    reach = np.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0))
    metres = limb.pixel * reach
    if not len(metres) or float(np.median(metres)) < _FINE:
        return limb
    blur = np.hypot(settings.edges.psf_sigma, _PIXEL_SIGMA) * metres
    edges = observation.edges.chosen(limb.index)
    shift, spread, sound = fit_profiles(edges.profile, edges.profile_steps, metres * limb.inward, blur)
    rays = limb.rays + shift[:, None] * observation.rays.brighter[limb.index]
    rays /= np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]
    # Lines closer together than the ground's features are not independent.
    alike = np.sqrt(max(1.0, _ALIKE / observation.space))
    least = np.hypot(_LEAST_SPREAD, _OTHER_AIR / (metres * limb.inward))
    sigma = alike * np.hypot(spread, least) * limb.inward * limb.pixel
    return replace(limb, rays=rays, sigma=sigma).chosen(sound)


def _slopes(
    observation: Observation, chosen: IntArray, rays: FloatArray, gradients: FloatArray
) -> FloatArray:
    """Return the residuals' change (n, 2) rad a pixel to the right and downwards, from gradients (n, 5)."""
    # The effect of a turn d on a residual, g (d x u), a step s of the ray u does with d = u x s.
    turns = crossed(gradients[:, :3], rays)
    across, down = observation.across[chosen], observation.down[chosen]
    return -np.stack([np.einsum("ij,ij->i", turns, step) for step in (across, down)], axis=1)


_GATES = (0.25, 0.5, 1.0, 2.0)
"""Gates (px): the gate with the fewest chance cones counts."""
_ROUND = 0.1
"""Radius of the curves on which chance edges lie, as a fraction of the image size."""
_BESIDE = 0.05
"""Distance from the limb within which other edges give the density, as a fraction of the image size."""


@dataclass(frozen=True, slots=True)
class LimbInView:
    """The limb in a picture.

    Attributes:
        length: px, of the part that should show edges.
        crossings: of that part and the scan lines.
        all_crossings: of all that is in the picture, and the scan lines.
    """

    length: float
    crossings: float
    all_crossings: float


def limb_in_view(
    points: FloatArray, inside: BoolArray, due: BoolArray, space: tuple[float, float]
) -> LimbInView:
    """Return a closed limb `points` (n, 2) px where they are `inside` the picture (n,), and `due` (n,) there.

    `space` is px between the columns that are read, and between the rows.
    """
    with np.errstate(invalid="ignore"):
        step = np.abs(np.roll(points, -1, axis=0) - points)
    both = [kept & np.roll(kept, -1) for kept in (inside & due, inside)]
    size = np.hypot(step[:, 0], step[:, 1])
    # A column is crossed where the limb goes along x.
    crossings = np.sum(step * (step > _GRAZING * size[:, None]) / np.array(space), axis=1)
    return LimbInView(
        *(float(np.sum(each)) for each in (size[both[0]], crossings[both[0]], crossings[both[1]]))
    )


def log10_chance(
    limb: LimbInView, residuals: FloatArray, others: FloatArray, camera: CameraModel, unknowns: int
) -> float:
    """Return log10 of the bound on chance cones as good as a limb.

    `residuals` (k,) px are those of its edges, `others` (m,) px the distances of all other edges from the
    limb; `unknowns` is 2 for nadir, 3 with the altitude.
    """
    size = float(max(camera.columns, camera.rows))
    lines = max(limb.crossings, float(len(residuals)), 1.0)
    beside = _BESIDE * size
    # One edge is added: without an edge beside the limb the density is still not zero.
    near = np.count_nonzero(np.abs(others) < beside) + 1.0
    density = near / (2.0 * beside * max(limb.all_crossings, lines))
    best = math.inf
    for gate in _GATES:
        hits = np.count_nonzero(np.abs(residuals) <= gate) / lines
        pieces = min(lines, limb.length / (2.0 * math.sqrt(2.0 * gate * _ROUND * size)))
        chance = min(2.0 * gate * density, 0.5)
        cones = math.log10(len(_GATES)) + unknowns * math.log10(size / gate)
        best = min(best, cones + _log10_tail(pieces, hits, chance))
    return best


def _log10_tail(number: float, share: float, chance: float) -> float:
    """Return log10 of the probability that a `share` of `number` or more happens (Chernoff's bound)."""
    if share <= chance:
        return 0.0
    rest = 0.0 if share >= 1.0 else (1.0 - share) * math.log((1.0 - share) / (1.0 - chance))
    return -number * (share * math.log(share / chance) + rest) / math.log(10.0)


_UNKNOWN_TURN = 1.0
"""Prior standard deviation of an unknown rotation about nadir (rad); it has no effect on a sphere."""
_NIGHT = np.radians(-8.0)
"""Elevation of the Sun (rad) below which an edge is not the limb."""
_LIMB_RAYS, _FINE_RAYS = 120, 720
_BORDER = 8.0
"""Distance from the image border (px) within which the limb needs no edges."""
_NEAR = 0.0375
"""Distance within which an edge covers the limb, as a fraction of the image size: about two scan lines."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A fitted horizon and the evidence for and against it.

    Attributes:
        fit: the limb.
        members: (n,) the picture's edges that lie on it.
        limb: those edges, where the fit places them.
        residual: px rms normal to the limb, of the members.
        guess: start of the fit.
        lighting: how the picture agrees with it.
        coverage: the share of the lit limb that runs through the picture near a member; 1 where there is
            none.
        night: the share of members where the Sun is well below the horizon.
        allowance: rad an axis, added to the covariance for unmodelled effects.
        chance: log10 of the expected number of cones as good among chance edges, see `log10_chance`.
        breadth: of the members' edges over the air's, medians.
        altitude_off: sigmas by which a fitted altitude lies beyond `HorizonSettings.altitudes`; 0 for a
            known one.
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
        """The nadir's covariance (3, 3) rad^2, allowances included."""
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
    """Return the horizon fitted from a guess and tested; None if no limb can be fitted."""
    place, stand = guess.place, guess.orientation
    sun = sun_from(place, knowledge)
    prior = Prior(min(stand.sigma, _UNKNOWN_TURN), settings.limb_height_sigma, place.altitude_sigma)
    fitted = _fitted(guess.view, observation, guess.members, sun, settings, prior)
    if fitted is None:
        return None
    fit, limb = fitted
    members = near_limb(fit.view, observation, settings.tolerance)
    used = np.zeros(len(observation.edges), dtype=bool)
    used[limb.index[fit.used]] = True
    night = 0.0
    if sun is not None and np.any(members):
        night = float(np.mean(sun_elevation(fit.view, observation.rays.rays[members], sun) < _NIGHT))
    return Hypothesis(
        fit,
        used,
        limb.chosen(fit.used),
        float(np.sqrt(np.mean((fit.residuals / limb.pixel)[fit.used] ** 2))),
        guess,
        agreement(fit.view, sun, observation.samples),
        _coverage(fit.view, observation, used, sun, camera),
        night,
        settings.sphere_sigma if np.isinf(stand.sigma) else 0.0,
        _chance(guess, fit, limb, observation, used, sun, camera, settings),
        _breadth(fit.view, observation, used, settings),
        _altitude_off(fit, place, settings),
    )


def _altitude_off(fit: FittedLimb, place: Place, settings: HorizonSettings) -> float:
    if place.altitude_sigma < UNKNOWN:
        return 0.0
    (low, high), altitude = settings.altitudes, fit.view.surface.height_of(fit.view.position)
    return max(low - altitude, altitude - high, 0.0) / fit.altitude_sigma(SPHERE_ALTITUDE_SIGMA)


def _chance(
    guess: InitialGuess,
    fit: FittedLimb,
    limb: LimbPoints,
    observation: Observation,
    used: BoolArray,
    sun: FloatArray | None,
    camera: CameraModel,
    settings: HorizonSettings,
) -> float:
    """Return log10 of the number of chance cones; limb that is known to lie in the night needs no edges."""
    rays = limb_rays(fit.view, _FINE_RAYS)
    points = camera.project(rays)
    inside = camera.contains(points, -_BORDER)
    due: BoolArray = inside if sun is None else sun_elevation(fit.view, rays, sun) > LOWEST_SUN
    columns, rows = (max(1.0, size / settings.edges.lines) for size in (camera.columns, camera.rows))
    others = (limb_residuals(fit.view, observation.rays.rays) / observation.rays.pixel)[~used]
    residuals = (fit.residuals / limb.pixel)[fit.used]
    in_view = limb_in_view(points, inside, due, (columns, rows))
    unknowns = 3 if guess.place.altitude_sigma >= UNKNOWN else 2
    chance = log10_chance(in_view, residuals, others, camera, unknowns)
    return chance + math.log10(guess.orientation.share)


def _breadth(view: LimbView, observation: Observation, used: BoolArray, settings: HorizonSettings) -> float:
    """Return the breadth of the used edges over that of the air and the blur."""
    reach = math.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0))
    air = UNIT_DEPTH_HEIGHT / (reach * float(np.median(observation.rays.pixel[used])))
    return float(np.median(observation.edges.scale[used])) / (air + 1.0 + settings.edges.psf_sigma)


def _fitted(
    view: LimbView,
    observation: Observation,
    members: BoolArray,
    sun: FloatArray | None,
    settings: HorizonSettings,
    prior: Prior,
) -> tuple[FittedLimb, LimbPoints] | None:
    """Return the limb through the members, and the places it was fitted to; None if the fit fails.

    One step towards the steepest places of the edges, and from there the fit to their profiles.
    """
    limb = limb_points(view, observation, members, sun)
    if len(limb.index) < settings.least_edges:
        return None
    start = stepped(view, limb.residuals, limb.gradients, limb.sigma, prior)
    if start is None:
        return None
    limb = limb_points(start, observation, near_limb(start, observation, settings.tolerance), sun)
    limb = placed_by_profile(start, observation, limb, settings)
    if len(limb.index) < settings.least_edges:
        return None
    fit = fit_limb(start, limb.rays, limb.sigma, prior)
    if fit is None or np.count_nonzero(fit.used) < settings.least_edges:
        return None
    return fit, limb


def _coverage(
    view: LimbView,
    observation: Observation,
    used: BoolArray,
    sun: FloatArray | None,
    camera: CameraModel,
) -> float:
    """Return the share of the limb in view, of the lit one where the Sun is known, near a used edge."""
    rays = limb_rays(view, _LIMB_RAYS)
    if sun is not None:
        plain = (sun_elevation(view, rays, sun) > DAYLIGHT) & (rays @ (view.rotation @ sun) < np.cos(GLARE))
        rays = rays[plain]
    points = camera.project(rays)
    points = points[camera.contains(points, -_BORDER)]
    if not len(points):
        return 1.0
    space = _NEAR * max(camera.columns, camera.rows)
    edges = observation.edges.points[used]
    apart = np.maximum(
        np.abs(points[:, :1] - edges[:, 0]),
        np.abs(points[:, 1:] - edges[:, 1]),
    )
    return float(np.mean(apart.min(axis=1, initial=np.inf) < space))
