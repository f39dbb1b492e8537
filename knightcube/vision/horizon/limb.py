"""The Earth's limb as a cone, and its robust fit to edges.

Stretched along its axes an ellipsoid becomes the unit sphere, whose limb is a circular cone about the
direction of its centre. Stretching takes rays to rays, so that a ray is on the limb exactly if its stretched
ray is on that cone (Christian & Robinson 2016, "Noniterative Horizon-Based Optical Navigation by Cholesky
Factorization", J. Guid. Control Dyn. 39, 2757). The residual of a ray is its angle from the stretched centre
less the cone's half-angle: 0 on the limb, positive outside. Its gradient by attitude, limb height and
altitude is exact.

The fit is Gauss-Newton. Huber's weights, and zero weight beyond five standard deviations, exclude clouds,
glare and the terminator's ends. The standard deviation is that of the points (from the median of their
residuals) if it exceeds the stated one. Parameters that the limb does not determine (its height, the rotation
about nadir, the altitude) have a prior, so that the covariance includes their uncertainty.

The brightness of the sunlit limb against tangent height, and its fit to the samples along a scan line.

A line of sight with tangent height h passes the optical depth t(h) = t0 exp(-h/H), t0 = t_v sqrt(2 pi R/H),
with t_v the vertical depth of Rayleigh scattering and H the scale height of the air. Below the surface the
line ends on the ground, at the elevation whose sine is sqrt(-2h/R). Sunlit air has the brightness
1 - exp(-t); the ground, of any brightness, is attenuated by exp(-t). Without blur the brightness falls
fastest where t = 1, at 15.4 km. Refraction is neglected: it lowers the apparent limb by 1 to 2 km, within
`HorizonSettings.limb_height_sigma`.

The profile across an edge is background + a air(h) + g ground(h), where h falls by a known number of metres
per pixel. The position of unit optical depth is fitted together with the three brightnesses. Unlike the
steepest place, it is not shifted inwards by bright ground behind the limb or outwards by thinning haze.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.directions import tangent_basis
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS

MEAN_RADIUS = (2.0 * SEMI_MAJOR_AXIS + SEMI_MINOR_AXIS) / 3.0
"""Mean radius of the Earth (m), 6,371,008.8 (WGS 84)."""


_IDENTITY: FloatArray = np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """A spheroid about the origin.

    Attributes:
        pole: (3,) unit vector along the axis.
        equatorial, polar: its semi-axes in m.
    """

    pole: FloatArray
    equatorial: float
    polar: float
    _along: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_along", np.outer(self.pole, self.pole))

    def stretching(self, height: float = 0.0) -> FloatArray:
        """Return L (3, 3), symmetric, with |L x| = 1 on the surface with both axes longer by `height` m."""
        return self._along_axes(1.0 / (self.equatorial + height), 1.0 / (self.polar + height))

    def shape(self, height: float = 0.0) -> FloatArray:
        """Return the inverse (3, 3) of `stretching`: it takes the unit sphere to the surface."""
        return self._along_axes(self.equatorial + height, self.polar + height)

    def stretching_by_height(self, height: float = 0.0) -> FloatArray:
        """Return dL/dh (3, 3) of `stretching`."""
        return self._along_axes(-1.0 / (self.equatorial + height) ** 2, -1.0 / (self.polar + height) ** 2)

    def height_of(self, position: FloatArray) -> float:
        """Return the height above the surface, m, of a position (3,), along its own radius."""
        distance = float(np.linalg.norm(position))
        return distance - distance / float(np.linalg.norm(self.stretching() @ position))

    def tangent_cone(self, position: FloatArray, height: float = 0.0) -> FloatArray:
        """Return M (3, 3), symmetric: u^T M u is 0 for rays u from `position` along the limb, > 0 within.

        M = Q r r^T Q - (r^T Q r - 1) Q with Q = L^T L, the discriminant of |L (r + t u)| = 1 in t; L is that
        of the surface `height` m higher.
        """
        stretching = self.stretching(height)
        shape = stretching.T @ stretching
        normal = shape @ position
        return np.asarray(np.outer(normal, normal) - (position @ normal - 1.0) * shape)

    def _along_axes(self, across: float, along: float) -> FloatArray:
        return across * _IDENTITY + (along - across) * self._along


def earth(pole: FloatArray) -> Ellipsoid:
    """Return the WGS 84 ellipsoid with its axis along `pole` (3,)."""
    return Ellipsoid(np.asarray(pole) / np.linalg.norm(pole), SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS)


def mean_sphere() -> Ellipsoid:
    """Return the sphere of the Earth's mean radius."""
    return Ellipsoid(np.array([0.0, 0.0, 1.0]), MEAN_RADIUS, MEAN_RADIUS)


PARAMETERS = 5
"""Number of parameters: small rotation in camera axes (3, rad), limb height (m), altitude (m)."""
LIMB_HEIGHT, ALTITUDE = 3, 4


@dataclass(frozen=True, slots=True, eq=False)
class LimbView:
    """The camera's position and attitude, and the limb's height.

    Attributes:
        rotation: (3, 3), inertial into camera axes.
        position: (3,) m, inertial axes.
        surface: the Earth's, without atmosphere.
        limb_height: m above the surface, where the limb appears.
    """

    rotation: FloatArray
    position: FloatArray
    surface: Ellipsoid
    limb_height: float

    @property
    def nadir(self) -> FloatArray:
        """The direction (3,) to the Earth's centre, camera axes."""
        return np.asarray(-(self.rotation @ self.position) / math.sqrt(self.position @ self.position))

    def moved(self, step: FloatArray) -> LimbView:
        """Return the view after a step (5,) of the parameters."""
        distance = float(np.linalg.norm(self.position))
        return LimbView(
            turn(step[:3]) @ self.rotation,
            self.position * (1.0 + step[ALTITUDE] / distance),
            self.surface,
            self.limb_height + float(step[LIMB_HEIGHT]),
        )

    def cone(self) -> FloatArray:
        """Return the limb's quadratic cone (3, 3) in camera axes, see `Ellipsoid.tangent_cone`."""
        cone = self.surface.tangent_cone(self.position, self.limb_height)
        return np.asarray(self.rotation @ cone @ self.rotation.T)


def turn(vector: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) that turns vectors by |vector| rad about `vector` (3,) (Rodrigues)."""
    # Plain floats: for one vector numpy costs ten times as much.
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


def crossed(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the cross products (n, 3) of vectors (n, 3); five times as fast as numpy's general one."""
    x1, y1, z1 = one.T
    x2, y2, z2 = other.T
    product = np.empty((len(one), 3))
    product[:, 0] = y1 * z2 - z1 * y2
    product[:, 1] = z1 * x2 - x1 * z2
    product[:, 2] = x1 * y2 - y1 * x2
    return product


def limb_residuals(view: LimbView, rays: FloatArray) -> FloatArray:
    """Return the angles (n,) rad by which rays (n, 3), unit, camera axes, lie outside the limb."""
    stretching = view.surface.stretching(view.limb_height)
    centre = -(stretching @ view.position)
    size = math.sqrt(centre @ centre)
    stretched = rays @ (view.rotation @ stretching)
    cosine = stretched @ (centre / size)
    cosine /= np.sqrt(np.einsum("ij,ij->i", stretched, stretched))
    angles = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
    return np.asarray(angles - math.asin(min(1.0, 1.0 / size)))


def limb_gradients(view: LimbView, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (n,) and their gradients (n, 5) with respect to the parameters of `moved`."""
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
    # The residual's change by a stretched ray; then back through the stretching into camera axes.
    slope = (stretched * (cosine / lengths)[:, None] - towards) / (lengths * sine)[:, None]
    back = to_stretched.T
    # Columns y, z, x and z, x, y at once: what a cross product takes.
    by_ray = slope @ np.concatenate(
        [back[:, _AFTER], back[:, _BEFORE], (view.rotation @ by_height).T], axis=1
    )
    gradients = np.empty((len(rays), PARAMETERS))
    # The camera turned by d sees with u what it saw with u - d x u.
    gradients[:, :3] = by_ray[:, :3] * rays[:, _BEFORE] - by_ray[:, 3:6] * rays[:, _AFTER]
    # The half-angle is arcsin(1/size): it grows by this for each m that the centre draws nearer.
    by_size = 1.0 / (size * math.sqrt(size * size - 1.0))
    step = -(by_height @ view.position)
    along = float(towards @ step)
    aside = stretched @ ((step - along * towards) / size)
    gradients[:, LIMB_HEIGHT] = (
        np.einsum("ij,ij->i", rays, by_ray[:, 6:]) - aside / (lengths * sine) + along * by_size
    )
    # Farther away along its own radius the centre stays in its direction.
    gradients[:, ALTITUDE] = by_size * size / math.sqrt(view.position @ view.position)
    return np.arccos(cosine) - math.asin(1.0 / size), gradients


_AFTER, _BEFORE = [1, 2, 0], [2, 0, 1]


_MOST_STEPS = 10
_LAST_STEP = 3e-5
"""Step (rad) that ends the iteration: an eightieth of a pixel."""
_SAME_GRADIENTS = 3e-3
"""Step (rad) below which the gradients change by less than a hundredth."""
_HUBER = 1.5
_BEYOND = 5.0
_MOST_ALIKE = 0.8
"""Largest correlation between neighbouring residuals that is assumed."""
_TO_SIGMA = 1.4826
"""Ratio of the standard deviation of a normal distribution to its median absolute value."""
UNKNOWN = 1e9
"""Standard deviation (m) of an unknown height."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Standard deviations of the first view: the turn about nadir in rad, limb height and altitude in m."""

    azimuth: float
    limb_height: float
    altitude: float = UNKNOWN


@dataclass(frozen=True, slots=True, eq=False)
class FittedLimb:
    """A view fitted to edges.

    Attributes:
        view: the best one.
        covariance: (5, 5) of the parameters of `LimbView.moved`.
        residuals: (n,) rad, positive outside the limb.
        used: (n,) edges within five spreads.
        spread: factor by which the residuals exceed the stated ones, at least 1.
        cost: the sum of squares in units of the spread, of the used edges and the prior.
    """

    view: LimbView
    covariance: FloatArray
    residuals: FloatArray
    used: BoolArray
    spread: float
    cost: float

    @property
    def nadir_covariance(self) -> FloatArray:
        """The covariance (3, 3) rad^2 of the direction to the Earth's centre in camera axes."""
        x, y, z = self.view.nadir
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(cross @ self.covariance[:3, :3] @ cross.T)

    def altitude_sigma(self, allowance: float) -> float:
        """Return the standard deviation of the altitude, m, with an `allowance` for unmodelled effects."""
        return float(np.hypot(np.sqrt(self.covariance[ALTITUDE, ALTITUDE]), allowance))


def fit_limb(start: LimbView, rays: FloatArray, sigma: FloatArray, prior: Prior) -> FittedLimb | None:
    """Return the limb through rays (n, 3) of spreads (n,) rad, from a view near it.

    None if the edges do not determine the nadir, or the fit diverges.
    """
    information = _information(start, prior)
    view, moved = start, np.zeros(PARAMETERS)
    last = np.inf
    for number in range(_MOST_STEPS + 1):
        if last > _SAME_GRADIENTS:
            residuals, gradients = limb_gradients(view, rays)
        else:
            residuals = limb_residuals(view, rays)
        weights, spread, used = _weights(residuals, sigma)
        weighted = gradients * weights[:, None]
        normal = weighted.T @ gradients + information
        if last < _LAST_STEP or number == _MOST_STEPS:
            break
        step = _solved(normal, -(weighted.T @ residuals + information @ moved))
        if step is None:
            return None
        view, moved = view.moved(step), moved + step
        if not _sound(view):
            return None
        last = float(np.max(np.abs(step[:3])))
    points = (normal - information) / _alike(view.nadir, rays[used], (residuals / sigma)[used])
    covariance = _solved(points + information, np.eye(PARAMETERS))
    if covariance is None:
        return None
    cost = float(weights @ residuals**2 + moved @ information @ moved)
    return FittedLimb(view, covariance, residuals, used, spread, cost)


def shared_error(
    fit: FittedLimb, rays: FloatArray, sigma: FloatArray, prior: Prior, groups: IntArray, error: FloatArray
) -> FloatArray:
    """Return the covariance (5, 5) that errors shared by all points of a group add to a fit's.

    `groups` (n,) are the numbers of the rays' groups from 0, `error` (groups,) rad the standard deviation of
    each: the fit weighs its points as if none were shared.
    """
    _, gradients = limb_gradients(fit.view, rays)
    weighted = gradients * _weights(fit.residuals, sigma)[0][:, None]
    inverse = _solved(weighted.T @ gradients + _information(fit.view, prior), np.eye(PARAMETERS))
    assert inverse is not None  # the fit has solved these equations
    moved = np.array([inverse @ weighted[groups == k].sum(axis=0) for k in range(len(error))])
    return np.asarray((moved * (error**2)[:, None]).T @ moved)


def stepped(
    start: LimbView, residuals: FloatArray, gradients: FloatArray, sigma: FloatArray, prior: Prior
) -> LimbView | None:
    """Return the view after one step of `fit_limb`, its residuals (n,) and gradients (n, 5) being given."""
    weighted = gradients * _weights(residuals, sigma)[0][:, None]
    step = _solved(weighted.T @ gradients + _information(start, prior), -(weighted.T @ residuals))
    view = None if step is None else start.moved(step)
    return view if view is not None and _sound(view) else None


def _information(start: LimbView, prior: Prior) -> FloatArray:
    nadir = start.nadir
    information = np.zeros((PARAMETERS, PARAMETERS))
    information[:3, :3] = np.outer(nadir, nadir) / prior.azimuth**2
    information[LIMB_HEIGHT, LIMB_HEIGHT] = prior.limb_height**-2
    information[ALTITUDE, ALTITUDE] = prior.altitude**-2
    return information


def _weights(residuals: FloatArray, sigma: FloatArray) -> tuple[FloatArray, float, BoolArray]:
    """Return weights (n,) rad^-2, the spread, and which edges count at all (n,)."""
    scaled = np.abs(residuals) / sigma
    middle = len(scaled) // 2
    spread = max(1.0, _TO_SIGMA * float(np.partition(scaled, middle)[middle]))
    scaled /= spread
    used = scaled <= _BEYOND
    huber = np.minimum(1.0, _HUBER / np.maximum(scaled, _HUBER))
    return huber * used / (sigma * spread) ** 2, spread, used


def _alike(nadir: FloatArray, rays: FloatArray, scaled: FloatArray) -> float:
    """Return the factor by which correlation raises the variance of the mean of residuals `scaled` (n,).

    Clouds and coasts behind the limb shift neighbouring points alike: for a first-order process with the
    correlation r of neighbours round the limb the factor is (1 + r)/(1 - r).
    """
    square = float(scaled @ scaled)
    if len(scaled) < 3 or square == 0.0:
        return 1.0
    aside = rays @ tangent_basis(nadir).T
    azimuth = np.arctan2(aside[:, 1], aside[:, 0])
    # Starting at the widest gap: the first and the last are not neighbours.
    order = np.argsort(azimuth)
    gaps = np.diff(azimuth[order], append=azimuth[order[0]] + 2.0 * np.pi)
    along = scaled[np.roll(order, -1 - int(np.argmax(gaps)))]
    alike = float(along[1:] @ along[:-1]) / square
    return (1.0 + (r := min(max(alike, 0.0), _MOST_ALIKE))) / (1.0 - r)


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray | None:
    """Return the solution of normal equations whose unknowns have different units; None if singular."""
    diagonal = normal.diagonal()
    if not diagonal.min() > 0.0:
        return None
    scale = 1.0 / np.sqrt(diagonal)
    try:
        answer = scale * np.linalg.solve(normal * scale * scale[:, None], (right.T * scale).T).T
    except np.linalg.LinAlgError:
        return None
    answer = answer.T
    return np.asarray(answer) if np.isfinite(answer).all() else None


def _sound(view: LimbView) -> bool:
    """Return whether the camera is still outside the surface on which the limb lies."""
    if view.surface.polar + view.limb_height <= 0.0:
        return False
    stretched = view.surface.stretching(view.limb_height) @ view.position
    return float(stretched @ stretched) > 1.0 + 1e-6


SCALE_HEIGHT = 8000.0
"""Scale height of the lower air (m; US Standard Atmosphere 1976: 8.4 km at the ground, 6.4 km at 15 km)."""
VERTICAL_DEPTH = 0.097
"""Vertical optical depth of the whole air at 550 nm (Bucholtz 1995, Appl. Opt. 34, 2765, Table 3)."""
UNIT_DEPTH_HEIGHT = SCALE_HEIGHT * math.log(
    VERTICAL_DEPTH * math.sqrt(2.0 * math.pi * SEMI_MAJOR_AXIS / SCALE_HEIGHT)
)
"""m, 15.4 km: where the optical depth right through is one."""

_LOWEST, _HIGHEST, _STEP = -320e3, 240e3, 500.0
"""Tangent heights of the table: first, last and step (m)."""
_SHARPEST, _BROADEST, _WIDTHS = 500.0, 50e3, 61
"""Standard deviations of blur in the table (m), spaced evenly in their logarithm, and their number."""


def limb_light(heights: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the light of air and of ground, and both slopes per m, (4, n, k), at tangent heights (n, k) m.

    Seen through Gaussian blurs of (n,) m; sunlit air without end and the ground without air are both 1. The
    nearest blur of the table serves: they are 8 % apart.
    """
    table = _table()
    width = np.log(np.clip(blur, _SHARPEST, _BROADEST) / _SHARPEST) / math.log(_BROADEST / _SHARPEST)
    row = np.rint(width * (_WIDTHS - 1)).astype(int)[:, None]
    place = np.clip((heights - _LOWEST) / _STEP, 0.0, table.shape[2] - 1.001)
    column = place.astype(int)
    part = place - column
    low = table[:, row, column]
    return np.asarray(low + part * (table[:, row, column + 1] - low))


@lru_cache(maxsize=1)
def _table() -> FloatArray:
    """Return air, ground and their slopes (4, widths, heights)."""
    heights = np.arange(_LOWEST, _HIGHEST, _STEP)
    depth = np.where(
        heights >= 0.0,
        math.exp(UNIT_DEPTH_HEIGHT / SCALE_HEIGHT) * np.exp(-np.maximum(heights, 0.0) / SCALE_HEIGHT),
        _slant_depth(np.sqrt(np.maximum(-2.0 * heights / SEMI_MAJOR_AXIS, 0.0))),
    )
    through = np.exp(-depth)
    widths = _SHARPEST * (_BROADEST / _SHARPEST) ** (np.arange(_WIDTHS) / (_WIDTHS - 1))
    air = _blurred(1.0 - through, widths)
    ground = _blurred(np.where(heights < 0.0, through, 0.0), widths)
    return np.stack([air, ground, np.gradient(air, _STEP, axis=1), np.gradient(ground, _STEP, axis=1)])


def _slant_depth(sines: FloatArray) -> FloatArray:
    """Return the optical depth from the ground out at elevations of `sines` (n,), by the trapezium rule."""
    way = np.linspace(0.0, 1200e3, 601)
    above = (
        np.sqrt(SEMI_MAJOR_AXIS**2 + 2.0 * SEMI_MAJOR_AXIS * way * sines[:, None] + way**2) - SEMI_MAJOR_AXIS
    )
    density = np.exp(-above / SCALE_HEIGHT)
    mean = np.mean(0.5 * (density[:, 1:] + density[:, :-1]), axis=1)
    return np.asarray(VERTICAL_DEPTH / SCALE_HEIGHT * way[-1] * mean)


def _blurred(profile: FloatArray, widths: FloatArray) -> FloatArray:
    """Return the profile (m,) through Gaussian blurs (k,) m, (k, m); extended beyond its ends."""
    margin = int(4.0 * _BROADEST / _STEP)
    padded = np.pad(profile, margin, mode="edge")
    frequency = 2.0 * np.pi * np.fft.rfftfreq(len(padded), _STEP)
    spectrum = np.fft.rfft(padded) * np.exp(-0.5 * (widths[:, None] * frequency) ** 2)
    return np.asarray(np.fft.irfft(spectrum, len(padded), axis=1)[:, margin:-margin])


_FIT_STEPS = 2
_OUTSIDE, _INSIDE = -8.0, 4.0
"""Ends of the part of the profile that is fitted, px from the steepest point."""
_FLOOR, _SHARE = 0.02, 0.08
"""Noise of a sample: fractions of the limb's brightness and of the sample's own brightness."""
_FARTHEST = 2.0
"""Largest distance (px) of the fitted limb from the steepest point."""
_LEAST = 7
"""Least number of samples of a fit."""


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
    for _ in range(_FIT_STEPS):
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
