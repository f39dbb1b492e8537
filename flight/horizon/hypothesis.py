"""One supposed horizon: fitted in full, and held against everything that is known."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from flight.arrays import BoolArray, FloatArray, IntArray
from flight.horizon.azimuth import Orientation, orientation, turned
from flight.horizon.consensus import ConeCandidate
from flight.horizon.ellipsoid import MEAN_RADIUS, Ellipsoid, earth, mean_sphere
from flight.horizon.illumination import DAYLIGHT, GLARE, Agreement, agreement, limb_rays, sun_elevation
from flight.horizon.knowledge import HorizonKnowledge
from flight.horizon.limb_equation import View, crossed, limb_gradients, limb_residuals
from flight.horizon.limb_fit import UNKNOWN, FittedLimb, Prior, fit_limb, stepped
from flight.horizon.limb_profile import SCALE_HEIGHT, UNIT_DEPTH_HEIGHT
from flight.horizon.observation import Observation
from flight.horizon.profile_fit import fit_profiles
from flight.horizon.settings import HorizonSettings
from flight.lens import CameraModel

SPHERE_ALTITUDE_SIGMA = 10e3
"""m: what the Earth's flattening makes of an altitude above the mean sphere."""
_UNKNOWN_TURN = 1.0
"""rad: the prior on a turn about nadir of which nothing is known; on a sphere it changes nothing."""
_TURNS = 24
_GRAZING = 0.3
"""Cosine: a scan line that meets the limb more obliquely places it badly."""
_LOWEST_SUN = np.radians(1.0)
"""Of a limb point's Sun: lower, the light reaches high air only, and the limb appears higher."""
_FINE = SCALE_HEIGHT / 6.0
"""m a pixel: in a closer picture the steepest place serves, and the profile is longer than what is kept."""
_ALIKE = 10.0
"""px: over this length the light behind the limb is one and the same."""
_NIGHT = np.radians(-8.0)
"""Elevation of the Sun: an edge there is no limb's."""
_LIMB_RAYS = 120
_BORDER = 8.0
"""px."""
_NEAR = 0.0375
"""Of the picture's size, little more than the space of two scan lines: an edge so near covers the limb."""
_PIXEL_SIGMA = 12.0**-0.5
"""px: a square pixel's own blur."""
_LEAST_SPREAD = 0.03
"""px: what no profile is believed beyond."""
_OTHER_AIR = 500.0
"""m: by which bright and dark ground shift the limb unlike, in air thicker or thinner than believed."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where the camera is, as far as is known.

    Attributes:
        position: (3,) m, inertial axes where the real one is known.
        surface: ellipsoid or sphere.
        altitude_sigma: m, infinite where the altitude is unknown.
        located: whether the position is the real one.
    """

    position: FloatArray
    surface: Ellipsoid
    altitude_sigma: float
    located: bool

    @property
    def cosine(self) -> float:
        """The cosine of the half-angle of the limb's cone, taken for circular with the radius below."""
        distance = float(np.linalg.norm(self.position))
        radius = distance - self.surface.height_of(self.position) + UNIT_DEPTH_HEIGHT
        return float(np.sqrt(1.0 - min(1.0, radius / distance) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class Supposition:
    """A horizon before it is fitted.

    Attributes:
        place: where the camera is taken to be.
        view: the view to begin with.
        orientation: how the camera stands about nadir.
        members: (n,) the picture's edges that may lie on it.
    """

    place: Place
    view: View
    orientation: Orientation
    members: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A fitted horizon and what speaks for and against it.

    Attributes:
        fit: the limb.
        members: (n,) the picture's edges that lie on it.
        residual: px rms normal to the limb, of the members.
        supposition: what it was fitted from.
        lighting: how the picture agrees with it.
        coverage: the share of the lit limb that runs through the picture near a member; 1 where there is
            none.
        night: the share of members where the Sun is well below the horizon.
        allowance: rad an axis, to be added to the covariance for what the model leaves out.
    """

    fit: FittedLimb
    members: BoolArray
    residual: float
    supposition: Supposition
    lighting: Agreement
    coverage: float
    night: float
    allowance: float

    @property
    def covariance(self) -> FloatArray:
        """The nadir's covariance (3, 3) rad^2, allowances included."""
        nadir = self.fit.view.nadir
        across = np.eye(3) - np.outer(nadir, nadir)
        return np.asarray(self.fit.nadir_covariance + self.allowance**2 * across)


def place_of(knowledge: HorizonKnowledge, settings: HorizonSettings) -> Place | None:
    """Return where the camera is known to be; None where nothing is known of its altitude."""
    if knowledge.position is not None:
        position = np.asarray(knowledge.position, dtype=float)
        return Place(position, earth(knowledge.pole), settings.altitude_sigma, True)
    if knowledge.altitude is not None:
        return _above_sphere(knowledge.altitude, SPHERE_ALTITUDE_SIGMA)
    return None


def _above_sphere(altitude: float, sigma: float) -> Place:
    return Place(np.array([0.0, 0.0, MEAN_RADIUS + altitude]), mean_sphere(), sigma, False)


def suppose(
    candidate: ConeCandidate,
    seen: Observation,
    place: Place | None,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
) -> Supposition:
    """Return what a cone would mean; `place` is None where nothing is known of the altitude."""
    if place is None:
        sine = float(np.sqrt(max(1.0 - candidate.cosine**2, 1e-6)))
        place = _above_sphere((MEAN_RADIUS + UNIT_DEPTH_HEIGHT) / sine - MEAN_RADIUS, UNKNOWN)
    view, stand = _first_view(candidate, seen, place, knowledge)
    return Supposition(place, view, stand, candidate.members)


def examine(
    supposition: Supposition,
    seen: Observation,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
) -> Hypothesis | None:
    """Return the supposed horizon fitted and judged, or None when no limb can be fitted to it."""
    place, stand = supposition.place, supposition.orientation
    sun = _sun(knowledge, place)
    prior = Prior(min(stand.sigma, _UNKNOWN_TURN), settings.limb_height_sigma, place.altitude_sigma)
    fitted = _fitted(supposition.view, seen, supposition.members, sun, settings, prior)
    if fitted is None:
        return None
    fit, limb = fitted
    members = near_limb(fit.view, seen, settings.tolerance)
    used = np.zeros(len(seen.edges), dtype=bool)
    used[limb.index[fit.used]] = True
    night = 0.0
    if sun is not None and np.any(members):
        night = float(np.mean(sun_elevation(fit.view, seen.rays.rays[members], sun) < _NIGHT))
    return Hypothesis(
        fit,
        used,
        float(np.sqrt(np.mean((fit.residuals / limb.pixel)[fit.used] ** 2))),
        supposition,
        agreement(fit.view, sun, seen.samples),
        _coverage(fit.view, seen, used, sun, camera),
        night,
        settings.sphere_sigma if np.isinf(stand.sigma) else 0.0,
    )


def near_limb(view: View, seen: Observation, tolerance: float) -> BoolArray:
    """Tell which edges (n,) lie within `tolerance` px of a view's limb, their bright side towards nadir."""
    near = np.abs(limb_residuals(view, seen.rays.rays)) < tolerance * seen.rays.pixel
    return np.asarray(near & (seen.rays.brighter @ view.nadir > 0.0))


def _fitted(
    view: View,
    seen: Observation,
    members: BoolArray,
    sun: FloatArray | None,
    settings: HorizonSettings,
    prior: Prior,
) -> tuple[FittedLimb, _LimbPoints] | None:
    """Return the limb through the members, and the places it was fitted to; None where there is none.

    One step towards the steepest places of the edges, and from there the fit to their profiles.
    """
    limb = _limb_points(view, seen, members, sun)
    if len(limb.index) < settings.least_edges:
        return None
    start = stepped(view, limb.residuals, limb.gradients, limb.sigma, prior)
    if start is None:
        return None
    limb = _limb_points(start, seen, near_limb(start, seen, settings.tolerance), sun)
    limb = _by_profile(start, seen, limb, settings)
    if len(limb.index) < settings.least_edges:
        return None
    fit = fit_limb(start, limb.rays, limb.sigma, prior)
    if fit is None or np.count_nonzero(fit.used) < settings.least_edges:
        return None
    return fit, limb


def _coverage(
    view: View,
    seen: Observation,
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
    edges = seen.edges.points[used]
    apart = np.maximum(
        np.abs(points[:, :1] - edges[:, 0]),
        np.abs(points[:, 1:] - edges[:, 1]),
    )
    return float(np.mean(apart.min(axis=1, initial=np.inf) < space))


def _sun(knowledge: HorizonKnowledge, place: Place) -> FloatArray | None:
    if knowledge.sun is None or not place.located:
        return None
    return np.asarray(knowledge.sun / np.linalg.norm(knowledge.sun))


def _first_view(
    candidate: ConeCandidate,
    seen: Observation,
    place: Place,
    knowledge: HorizonKnowledge,
) -> tuple[View, Orientation]:
    """Return the view to begin with, and how it stands about nadir; on a sphere where that is not known."""
    down = -place.position / np.linalg.norm(place.position)
    nothing = HorizonKnowledge()
    stand = orientation(candidate.direction, down, knowledge if place.located else nothing)
    height = UNIT_DEPTH_HEIGHT
    view = View(stand.rotation, place.position, place.surface, height)
    if np.isfinite(stand.sigma):
        return view, stand
    distance = float(np.linalg.norm(place.position))
    radius = distance - place.surface.height_of(place.position)
    view = replace(view, surface=Ellipsoid(place.surface.pole, radius, radius))
    sun = _sun(knowledge, place)
    if sun is None:
        return view, stand
    turns = [
        replace(view, rotation=turned(stand.rotation, candidate.direction, angle))
        for angle in np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
    ]
    looks = [agreement(each, sun, seen.samples) for each in turns]
    best = int(
        np.argmin([look.stray * look.dark_samples + look.missing * look.lit_samples for look in looks])
    )
    return turns[best], replace(stand, rotation=turns[best].rotation)


@dataclass(frozen=True, slots=True, eq=False)
class _LimbPoints:
    """The edges taken for limb.

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

    def chosen(self, which: BoolArray) -> _LimbPoints:
        """Return those that `which` (n,) tells."""
        return _LimbPoints(*(getattr(self, each.name)[which] for each in fields(self)))


def _limb_points(view: View, seen: Observation, members: BoolArray, sun: FloatArray | None) -> _LimbPoints:
    """Return the members in daylight that no line grazes."""
    chosen = np.flatnonzero(members)
    rays = seen.rays.rays[chosen]
    if sun is not None:
        day = sun_elevation(view, rays, sun) > _LOWEST_SUN
        chosen, rays = chosen[day], rays[day]
    residuals, gradients = limb_gradients(view, rays)
    slopes = _slopes(seen, chosen, rays, gradients)
    size = np.sqrt(np.einsum("ij,ij->i", slopes, slopes))
    inward = -np.einsum("ij,ij->i", slopes, seen.edges.towards[chosen]) / size
    sigma = seen.edges.sigma[chosen] * inward * size
    points = _LimbPoints(chosen, rays, sigma, size, inward, residuals, gradients)
    return points.chosen(inward > _GRAZING)


def _by_profile(view: View, seen: Observation, limb: _LimbPoints, settings: HorizonSettings) -> _LimbPoints:
    """Return the points placed by the limb's own profile, where a pixel holds enough of it."""
    reach = np.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0))
    metres = limb.pixel * reach
    if not len(metres) or float(np.median(metres)) < _FINE:
        return limb
    blur = np.hypot(settings.edges.psf_sigma, _PIXEL_SIGMA) * metres
    edges = seen.edges.chosen(limb.index)
    shift, spread, sound = fit_profiles(edges.profile, edges.profile_steps, metres * limb.inward, blur)
    rays = limb.rays + shift[:, None] * seen.rays.brighter[limb.index]
    rays /= np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]
    # Lines closer together than the ground's features are long do not tell of it independently.
    alike = np.sqrt(max(1.0, _ALIKE / seen.space))
    least = np.hypot(_LEAST_SPREAD, _OTHER_AIR / (metres * limb.inward))
    sigma = alike * np.hypot(spread, least) * limb.inward * limb.pixel
    return replace(limb, rays=rays, sigma=sigma).chosen(sound)


def _slopes(seen: Observation, chosen: IntArray, rays: FloatArray, gradients: FloatArray) -> FloatArray:
    """Return the residuals' change (n, 2) rad a pixel to the right and downwards, from gradients (n, 5)."""
    # What a turn d does to a residual, g (d x u), a step s of the ray u does with d = u x s.
    turns = crossed(gradients[:, :3], rays)
    across, down = seen.across[chosen], seen.down[chosen]
    return -np.stack([np.einsum("ij,ij->i", turns, step) for step in (across, down)], axis=1)
