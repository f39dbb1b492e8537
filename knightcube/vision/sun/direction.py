"""The Sun's direction from a camera's frame.

    solution = find_sun(ArrayPixels(frame), camera, SunSettings())

A few rows are read. The rim of each patch that is brighter than the level and not too large is traced, and a
circle on the sphere is fitted to it. The circle's centre is the Sun's, even if the disc is saturated, has
glare, or is partly cut off by the frame's edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.errors import UsageError
from knightcube.vision.camera.lens import CameraModel
from knightcube.vision.camera.pixel_access import PixelAccess
from knightcube.vision.sun.disc import SPOKES, Circle, Rim, bright_patches, fit_circle, trace, window


@dataclass(frozen=True, slots=True, kw_only=True)
class SunSettings:
    """How the Sun is distinguished from other bright objects, and its assumed errors.

    At one exposure the Sun's bright disc, glare included, has one radius: give that within about a fifth;
    within wide bounds a cloud may pass for the Sun. The defaults are for a logarithmic camera like the Fuga
    15d; `LINEAR` is for a linear one whose white clouds come near to saturation.

    Attributes:
        level: counts, exceeded by the Sun's image. For a logarithmic camera well above the brightest cloud,
            so that only the disc remains; for a linear one a little below saturation.
        stride: px between the rows that are read first.
        least_radius: rad; smaller patches are hot pixels. The disc itself has 0.0047.
        greatest_radius: rad; larger patches are clouds, or the Earth.
        tolerance: px rms by which the rim may be off a circle.
        least_agreement: share of the rim within the frame that must lie on the circle.
        least_arc: rad of the rim that must be seen.
        rim_sigma: px, a rim point's error that the fit's residuals may not show.
        floor_sigma: px an axis, least error of the centre, from the pixels' pattern.
    """

    level: float = 200.0
    stride: int = 3
    least_radius: float = math.radians(0.35)
    greatest_radius: float = math.radians(0.6)
    tolerance: float = 0.25
    least_agreement: float = 0.55
    least_arc: float = math.radians(110.0)
    rim_sigma: float = 0.03
    floor_sigma: float = 0.01

    def __post_init__(self) -> None:
        if self.stride < 1:
            raise UsageError(f"stride {self.stride}: must be a whole number of pixels from 1")
        if not 0.0 < self.least_radius < self.greatest_radius < 0.5:
            raise UsageError(
                f"least_radius {self.least_radius} and greatest_radius {self.greatest_radius}: "
                "give rad that grow, the greatest below 0.5"
            )
        for name in ("level", "tolerance", "rim_sigma", "floor_sigma"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"{name} {getattr(self, name)}: must be positive")
        if not 0.5 <= self.least_agreement <= 1.0:
            raise UsageError(f"least_agreement {self.least_agreement}: must lie between 0.5 and 1")
        if not 0.0 < self.least_arc <= 2.0 * math.pi:
            raise UsageError(f"least_arc {self.least_arc}: must lie between 0 and 2 pi rad")


LINEAR = SunSettings(least_radius=math.radians(1.3), greatest_radius=math.radians(2.0))
"""Settings for a linear 8-bit camera: a white matt surface has 200 counts, the optics scatter 1 % of the
light."""


class SunStatus(Enum):
    """The outcome of the search for the Sun."""

    FOUND = "found"
    PARTIAL = "partial"
    """Found, but cut by the frame's edge: see the covariance."""
    NO_SUN = "no-sun"
    """Nothing is bright enough."""
    NOT_THE_SUN = "not-the-sun"
    """Something is bright enough, but too small, too large or not round: see the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class SunMeasurement:
    """The direction to the Sun's centre from one frame.

    Attributes:
        direction: (3,) unit vector in camera axes.
        basis: (2, 3), two unit vectors normal to it and to one another.
        tangent_covariance: (2, 2) rad^2, of the direction's error along `basis`; without the lens's
            calibration.
        point: (2,) px, of the centre; NaN outside the lens's image.
        radius: rad, of the bright disc, glare included.
        residual: px rms, of the rim points that were used.
        arc: rad of the rim that was used.
        cut: whether the frame's edge cuts the bright disc.
    """

    direction: FloatArray
    basis: FloatArray
    tangent_covariance: FloatArray
    point: FloatArray
    radius: float
    residual: float
    arc: float
    cut: bool

    @property
    def covariance(self) -> FloatArray:
        """The covariance (3, 3) rad^2 of the direction's error: of rank 2, nothing along the direction."""
        return np.asarray(self.basis.T @ self.tangent_covariance @ self.basis)

    @property
    def sigma(self) -> float:
        """The root of the mean variance over the two axes, rad."""
        return float(np.sqrt(0.5 * np.trace(self.tangent_covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class SunSolution:
    """The outcome of one frame.

    Attributes:
        sun: the measurement, when the status is FOUND or PARTIAL.
        pixels_read: number of pixels read.
    """

    status: SunStatus
    reason: str = ""
    sun: SunMeasurement | None = None
    pixels_read: int = 0


_ROUNDS = 3
"""Largest number of tracings of the rim, each from the centre of the previous circle."""
_NEAR = 0.5
"""Distance (px) of the fitted centre from the origin of the spokes that ends the tracing."""


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
