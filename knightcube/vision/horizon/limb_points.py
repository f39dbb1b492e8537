"""Edges assigned to the limb: their places, errors, and gradients by the view."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.horizon.illumination import sun_elevation
from knightcube.vision.horizon.limb_equation import View, crossed, limb_gradients, limb_residuals
from knightcube.vision.horizon.limb_profile import SCALE_HEIGHT
from knightcube.vision.horizon.observation import Observation
from knightcube.vision.horizon.profile_fit import fit_profiles
from knightcube.vision.horizon.settings import HorizonSettings

_GRAZING = 0.3
"""Cosine: a scan line more oblique to the limb places it badly."""
LOWEST_SUN = np.radians(1.0)
"""Of a limb point's Sun: lower, the light reaches high air only, and the limb appears higher."""
_FINE = SCALE_HEIGHT / 6.0
"""m a pixel: with finer pixels the steepest place is used; the profile is longer than the samples kept."""
_ALIKE = 10.0
"""px: length over which the light behind the limb is correlated."""
_PIXEL_SIGMA = 12.0**-0.5
"""px: a square pixel's own blur."""
_LEAST_SPREAD = 0.03
"""px: least error of a profile's place."""
_OTHER_AIR = 500.0
"""m: shift of the limb between bright and dark ground in air thicker or thinner than assumed."""


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


def near_limb(view: View, seen: Observation, tolerance: float) -> BoolArray:
    """Return which edges (n,) lie within `tolerance` px of a view's limb, their bright side towards nadir."""
    near = np.abs(limb_residuals(view, seen.rays.rays)) < tolerance * seen.rays.pixel
    return np.asarray(near & (seen.rays.brighter @ view.nadir > 0.0))


def limb_points(view: View, seen: Observation, members: BoolArray, sun: FloatArray | None) -> LimbPoints:
    """Return the members in daylight whose scan line is not too oblique to the limb."""
    chosen = np.flatnonzero(members)
    rays = seen.rays.rays[chosen]
    if sun is not None:
        day = sun_elevation(view, rays, sun) > LOWEST_SUN
        chosen, rays = chosen[day], rays[day]
    residuals, gradients = limb_gradients(view, rays)
    slopes = _slopes(seen, chosen, rays, gradients)
    size = np.sqrt(np.einsum("ij,ij->i", slopes, slopes))
    inward = -np.einsum("ij,ij->i", slopes, seen.edges.towards[chosen]) / size
    sigma = seen.edges.sigma[chosen] * inward * size
    points = LimbPoints(chosen, rays, sigma, size, inward, residuals, gradients)
    return points.chosen(inward > _GRAZING)


def placed_by_profile(
    view: View, seen: Observation, limb: LimbPoints, settings: HorizonSettings
) -> LimbPoints:
    """Return the points placed by the limb's profile if pixels are coarse enough for it."""
    reach = np.sqrt(max(float(view.position @ view.position) - view.surface.equatorial**2, 1.0))
    metres = limb.pixel * reach
    if not len(metres) or float(np.median(metres)) < _FINE:
        return limb
    blur = np.hypot(settings.edges.psf_sigma, _PIXEL_SIGMA) * metres
    edges = seen.edges.chosen(limb.index)
    shift, spread, sound = fit_profiles(edges.profile, edges.profile_steps, metres * limb.inward, blur)
    rays = limb.rays + shift[:, None] * seen.rays.brighter[limb.index]
    rays /= np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]
    # Lines closer together than the ground's features are not independent.
    alike = np.sqrt(max(1.0, _ALIKE / seen.space))
    least = np.hypot(_LEAST_SPREAD, _OTHER_AIR / (metres * limb.inward))
    sigma = alike * np.hypot(spread, least) * limb.inward * limb.pixel
    return replace(limb, rays=rays, sigma=sigma).chosen(sound)


def _slopes(seen: Observation, chosen: IntArray, rays: FloatArray, gradients: FloatArray) -> FloatArray:
    """Return the residuals' change (n, 2) rad a pixel to the right and downwards, from gradients (n, 5)."""
    # The effect of a turn d on a residual, g (d x u), a step s of the ray u does with d = u x s.
    turns = crossed(gradients[:, :3], rays)
    across, down = seen.across[chosen], seen.down[chosen]
    return -np.stack([np.einsum("ij,ij->i", turns, step) for step in (across, down)], axis=1)
