"""Model images of all stars of a scene, for any profile of the point spread function (PSF).

The images of long streaks and of spots are computed for Gaussian PSFs, see `streak_model`. Images and
derivatives are linear in the PSF. For any other profile, they are sums over the Gaussians of the profile.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from knightcube.astro.arrays import Float32Array, FloatArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks import streak_model, vibrating_streaks
from knightcube.vision.streaks.fit_windows import FitWindows, StarPixels
from knightcube.vision.streaks.geometry import GAUSSIAN, Shutter, StreakScene

ModelImages = tuple[Float32Array, FloatArray, FloatArray]
"""Images that are combined to model long streaks, images of spots, and the derivatives of these images."""

# Indices of the sky image, the only image independent of the PSF, and of the width derivative.
_SKY, _BY_WIDTH = 6, 5
# Index of the derivative with respect to the width among the derivatives of a spot.
_SPOT_BY_WIDTH = 8


def light_of(pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows) -> Float32Array:
    """Return the modelled counts (m,) of all stars of `scene` on the m fitted pixels, without sky level."""
    return _light(scene, windows, light_images(pinhole, shutter, scene, windows))


def gaussian_lights(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: FitWindows
) -> Float32Array:
    """Return the counts (k, m) of all stars on the m fitted pixels, for each of the k Gaussians as PSF."""
    parts = _gaussian_scenes(scene)
    return np.stack([_light(part, windows, light_images(pinhole, shutter, part, windows)) for part in parts])


def _light(scene: StreakScene, windows: FitWindows, images: tuple[Float32Array, FloatArray]) -> Float32Array:
    """Return the counts (m,) of all stars on the m fitted pixels, given the result of `light_images`."""
    return windows.total(*images, scene.light, np.zeros_like(scene.sky))[:-1]


def light_images(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, pixels: StarPixels
) -> tuple[Float32Array, FloatArray]:
    """Return images of long streaks (b, 1, LINES, k) and of spots (n, p, p), for stars of unit flux."""
    camera, long, spot = (pinhole, scene.motion, shutter), pixels.long, pixels.spot
    streaks, spots = [], []
    for part in _gaussian_scenes(scene):
        if scene.motion.vibration.exists:
            whole = vibrating_streaks.images(*camera, scene.stars[long], part.width, pixels.strips)
            streaks.append(whole[:, :1])
        else:
            streaks.append(streak_model.images(*camera, scene.stars[long], part.width, pixels.strips, 1))
        spots.append(streak_model.spot_derivatives(*camera, scene.stars[spot], part.sigma, pixels.patches)[0])
    if scene.profile == GAUSSIAN:
        return streaks[0], spots[0]
    shares = np.array(scene.profile.shares)
    return np.tensordot(shares.astype(np.float32), streaks, 1), np.tensordot(shares, spots, 1)


def model_images(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: StarPixels, quadratic: bool = False
) -> ModelImages:
    """Return the images that are combined to model long streaks, and the images and derivatives of spots.

    The last image of each long streak is an uninitialised buffer for the residuals. If `quadratic` is True,
    the images describe displacements that are quadratic along the path within a block of pixels.
    """
    if scene.profile == GAUSSIAN:
        return _gaussian_images(pinhole, shutter, scene, windows, quadratic)
    each = [_gaussian_images(pinhole, shutter, part, windows, quadratic) for part in _gaussian_scenes(scene)]
    parts = list(zip(_gaussian_scenes(scene), each, strict=True))
    scaled = [_share(scene, *each, share) for each, share in zip(parts, scene.profile.shares, strict=True)]
    images, spots, change = scaled[0]
    for other in scaled[1:]:
        for of_psf in (slice(_SKY), slice(_SKY + 1, -1)):
            images[:, of_psf] += other[0][:, of_psf]
        spots += other[1]
        change += other[2]
    return images, spots, change


def _share(scene: StreakScene, part: StreakScene, images: ModelImages, share: float) -> ModelImages:
    """Return the images of one Gaussian of the PSF, scaled by its `share` of the flux.

    A change of the scene's width changes the widths of all Gaussians in proportion.
    """
    streaks, spots, change = images
    streaks[:, :_SKY] *= np.float32(share)
    streaks[:, _SKY + 1 : -1] *= np.float32(share)
    streaks[:, _BY_WIDTH] *= np.float32(part.width / scene.width)
    change[:, _SPOT_BY_WIDTH] *= (part.width / scene.width) ** 2 * scene.sigma / part.sigma
    return streaks, share * spots, share * change


def _gaussian_images(
    pinhole: Pinhole, shutter: Shutter, scene: StreakScene, windows: StarPixels, quadratic: bool
) -> ModelImages:
    """Return the result of `model_images` for a Gaussian PSF of the width of the `scene`."""
    camera, long, spot = (pinhole, scene.motion, shutter), windows.long, windows.spot
    if scene.motion.vibration.exists:
        images = vibrating_streaks.images(*camera, scene.stars[long], scene.width, windows.strips)
    else:
        count = streak_model.IMAGES + (streak_model.QUADRATIC_IMAGES if quadratic else 0) + 1
        images = streak_model.images(*camera, scene.stars[long], scene.width, windows.strips, count)
    spots = streak_model.spot_derivatives(*camera, scene.stars[spot], scene.sigma, windows.patches)
    return images, *spots


def _gaussian_scenes(scene: StreakScene) -> list[StreakScene]:
    """Return one copy of `scene` for each Gaussian of its PSF, with this Gaussian as PSF."""
    widths = scene.profile.widths
    return [replace(scene, width=width * scene.width, profile=GAUSSIAN) for width in widths]
