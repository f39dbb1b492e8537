"""Synthetic star lists: the output of a perfect detector for a random part of the sky.

A camera of 1024 x 1024 pixels has a random pointing and roll. The guide stars brighter than its limiting
magnitude are imaged with Gaussian centroid noise, and some stars are missing. False stars are distributed
uniformly over the frame, with the brightness of random true stars. The list is ordered by magnitudes with
errors, as a detector measures them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray, IntArray
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.startracker.attitude_fit import StarField
from knightcube.vision.startracker.index import GuideStars

PIXELS = 1024


@dataclass(frozen=True, slots=True)
class ListKind:
    """Parameters of a synthetic star list.

    Attributes:
        field_deg: field of view, edge to edge.
        noise_px: noise of a centroid along either axis.
        false_stars: number of false stars.
        faintest: V magnitude of the faintest detected star.
        magnitude_error: standard deviation of the instrumental magnitudes.
        lost: fraction of the stars that is missing.
        order: "brightness", or "none" for a shuffled list without magnitudes.
        known_deg: largest difference (deg) between true and assumed field of view; None if the range
            `searched_deg` is searched.
        distortion_px: radial distortion at the corner.
        searched_deg: lowest and highest assumed field of view if `known_deg` is None.
        bright: whether all false stars are brighter than all true stars.
        mirrored: whether the image is mirrored left to right.
    """

    field_deg: float = 12.0
    noise_px: float = 0.1
    false_stars: int = 0
    faintest: float = 6.0
    magnitude_error: float = 0.1
    lost: float = 0.0
    order: str = "brightness"
    known_deg: float | None = 0.1
    distortion_px: float = 0.0
    searched_deg: tuple[float, float] = (10.0, 30.0)
    bright: bool = False
    mirrored: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class StarList:
    """One synthetic star list, with the true stars, attitude and camera.

    Attributes:
        pixels: centroids (n, 2), x and y.
        magnitude: (n,), instrumental.
        star: index (n,) of the true guide star of each point, -1 for false stars.
        attitude: true attitude (4,), ICRS to camera.
        camera: true camera.
        kind: parameters of the list.
    """

    pixels: FloatArray
    magnitude: FloatArray
    star: IntArray
    attitude: FloatArray
    camera: Pinhole
    kind: ListKind

    def field(self) -> StarField:
        """Return the list in the form that the star tracker accepts."""
        believed_deg, scale = believed_field(self.kind)
        camera = Pinhole.from_field_of_view(PIXELS, PIXELS, float(np.deg2rad(believed_deg)))
        half = 0.5 * PIXELS / camera.focal_length
        sigma = np.full(len(self.pixels), self.kind.noise_px / camera.focal_length)
        magnitude = None if self.kind.order == "none" else self.magnitude
        seen = StarField(camera.unit_vectors(self.pixels), sigma, (half, half), scale, magnitude)
        return seen.mirrored() if self.kind.mirrored else seen


def believed_field(kind: ListKind) -> tuple[float, tuple[float, float]]:
    """Return the assumed field of view (deg) and the corresponding range of the scale."""
    if kind.known_deg is None:
        low, high = kind.searched_deg
        believed = float(np.rad2deg(2.0 * np.arctan(np.sqrt(_tangent(low) * _tangent(high)))))
    else:
        low, high = kind.field_deg - kind.known_deg, kind.field_deg + kind.known_deg
        believed = kind.field_deg
    return believed, (_tangent(low) / _tangent(believed), _tangent(high) / _tangent(believed))


def _tangent(field_deg: float) -> float:
    return float(np.tan(np.deg2rad(0.5 * field_deg)))


def draw(kind: ListKind, stars: GuideStars, rng: np.random.Generator) -> StarList:
    """Return a list of the sky. The true field of view of the camera is uniform within its tolerance."""
    off = 0.0 if kind.known_deg is None else rng.uniform(-kind.known_deg, kind.known_deg)
    camera = Pinhole.from_field_of_view(PIXELS, PIXELS, float(np.deg2rad(kind.field_deg + off)))
    attitude = normalise(rng.standard_normal(4))
    matrix = attitude_matrix(attitude)
    near = np.flatnonzero(stars.direction @ matrix[2] > np.cos(1.05 * camera.half_diagonal))
    seen_magnitude = stars.magnitude[near] + kind.magnitude_error * rng.standard_normal(len(near))
    near, seen_magnitude = (
        near[seen_magnitude < kind.faintest],
        seen_magnitude[seen_magnitude < kind.faintest],
    )
    pixels = camera.project(stars.direction[near] @ matrix.T)
    pixels = _distort(pixels, camera, kind.distortion_px)
    pixels = pixels + kind.noise_px * rng.standard_normal(pixels.shape)
    kept = camera.contains(pixels) & (rng.random(len(near)) >= kind.lost)
    near, pixels, seen_magnitude = near[kept], pixels[kept], seen_magnitude[kept]
    false = rng.uniform(-0.5, PIXELS - 0.5, (kind.false_stars, 2))
    false_magnitude = (
        rng.choice(seen_magnitude, kind.false_stars) + 0.1 * rng.standard_normal(kind.false_stars)
        if len(near)
        else np.full(kind.false_stars, kind.faintest)
    )
    if kind.bright:
        false_magnitude = seen_magnitude.min(initial=kind.faintest) - rng.random(kind.false_stars)
    pixels = np.concatenate([pixels, false])
    magnitude = np.concatenate([seen_magnitude, false_magnitude])
    star = np.concatenate([near, np.full(kind.false_stars, -1)])
    order = np.argsort(magnitude) if kind.order == "brightness" else rng.permutation(len(magnitude))
    return StarList(pixels[order], magnitude[order], star[order], attitude, camera, kind)


def draw_random(kind: ListKind, count: int, rng: np.random.Generator) -> StarList:
    """Return a list of `count` stars at random positions that match no part of the sky."""
    camera = Pinhole.from_field_of_view(PIXELS, PIXELS, float(np.deg2rad(kind.field_deg)))
    pixels = rng.uniform(-0.5, PIXELS - 0.5, (count, 2))
    magnitude = np.sort(kind.faintest - rng.exponential(1.0, count))
    nowhere = np.array([0.0, 0.0, 0.0, 1.0])
    return StarList(pixels, magnitude, np.full(count, -1), nowhere, camera, kind)


def _distort(pixels: FloatArray, camera: Pinhole, corner: float) -> FloatArray:
    """Return pixels with a radial distortion that is cubic in the distance and `corner` px at the corner."""
    centre = np.array(camera.centre)
    off = (pixels - centre) / (PIXELS / np.sqrt(2.0))
    return np.asarray(pixels + corner * off * np.sum(off**2, axis=-1, keepdims=True))


def configurations(known_deg: float | None = 0.1) -> list[ListKind]:
    """Return the twelve kinds of list of issue 4: two fields, two noise levels, three false star counts."""
    base = ListKind(known_deg=known_deg)
    return [
        replace(base, field_deg=field, noise_px=noise, false_stars=false)
        for field in (12.0, 20.0)
        for noise in (0.1, 0.5)
        for false in (0, 2, 5)
    ]


def spread_field(count: int, magnitude: bool = False) -> StarField:
    """Return `count` points in random directions near the boresight, with magnitudes if requested."""
    draw = np.random.default_rng(count)
    tangent = draw.uniform(-0.1, 0.1, (count, 2))
    direction = np.column_stack([tangent, np.ones(count)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    brightness = np.arange(float(count)) if magnitude else None
    return StarField(direction, np.full(count, 1e-5), (0.1, 0.1), magnitude=brightness)
