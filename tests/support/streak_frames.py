"""Simulated star frames for the tests of image processing, independent of the simulator's camera.

The directions v of fixed stars change as v' = -omega x v. The paths of the stars are sampled at steps of 0.1
px or less, and each sample is a Gaussian that is integrated over each pixel (erf). Photon, dark and read
noise are added.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import erf

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import Pinhole

# V magnitudes, and numbers of brighter stars in the whole sky (Hipparcos).
_COUNTS_V = (6.0, 6.5, 7.0, 8.0, 8.5)
_COUNTS = (4995.0, 8789.0, 15404.0, 41074.0, 61320.0)
_CHUNK_PX = 10.0
_STEP_PX = 0.1


@dataclass(frozen=True)
class Camera:
    """A star camera: electrons per second at magnitude 0, PSF sigma (px), noise (electrons)."""

    pinhole: Pinhole
    zero_magnitude: float = 1.9e10 * np.pi / 4.0 * 0.025**2
    psf_sigma: float = 1.0
    read_noise: float = 10.0
    dark: float = 50.0
    pedestal: float = 100.0
    gain: float = 1.0
    full_well: float = 20_000.0
    top: int = 65_535


def star_camera(size: int = 1024, psf_sigma: float = 1.0) -> Camera:
    """Return the demonstration's camera (1024 px for 20 deg), or its central `size` x `size` px."""
    whole = Pinhole.from_field_of_view(1024, 1024, np.deg2rad(20.0))
    return Camera(Pinhole(size, size, whole.focal_length), psf_sigma=psf_sigma)


def rate_at(theta: float, speed: float, roll: float = 0.0) -> FloatArray:
    """Return a rate (3,) of `speed` rad/s about an axis `theta` (rad) off boresight, by default to +y."""
    return speed * np.array([np.sin(theta) * np.sin(roll), np.sin(theta) * np.cos(roll), np.cos(theta)])


def random_stars(
    rng: np.random.Generator, pinhole: Pinhole, reach: float, faintest: float = 7.5
) -> tuple[FloatArray, FloatArray]:
    """Return random stars in a cap of the sky: directions (n, 3), and magnitudes (n,) up to `faintest`."""
    cap = min(pinhole.half_diagonal + reach, np.pi)
    part = 0.5 * (1.0 - np.cos(cap))
    on_sky = 10.0 ** np.interp(faintest, _COUNTS_V, np.log10(_COUNTS))
    n = rng.poisson(part * on_sky)
    z = rng.uniform(np.cos(cap), 1.0, n)
    around = rng.uniform(0.0, 2.0 * np.pi, n)
    r = np.sqrt(1.0 - z**2)
    # log10 of the counts increases by 0.49 per magnitude near V = 6.5. This slope is extrapolated to bright
    # stars.
    magnitudes = faintest + np.log10(rng.uniform(0.0, 1.0, n)) / 0.49
    return np.stack([r * np.cos(around), r * np.sin(around), z], axis=-1), magnitudes


def rotate(vectors: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return fixed stars (n, 3) in the axes of a body that has rotated by `rotation` (3,), rad."""
    angle = np.linalg.norm(rotation)
    if angle == 0.0:
        return vectors
    a = rotation / angle
    return np.asarray(
        vectors * np.cos(angle)
        - np.cross(a, vectors) * np.sin(angle)
        + np.outer(vectors @ a, a) * (1.0 - np.cos(angle))
    )


def true_endpoints(camera: Camera, directions: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return the pixels (n, 2, 2), at start and end of an exposure, of stars given at mid-exposure."""
    first = camera.pinhole.project(rotate(directions, -0.5 * rotation))
    last = camera.pinhole.project(rotate(directions, 0.5 * rotation))
    return np.stack([first, last], axis=1)


def deposit(image: FloatArray, path: FloatArray, electrons: float, sigma: float) -> None:
    """Add `electrons` uniformly over the points (m, 2) of `path`, each as a pixel-integrated Gaussian."""
    reach = int(np.ceil(6.0 * sigma))
    rows, columns = image.shape
    x0, y0 = np.floor(path.min(axis=0)).astype(int) - reach
    x1, y1 = np.ceil(path.max(axis=0)).astype(int) + reach + 1
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, columns), min(y1, rows)
    if x0 >= x1 or y0 >= y1:
        return
    root = np.sqrt(2.0) * sigma
    in_x = 0.5 * np.diff(erf((np.arange(x0, x1 + 1) - 0.5 - path[:, :1]) / root), axis=1)
    in_y = 0.5 * np.diff(erf((np.arange(y0, y1 + 1) - 0.5 - path[:, 1:]) / root), axis=1)
    image[y0:y1, x0:x1] += electrons / len(path) * (in_y.T @ in_x)


def expose(
    camera: Camera,
    directions: FloatArray,
    magnitudes: FloatArray,
    rotation: FloatArray,
    exposure: float,
    growth: float = 0.0,
) -> FloatArray:
    """Return the mean electrons (rows, columns) of stars (n, 3) while the camera rotates by `rotation` (3,).

    `growth` is the relative change of the rate over the exposure. `directions` are in the camera axes at half
    of the rotation.
    """
    image = np.zeros((camera.pinhole.rows, camera.pinhole.columns))
    electrons = camera.zero_magnitude * 10.0 ** (-0.4 * magnitudes) * exposure
    ends = true_endpoints(camera, directions, rotation)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    seen = camera.pinhole.contains(ends.mean(axis=1), margin=float(np.nanmax(length, initial=0.0)) + 10.0)
    for star in np.flatnonzero(seen):
        chunks = max(1, int(np.ceil(length[star] / _CHUNK_PX)))
        # The number of samples is 1.5 times larger, because an arc is longer than its chord and the speed
        # varies.
        steps = chunks * int(np.ceil((1.5 + growth) * _CHUNK_PX / _STEP_PX)) if length[star] > 0.0 else 1
        time = (np.arange(steps) + 0.5) / steps - 0.5
        fraction = time + 0.5 * growth * (time**2 - 0.25)
        path = camera.pinhole.project(_along(directions[star], rotation, fraction))
        for part in np.array_split(path, chunks):
            deposit(image, part, electrons[star] * len(part) / steps, camera.psf_sigma)
    return image


def _along(direction: FloatArray, rotation: FloatArray, fraction: FloatArray) -> FloatArray:
    """Return the directions (m, 3) of a star after fractions (m,) of the rotation since mid-exposure."""
    angle = np.linalg.norm(rotation)
    if angle == 0.0:
        return np.tile(direction, (len(fraction), 1))
    a = rotation / angle
    phi = (angle * fraction)[:, None]
    return np.asarray(
        direction * np.cos(phi)
        - np.cross(a, direction) * np.sin(phi)
        + (direction @ a) * a * (1 - np.cos(phi))
    )


def read_out(
    camera: Camera,
    electrons: FloatArray,
    exposure: float,
    rng: np.random.Generator,
    dtype: npt.DTypeLike = np.uint16,
) -> Image:
    """Return the frame in counts, with photon, dark and read noise, pedestal, clipping and rounding."""
    drawn = rng.poisson(electrons + camera.dark * exposure).astype(float)
    drawn = np.minimum(drawn, camera.full_well) + camera.read_noise * rng.standard_normal(electrons.shape)
    top = min(camera.top, int(np.iinfo(dtype).max))
    return np.asarray(np.clip(np.rint(drawn / camera.gain + camera.pedestal), 0, top).astype(dtype))


def star_frame(camera: Camera, rate: FloatArray, exposure: float, seed: int, faintest: float = 7.5) -> Image:
    """Return a frame of a random star field at a rate (3,), rad/s. The star field depends only on `seed`."""
    rng = np.random.default_rng(seed)
    rotation = rate * exposure
    directions, magnitudes = random_stars(rng, camera.pinhole, float(np.linalg.norm(rotation)), faintest)
    return read_out(camera, expose(camera, directions, magnitudes, rotation, exposure), exposure, rng)
