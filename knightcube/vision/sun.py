"""The disc of the Sun in a frame: bright patches, the rim of a patch, and the circle through the rim.

A few rows are read by random access, and bright patches on them are candidates. The rim of a candidate is
traced along spokes. The circle starts from a consensus among triples of rim points and is refined by
geometric least squares (Gauss-Newton). Tukey's biweight of each point's distance from the circle (Huber 1981,
Robust Statistics, chapter 7) excludes a cloud beside the disc or a hot pixel on its rim.

The Sun's direction from a camera's frame.

    solution = find_sun(ArrayPixels(frame), camera, SunSettings())

A few rows are read. The rim of each patch that is brighter than the level and not too large is traced, and a
circle on the sphere is fitted to it. The circle's centre is the Sun's, even if the disc is saturated, has
glare, or is partly cut off by the frame's edge.

The Sun from several cameras and the solar strings (Meller et al., chapter 2).

    found = sun_of_cameras(frames, cameras, coarse_sun(currents, strings), settings)

The strings say which camera to read first; where no camera finds the Sun, their own direction stands in, with
its own covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.ndimage import find_objects, label

from knightcube.astro import quaternion
from knightcube.astro.arrays import BoolArray, FloatArray, Image
from knightcube.astro.directions import tangent_basis
from knightcube.errors import UsageError
from knightcube.vision.camera.lens import CameraModel, MountedCamera
from knightcube.vision.frame import ArrayPixels, PixelAccess
from knightcube.vision.solar_cells import CoarseSun

MOST_PATCHES = 4
"""Largest number of patches that are examined, the largest first."""
LEAST_PATCH = 3
"""Least number of pixels of a patch on the rows that are read: a chord of the Sun's disc, not a hot pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class BrightPatch:
    """A bright patch: its `middle` (2,) px, and `half` px of its greater extent."""

    middle: FloatArray
    half: float


def bright_patches(
    pixels: PixelAccess, level: float, stride: int, narrowest: float, widest: float
) -> tuple[list[BrightPatch], bool]:
    """Return the patches above `level` counts on every `stride`th row, largest first.

    Patches narrower than `narrowest` px or wider than `widest` are excluded; the second value is whether
    any wide one was.
    """
    rows = np.arange(stride // 2, pixels.rows, stride)
    bright = pixels.read_rows(rows) >= level
    if not bright.any():
        return [], False
    # Labelling costs per pixel: only the box about all bright pixels is labelled.
    down, across = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    top, left = int(down[0]), int(across[0])
    labels, count = label(bright[top : down[-1] + 1, left : across[-1] + 1])
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    boxes = find_objects(labels)
    patches: list[BrightPatch] = []
    wide = False
    for patch in np.argsort(-sizes, kind="stable").tolist():
        if sizes[patch] < LEAST_PATCH or len(patches) == MOST_PATCHES:
            break
        box = boxes[patch]
        extent = max((box[0].stop - box[0].start) * stride, box[1].stop - box[1].start)
        wide = wide or extent > widest
        if not narrowest <= extent <= widest:
            continue
        y, x = np.nonzero(labels[box] == patch + 1)
        y, x = y + box[0].start + top, x + box[1].start + left
        middle = np.array([x.mean(), rows[0] + stride * y.mean()])
        patches.append(BrightPatch(middle, 0.5 * extent))
    return patches, wide


def window(pixels: PixelAccess, middle: FloatArray, reach: float) -> tuple[Image, int]:
    """Return the rows within `reach` px of the point `middle` (2,), and the first one's number."""
    first = max(int(np.floor(middle[1] - reach)), 0)
    last = min(int(np.ceil(middle[1] + reach)), pixels.rows - 1)
    return pixels.read_rows(np.arange(first, last + 1)), first


SPOKES = 48
_STEP = 0.5
"""Distance between samples along a spoke (px)."""


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Rim points about a direction, in its tangent plane.

    Attributes:
        axis: (3,) unit vector in camera axes, where the spokes start.
        basis: (2, 3) axes of the plane.
        points: (n, 2) rad, of arc length from the axis: azimuthal equidistant.
        cut: number of `SPOKES` that left the frame before the rim.
        endless: number that met no rim within reach.
    """

    axis: FloatArray
    basis: FloatArray
    points: FloatArray
    cut: int
    endless: int

    def direction(self, point: FloatArray) -> FloatArray:
        """Return the unit vector (3,) in camera axes of a `point` (2,) rad in the tangent plane."""
        arc = float(np.hypot(*point))
        return np.asarray(np.cos(arc) * self.axis + np.sinc(arc / np.pi) * (point @ self.basis))


def trace(
    strip: Image, first_row: int, camera: CameraModel, axis: FloatArray, level: float, reach: float
) -> Rim:
    """Return the rim about `axis` (3,) within `reach` rad, in `strip`, rows from `first_row` on."""
    basis = tangent_basis(axis)
    angle = np.arange(SPOKES) * (2.0 * np.pi / SPOKES)
    ways = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = _STEP / camera.focal_length
    arcs = np.arange(int(reach / step) + 1) * step
    rays = np.cos(arcs)[:, None] * axis + np.sin(arcs)[:, None] * (ways @ basis)[:, None, :]
    counts = sample(strip, first_row, camera.project(rays.reshape(-1, 3))).reshape(SPOKES, -1)
    inner, outer = counts[:, :-1], counts[:, 1:]
    # Outside the frame the counts are NaN, and no comparison holds.
    falls = (inner >= level) & (outer < level)
    crosses = falls.any(axis=1)
    at = falls.argmax(axis=1)[crosses]
    inside, outside = inner[crosses, at], outer[crosses, at]
    arc = step * (at + (inside - level) / (inside - outside))
    leaves = np.isnan(counts).any(axis=1)
    cut, endless = np.count_nonzero(leaves & ~crosses), np.count_nonzero(~leaves & ~crosses)
    return Rim(axis, basis, arc[:, None] * ways[crosses], int(cut), int(endless))


def sample(strip: Image, first_row: int, points: FloatArray) -> FloatArray:
    """Return the counts (n,) at `points` (n, 2), bilinear between pixels; NaN outside the strip."""
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


LEAST_POINTS = 6

_STEPS = 10
_LAST_STEP = 1e-2
"""Step that ends the iteration, as a fraction of a point's error."""
_MOST_ALIKE = 0.9
"""Largest correlation between neighbours' errors that is assumed."""
_TUKEY = 4.685
"""Cut-off of the biweight, in scales: 95 % efficient for Gaussian errors."""
_NEARLY_AS_MANY = 0.75
"""Share of the best consensus with which a smaller circle is preferred: stray light enlarges the disc."""


@dataclass(frozen=True, slots=True, eq=False)
class Circle:
    """A circle in a plane; lengths in the unit of the points.

    Attributes:
        centre: (2,).
        radius: greater than 0.
        used: which of the points (n,) it was fitted to.
        residual: rms of their distances from it.
        shape: (2, 2), the centre's covariance for unit variance of each point; with the
            measured correlation of neighbours' errors.
    """

    centre: FloatArray
    radius: float
    used: BoolArray
    residual: float
    shape: FloatArray


def fit_circle(points: FloatArray, scale: float) -> Circle | None:
    """Return the circle of `points` (n, 2), in order round it, or None without one.

    `scale` is the error of a good point.
    """
    start = _consensus(points, 2.5 * scale) if len(points) >= LEAST_POINTS else None
    if start is None:
        return None
    solution = start
    gate = _TUKEY * scale
    for _ in range(_STEPS):
        distance, slopes = _distances(points, solution)
        weight = np.maximum(1.0 - (distance / gate) ** 2, 0.0) ** 2
        used = weight > 0.0
        if np.count_nonzero(used) < LEAST_POINTS:
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
    # Correlated errors average out less: by (1 + r)/(1 - r) for a first-order process.
    alike = min(max(float(np.mean(left * np.roll(left, 1))) / square, 0.0), _MOST_ALIKE)
    shape = np.linalg.inv(slopes.T @ slopes)[:2, :2] * ((1.0 + alike) / (1.0 - alike))
    return Circle(solution[:2], float(solution[2]), used, float(np.sqrt(square)), np.asarray(shape))


def _distances(points: FloatArray, solution: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far (n,) the points lie outside the circle (x, y, radius), and the slopes (n, 3) of that."""
    offset = points - solution[:2]
    length = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-12)
    slopes = np.concatenate([-offset / length[:, None], np.full((len(points), 1), -1.0)], axis=1)
    return length - solution[2], slopes


def _consensus(points: FloatArray, gate: float) -> FloatArray | None:
    """Return the circle (x, y, radius) through three of the points that most others lie on, within `gate`.

    Triples are evenly spaced along the rim, as wide as a third of it and as narrow as an eighth.
    """
    count = len(points)
    place = np.arange(0, count, 3)
    triples = [
        np.stack([place, (place + apart) % count, (place + 2 * apart) % count], axis=1)
        for apart in sorted({max(count // part, 1) for part in (3, 4, 6, 8)})
    ]
    first, second, third = np.moveaxis(points[np.concatenate(triples)], 1, 0)
    # Twice the circumcentre from the first point: of the bisectors of two chords.
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


_SIGMAS = 3.0
_RING = 12


@dataclass(frozen=True, slots=True)
class CameraChoice:
    """A camera and whether it may see the Sun.

    Attributes:
        index: of the camera.
        likely: whether the coarse Sun itself is in its field.
        possible: whether the Sun is within three standard deviations.
        angle: rad from its boresight to the coarse Sun.
    """

    index: int
    likely: bool
    possible: bool
    angle: float


def cameras_by_sun(
    sun: CoarseSun, cameras: Sequence[CameraModel], mountings: Sequence[FloatArray]
) -> list[CameraChoice]:
    """Return the cameras in the order in which they are to be read for the Sun; none when it is dark.

    `mountings` are quaternions (4,), body into camera. With a coarse Sun those that have it in their field
    come first, then those that may have; by the angle from the boresight in each. With uncertain
    strings all cameras are possible, in the given order. Raises ValueError for unlike numbers of both.
    """
    if len(cameras) != len(mountings):
        raise ValueError(f"{len(cameras)} cameras with {len(mountings)} mountings: give one for each")
    if sun.direction is None or sun.basis is None or sun.tangent_covariance is None:
        if sun.status is sun.status.DARK:
            return []
        return [CameraChoice(index, False, True, float("nan")) for index in range(len(cameras))]
    angle = np.arange(_RING) * (2.0 * np.pi / _RING)
    root = np.linalg.cholesky(sun.tangent_covariance)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ root.T @ sun.basis
    around = np.concatenate(
        [sun.direction[None, :], *(sun.direction + k * ring for k in (1.0, 2.0, _SIGMAS))]
    )
    choices = []
    for index, (camera, mounting) in enumerate(zip(cameras, mountings, strict=True)):
        seen = around @ quaternion.attitude_matrix(mounting).T
        inside = camera.contains(camera.project(seen))
        away = float(np.arccos(np.clip(seen[0, 2], -1.0, 1.0)))
        choices.append(CameraChoice(index, bool(inside[0]), bool(inside.any()), away))
    return sorted(choices, key=lambda choice: (not choice.likely, not choice.possible, choice.angle))


_CONTRADICTED = 5.0
"""Largest distance between a camera's Sun and the coarse Sun, in standard deviations of the coarse Sun."""

_CUT = np.radians(0.05)
"""Systematic error per axis (rad) of a disc that the frame's edge cuts."""


@dataclass(frozen=True, slots=True, eq=False)
class SunOfCameras:
    """The Sun in body axes, and where it is from.

    Attributes:
        direction: (3,) unit vector; None when neither a camera nor the strings have it.
        covariance: (3, 3) rad^2 of its error, nothing along it.
        camera: the number of the camera that found it; None where it is the strings'.
        each: what the cameras gave, in the order in which they were read.
        reason: why no camera has it; empty where one has.
    """

    direction: FloatArray | None
    covariance: FloatArray | None
    camera: int | None
    each: Mapping[int, SunSolution]
    reason: str = ""


def sun_of_cameras(
    frames: Mapping[int, Image | PixelAccess],
    cameras: Sequence[MountedCamera],
    strings: CoarseSun,
    settings: SunSettings,
) -> SunOfCameras:
    """Return the Sun that the first of some cameras' frames, by number, shows, or else the strings' own.

    A camera that cannot have the Sun in view by the strings is not read; a Sun that contradicts theirs is
    not taken.
    """
    order = cameras_by_sun(strings, [one.lens for one in cameras], [one.mounting for one in cameras])
    each: dict[int, SunSolution] = {}
    reason = "" if order else "no light: " + strings.reason
    for choice in order:
        frame = frames.get(choice.index)
        if frame is None or not choice.possible:
            continue
        camera = cameras[choice.index]
        access = ArrayPixels(frame) if isinstance(frame, np.ndarray) else frame
        solution = each[choice.index] = find_sun(access, camera.lens, settings)
        if solution.sun is None:
            reason = f"camera {choice.index}: {solution.reason}"
            continue
        direction = camera.in_body(solution.sun.direction)
        if not _contradicts(direction, strings):
            return SunOfCameras(direction, _in_body(solution.sun, camera), choice.index, each)
        reason = f"camera {choice.index}: a Sun where the strings have none"
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return SunOfCameras(None, None, None, each, reason or strings.reason)
    covariance = strings.basis.T @ strings.tangent_covariance @ strings.basis
    return SunOfCameras(
        strings.direction, covariance, None, each, reason or "no camera has the Sun in its field"
    )


def _in_body(sun: SunMeasurement, camera: MountedCamera) -> FloatArray:
    across = np.eye(3) - np.outer(sun.direction, sun.direction)
    covariance = sun.covariance + (_CUT**2 * across if sun.cut else 0.0)
    return np.asarray(camera.to_camera.T @ covariance @ camera.to_camera)


def _contradicts(direction: FloatArray, strings: CoarseSun) -> bool:
    """Return whether a direction lies farther off the strings' Sun than their errors explain."""
    if strings.direction is None or strings.basis is None or strings.tangent_covariance is None:
        return False
    if float(direction @ strings.direction) <= 0.0:
        return True
    off = strings.basis @ (direction / float(direction @ strings.direction))
    return float(off @ np.linalg.solve(strings.tangent_covariance, off)) > _CONTRADICTED**2
