"""The Earth's limb: its direction from a camera, its brightness profile, and robust fits of both.

A scaling along the axes of the Earth's ellipsoid transforms the ellipsoid into the unit sphere. The rays to
the limb of a sphere form a circular cone about the direction of the sphere's centre. A scaled ray is a ray as
well, so that a ray lies on the ellipsoid's limb if and only if the scaled ray lies on the cone (Christian &
Robinson 2016, "Noniterative Horizon-Based Optical Navigation by Cholesky Factorization", Journal of Guidance,
Control, and Dynamics 39, 2757). The residual of a ray is the angle between the scaled ray and the scaled
direction of the centre, minus the half-angle of the limb cone. The residual of a ray is 0 on the limb and
positive outside of the Earth. The gradient of the residuals is analytic.

The limb cone is fitted by a Gauss-Newton iteration. Huber's weights, with zero weight beyond five standard
deviations, exclude clouds, glare and the ends of the terminator. If the median residual shows a larger spread
than the stated standard deviations, the standard deviations are scaled up. The limb height, the rotation
about nadir and the altitude have a prior, because the limb does not determine them. The covariance therefore
includes the uncertainty of limb height, rotation and altitude.

Along a line of sight with the tangent height h, the optical depth of the atmosphere is t(h) = t0 exp(-h/H)
with t0 = t_v sqrt(2 pi R/H), where t_v is the vertical optical depth of Rayleigh scattering, R the Earth's
radius and H the scale height of the atmosphere. A line of sight with a tangent height h < 0 ends on the
ground at an elevation whose sine is sqrt(-2h/R). The brightness of sunlit air at the optical depth t is 1 -
exp(-t), and the air attenuates the light from the ground by the factor exp(-t). Without blur, the brightness
falls fastest at the optical depth t = 1, at a tangent height of 15.4 km. Refraction is neglected. Refraction
lowers the apparent limb by 1 to 2 km, which is within `HorizonSettings.limb_height_sigma`.

The brightness profile across an edge is fitted by background + a air(h) + b ground(h), where a and b are
free, and the tangent height h falls by a known number of metres per pixel. The position of unit optical depth
is fitted together with the brightness of background, air and ground. In contrast to the steepest point, the
position of unit optical depth is not shifted inwards by bright ground behind the limb or outwards by haze.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray, tangent_basis
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS
from knightcube.vision.background import MAD_TO_SIGMA

_EYE3: FloatArray = np.eye(3)
MEAN_RADIUS = (2.0 * SEMI_MAJOR_AXIS + SEMI_MINOR_AXIS) / 3.0
"""Mean radius of the Earth (m), 6,371,008.8 (WGS 84)."""


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """A spheroid centred on the origin, with the unit vector `pole` (3,) and the semi-axes in m."""

    pole: FloatArray
    equatorial: float
    polar: float

    def stretching(self, height: float = 0.0) -> FloatArray:
        """Return the symmetric matrix L (3, 3), 1/m: |L x| = 1 on the ellipsoid enlarged by `height`, m."""
        return self._along_axes(1.0 / (self.equatorial + height), 1.0 / (self.polar + height))

    def shape(self, height: float = 0.0) -> FloatArray:
        """Return the matrix (3, 3), m, that transforms the unit sphere into the ellipsoid."""
        return self._along_axes(self.equatorial + height, self.polar + height)

    def stretching_by_height(self, height: float = 0.0) -> FloatArray:
        """Return the derivative (3, 3) of `stretching` with respect to the height, 1/m^2."""
        return self._along_axes(-1.0 / (self.equatorial + height) ** 2, -1.0 / (self.polar + height) ** 2)

    def height_of(self, position: FloatArray) -> float:
        """Return the height of a position (3,) above the surface, m, measured along the radius."""
        distance = float(np.linalg.norm(position))
        return distance - distance / float(np.linalg.norm(self.stretching() @ position))

    def _along_axes(self, across: float, along: float) -> FloatArray:
        return across * _EYE3 + (along - across) * (self.pole[:, None] * self.pole)


def earth(pole: FloatArray) -> Ellipsoid:
    """Return the WGS 84 ellipsoid with its axis along `pole` (3,)."""
    return Ellipsoid(np.asarray(pole) / np.linalg.norm(pole), SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS)


def mean_sphere() -> Ellipsoid:
    """Return the sphere of the Earth's mean radius."""
    return Ellipsoid(np.array([0.0, 0.0, 1.0]), MEAN_RADIUS, MEAN_RADIUS)


PARAMETERS = 5
"""Number of fitted parameters: a small rotation in camera axes (3, rad), limb height (m), altitude (m)."""
LIMB_HEIGHT, ALTITUDE = 3, 4
"""Indices of the limb height and of the altitude in an array of the fitted parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class LimbView:
    """Position and attitude of a camera, and the apparent height of the limb.

    Attributes:
        rotation: rotation matrix (3, 3) from inertial to camera axes.
        position: position (3,) of the camera, m, inertial axes.
        surface: ellipsoid of the Earth's surface, without atmosphere.
        limb_height: height above the surface at which the limb appears, m.
    """

    rotation: FloatArray
    position: FloatArray
    surface: Ellipsoid
    limb_height: float

    @property
    def nadir(self) -> FloatArray:
        """The unit vector (3,) to the Earth's centre, camera axes."""
        return np.asarray(-(self.rotation @ self.position) / math.sqrt(self.position @ self.position))

    @property
    def limb_distance(self) -> float:
        """The distance from the camera to the limb, m, for a sphere of the equatorial radius."""
        return math.sqrt(max(float(self.position @ self.position) - self.surface.equatorial**2, 1.0))

    def moved(self, step: FloatArray) -> LimbView:
        """Return the view after the fitted parameters change by a step (5,)."""
        distance = float(np.linalg.norm(self.position))
        return LimbView(
            turn(step[:3]) @ self.rotation,
            self.position * (1.0 + step[ALTITUDE] / distance),
            self.surface,
            self.limb_height + float(step[LIMB_HEIGHT]),
        )


def turn(vector: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), rad, by Rodrigues' formula."""
    # For a single vector, Python floats are ten times as fast as numpy arrays.
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > 0.0 else 1.0
    half = 0.5 * angle
    second = 0.5 * (math.sin(half) / half) ** 2 if angle > 0.0 else 0.5
    cosine = math.cos(angle)
    return np.array(
        [
            [cosine + second * x * x, second * x * y - first * z, second * x * z + first * y],
            [second * x * y + first * z, cosine + second * y * y, second * y * z - first * x],
            [second * x * z - first * y, second * y * z + first * x, cosine + second * z * z],
        ]
    )


def limb_residuals(view: LimbView, rays: FloatArray) -> FloatArray:
    """Return the angles (n,), rad, by which unit vectors (n, 3) in camera axes lie outside the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = math.sqrt(centre @ centre)
    stretched = rays @ (view.rotation @ stretching)
    cosine = stretched @ (centre / size)
    cosine /= np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
    angles = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
    return np.asarray(angles - math.asin(min(1.0, 1.0 / size)))


_AFTER, _BEFORE = [1, 2, 0], [2, 0, 1]


def limb_gradients(view: LimbView, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (n,), rad, of rays (n, 3), and gradients (n, 5) with respect to the fit parameters."""
    stretching = view.surface.stretching(view.limb_height)
    by_height = view.surface.stretching_by_height(view.limb_height)
    centre = -(stretching @ view.position)
    size = math.sqrt(centre @ centre)
    towards = centre / size
    to_stretched = view.rotation @ stretching
    stretched = rays @ to_stretched
    lengths = np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
    cosine = stretched @ towards / lengths
    sine = np.sqrt(1.0 - cosine * cosine)
    # The matrix product transforms the derivative with respect to the scaled ray into camera axes.
    # The product contains the components twice, in the orders that the cross product with the ray needs.
    slope = (stretched * (cosine / lengths)[:, None] - towards) / (lengths * sine)[:, None]
    back = to_stretched.T
    by_ray = slope @ np.concatenate(
        [back[:, _AFTER], back[:, _BEFORE], (view.rotation @ by_height).T], axis=1
    )
    gradients = np.empty((len(rays), PARAMETERS))
    # A small rotation d of the view displaces a ray u by -d x u relative to the Earth.
    gradients[:, :3] = by_ray[:, :3] * rays[:, _BEFORE] - by_ray[:, 3:6] * rays[:, _AFTER]
    # The derivative of the cone's half-angle, arcsin(1 / size), with respect to `size` is -by_size.
    by_size = 1.0 / (size * math.sqrt(size * size - 1.0))
    step = -(by_height @ view.position)
    along = float(towards @ step)
    aside = stretched @ ((step - along * towards) / size)
    gradients[:, LIMB_HEIGHT] = (
        np.einsum("ij,ij->i", rays, by_ray[:, 6:]) - aside / (lengths * sine) + along * by_size
    )
    # A change of the altitude does not change the direction of the Earth's centre.
    gradients[:, ALTITUDE] = by_size * size / math.sqrt(view.position @ view.position)
    return np.arccos(cosine) - math.asin(1.0 / size), gradients


_MOST_STEPS = 10
_LAST_STEP = 3e-5
"""Rotation step (rad) below which the limb fit ends; it is 0.012 px at a focal length of 400 px."""
_SAME_GRADIENTS = 3e-3
"""Rotation step (rad) below which the gradients of the residuals are not computed again.

A smaller step changes the gradients by less than 1 %.
"""
_HUBER, _BEYOND = 1.5, 5.0
"""Residuals (standard deviations) above which Huber's weights decrease, and above which they are zero."""
_MOST_CORRELATED = 0.8
"""Largest assumed correlation between neighbouring residuals."""
UNKNOWN = 1e9
"""Standard deviation (m) of an unknown altitude."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Standard deviations of the rotation about nadir (rad), the limb height (m) and the altitude (m).

    The standard deviation of the limb height along the limb, relative to the common height, is `uneven`, m.
    """

    azimuth: float
    limb_height: float
    altitude: float = UNKNOWN
    uneven: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FittedLimb:
    """A limb fitted to edges.

    Attributes:
        view: fitted position and attitude of the camera and height of the limb.
        covariance: covariance (5, 5) of the fitted parameters.
        residuals: angles of the edges from the fitted limb (n,), rad, positive outside the limb.
        used: mask of the edges that lie within five standard deviations of the limb (n,).
        correlation: factor by which correlated neighbouring residuals increase the variance of their mean.
        prior: chi-square of the fitted parameters' deviations from their prior values.
    """

    view: LimbView
    covariance: FloatArray
    residuals: FloatArray
    used: BoolArray
    correlation: float
    prior: float

    @property
    def nadir_covariance(self) -> FloatArray:
        """The covariance (3, 3), rad^2, of the direction to the Earth's centre in camera axes."""
        x, y, z = self.view.nadir
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(cross @ self.covariance[:3, :3] @ cross.T)

    def altitude_sigma(self, allowance: float) -> float:
        """Return the altitude's standard deviation, m, with an `allowance`, m, for unmodelled effects."""
        return float(np.hypot(np.sqrt(self.covariance[ALTITUDE, ALTITUDE]), allowance))


def fit_limb(start: LimbView, rays: FloatArray, sigma: FloatArray, prior: Prior) -> FittedLimb | None:
    """Return the limb fitted to rays (n, 3) with standard deviations `sigma` (n,), rad.

    The iteration begins at `start`. Returns None if the nadir is undetermined or the fit diverges.
    """
    information = _information(start, prior)
    view, moved = start, np.zeros(PARAMETERS)
    last = np.inf
    for number in range(_MOST_STEPS + 1):
        if last > _SAME_GRADIENTS:
            residuals, gradients = limb_gradients(view, rays)
        else:
            residuals = limb_residuals(view, rays)
        weights, used = _weights(residuals, sigma)
        weighted = gradients * weights[:, None]
        normal = weighted.T @ gradients + information
        if last < _LAST_STEP or number == _MOST_STEPS:
            break
        step = _solved(normal, -(weighted.T @ residuals + information @ moved))
        if step is None:
            return None
        view, moved = view.moved(step), moved + step
        if not _is_outside(view):
            return None
        last = float(np.max(np.abs(step[:3])))
    factor = _correlation_factor(view.nadir, rays[used], (residuals / sigma)[used])
    # The weights include the spread of the median residual. A few large residuals can still exceed this
    # spread, so that the covariance is also multiplied by chi-square per degree of freedom, `excess`.
    fitted = weights[used] * residuals[used] ** 2
    excess = max(1.0, float(np.sum(fitted)) / max(len(fitted) - 3, 1))
    covariance = _solved((normal - information) / (factor * excess) + information, np.eye(PARAMETERS))
    if covariance is None:
        return None
    if prior.uneven > 0.0:
        covariance = covariance + _uneven_limb_error(view, rays, weighted, normal, prior.uneven)
    return FittedLimb(view, covariance, residuals, used, factor, float(moved @ information @ moved))


_UNEVEN_ANGLE = 0.7
"""Angle about nadir (rad) over which the height of the limb is correlated."""


def _uneven_limb_error(
    view: LimbView, rays: FloatArray, weighted: FloatArray, normal: FloatArray, uneven: float
) -> FloatArray:
    """Return the covariance (5, 5) of a fit's parameters due to a limb height that varies along the limb.

    The variation has the standard deviation `uneven`, m, and is a Gaussian process of the azimuth about nadir
    with the correlation length `_UNEVEN_ANGLE`. The fit absorbs most of such a smooth variation, so that the
    residuals do not show it. The weighted gradients (n, 5) and the normal matrix (5, 5) are those of the fit.
    """
    gain = _solved(normal, weighted.T)
    if gain is None:
        return np.zeros((PARAMETERS, PARAMETERS))
    aside = rays @ tangent_basis(view.nadir).T
    aside /= np.sqrt(np.einsum("ij,ij->i", aside, aside))[:, None]
    # The kernel exp((cos d - 1) / L^2) of the azimuth difference d is Gaussian for small differences.
    kernel = np.exp((aside @ aside.T - 1.0) / _UNEVEN_ANGLE**2)
    return np.asarray((uneven / view.limb_distance) ** 2 * gain @ kernel @ gain.T)


def shared_error(
    fit: FittedLimb, rays: FloatArray, sigma: FloatArray, prior: Prior, groups: IntArray, error: FloatArray
) -> FloatArray:
    """Return the covariance (5, 5) of a fit's parameters due to errors common to the rays of a group.

    The covariance of the fit assumes independent errors of the rays (n, 3) with the standard deviations
    `sigma` (n,), rad. The array `groups` (n,) contains the index of each ray's group. The common errors of
    the groups have the standard deviations `error` (groups,), rad.
    """
    _, gradients = limb_gradients(fit.view, rays)
    weighted = gradients * _weights(fit.residuals, sigma)[0][:, None]
    inverse = _solved(weighted.T @ gradients + _information(fit.view, prior), np.eye(PARAMETERS))
    assert inverse is not None  # `fit_limb` has solved the same equations, so they are not singular
    moved = np.array([inverse @ weighted[groups == k].sum(axis=0) for k in range(len(error))])
    return np.asarray((moved * (error**2)[:, None]).T @ moved)


def stepped(
    start: LimbView, residuals: FloatArray, gradients: FloatArray, sigma: FloatArray, prior: Prior
) -> LimbView | None:
    """Return the view after one Gauss-Newton step, from given residuals (n,) and gradients (n, 5).

    Returns None if the equations are singular, or if the step places the camera inside the Earth.
    """
    weighted = gradients * _weights(residuals, sigma)[0][:, None]
    step = _solved(weighted.T @ gradients + _information(start, prior), -(weighted.T @ residuals))
    view = None if step is None else start.moved(step)
    return view if view is not None and _is_outside(view) else None


def _information(start: LimbView, prior: Prior) -> FloatArray:
    """Return the information matrix (5, 5) of the prior."""
    nadir = start.nadir
    information = np.zeros((PARAMETERS, PARAMETERS))
    information[:3, :3] = np.outer(nadir, nadir) / prior.azimuth**2
    information[LIMB_HEIGHT, LIMB_HEIGHT] = prior.limb_height**-2
    information[ALTITUDE, ALTITUDE] = prior.altitude**-2
    return information


def _weights(residuals: FloatArray, sigma: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the weights (n,), rad^-2, of residuals (n,), and a mask (n,) of the nonzero weights."""
    scaled = np.abs(residuals) / sigma
    middle = len(scaled) // 2
    spread = max(1.0, MAD_TO_SIGMA * float(np.partition(scaled, middle)[middle]))
    scaled /= spread
    used = scaled <= _BEYOND
    huber = np.minimum(1.0, _HUBER / np.maximum(scaled, _HUBER))
    return huber * used / (sigma * spread) ** 2, used


def _correlation_factor(nadir: FloatArray, rays: FloatArray, scaled: FloatArray) -> float:
    """Return the factor by which correlated neighbouring residuals increase the variance of their mean.

    Clouds and coasts behind the limb displace neighbouring points in the same direction. If neighbours around
    the limb have the correlation r (first-order process), the factor is (1 + r)/(1 - r). The residuals
    `scaled` (n,) are given in standard deviations.
    """
    square = float(scaled @ scaled)
    if len(scaled) < 3 or square == 0.0:
        return 1.0
    aside = rays @ tangent_basis(nadir).T
    azimuth = np.arctan2(aside[:, 1], aside[:, 0])
    # The sequence of points around the limb starts at the widest gap, whose ends are not neighbours.
    order = np.argsort(azimuth)
    gaps = np.diff(azimuth[order], append=azimuth[order[0]] + 2.0 * np.pi)
    along = scaled[np.roll(order, -1 - int(np.argmax(gaps)))]
    correlation = min(max(float(along[1:] @ along[:-1]) / square, 0.0), _MOST_CORRELATED)
    return (1.0 + correlation) / (1.0 - correlation)


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray | None:
    """Return the solution of normal equations for unknowns of different units; None if it is not unique."""
    diagonal = normal.diagonal()
    if not diagonal.min() > 0.0:
        return None
    scale = 1.0 / np.sqrt(diagonal)
    try:
        answer = scale * np.linalg.solve(normal * scale * scale[:, None], (right.T * scale).T).T
    except np.linalg.LinAlgError:
        return None
    return np.asarray(answer.T) if np.isfinite(answer).all() else None


def _is_outside(view: LimbView) -> bool:
    """Return whether the camera is outside the surface on which the limb lies."""
    if view.surface.polar + view.limb_height <= 0.0:
        return False
    stretched = view.surface.stretching(view.limb_height) @ view.position
    return float(stretched @ stretched) > 1.0 + 1e-6


SCALE_HEIGHT = 8000.0
"""Scale height (m) of the lower atmosphere.

The scale height of the US Standard Atmosphere 1976 is 8.4 km at the ground and 6.4 km at 15 km.
"""
_VERTICAL_DEPTH = 0.097
"""Vertical optical depth of the atmosphere at 550 nm (Bucholtz 1995, Applied Optics 34, 2765, Table 3)."""
UNIT_DEPTH_HEIGHT = SCALE_HEIGHT * math.log(
    _VERTICAL_DEPTH * math.sqrt(2.0 * math.pi * SEMI_MAJOR_AXIS / SCALE_HEIGHT)
)
"""Tangent height (m), 15.4 km, at which the optical depth along the line of sight is one."""

_LOWEST, _HIGHEST, _STEP = -320e3, 240e3, 500.0
"""Lowest and highest tangent height of the brightness table, and the step between its heights (m)."""
_SHARPEST, _BROADEST, _WIDTHS = 500.0, 50e3, 61
"""Smallest and largest blur (standard deviation, m at the limb) in the brightness table; number of blurs."""


def limb_light(heights: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the brightness of air and ground at tangent heights, and their derivatives, 1/m, as (4, n, k).

    Sunlit air of infinite optical depth has the brightness 1, and so has ground without an atmosphere above
    it. The `heights` (n, k), m, are k tangent heights along each of n scan lines. The `blur` (n,), m, is the
    standard deviation of a Gaussian for each scan line. It is rounded to the nearest blur of the table;
    neighbouring blurs of the table differ by 8 %.
    """
    table = _limb_table()
    width = np.log(np.clip(blur, _SHARPEST, _BROADEST) / _SHARPEST) / math.log(_BROADEST / _SHARPEST)
    row = np.rint(width * (_WIDTHS - 1)).astype(int)[:, None]
    place = np.clip((heights - _LOWEST) / _STEP, 0.0, table.shape[2] - 1.001)
    column = place.astype(int)
    part = place - column
    low = table[:, row, column]
    return np.asarray(low + part * (table[:, row, column + 1] - low))


@lru_cache(maxsize=1)
def _limb_table() -> FloatArray:
    """Return the brightness of air and ground and their derivatives, 1/m, as a table (4, blurs, heights)."""
    heights = np.arange(_LOWEST, _HIGHEST, _STEP)
    # For lines of sight that end on the ground, the optical depth is integrated from the ground outwards.
    sines = np.sqrt(np.maximum(-2.0 * heights / SEMI_MAJOR_AXIS, 0.0))
    way = np.linspace(0.0, 1200e3, 601)
    above = (
        np.sqrt(SEMI_MAJOR_AXIS**2 + 2.0 * SEMI_MAJOR_AXIS * way * sines[:, None] + way**2) - SEMI_MAJOR_AXIS
    )
    density = np.exp(-above / SCALE_HEIGHT)
    mean = np.mean(0.5 * (density[:, 1:] + density[:, :-1]), axis=1)
    depth = np.where(
        heights >= 0.0,
        math.exp(UNIT_DEPTH_HEIGHT / SCALE_HEIGHT) * np.exp(-np.maximum(heights, 0.0) / SCALE_HEIGHT),
        _VERTICAL_DEPTH / SCALE_HEIGHT * way[-1] * mean,
    )
    through = np.exp(-depth)
    widths = _SHARPEST * (_BROADEST / _SHARPEST) ** (np.arange(_WIDTHS) / (_WIDTHS - 1))
    air = _blurred(1.0 - through, widths)
    ground = _blurred(np.where(heights < 0.0, through, 0.0), widths)
    return np.stack([air, ground, np.gradient(air, _STEP, axis=1), np.gradient(ground, _STEP, axis=1)])


def _blurred(profile: FloatArray, widths: FloatArray) -> FloatArray:
    """Return k copies (k, m) of a profile (m,), each blurred by a Gaussian of standard deviation `widths`, m.

    The profile is extended at both ends by repeating its end values.
    """
    margin = int(4.0 * _BROADEST / _STEP)
    padded = np.pad(profile, margin, mode="edge")
    frequency = 2.0 * np.pi * np.fft.rfftfreq(len(padded), _STEP)
    spectrum = np.fft.rfft(padded) * np.exp(-0.5 * (widths[:, None] * frequency) ** 2)
    return np.asarray(np.fft.irfft(spectrum, len(padded), axis=1)[:, margin:-margin])


_PROFILE_STEPS = 2
_OUTSIDE, _INSIDE = -8.0, 4.0
"""Start and end of the fitted section of a profile, in px from the steepest point towards the bright side."""
_FLOOR, _SHARE = 0.02, 0.08
"""Noise of a profile sample: a fraction of the profile's maximum plus a fraction of the sample's value."""
_FARTHEST = 2.0
"""Largest distance (px) of the fitted limb from the steepest point of the brightness profile."""
_LEAST_SAMPLES = 7


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFits:
    """Limb positions on n scan lines, fitted to brightness profiles.

    Attributes:
        place: limb positions (n,), px from the edge towards the bright side.
        sigma: standard deviations of the limb positions (n,), px.
        valid: mask of the valid fits (n,).
        misfit: chi-square per degree of freedom of each profile (n,).
    """

    place: FloatArray
    sigma: FloatArray
    valid: BoolArray
    misfit: FloatArray


def fit_profiles(
    profiles: FloatArray, steps: FloatArray, metres: FloatArray, blur: FloatArray
) -> ProfileFits:
    """Return the limb positions on n scan lines that are fitted to their brightness profiles.

    The profiles (n, m) contain the brightness, or NaN for missing samples, at the positions `steps` (n, m),
    px, relative to the edge, positive towards the bright side. The tangent height decreases by `metres` (n,),
    m, per pixel, and the blur (n,), m, is a standard deviation.
    """
    usable = np.isfinite(profiles) & (steps >= _OUTSIDE) & (steps <= _INSIDE)
    light = np.where(usable, profiles, 0.0)
    enough = np.count_nonzero(usable, axis=1) >= _LEAST_SAMPLES
    top = np.max(np.where(usable, profiles, -np.inf), axis=1, initial=0.0)
    light = light / np.maximum(top, 1e-12)[:, None]
    weights = usable / (_FLOOR + _SHARE * np.clip(light, 0.0, 1.0)) ** 2
    place = np.zeros(len(profiles))
    amounts = np.zeros((len(profiles), 3))
    # Weak priors keep the normal equations regular if a brightness profile does not determine a parameter.
    prior = np.diag([1.0, 1.0, 1.0, 0.1])
    of_place = np.zeros((len(profiles), 4, 1))
    of_place[:, 3] = 1.0
    for _ in range(_PROFILE_STEPS):
        heights = UNIT_DEPTH_HEIGHT - (steps - place[:, None]) * metres[:, None]
        air, ground, air_slope, ground_slope = limb_light(heights, blur)
        if not amounts.any():
            # The brightnesses of background, air and ground are first fitted for the initial limb position.
            columns = np.stack([np.ones_like(air), air, ground], axis=2)
            weighted = (columns * weights[:, :, None]).transpose(0, 2, 1)
            amounts = np.linalg.solve(weighted @ columns + np.eye(3), weighted @ light[:, :, None])[:, :, 0]
        model = amounts[:, :1] + amounts[:, 1:2] * air + amounts[:, 2:] * ground
        shift = (amounts[:, 1:2] * air_slope + amounts[:, 2:] * ground_slope) * metres[:, None]
        columns = np.stack([np.ones_like(air), air, ground, shift], axis=2)
        weighted = (columns * weights[:, :, None]).transpose(0, 2, 1)
        right = weighted @ (light - model)[:, :, None]
        # The second right-hand side of the normal equations gives the variance of the limb position.
        answer = np.linalg.solve(weighted @ columns + prior, np.concatenate([right, of_place], axis=2))
        amounts = amounts + answer[:, :3, 0]
        place = place + np.minimum(np.maximum(answer[:, 3, 0], -1.0), 1.0)
    misfit = np.sum(weights * (light - model) ** 2, axis=1) / np.maximum(
        np.count_nonzero(usable, axis=1) - 4, 1
    )
    sigma = np.sqrt(answer[:, 3, 1] * np.maximum(misfit, 0.3))
    valid = enough & (np.abs(place) < _FARTHEST) & (amounts[:, 1] > 0.2)
    return ProfileFits(place, sigma, valid, misfit)


_WIDER, _WIDEST = 2.0**0.5, 10.0
"""Ratio of each trial blur to the previous trial blur, and of the largest trial blur to the stated blur."""
_BETTER = 0.7
"""Largest misfit of a fitted blur that is used, as a fraction of the misfit of the stated blur."""
_BLUR_LINES = 32
"""Number of scan lines whose profiles determine the blur."""


def blur_factor(profiles: FloatArray, steps: FloatArray, metres: FloatArray, blur: FloatArray) -> float:
    """Return the ratio of the blur of the brightness profiles to the stated `blur` (n,), m.

    A defocused image would displace the limb by about the excess width of its blur. The factor with the
    smallest median misfit is used if the misfit is clearly smaller than that of the stated blur; otherwise
    the factor is 1. See `fit_profiles` for the arguments.
    """
    some = slice(None, None, max(1, len(profiles) // _BLUR_LINES))
    given = profiles[some], steps[some], metres[some]

    def misfit(factor: float) -> float:
        return math.log(max(float(np.median(fit_profiles(*given, factor * blur[some]).misfit)), 1e-12))

    factor, trials = 1.0, [misfit(1.0)]
    while factor * _WIDER < _WIDEST and (len(trials) == 1 or trials[-1] < trials[-2]):
        factor *= _WIDER
        trials.append(misfit(factor))
    best = int(np.argmin(trials))
    if trials[best] > trials[0] + math.log(_BETTER):
        return 1.0
    place = float(best)
    if best < len(trials) - 1:
        before, least, after = trials[best - 1 : best + 2]
        place += 0.5 * (before - after) / max(before - 2.0 * least + after, 1e-12)
    return float(_WIDER**place)
