"""The Sun's direction from a camera's frame.

    solution = find_sun(ArrayPixels(frame), camera, SunSettings())

A few rows are read; the rim of each patch brighter than the level and not too large is traced, and a circle
on the sphere fitted to it. The circle's centre is the Sun's, whether the disc is saturated, has glare, or is
partly cut off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.camera.pixel_access import PixelAccess
from knightcube.vision.sun.candidates import bright_patches, window
from knightcube.vision.sun.circle import Circle, fit_circle
from knightcube.vision.sun.rim import SPOKES, Rim, trace
from knightcube.vision.sun.settings import SunSettings
from knightcube.vision.sun.solution import SunMeasurement, SunSolution, SunStatus

_ROUNDS = 3
"""Most tracings of the rim, each from the centre that the last one found."""
_NEAR = 0.5
"""px: a centre this close to the start of its spokes needs no further tracing."""


@dataclass(frozen=True, slots=True, eq=False)
class _Disc:
    """A bright disc: its rim, the circle through it, and px per rad (2, 2) along the rim's basis."""

    rim: Rim
    circle: Circle
    scale: FloatArray

    @property
    def axis(self) -> FloatArray:
        """The circle's middle as a unit vector (3,)."""
        return self.rim.direction(self.circle.centre)

    @property
    def stretch(self) -> float:
        """The root of by how much the lens draws a disc out there: its blur, which is round, as much less."""
        widest, narrowest = np.linalg.svd(self.scale, compute_uv=False)
        return math.sqrt(float(widest / narrowest))

    @property
    def pixels_per_radian(self) -> float:
        """The mean over all directions."""
        return float(np.sqrt(abs(np.linalg.det(self.scale))))


def find_sun(pixels: PixelAccess, camera: CameraModel, settings: SunSettings) -> SunSolution:
    """Return the Sun's direction in camera axes, or why there is none.

    Raises ValueError when the picture is not of the camera's size.
    """
    if (pixels.rows, pixels.columns) != (camera.rows, camera.columns):
        raise ValueError(
            f"a picture of {pixels.rows} x {pixels.columns} pixels: "
            f"the camera has {camera.rows} x {camera.columns}"
        )
    # Towards the corners a pinhole draws a disc out by the square of the angle's secant.
    stretch = 1.0 / np.cos(min(camera.half_diagonal, 1.2)) ** 2
    reach = settings.greatest_radius * camera.focal_length * stretch
    # A disc cut by the frame's edge shows at least half its width, or too little of its rim.
    narrowest = settings.least_radius * camera.focal_length - settings.stride
    patches, wide = bright_patches(pixels, settings.level, settings.stride, narrowest, 2.0 * reach)
    read = pixels.columns * len(range(settings.stride // 2, pixels.rows, settings.stride))
    reasons = ["a patch larger than the Sun and its glare"] if wide else []
    found: list[SunMeasurement] = []
    for patch in patches:
        # Twice the radius and a margin, for a centre outside the frame.
        near = min(2.5 * patch.half + 6.0, 2.0 * reach)
        strip, first = window(pixels, patch.middle, near)
        read += strip.size
        disc = _disc(strip, first, patch.middle, near / camera.focal_length, camera, settings)
        reason = "no round rim" if disc is None else _flaw(disc, settings)
        if disc is None or reason:
            reasons.append(f"{reason} about pixel ({patch.middle[0]:.0f}, {patch.middle[1]:.0f})")
        else:
            found.append(_measurement(disc, camera, settings))
    if not found:
        status = SunStatus.NOT_THE_SUN if reasons else SunStatus.NO_SUN
        return SunSolution(
            status, reasons[0] if reasons else f"nothing reaches {settings.level:g} counts", None, read
        )
    # There is one Sun: of several round patches the largest.
    sun = max(found, key=lambda one: one.radius)
    return SunSolution(SunStatus.PARTIAL if sun.cut else SunStatus.FOUND, "", sun, read)


def _disc(
    strip: Image, first: int, middle: FloatArray, reach: float, camera: CameraModel, settings: SunSettings
) -> _Disc | None:
    """Return the disc whose bright patch has its `middle` (2,) px there and its rim within `reach` rad."""
    axis = camera.unit_vectors(middle[None, :])[0]
    disc = None
    for _ in range(_ROUNDS):
        rim = trace(strip, first, camera, axis, settings.level, reach)
        scale = _scale(camera, rim)
        circle = fit_circle(rim.points, settings.tolerance / float(np.sqrt(abs(np.linalg.det(scale)))))
        if circle is None:
            return None
        disc = _Disc(rim, circle, scale)
        aside = float(np.linalg.norm(circle.centre))
        if aside > settings.greatest_radius:
            return None
        # Another tracing does not turn a wrong radius into the Sun's.
        alien = not 0.5 * settings.least_radius < circle.radius < 2.0 * settings.greatest_radius
        if alien or aside * disc.pixels_per_radian < _NEAR:
            break
        axis = disc.axis
    return disc


def _flaw(disc: _Disc, settings: SunSettings) -> str:
    """Return the reason why the disc is not the Sun; empty without one."""
    circle, rim = disc.circle, disc.rim
    used = int(np.count_nonzero(circle.used))
    radius = np.degrees(circle.radius)
    if circle.radius < settings.least_radius:
        return f"a patch of {radius:.2f} deg radius, too small,"
    if circle.radius > settings.greatest_radius:
        return f"a patch of {radius:.2f} deg radius, too large,"
    if used < settings.least_agreement * (len(rim.points) + rim.endless):
        return f"a rim that is round in {used} of {len(rim.points) + rim.endless} places only"
    if used * 2.0 * np.pi / SPOKES < settings.least_arc:
        return f"too short an arc of a rim, {used * 360 // SPOKES} deg,"
    residual = circle.residual * disc.pixels_per_radian
    if residual > settings.tolerance * disc.stretch:
        return f"a rim {residual:.2f} px rms off a circle"
    return ""


def _measurement(disc: _Disc, camera: CameraModel, settings: SunSettings) -> SunMeasurement:
    circle, scale = disc.circle, disc.pixels_per_radian
    used = int(np.count_nonzero(circle.used))
    rim_sigma = max(circle.residual, settings.rim_sigma / scale)
    backward = np.linalg.inv(disc.scale)
    floor = settings.floor_sigma**2 * backward @ backward.T
    axis = disc.axis
    # The rim's basis, tilted to the centre found.
    first = disc.rim.basis[0] - (disc.rim.basis[0] @ axis) * axis
    first /= np.linalg.norm(first)
    return SunMeasurement(
        direction=axis,
        basis=np.stack([first, np.cross(axis, first)]),
        tangent_covariance=rim_sigma**2 * circle.shape + floor,
        point=camera.project(axis[None, :])[0],
        radius=circle.radius,
        residual=circle.residual * scale,
        arc=used * 2.0 * np.pi / SPOKES,
        cut=disc.rim.cut > 0,
    )


def _scale(camera: CameraModel, rim: Rim) -> FloatArray:
    """Return px per rad (2, 2) about the rim's axis along its basis; the boresight's beyond the lens."""
    step = 1e-4
    ends = camera.project(np.concatenate([rim.axis + step * rim.basis, rim.axis - step * rim.basis]))
    scale = (ends[:2] - ends[2:]).T / (2.0 * step)
    return scale if np.all(np.isfinite(scale)) else camera.focal_length * np.eye(2)
