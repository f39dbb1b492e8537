"""Places the limb on a scan line by the predicted light at each height.

The profile across the edge is background + a air(h) + g ground(h), h falling by so many metres a pixel; the
place where h is that of unit optical depth is fitted together with the three brightnesses. Unlike the
steepest place, it is not shifted inwards by bright ground behind the limb nor outwards by thinning haze.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.vision.horizon.limb_profile import UNIT_DEPTH_HEIGHT, limb_light

_STEPS = 2
_OUTSIDE, _INSIDE = -8.0, 4.0
"""px from the steepest place: the part of the profile that is fitted."""
_FLOOR, _SHARE = 0.02, 0.08
"""Noise of a sample: of the limb's brightness, and of the sample's own."""
_FARTHEST = 2.0
"""px from the steepest place: a limb farther away is rejected."""
_LEAST = 7
"""Samples."""


def fit_profiles(
    profiles: FloatArray, steps: FloatArray, metres: FloatArray, blur: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the limb's places (n,) px, their spreads (n,) px, and which are sound (n,).

    `profiles` (n, m) is light at `steps` (n, m) px along each line to the bright side, NaN where there is
    none; `metres` (n,) of tangent height a pixel; `blur` (n,) m. The places are on the scale of `steps`.
    """
    usable = np.isfinite(profiles) & (steps >= _OUTSIDE) & (steps <= _INSIDE)
    light = np.where(usable, profiles, 0.0)
    enough = np.count_nonzero(usable, axis=1) >= _LEAST
    top = np.max(np.where(usable, profiles, -np.inf), axis=1, initial=0.0)
    height = np.maximum(top, 1e-12)[:, None]
    light = light / height
    weights = usable / (_FLOOR + _SHARE * np.clip(light, 0.0, 1.0)) ** 2
    place = np.zeros(len(profiles))
    amounts = np.zeros((len(profiles), 3))
    # Weak priors that keep the equations regular if a profile leaves a parameter open.
    prior = np.diag([1.0, 1.0, 1.0, 0.1])
    of_place = np.zeros((len(profiles), 4, 1))
    of_place[:, 3] = 1.0
    for _ in range(_STEPS):
        heights = UNIT_DEPTH_HEIGHT - (steps - place[:, None]) * metres[:, None]
        air, ground, air_slope, ground_slope = limb_light(heights, blur)
        if not amounts.any():
            amounts = _amounts(light, weights, air, ground)
        model = amounts[:, :1] + amounts[:, 1:2] * air + amounts[:, 2:] * ground
        shift = (amounts[:, 1:2] * air_slope + amounts[:, 2:] * ground_slope) * metres[:, None]
        columns = np.stack([np.ones_like(air), air, ground, shift], axis=2)
        weighted = columns * weights[:, :, None]
        normal = weighted.transpose(0, 2, 1) @ columns + prior
        slope = weighted.transpose(0, 2, 1) @ (light - model)[:, :, None]
        # With the step the inverse's last column: the place's variance.
        answer = np.linalg.solve(normal, np.concatenate([slope, of_place], axis=2))
        amounts = amounts + answer[:, :3, 0]
        place = place + np.minimum(np.maximum(answer[:, 3, 0], -1.0), 1.0)
    misfit = np.sum(weights * (light - model) ** 2, axis=1) / np.maximum(
        np.count_nonzero(usable, axis=1) - 4, 1
    )
    spread = np.sqrt(answer[:, 3, 1] * np.maximum(misfit, 0.3))
    sound = enough & (np.abs(place) < _FARTHEST) & (amounts[:, 1] > 0.2)
    return place, spread, sound


def _amounts(light: FloatArray, weights: FloatArray, air: FloatArray, ground: FloatArray) -> FloatArray:
    """Return background, air and ground (n, 3) that explain the light best where the limb is now."""
    columns = np.stack([np.ones_like(air), air, ground], axis=2)
    weighted = (columns * weights[:, :, None]).transpose(0, 2, 1)
    return np.asarray(np.linalg.solve(weighted @ columns + np.eye(3), weighted @ light[:, :, None])[:, :, 0])
