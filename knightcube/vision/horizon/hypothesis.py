"""One possible horizon: fitted in full and tested against prior knowledge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.horizon.chance import limb_in_view, log10_chance
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
from knightcube.vision.horizon.knowledge import HorizonKnowledge
from knightcube.vision.horizon.limb_equation import View, limb_residuals
from knightcube.vision.horizon.limb_fit import UNKNOWN, FittedLimb, Prior, fit_limb, stepped
from knightcube.vision.horizon.limb_points import (
    LOWEST_SUN,
    LimbPoints,
    limb_points,
    near_limb,
    placed_by_profile,
)
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT
from knightcube.vision.horizon.observation import Observation
from knightcube.vision.horizon.settings import HorizonSettings

_UNKNOWN_TURN = 1.0
"""rad: the prior on an unknown turn about nadir; on a sphere it has no effect."""
_NIGHT = np.radians(-8.0)
"""Elevation of the Sun: an edge there is not the limb."""
_LIMB_RAYS, _FINE_RAYS = 120, 720
_BORDER = 8.0
"""px."""
_NEAR = 0.0375
"""Of the picture's size, little more than the space of two scan lines: a nearer edge covers the limb."""


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
    seen: Observation,
    knowledge: HorizonKnowledge,
    settings: HorizonSettings,
    camera: CameraModel,
) -> Hypothesis | None:
    """Return the horizon fitted from a guess and tested; None if no limb can be fitted."""
    place, stand = guess.place, guess.orientation
    sun = sun_from(place, knowledge)
    prior = Prior(min(stand.sigma, _UNKNOWN_TURN), settings.limb_height_sigma, place.altitude_sigma)
    fitted = _fitted(guess.view, seen, guess.members, sun, settings, prior)
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
        limb.chosen(fit.used),
        float(np.sqrt(np.mean((fit.residuals / limb.pixel)[fit.used] ** 2))),
        guess,
        agreement(fit.view, sun, seen.samples),
        _coverage(fit.view, seen, used, sun, camera),
        night,
        settings.sphere_sigma if np.isinf(stand.sigma) else 0.0,
        _chance(guess, fit, limb, seen, used, sun, camera, settings),
        _breadth(fit.view, seen, used, settings),
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
    seen: Observation,
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
    others = (limb_residuals(fit.view, seen.rays.rays) / seen.rays.pixel)[~used]
    residuals = (fit.residuals / limb.pixel)[fit.used]
    in_view = limb_in_view(points, inside, due, (columns, rows))
    unknowns = 3 if guess.place.altitude_sigma >= UNKNOWN else 2
    chance = log10_chance(in_view, residuals, others, camera, unknowns)
    return chance + math.log10(guess.orientation.share)


def _breadth(view: View, seen: Observation, used: BoolArray, settings: HorizonSettings) -> float:
    """Return the breadth of the used edges over that of the air and the blur."""
    reach = math.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0))
    air = UNIT_DEPTH_HEIGHT / (reach * float(np.median(seen.rays.pixel[used])))
    return float(np.median(seen.edges.scale[used])) / (air + 1.0 + settings.edges.psf_sigma)


def _fitted(
    view: View,
    seen: Observation,
    members: BoolArray,
    sun: FloatArray | None,
    settings: HorizonSettings,
    prior: Prior,
) -> tuple[FittedLimb, LimbPoints] | None:
    """Return the limb through the members, and the places it was fitted to; None if the fit fails.

    One step towards the steepest places of the edges, and from there the fit to their profiles.
    """
    limb = limb_points(view, seen, members, sun)
    if len(limb.index) < settings.least_edges:
        return None
    start = stepped(view, limb.residuals, limb.gradients, limb.sigma, prior)
    if start is None:
        return None
    limb = limb_points(start, seen, near_limb(start, seen, settings.tolerance), sun)
    limb = placed_by_profile(start, seen, limb, settings)
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
