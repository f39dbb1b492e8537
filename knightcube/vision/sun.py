"""Sun direction from one image, or from the images of several cameras and the solar strings.

    solution = find_sun(image, camera)

Only every n-th row of the image is read (`stride`), and bright patches on the rows are candidates for the
Sun. The edge of a bright patch is traced along radial lines (spokes) from its centre, and a circle on the
sphere is fitted to the edge points. The centre of the fitted circle is the centre of the Sun, even if the
disc is saturated, has glare, or is truncated by the edge of the image. The initial circle is the consensus
among circles through triples of edge points, and is refined by geometric least squares (Gauss-Newton).
Tukey's biweight of each point's distance from the circle (Huber 1981, Robust Statistics, chapter 7) excludes
a cloud beside the disc or a hot pixel on its edge.

The function `sun_of_cameras` reads the cameras in an order that depends on the coarse Sun direction from the
solar strings (Meller et al., chapter 2). If no camera finds the Sun, the coarse direction is returned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.ndimage import find_objects, label

from knightcube.astro.arrays import BoolArray, FloatArray, Image, check_fields, check_type, tangent_basis
from knightcube.astro.quaternion import attitude_matrix
from knightcube.errors import ArgumentError, UsageError
from knightcube.vision.camera.lens import CameraModel, MountedCamera, image_of_camera
from knightcube.vision.solar_cells import CoarseSun, CoarseSunStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class SunSettings:
    """Settings that distinguish the Sun from other bright objects, and assumed errors of the Sun direction.

    At a given exposure, the bright disc of the Sun, including its glare, has a fixed radius. The radius
    limits should differ from the radius of the disc with its glare by about a fifth. If the radius limits are
    wider, a cloud may be mistaken for the Sun. The default values fit a logarithmic 8-bit camera like the
    Fuga 15d, with a threshold of 200 of 255 counts and a disc radius of 0.35 to 0.6 deg. `LINEAR` fits a
    linear 8-bit camera in which white clouds are close to saturation, with a threshold of 200 of 255 counts
    and a disc radius of 1.3 to 2.0 deg. For another linear camera, use
    `replace(LINEAR, level=...)`, because `SunSettings(level=...)` has the radius limits of a logarithmic
    camera.

    Attributes:
        level: threshold of the Sun's image, in the unit of the pixel values. For a logarithmic camera, the
            threshold is well above the brightest cloud, so that only the disc of the Sun exceeds it. For a
            linear camera, the threshold is slightly below saturation, such as 60,000 for 16 bits or 0.9 for
            pixel values up to 1.
        stride: distance between the rows that are read first, px.
        least_radius: radius below which a bright patch is a hot pixel, rad (the Sun: 0.0047 rad).
        greatest_radius: radius above which a bright patch counts as a cloud or the Earth, rad.
        tolerance: largest rms distance of the rim of the Sun's disc from a circle, px.
        least_agreement: minimum fraction of the disc's edge points within the image that lie on the circle.
        least_arc: minimum visible arc of the disc's rim, rad.
        rim_sigma: minimum standard deviation of a point on the disc's rim, px.
        floor_sigma: minimum standard deviation of the disc's centre per axis, from the finite pixel size, px.

    Raises:
        UsageError: if a value is out of range.
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
        check_fields(self)
        if self.stride < 1:
            raise UsageError(f"stride {self.stride}: must be a whole number of pixels from 1")
        if not 0.0 < self.least_radius < self.greatest_radius < 0.5:
            raise UsageError(
                f"least_radius {self.least_radius} and greatest_radius {self.greatest_radius}: "
                "give increasing values below 0.5 rad"
            )
        for name in ("level", "tolerance", "rim_sigma", "floor_sigma"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise UsageError(f"{name} {getattr(self, name)}: must be positive")
        if not 0.5 <= self.least_agreement <= 1.0:
            raise UsageError(f"least_agreement {self.least_agreement}: must lie between 0.5 and 1")
        if not 0.0 < self.least_arc <= 2.0 * math.pi:
            raise UsageError(f"least_arc {self.least_arc}: must lie between 0 and 2 pi rad")


LINEAR = SunSettings(least_radius=math.radians(1.3), greatest_radius=math.radians(2.0))
"""Settings for a linear 8-bit camera, with 200 of 255 counts for matt white and 1 % of scattered light.

The scattered light of the Sun exceeds 200 counts up to 1.3 to 2.0 deg from its centre.
"""


class SunStatus(Enum):
    """Outcome of the search for the Sun."""

    FOUND = "found"
    PARTIAL = "partial"
    """The Sun is found, but the edge of the image truncates its disc, so that the covariance is larger."""
    NO_SUN = "no-sun"
    """No part of the image is bright enough for the Sun."""
    NOT_THE_SUN = "not-the-sun"
    """A patch of the image is bright enough for the Sun, but too small, too large or not round.

    The attribute `reason` of the solution states why the patch is not the Sun.
    """
    AMBIGUOUS = "ambiguous"
    """Two or more round discs have the size of the Sun, for example the Sun and its reflection in the lens.

    The discs are the `candidates` of the solution.
    """


@dataclass(frozen=True, slots=True, eq=False)
class SunMeasurement:
    """The direction to the centre of the Sun from one image.

    Attributes:
        direction: unit vector (3,) to the Sun in camera axes.
        basis: two unit vectors (2, 3) that are normal to the direction and to each other.
        tangent_covariance: covariance (2, 2) of the direction along `basis` without lens errors, rad^2. It
            includes the displacement by asymmetric glare, if a wider contour of the glare shows it, and
            0.05 deg per axis if the edge of the image truncates the disc.
        point: position of the Sun's centre (2,) in the image, px. The position is NaN if the lens does not
            image the direction of the Sun's centre.
        radius: radius of the bright disc with its glare, rad.
        residual: rms distance of the used rim points from the circle, px.
        arc: arc of the disc's rim that was used in the fit, rad.
        cut: whether the edge of the image truncates the bright disc.
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
        """The covariance (3, 3) of the direction error, rad^2, of rank 2 and zero along the direction."""
        return np.asarray(self.basis.T @ self.tangent_covariance @ self.basis)

    @property
    def sigma(self) -> float:
        """The standard deviation per axis, rad, computed from the mean variance over both axes."""
        return float(np.sqrt(0.5 * np.trace(self.tangent_covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class SunSolution:
    """The outcome of one image. A solution is true (`if solution:`) if the Sun was found.

    Attributes:
        status: the outcome.
        reason: short reason why no Sun was found. If the Sun was found, `reason` is empty.
        sun: the measurement, or None unless the status is FOUND or PARTIAL.
        pixels_read: number of pixels that were read.
        candidates: if the status is AMBIGUOUS, the measured discs, one of which is possibly the Sun.
    """

    status: SunStatus
    reason: str = ""
    sun: SunMeasurement | None = None
    pixels_read: int = 0
    candidates: tuple[SunMeasurement, ...] = ()

    def __bool__(self) -> bool:
        """Return whether the Sun was found."""
        return self.sun is not None

    def __repr__(self) -> str:
        """Return one line of text: status, direction and uncertainty, or the reason why no Sun was found."""
        if self.sun is None:
            return f"<SunSolution {self.status.value}: {self.reason}>"
        direction = ", ".join(f"{value:.5f}" for value in self.sun.direction)
        sigma = math.degrees(self.sun.sigma)
        return f"<SunSolution {self.status.value}: direction [{direction}], 1 sigma {sigma:.2g} deg>"


_MOST_PATCHES = 4
"""Maximum number of bright patches that are examined, starting with the largest."""
_LEAST_PATCH = 3
"""Minimum number of bright pixels of a patch on the sampled rows, so that no hot pixel counts as a patch."""
_SPOKES = 48
"""Number of spokes along which the rim of a bright patch is traced."""
_STEP = 0.5
"""Distance (px) between samples along a spoke from the centre of a patch to its rim."""
_ROUNDS = 3
"""Maximum number of times a rim is traced, each time from the centre of the last fitted circle."""
_WIDER = 1.5
"""Radius of the contour that shows asymmetric glare, as a multiple of the radius of the disc."""
_ASYMMETRIC = 3.0
"""Displacement of the wider contour, in standard deviations, above which the glare counts as asymmetric."""
_CUT = np.radians(0.05)
"""Systematic error per axis (rad) of a disc that the edge of the image truncates."""
_NEAR = 0.5
"""Largest distance (px) between the fitted centre and the origin of the spokes in the last tracing of a rim.
"""


def find_sun(image: Image, camera: CameraModel, settings: SunSettings | None = None) -> SunSolution:
    """Return the Sun direction in camera axes from an image, or the reason why no Sun was found.

    Args:
        image: pixel values (rows, columns) of any integer or floating type. Larger values are brighter.
        camera: camera model (`Pinhole` or `Lens` of `knightcube.vision.camera.lens`) with the size of the
            image.
        settings: settings of the search. If `settings` is None, `LINEAR` for a linear camera of 0 to 255
            counts is used. For another range of pixel values, give `replace(LINEAR, level=...)` with a level
            slightly below saturation.

    Raises:
        ArgumentError: if the image does not have the size of the camera, if its pixels are not finite
            numbers, or if the stride is so large that no row is read.
    """
    settings = LINEAR if settings is None else settings
    check_type("settings", settings, SunSettings)
    image = image_of_camera(image, camera)
    if settings.stride // 2 >= camera.rows:
        raise ArgumentError("settings.stride", f"{settings.stride}: no row of {camera.rows} is read")
    # Off the axis, a pinhole camera stretches a disc by at most the squared secant of the field angle.
    stretch = 1.0 / np.cos(min(camera.half_diagonal, 1.2)) ** 2
    reach = settings.greatest_radius * camera.focal_length * stretch
    # A truncated disc with less than half of its width visible is excluded, because its edge is too short.
    narrowest = settings.least_radius * camera.focal_length - settings.stride
    patches, wide, narrow = _bright_patches(image, settings, narrowest, 2.0 * reach, camera.focal_length)
    read = camera.columns * len(range(settings.stride // 2, camera.rows, settings.stride))
    reasons = [wide] if wide else []
    found: list[SunMeasurement] = []
    for middle, half in patches:
        # Spokes of twice the radius plus a margin are searched, because the centre may lie outside the image.
        near = min(2.5 * half + 6.0, 2.0 * reach)
        first = max(int(np.floor(middle[1] - near)), 0)
        strip = image[first : min(int(np.ceil(middle[1] + near)), camera.rows - 1) + 1]
        read += strip.size
        disc = _disc(strip, first, middle, near / camera.focal_length, camera, settings)
        reason = "no round edge" if disc is None else _flaw(disc, settings)
        if disc is None or reason:
            reasons.append(f"{reason} about pixel ({middle[0]:.0f}, {middle[1]:.0f})")
        else:
            asymmetry = _asymmetry(disc, strip, first, camera, settings)
            found.append(_measurement(disc, asymmetry, camera, settings))
    if not found:
        if reasons or narrow:
            return SunSolution(SunStatus.NOT_THE_SUN, [*reasons, narrow][0], None, read)
        return SunSolution(SunStatus.NO_SUN, _nothing_bright(image, settings), None, read)
    return _chosen(found, read)


def _chosen(found: list[SunMeasurement], read: int) -> SunSolution:
    """Return the solution for the discs `found` of the size of the Sun, after `read` pixels were read."""
    sun = max(found, key=lambda one: one.radius)
    # Dark pixels can divide one disc into several patches, whose circles coincide.
    others = [one for one in found if float(one.direction @ sun.direction) < math.cos(sun.radius)]
    if others:
        discs = (sun, *others)
        reason = f"{len(discs)} discs have the size of the Sun: one may be a reflection"
        return SunSolution(SunStatus.AMBIGUOUS, reason, None, read, discs)
    return SunSolution(SunStatus.PARTIAL if sun.cut else SunStatus.FOUND, "", sun, read)


def _bright_patches(
    image: Image, settings: SunSettings, narrowest: float, widest: float, focal_length: float
) -> tuple[list[tuple[FloatArray, float]], str, str]:
    """Return centre (2,), px, and half extent, px, of the bright patches, the largest first.

    Only every `stride`th row is read. Patches narrower than `narrowest` px or wider than `widest` px are
    excluded. The two texts describe the largest patches that are too wide and too narrow, and are empty
    without such a patch.
    """
    stride = settings.stride
    bright = image[stride // 2 :: stride] >= settings.level
    if not bright.any():
        return [], "", ""
    # Only the smallest rectangle around all bright pixels is labelled, which saves computing time.
    down, across = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    top, left = int(down[0]), int(across[0])
    labels, count = label(bright[top : down[-1] + 1, left : across[-1] + 1])
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes = find_objects(labels)
    patches: list[tuple[FloatArray, float]] = []
    wide = narrow = ""
    for patch in np.argsort(-sizes, kind="stable").tolist():
        if sizes[patch] < _LEAST_PATCH or len(patches) == _MOST_PATCHES:
            break
        box = boxes[patch]
        extent = max((box[0].stop - box[0].start) * stride, box[1].stop - box[1].start)
        if not narrowest <= extent <= widest:
            text = f"{_off_limits(0.5 * extent / focal_length, settings)} {extent} px wide"
            wide, narrow = (wide, narrow or text) if extent < narrowest else (wide or text, narrow)
            continue
        y, x = np.nonzero(labels[box] == patch + 1)
        y, x = y + box[0].start + top, x + box[1].start + left
        patches.append((np.array([x.mean(), stride // 2 + stride * y.mean()]), 0.5 * extent))
    return patches, wide, narrow


def _off_limits(radius: float, settings: SunSettings) -> str:
    """Return the reason why a patch of `radius`, rad, is not the Sun, with the setting that excludes it."""
    text = f"a patch of {math.degrees(radius):.2f} deg radius at level {settings.level:g},"
    if radius < settings.least_radius:
        return f"{text} smaller than `least_radius` of {math.degrees(settings.least_radius):.2f} deg,"
    text = f"{text} larger than `greatest_radius` of {math.degrees(settings.greatest_radius):.2f} deg"
    if settings.greatest_radius < LINEAR.least_radius <= radius <= LINEAR.greatest_radius:
        return f"{text} (for a linear camera use replace(LINEAR, level={settings.level:g})),"
    return f"{text} (set `level` just below saturation, or expose for a shorter time),"


def _nothing_bright(image: Image, settings: SunSettings) -> str:
    """Return the reason why an image without patches of the size of the Sun has no Sun."""
    level, highest = settings.level, float(image[settings.stride // 2 :: settings.stride].max())
    if highest >= level:
        return f"fewer than {_LEAST_PATCH} adjacent pixels reach the level of {level:g}, as hot pixels do"
    return (
        f"the largest pixel value, {highest:.6g}, is below the level of {level:g}: set `level` of SunSettings"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rim:
    """Points on the rim of a bright patch, in the tangent plane of a direction.

    Attributes:
        axis: unit vector (3,) in camera axes, from which the spokes start.
        basis: two unit vectors (2, 3) that span the tangent plane.
        points: positions (n, 2) in the azimuthal equidistant projection about the axis, rad.
        cut: number of spokes that leave the image before they reach the rim.
        endless: number of spokes that do not reach the rim within the searched distance.
    """

    axis: FloatArray
    basis: FloatArray
    points: FloatArray
    cut: int
    endless: int


@dataclass(frozen=True, slots=True, eq=False)
class _Disc:
    """A bright disc: its rim, the circle fitted to the rim, and the image scale (2, 2), px/rad."""

    rim: _Rim
    circle: Circle
    scale: FloatArray

    @property
    def axis(self) -> FloatArray:
        """The centre of the circle as a unit vector (3,)."""
        point, rim = self.circle.centre, self.rim
        arc = float(np.hypot(*point))
        return np.asarray(np.cos(arc) * rim.axis + np.sinc(arc / np.pi) * (point @ rim.basis))

    @property
    def pixels_per_radian(self) -> float:
        """The image scale (px/rad), as a mean over all directions."""
        return float(np.sqrt(abs(np.linalg.det(self.scale))))


def _disc(
    strip: Image, first: int, middle: FloatArray, reach: float, camera: CameraModel, settings: SunSettings
) -> _Disc | None:
    """Return the disc of a bright patch around `middle` (2,), px, with its rim within `reach` rad, or None.

    The array `strip` contains the rows of the image from row `first` onwards.
    """
    axis = camera.unit_vectors(middle[None, :])[0]
    disc = None
    step = 1e-4
    for _ in range(_ROUNDS):
        rim = _trace(strip, first, camera, axis, settings.level, reach)
        # The image scale at the boresight is used if the lens does not image the surroundings of the axis.
        ends = camera.project(np.concatenate([axis + step * rim.basis, axis - step * rim.basis]))
        scale = (ends[:2] - ends[2:]).T / (2.0 * step)
        scale = scale if np.all(np.isfinite(scale)) else camera.focal_length * np.eye(2)
        circle = fit_circle(rim.points, settings.tolerance / float(np.sqrt(abs(np.linalg.det(scale)))))
        if circle is None:
            return None
        disc = _Disc(rim, circle, scale)
        aside = float(np.linalg.norm(circle.centre))
        if aside > settings.greatest_radius:
            return None
        # The rim of a disc with a wrong radius is not traced again, because the disc will be rejected.
        wrong = not 0.5 * settings.least_radius < circle.radius < 2.0 * settings.greatest_radius
        if wrong or aside * disc.pixels_per_radian < _NEAR:
            break
        axis = disc.axis
    return disc


def _trace(
    strip: Image, first_row: int, camera: CameraModel, axis: FloatArray, level: float, reach: float
) -> _Rim:
    """Return the rim within `reach` rad around `axis` (3,); `strip` contains the rows from `first_row` on."""
    basis = tangent_basis(axis)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = _STEP / camera.focal_length
    arcs = np.arange(int(reach / step) + 1) * step
    rays = np.cos(arcs)[:, None] * axis + np.sin(arcs)[:, None] * (ways @ basis)[:, None, :]
    counts = sample(strip, first_row, camera.project(rays.reshape(-1, 3))).reshape(_SPOKES, -1)
    inner, outer = counts[:, :-1], counts[:, 1:]
    # Counts outside the image are NaN, so that their comparisons with the level are false.
    falls = (inner >= level) & (outer < level)
    crosses = falls.any(axis=1)
    at = falls.argmax(axis=1)[crosses]
    inside, outside = inner[crosses, at], outer[crosses, at]
    arc = step * (at + (inside - level) / (inside - outside))
    leaves = np.isnan(counts).any(axis=1)
    cut, endless = np.count_nonzero(leaves & ~crosses), np.count_nonzero(~leaves & ~crosses)
    return _Rim(axis, basis, arc[:, None] * ways[crosses], int(cut), int(endless))


def sample(strip: Image, first_row: int, points: FloatArray) -> FloatArray:
    """Return the counts (n,) at `points` (n, 2), px, by bilinear interpolation; NaN outside of the strip."""
    rows, columns = strip.shape
    x, y = points[:, 0], points[:, 1] - first_row
    inside = (x >= 0.0) & (x <= columns - 1.0) & (y >= 0.0) & (y <= rows - 1.0)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    column = np.minimum(x.astype(int), max(columns - 2, 0))
    row = np.minimum(y.astype(int), max(rows - 2, 0))
    x, y = x - column, y - row
    flat = strip.reshape(-1)
    corner = row * columns + column
    right, down = (1 if columns > 1 else 0), (columns if rows > 1 else 0)
    top = flat[corner] * (1.0 - x) + flat[corner + right] * x
    bottom = flat[corner + down] * (1.0 - x) + flat[corner + down + right] * x
    return np.where(inside, top * (1.0 - y) + bottom * y, np.nan)


def _flaw(disc: _Disc, settings: SunSettings) -> str:
    """Return the reason why the disc is not the Sun, or an empty string."""
    circle, rim = disc.circle, disc.rim
    used = int(np.count_nonzero(circle.used))
    if not settings.least_radius <= circle.radius <= settings.greatest_radius:
        return _off_limits(circle.radius, settings)
    if used < settings.least_agreement * (len(rim.points) + rim.endless):
        return f"an edge on the circle in only {used} of {len(rim.points) + rim.endless} directions"
    if used * 2.0 * np.pi / _SPOKES < settings.least_arc:
        return f"too short an arc of the limb, {used * 360 // _SPOKES} deg,"
    residual = circle.residual * disc.pixels_per_radian
    # If the lens stretches the disc, a blur that is circular in the image is elongated on the sphere.
    widest, narrowest = np.linalg.svd(disc.scale, compute_uv=False)
    if residual > settings.tolerance * math.sqrt(float(widest / narrowest)):
        return f"an edge that deviates from a circle by {residual:.2f} px rms"
    return ""


def _asymmetry(
    disc: _Disc, strip: Image, first: int, camera: CameraModel, settings: SunSettings
) -> FloatArray:
    """Return the displacement (3,) of a disc's centre by asymmetric glare, rad, or zero if none is measured.

    Glare that is brighter on one side displaces each contour in proportion to its radius. The displacement
    is extrapolated from the centre of the disc and the centre of a wider contour.
    """
    circle, axis = disc.circle, disc.axis
    basis = tangent_basis(axis)
    angle = np.arange(_SPOKES) * (2.0 * np.pi / _SPOKES)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ basis
    wide = _WIDER * circle.radius
    counts = sample(strip, first, camera.project(np.cos(wide) * axis + np.sin(wide) * ways))
    counts = counts[np.isfinite(counts)]
    none = np.zeros(3)
    if not len(counts) or (level := float(np.median(counts))) >= settings.level:
        return none
    rim = _trace(strip, first, camera, axis, level, 2.0 * wide - circle.radius)
    wider = fit_circle(rim.points, 2.0 * settings.tolerance / disc.pixels_per_radian)
    if wider is None or np.count_nonzero(wider.used) < settings.least_agreement * (
        len(rim.points) + rim.endless
    ):
        return none
    apart = wider.radius / circle.radius - 1.0
    if apart < 0.5 * (_WIDER - 1.0):
        return none
    noise = circle.residual**2 * circle.shape + wider.residual**2 * wider.shape
    if wider.centre @ np.linalg.solve(noise, wider.centre) < _ASYMMETRIC**2:
        return none
    return np.asarray(wider.centre @ basis / apart)


def _measurement(
    disc: _Disc, asymmetry: FloatArray, camera: CameraModel, settings: SunSettings
) -> SunMeasurement:
    """Return the measured Sun direction from an accepted disc, and its displacement `asymmetry` (3,), rad."""
    circle, scale = disc.circle, disc.pixels_per_radian
    rim_sigma = max(circle.residual, settings.rim_sigma / scale)
    backward = np.linalg.inv(disc.scale)
    floor = settings.floor_sigma**2 * backward @ backward.T
    axis = disc.axis
    # The basis of the tangent plane in which the rim was traced is made normal to the fitted direction.
    first = disc.rim.basis[0] - (disc.rim.basis[0] @ axis) * axis
    first /= np.linalg.norm(first)
    basis = np.stack([first, np.cross(axis, first)])
    displaced = basis @ asymmetry
    systematic = np.outer(displaced, displaced) + (_CUT**2 * np.eye(2) if disc.rim.cut else 0.0)
    return SunMeasurement(
        direction=axis,
        basis=basis,
        tangent_covariance=rim_sigma**2 * circle.shape + floor + systematic,
        point=camera.project(axis[None, :])[0],
        radius=circle.radius,
        residual=circle.residual * scale,
        arc=int(np.count_nonzero(circle.used)) * 2.0 * np.pi / _SPOKES,
        cut=disc.rim.cut > 0,
    )


_LEAST_POINTS = 6
"""Minimum number of points for the fit of a circle."""
_CIRCLE_STEPS = 10
_LAST_STEP = 1e-2
"""Step of the circle fit, as a fraction of the error of a point, below which the iteration ends."""
_MOST_CORRELATED = 0.9
"""Largest assumed correlation between the errors of neighbouring points."""
_TUKEY = 4.685
"""Cut-off of Tukey's biweight (standard deviations), for 95 % efficiency with Gaussian errors."""
_NEARLY_AS_MANY = 0.75
"""Minimum ratio of the number of points on a smaller circle to that on the best circle.

A smaller circle that reaches this ratio is preferred, because stray light enlarges discs.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle in a plane, with lengths in the unit of the points.

    Attributes:
        centre: centre (2,).
        radius: radius, positive.
        used: mask (n,) of the points that determine the circle.
        residual: rms distance of the used points from the circle.
        shape: covariance (2, 2) of the circle's centre for unit variance of each point, including the
            measured correlation of neighbouring points.
    """

    centre: FloatArray
    radius: float
    used: BoolArray
    residual: float
    shape: FloatArray


def fit_circle(points: FloatArray, scale: float) -> Circle | None:
    """Return the circle through `points` (n, 2), which are in order along a rim, or None if no circle fits.

    The argument `scale` is the standard deviation of a point that is not an outlier.
    """
    solution = _consensus(points, 2.5 * scale) if len(points) >= _LEAST_POINTS else None
    if solution is None:
        return None
    gate = _TUKEY * scale
    for _ in range(_CIRCLE_STEPS):
        distance, slopes = _distances(points, solution)
        weight = np.maximum(1.0 - (distance / gate) ** 2, 0.0) ** 2
        used = weight > 0.0
        if np.count_nonzero(used) < _LEAST_POINTS:
            return None
        weighted = slopes * weight[:, None]
        try:
            step = np.linalg.solve(weighted.T @ slopes, weighted.T @ distance)
        except np.linalg.LinAlgError:
            return None
        solution = solution - step
        if np.abs(step).max() < _LAST_STEP * scale:
            break
    distance, slopes = _distances(points, solution)
    left, slopes = distance[used], slopes[used]
    square = float(np.mean(left**2))
    if not (solution[2] > 0.0 and 0.0 < square < np.inf):
        return None
    # Correlation r of neighbouring errors increases the variance of a mean by (1 + r)/(1 - r).
    correlation = min(max(float(np.mean(left * np.roll(left, 1))) / square, 0.0), _MOST_CORRELATED)
    shape = np.linalg.inv(slopes.T @ slopes)[:2, :2] * ((1.0 + correlation) / (1.0 - correlation))
    return Circle(solution[:2], float(solution[2]), used, float(np.sqrt(square)), np.asarray(shape))


def _distances(points: FloatArray, solution: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distances (n,) from a circle (x, y, radius), and their derivatives (n, 3) by its parameters."""
    offset = points - solution[:2]
    length = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
    slopes = np.concatenate([-offset / length[:, None], np.full((len(points), 1), -1.0)], axis=1)
    return length - solution[2], slopes


def _consensus(points: FloatArray, gate: float) -> FloatArray | None:
    """Return the best circle (x, y, radius) through three of the points, or None if there is no such circle.

    The best circle is the smallest of the circles that have nearly the most points within the distance
    `gate`. The three points of a circle have equal spacings, between an eighth and a third of the rim.
    """
    count = len(points)
    place = np.arange(0, count, 3)
    triples = [
        np.stack([place, (place + apart) % count, (place + 2 * apart) % count], axis=1)
        for apart in sorted({max(count // part, 1) for part in (3, 4, 6, 8)})
    ]
    first, second, third = np.moveaxis(points[np.concatenate(triples)], 1, 0)
    # The circumcentre, relative to `first`, is the intersection of two perpendicular bisectors.
    b, c = second - first, third - first
    cross = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    sound = np.abs(cross) > 1e-9 * np.sum(b * b + c * c, axis=1)
    if not sound.any():
        return None
    first, b, c, cross = first[sound], b[sound], c[sound], cross[sound]
    bb, cc = np.sum(b * b, axis=1), np.sum(c * c, axis=1)
    aside = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / cross[:, None]
    centre, radius = first + aside, np.hypot(aside[:, 0], aside[:, 1])
    away = np.hypot(points[:, 0] - centre[:, :1], points[:, 1] - centre[:, 1:])
    agreeing = np.count_nonzero(np.abs(away - radius[:, None]) < gate, axis=1)
    good = np.flatnonzero(agreeing >= _NEARLY_AS_MANY * agreeing.max())
    best = good[np.argmin(radius[good])]
    return np.array([*centre[best], radius[best]])


_SIGMAS = 3.0
"""Radius of the region in which the Sun is expected, in standard deviations of the coarse Sun direction."""
_RING = 12
"""Number of directions that are tested at each angular distance from the coarse Sun direction."""
_SHARES = (1.0 / 6.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 5.0 / 6.0, 1.0)
"""Angular distances of tested directions from the coarse Sun direction, as fractions of the largest.
"""
_CONTRADICTED = 5.0
"""Largest accepted deviation of the measured from the coarse Sun direction, in standard deviations."""


@dataclass(frozen=True, slots=True)
class CameraChoice:
    """A camera, and whether the Sun is possibly in its field of view.

    Attributes:
        index: index of the camera among all cameras.
        likely: whether the coarse Sun direction is in the field of view.
        possible: whether the Sun is possibly in the field of view, within three standard deviations.
        angle: angle between the boresight and the coarse Sun direction, rad.
    """

    index: int
    likely: bool
    possible: bool
    angle: float


def cameras_by_sun(sun: CoarseSun, cameras: Sequence[MountedCamera]) -> list[CameraChoice]:
    """Return the cameras in the order in which they are read, or none if no solar string is lit by the Sun.

    Cameras with the coarse Sun direction in their field of view come first, followed by cameras that may have
    the Sun in their field of view. Each group of cameras is sorted by the angle between boresight and coarse
    Sun direction. If some strings are lit but give no coarse Sun direction, all cameras are possible, in
    their given order.
    """
    if sun.direction is None or sun.basis is None or sun.tangent_covariance is None:
        if sun.status is CoarseSunStatus.DARK:
            return []
        return [CameraChoice(index, False, True, float("nan")) for index in range(len(cameras))]
    angle = np.arange(_RING) * (2.0 * np.pi / _RING)
    root = np.linalg.cholesky(sun.tangent_covariance)
    ring = _SIGMAS * np.stack([np.cos(angle), np.sin(angle)], axis=1) @ root.T @ sun.basis
    # One angle is nearly undetermined if the normals of the lit strings lie in one plane.
    # The tested directions therefore have equal angular spacing.
    reach = np.linalg.norm(ring, axis=1, keepdims=True)
    spaced = (ring / reach * np.tan(share * np.arctan(reach)) for share in _SHARES)
    around = np.concatenate([sun.direction[None, :], *(sun.direction + offset for offset in spaced)])
    choices = []
    for index, camera in enumerate(cameras):
        seen = around @ attitude_matrix(camera.mounting).T
        inside = camera.lens.contains(camera.lens.project(seen))
        away = float(np.arccos(np.clip(seen[0, 2], -1.0, 1.0)))
        choices.append(CameraChoice(index, bool(inside[0]), bool(inside.any()), away))
    return sorted(choices, key=lambda choice: (not choice.likely, not choice.possible, choice.angle))


@dataclass(frozen=True, slots=True, eq=False)
class SunOfCameras:
    """The Sun in body axes.

    Attributes:
        direction: unit vector (3,) to the Sun, or None if neither a camera nor the solar strings found it.
        covariance: covariance (3, 3) of the direction error, zero along the direction, rad^2.
        camera: index of the camera that found the Sun, or None if the solar strings gave the direction.
        each: result of the search in each image by camera index, in the order in which the cameras were read.
        reason: reason why no camera found the Sun. If a camera found the Sun, `reason` is empty.
    """

    direction: FloatArray | None
    covariance: FloatArray | None
    camera: int | None
    each: Mapping[int, SunSolution]
    reason: str = ""


def sun_of_cameras(
    images: Mapping[int, Image], cameras: Sequence[MountedCamera], strings: CoarseSun, settings: SunSettings
) -> SunOfCameras:
    """Return the Sun direction in body axes from the first camera that finds it, or from the solar strings.

    The `images` (rows, columns), whose keys are camera indices, were taken at the same time. A camera is not
    read if, according to the solar strings, the Sun cannot be in its field of view. A Sun direction that
    contradicts the currents of the solar strings is rejected. If an image is ambiguous, the solar strings
    decide between its discs. Raises ValueError for another image size or non-finite pixels.
    """
    order = cameras_by_sun(strings, cameras)
    each: dict[int, SunSolution] = {}
    reason = "" if order else "no light: " + strings.reason
    for choice in order:
        image = images.get(choice.index)
        if image is None or not choice.possible:
            continue
        camera = cameras[choice.index]
        solution = each[choice.index] = find_sun(image, camera.lens, settings)
        discs = solution.candidates if solution.sun is None else (solution.sun,)
        suns = [one for one in discs if not _contradicts(camera.in_body(one.direction), strings)]
        if len(suns) == 1:
            covariance = np.asarray(camera.to_camera.T @ suns[0].covariance @ camera.to_camera)
            return SunOfCameras(camera.in_body(suns[0].direction), covariance, choice.index, each)
        reason = f"camera {choice.index}: {solution.reason}"
        if discs and not suns:
            reason = f"camera {choice.index}: its Sun direction contradicts the solar strings"
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return SunOfCameras(None, None, None, each, reason or strings.reason)
    covariance = strings.basis.T @ strings.tangent_covariance @ strings.basis
    return SunOfCameras(
        strings.direction, covariance, None, each, reason or "no camera has the Sun in its field"
    )


def _contradicts(direction: FloatArray, strings: CoarseSun) -> bool:
    """Return whether a direction differs significantly from the Sun direction of the solar strings."""
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return False
    if float(direction @ strings.direction) <= 0.0:
        return True
    off = strings.basis @ (direction / float(direction @ strings.direction))
    return float(off @ np.linalg.solve(strings.tangent_covariance, off)) > _CONTRADICTED**2
