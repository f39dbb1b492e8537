"""What a fit leaves over on its trusted streaks' pixels, and by how much their ends may be displaced for it.

A point spread that is not the model's, wider along the streak than across it or of another shape, leaves
light over at the ends of all streaks alike, and moves them alike. How much it moves them is not seen; were
all that is left over a displacement, its size in px is what this module gives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import chdtri

from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.streaks.frame import Float32Array
from knightcube.vision.streaks.geometry import (
    PIXEL_VARIANCE,
    BentPinhole,
    Motion,
    Scene,
    moving,
    path_lengths,
    paths,
    positions,
)
from knightcube.vision.streaks.joint_fit import ExposedCamera, Fit, bared_fit, refit
from knightcube.vision.streaks.normal_equations import (
    OwnEquations,
    contradiction,
    disagreement,
    estimates_of,
    own_equations,
    shapes,
    turn_covariance,
)
from knightcube.vision.streaks.streak_model import LINES
from knightcube.vision.streaks.streak_result import MotionResult

# Residuals beyond this many sigmas and this part of their line's brightest pixel are another's light.
_FOREIGN_SIGMAS = 5.0
_FOREIGN_SHARE = 0.6
# Pixels on which an end's displacement shows at least by this part of where it shows most.
_SHOWN = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class LeftOver:
    """The trusted streaks' blocks of pixels, and what the model leaves over there.

    Attributes:
        star: (b,) index into the scene; time: (b, LINES) at which the path crosses the line.
        images: (b, IMAGES, LINES, k); weight, residual: (b, LINES, k).
    """

    star: IntArray
    time: FloatArray
    images: Float32Array
    weight: Float32Array
    residual: Float32Array


def left_over(camera: ExposedCamera, fit: Fit) -> LeftOver:
    """Return what the fit leaves over on the strips of its trusted streaks."""
    scene, windows = fit.scene, fit.windows
    images, spots, _ = shapes(camera.pinhole, camera.shutter, scene, windows)
    of_block = windows.long[windows.strips.star]
    light = images[:, 0] * scene.light[of_block, None, None].astype(np.float32)
    peak = light.max(axis=2, keepdims=True, initial=0.0)
    light += scene.sky[of_block, None, None].astype(np.float32)
    spot_light = spots * scene.light[windows.spot, None, None] + scene.sky[windows.spot, None, None]
    weight, residual = windows.on_strips.residual(windows.total(light, spot_light), 0.0)
    with np.errstate(divide="ignore"):
        foreign = np.abs(residual) > _FOREIGN_SIGMAS / np.sqrt(weight) + _FOREIGN_SHARE * peak
    weight[foreign] = 0.0
    chosen = np.flatnonzero(scene.trusted[of_block])
    return LeftOver(
        of_block[chosen], windows.strips.time[chosen], images[chosen], weight[chosen], residual[chosen]
    )


@dataclass(frozen=True, slots=True)
class Displacement:
    """By how many px something would be displaced were all that is left over about it a displacement, rms.

    Attributes:
        shown: what is left over beyond chance; chance: what may be, beside noise.
    """

    shown: float
    chance: float


def displaced_ends(left: LeftOver, scene: Scene) -> Displacement | None:
    """Return the displacement of the ends along the paths; None where no streak shows an end."""
    change = _light(left, scene) * (left.images[:, 3] + left.images[:, 4])
    near = _shown(left, change)
    elsewhere = (left.weight > 0.0) & ~near
    squares = left.weight * left.residual * left.residual
    usual = float(np.mean(squares[elsewhere], dtype=np.float64)) if elsewhere.any() else 1.0
    return _displacement(left, squares, change, near, min(usual, 1.0))


def displaced_sides(left: LeftOver, scene: Scene) -> Displacement | None:
    """Return the displacement across the paths, away from their ends; None without a streak."""
    light = _light(left, scene)
    change = np.abs(light * left.images[:, 1])
    along = _shown(left, change) & ~_shown(left, light * (left.images[:, 3] + left.images[:, 4]))
    return _displacement(left, left.weight * left.residual * left.residual, change, along, 1.0)


def _light(left: LeftOver, scene: Scene) -> Float32Array:
    return scene.light[left.star, None, None].astype(np.float32)


def _shown(left: LeftOver, change: Float32Array) -> BoolArray:
    """Return on which pixels in use a `change` of the light shows."""
    most = change.max(axis=(1, 2), keepdims=True, initial=0.0)
    return np.asarray((left.weight > 0.0) & (change > _SHOWN * most))


def _displacement(
    left: LeftOver, squares: Float32Array, change: Float32Array, on: BoolArray, usual: float
) -> Displacement | None:
    """Return the displacement that the residuals' `squares` on some pixels amount to; `usual` each by noise.

    `change` is that of the light by a px.
    """
    count = int(np.count_nonzero(on))
    information = float(np.sum((left.weight * change * change)[on], dtype=np.float64))
    if not count or information <= 0.0:
        return None
    beyond = float(np.sum(squares[on], dtype=np.float64)) - count * usual
    chance = float(np.sqrt(2.0 * count))
    return Displacement(
        float(np.sqrt(max(beyond - 2.0 * chance, 0.0) / information)),
        float(np.sqrt((max(beyond, 0.0) + chance) / information)),
    )


# Instants at which a path is compared with where an error puts it: the ends and between.
_INSTANTS = np.linspace(-0.5, 0.5, 9)
_SLOWEST = 1e-3
# Turn and the star's own place among the sensitivities.
_TURN_AND_PLACE = np.array([0, 1, 2, 6, 7])
# Probability of a camera that is as described being taken for another.
_BY_CHANCE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """What the errors of the camera's description change.

    Attributes:
        step: (k,) of the shared parameters, to where they are without these errors; 0 where chance explains
            what the stars say of them.
        added: (k, k), covariance beside that of an exact camera; described: that of the errors alone whose
            size the description gives.
        score: (n, k) of each star after these errors.
        error: (m,), the likeliest errors, in standard deviations.
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    score: FloatArray
    error: FloatArray


def correct(
    information: FloatArray,
    score: FloatArray,
    seeming: FloatArray,
    spread: float,
    described: int,
    counted: FloatArray | None = None,
) -> Correction | None:
    """Return the joint solution of the shared parameters and of the camera's errors; None without one.

    `information` (n, k, k) and `score` (n, k) are each star's, its own numbers eliminated; `seeming`
    (n, k, m) the change of the parameters that m errors, each of one standard deviation, seem to be, those
    first whose size is `described`; `spread` the variance of what is left over, in that of the noise;
    `counted` (m,) what the fit knows of the errors already, beside which the correction is.
    """
    m = seeming.shape[2]
    known = information / spread
    shared = known.sum(axis=0)
    weighted = known @ seeming
    cross = weighted.sum(axis=0)
    own = np.sum(seeming.swapaxes(1, 2) @ weighted, axis=0) + np.eye(m)
    asked = np.einsum("nkm,nk->m", seeming, score) / spread
    if counted is not None:
        asked = asked - counted
    total = score.sum(axis=0) / spread
    try:
        leading = np.linalg.solve(shared, cross)
        left = own - cross.T @ leading
        error = np.linalg.solve(left, asked - leading.T @ total)
        added, stated = (
            _added(leading[:, :count], left[:count, :count], error[:count]) for count in (m, described)
        )
    except np.linalg.LinAlgError:
        return None
    change = leading @ error
    seen = counted is not None or float((asked - leading.T @ total) @ error) > chdtri(m, _BY_CHANCE)
    left_over = score - np.einsum("nij,nj->ni", information, seeming @ error - change)
    return Correction(seen * -change, added, stated, left_over, error)


def _added(leading: FloatArray, left: FloatArray, error: FloatArray) -> FloatArray:
    """Return the covariance (k, k) by errors of which the stars leave the information `left` (m, m).

    Streaks displaced by much of their width ask for too little: a correction is known to its own size.
    """
    change = leading @ error
    return np.asarray(leading @ np.linalg.inv(left) @ leading.T + np.outer(change, change))


def seeming_turns(camera: ExposedCamera, scene: Scene, exposure: float) -> FloatArray:
    """Return the turn (n, 3, m), rad, that one standard deviation of each error seems to be to each star.

    Errors that cannot be, being known exactly, are left out; that of the shutter is the last. A streak shows
    where its path lies all along and, by its ends, how far it goes: an error that only lengthens the path is
    no other curvature.
    """
    errors = _errors(camera)
    n = len(scene.stars)
    if not errors:
        return np.empty((n, 3, 0))
    time, stars = np.repeat(_INSTANTS, n), np.tile(scene.stars, (len(_INSTANTS), 1))
    sensitive, velocity = moving(camera.pinhole, scene.motion, stars, time, growing=False)
    place = positions(camera.pinhole, scene.motion, stars, time)
    shift = _displacements(camera.pinhole, errors, place, velocity / exposure)
    speed = np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), _SLOWEST)
    tangent = velocity / speed
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    ends = np.abs(time) == 0.5
    change, moved = (
        np.concatenate(
            [
                np.einsum("pi,pij->pj", normal, of).reshape(len(_INSTANTS), n, -1),
                np.einsum("pi,pij->pj", tangent[ends], of[ends]).reshape(2, n, -1),
            ]
        ).swapaxes(0, 1)
        for of in (sensitive[:, :, _TURN_AND_PLACE], shift)
    )
    return np.asarray((np.linalg.pinv(change) @ moved)[:, :3])


def _errors(camera: ExposedCamera) -> dict[str, float]:
    """Return one standard deviation of each error that can be; the shutter's is the last."""
    known = camera.settings.knowledge
    sizes = {
        "focal length": known.focal_length,
        "centre x": known.centre,
        "centre y": known.centre,
        "distortion": known.distortion,
        "line time": camera.settings.line_time_sigma,
    }
    return {error: sigma for error, sigma in sizes.items() if sigma > 0.0}


def _displacements(
    pinhole: Pinhole, errors: dict[str, float], place: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Return by how many px (p, 2, m) each error moves stars at `place` (p, 2), px, with `velocity`, px/s."""
    away = place - np.array(pinhole.centre)
    corner = np.hypot(*pinhole.centre)
    moves = {
        "focal length": away,
        "centre x": np.array([[1.0, 0.0]]),
        "centre y": np.array([[0.0, 1.0]]),
        "distortion": away * (np.sum(away**2, axis=1, keepdims=True) / corner**2),
        "line time": velocity * away[:, 1:],
    }
    return np.stack(
        [np.broadcast_to(sigma * moves[error], away.shape) for error, sigma in errors.items()], axis=-1
    )


def bent_camera(camera: ExposedCamera, error: FloatArray) -> ExposedCamera:
    """Return the camera with a lens of these errors, in deviations and in the order of `seeming_turns`."""
    sizes = zip(_errors(camera).items(), error, strict=False)  # the shutter's, which is none of the lens
    found = {name: sigma * float(by) for (name, sigma), by in sizes}
    scale, x, y, cubic = (
        found.get(name, 0.0) for name in ("focal length", "centre x", "centre y", "distortion")
    )
    pinhole = camera.pinhole
    lens = BentPinhole(pinhole.columns, pinhole.rows, pinhole.focal_length, (x, y), scale, cubic)
    return replace(camera, pinhole=lens)


_BINS = 48
# What is common must exceed chance by this many deviations to be believed.
_SIGNIFICANT = 4.0


@dataclass(frozen=True, slots=True)
class Shaking:
    """What the streaks have in common beyond a smooth motion, rms; 0 where chance explains it.

    Attributes:
        across: px, displacement across the paths.
        along: relative change of brightness along them.
    """

    across: float = 0.0
    along: float = 0.0


def find_shaking(camera: ExposedCamera, scene: Scene, left: LeftOver) -> Shaking:
    """Return what the trusted streaks of a fit have in common; nothing where none is long."""
    if not len(left.star):
        return Shaking()
    time, star = left.time, left.star
    stars = scene.stars[star]
    velocity = paths(camera.pinhole, scene.motion, np.repeat(stars, LINES, axis=0), time.reshape(-1)).velocity
    tangent = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    light = scene.light[star, None]
    place = np.clip(((time + 0.5) * _BINS).astype(np.int64), 0, _BINS - 1).reshape(-1)
    within = (np.abs(time) < 0.5).reshape(-1)
    owner = np.repeat(star, LINES)
    found = []
    for image, way in ((left.images[:, 1], normal), (left.images[:, 0], tangent)):
        score = (light * np.sum(left.weight * left.residual * image, axis=2)).reshape(-1)
        information = (light**2 * np.sum(left.weight * image * image, axis=2)).reshape(-1)
        cell = (owner * _BINS + place)[within]
        found.append(_common(cell, score[within, None] * way[within], information[within]))
    return Shaking(*found)


def _common(cell: IntArray, score: FloatArray, information: FloatArray) -> float:
    """Return the rms of what all stars ask for in common, 0 when it may be chance.

    `cell` (m,) numbers star and time; `score` (m, 2) and `information` (m,) of lines are summed.
    """
    size = (int(cell.max()) // _BINS + 1) * _BINS if len(cell) else 0
    if size < 2 * _BINS:
        return 0.0
    own = np.stack([np.bincount(cell, score[:, axis], size) for axis in (0, 1)], axis=-1)
    own = own.reshape(-1, _BINS, 2)
    known = np.bincount(cell, information, size).reshape(-1, _BINS)
    # A star by itself says as much as its own scatter allows: its model errors are not noise.
    scatter = np.sum(own**2, axis=(1, 2)) / np.maximum(known.sum(axis=1), 1e-30)
    trust = 1.0 / np.maximum(scatter, 1.0)
    own, known = own * trust[:, None, None], known * trust[:, None]
    square = np.sum(own**2, axis=2)
    common = float(np.sum(np.sum(own, axis=0) ** 2) - square.sum())
    chance = float(np.sqrt(2.0 * np.sum(square.sum(axis=0) ** 2 - np.sum(square**2, axis=0))))
    weight = float(np.sum(known.sum(axis=0) ** 2 - np.sum(known**2, axis=0)))
    if weight <= 0.0 or common <= _SIGNIFICANT * chance:
        return 0.0
    return float(np.sqrt(common / weight))


# A rate that changes by less than this part of itself is far from rest: the pixels show how it changes.
_NEAR_REST = 1.5
_MOST_STARS = 10
# The light along a path is summed in steps of this many px, from so many before the rest to so many lengths.
_STEP = 0.5
_BEFORE = 5.0
_BEYOND = 1.9
# Px to either side of the path that count.
_ASIDE = 3
# The motions compared: times of the shorter way over the longer one's, and lengths over that of the fit.
# Ways nearly alike differ by a px or two of the path.
_SHARES = np.concatenate([np.arange(0.15, 0.96, 0.1), [0.97, 0.98, 0.99]])
_LENGTHS = np.concatenate([np.arange(0.95, 1.1, 0.01), np.arange(1.1, 1.71, 0.05)])
# Part of the light by which the profile across may be wrong.
_ROUGH = 0.05
# No star says more than this many sigmas squared.
_LOUDEST = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class _Along:
    """A streak's light along its path, and what gives chi-square for any other light there.

    Attributes:
        places: (k,) px from the rest.
        square, cross, plain: (k,) sums of w g^2, w g d and w g over the pixels nearest to each place: data d
            of weight w, and the point spread g across the path.
        moments: sums of w, w d and w d^2 over all pixels.
        pixels: their number.
    """

    places: FloatArray
    square: FloatArray
    cross: FloatArray
    plain: FloatArray
    moments: tuple[float, float, float]
    pixels: int


def turning_back(camera: ExposedCamera, scene: Scene) -> float:
    """Return by how many sigmas squared a motion that turned back explains bright streaks better.

    0 where none does. Where the rate is far from rest, or known from elsewhere, none is asked for.
    """
    motion, change = scene.motion, scene.motion.relative_growth
    if abs(change) < _NEAR_REST or motion.shape.any():
        return 0.0
    scene = scene.select(np.flatnonzero(scene.trusted))
    scene = scene.select(np.argsort(-scene.light, kind="stable")[:_MOST_STARS])
    first = -0.5 * np.sign(change)
    rests = positions(camera.pinhole, motion, scene.stars, np.full(len(scene.stars), first))
    onward = Motion.steady(-np.sign(first) * motion.whole)
    share = (0.5 - 1.0 / abs(change)) / (0.5 + 1.0 / abs(change))
    better = np.zeros((len(_SHARES), len(_LENGTHS)))
    for rest, length in zip(rests, path_lengths(camera.pinhole, motion, scene.stars), strict=True):
        streak = _along(camera, onward, rest, float(length), scene.width)
        fitted = _misfit(streak, np.array([share]), np.array([length]), scene.width)
        others = _misfit(streak, _SHARES, _LENGTHS * length, scene.width)
        scale = max(1.0, float(min(others.min(), fitted.min())) / max(streak.pixels, 1))
        better += np.clip((fitted - others) / scale, -_LOUDEST, _LOUDEST)
    return max(0.0, float(better.max()))


def _along(camera: ExposedCamera, onward: Motion, rest: FloatArray, length: float, width: float) -> _Along:
    """Return the light along the path of a star that is at pixel `rest` (2,) first and moves `onward`."""
    frame, pinhole = camera.frame, camera.pinhole
    places = np.arange(-_BEFORE, _BEYOND * length + _BEFORE, _STEP)
    path = positions(pinhole, onward, np.repeat(rest[None], len(places), axis=0), places / length)
    index = _pixels_near(path, pinhole.columns, pinhole.rows)
    index = index[~frame.bad[index]]
    points = np.stack([index % pinhole.columns, index // pinhole.columns], axis=1)
    apart = np.sum((points[:, None] - path) ** 2, axis=2)
    nearest = np.argmin(apart, axis=1)
    apart = apart[np.arange(len(index)), nearest]
    # What lies before the first place or beyond the last one is no part of the path.
    kept = (apart < _ASIDE**2) & (nearest > 0) & (nearest < len(places) - 1)
    index, apart, nearest = index[kept], apart[kept], nearest[kept]
    data = frame.signal[index].astype(float)
    bright = np.maximum(data, 0.0)
    weight = 1.0 / (frame.floor[index] + bright / frame.gain + (_ROUGH * bright) ** 2)
    across = np.exp(-0.5 * apart / width**2)
    square, cross, plain = (
        np.bincount(nearest, weight * each, len(places)).astype(float)
        for each in (across**2, across * data, across)
    )
    moments = float(np.sum(weight)), float(weight @ data), float(weight @ data**2)
    return _Along(places, square, cross, plain, moments, len(index))


def _pixels_near(path: FloatArray, columns: int, rows: int) -> IntArray:
    """Return the flat indices of the pixels about a path (k, 2)."""
    offset = np.arange(-_ASIDE, _ASIDE + 1)
    x, y = (np.rint(path[:, axis]).astype(np.int64)[:, None, None] for axis in (0, 1))
    x, y = np.broadcast_arrays(x + offset[:, None], y + offset)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    return np.unique(y[inside] * columns + x[inside])


def _misfit(one: _Along, shares: FloatArray, lengths: FloatArray, width: float) -> FloatArray:
    """Return chi-square (s, l) under motions whose ways have `shares` (s,) of time and `lengths` (l,) px.

    The star's light and the sky about it are free.
    """
    edges = np.append(one.places, one.places[-1] + _STEP) - 0.5 * _STEP
    light = np.diff(_passed(edges / lengths[:, None], shares[:, None, None]), axis=-1)
    light = gaussian_filter1d(light, width / _STEP, axis=-1, mode="constant")
    square, cross, plain = light**2 @ one.square, light @ one.cross, light @ one.plain
    weight, first, second = one.moments
    determinant = np.maximum(square * weight - plain**2, 1e-30)
    explained = (weight * cross**2 - 2.0 * plain * cross * first + square * first**2) / determinant
    return np.asarray(second - explained)


def _passed(place: FloatArray, share: FloatArray) -> FloatArray:
    """Return what part of the light lies before `place`, in lengths from the rest.

    A negative `share` is of a motion that begins after the rest.
    """
    root, turned = np.sqrt(np.clip(place, 0.0, 1.0)), np.maximum(share, 0.0)
    whole = np.maximum(root, -share) + np.minimum(root, turned) + np.minimum(share, 0.0)
    return np.asarray(whole / (1.0 + share))


# Rounds of conjugate gradients for the covariance.
_CONJUGATE = 12
# Up to this number, stars hardly contradict each other: their variance counts by the factor.
_UNCHECKED = (2, 4.0)
# Fitted and described point spread are the same when their variances differ by this part.
_SAME_SPREAD = 0.05
# Ends are uncertain by this part of the square root of the difference of the variances;
_END_SHARE = 0.6
# where streaks show them, at most by this floor, px, and by these shares of the displacement that the light
# left over about them amounts to: beyond chance, and with it.
_END_FLOOR = 0.12
_END_SHOWN = 1.5
_END_CHANCE = 0.5
# Px by which ends are uncertain for each px, or unit of brightness, that all streaks waver in common.
_END_SHAKING = 25.0
# The lens is corrected so often at most, as long as an error of it is more than this part of its deviation,
# where it leaves the turn uncertain by this part of it, unless the stars show it.
_MOST_LENSES = 3
_SMALL_ERROR = 0.2
_WORTH = 0.002
# A covariance beyond this many times that of noise is by errors of the model: three deviations.
_BEYOND_NOISE = 9.0


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """What is known of the turn.

    Attributes:
        turn: (3,) rad, corrected for the camera's errors where the stars show them.
        covariance: (3, 3) rad^2.
        doubt: share of the turn to which errors of the model leave it uncertain, as a vector: common to all
            stars or not. A shutter that nobody described is not counted: the covariance says all of it.
        shaking: of the body.
        aside: px across the streaks, what the model leaves over there as a displacement.
    """

    turn: FloatArray
    covariance: FloatArray
    doubt: float
    shaking: Shaking
    aside: float


def claim(result: MotionResult, camera: ExposedCamera, whole: Fit) -> Claim:
    """Return what the `whole` fit may claim of its turn; `result` has its stars.

    Where stars are hidden in the streaks, the turn is that of the brightest, fitted with those.
    """
    camera, whole, lens = _straightened(camera, whole, result.exposure)
    bared = bared_fit(camera, whole)
    last = whole if bared is None else bared
    scene, settings = last.scene, camera.settings
    exact = turn_covariance(last.evaluation, last.free, _CONJUGATE)
    noise = last.solution.covariance[:3, :3] if exact is None else exact
    if bared is not None:
        lens = _with_lens(camera, bared, result.exposure, lens.counted)
    turn = scene.motion.whole + lens.step
    # What made others disagree is as likely to hide, less of it, in the light of those that agree.
    agreed = int(np.count_nonzero(scene.trusted))
    asked = int(np.count_nonzero(scene.light >= scene.light[scene.trusted].min(initial=np.inf)))
    spread = max(result.misfit, lens.spread, 1.0) * max(asked / max(agreed, 1), 1.0)
    if agreed <= _UNCHECKED[0]:
        spread *= _UNCHECKED[1]
    left = left_over(camera, whole)
    shaking = find_shaking(camera, whole.scene, left)
    end = np.hypot(
        _spread_doubt(left, whole.scene, settings.psf_sigma, result.misfit),
        _END_SHAKING * max(shaking.across, shaking.along),
    )
    ends = float(np.sqrt(2.0) * end / result.length)
    # What the model does not explain makes it less certain; what fits too well, no more. A fit that goes
    # to and fro, as pixels are left out and taken in, is known no better than that.
    covariance = noise * spread * (1.0 + last.restless**2)
    longer = ends**2 * float(turn @ turn)
    # Ends that are alike uncertain make the turn longer or shorter; the covariance leaves room for its axis.
    common = float(np.trace(lens.described)) + longer
    unmodelled = max(common, common + float(np.trace(covariance - _BEYOND_NOISE * noise)))
    covariance = covariance + lens.added + longer * np.eye(3)
    return Claim(
        turn, covariance, float(np.sqrt(unmodelled / (turn @ turn))), shaking, _aside(left, whole.scene)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Lens:
    """What errors of the camera's description make of the turn.

    Attributes:
        step: (3,), its correction; added, described: (3, 3), as of `Correction`.
        spread: of the stars, in that of the noise.
        error: (m,) as of `Correction`, beside those that the fit knew, `counted` (m,), None without; seen:
            whether the stars show them.
    """

    step: FloatArray
    added: FloatArray
    described: FloatArray
    spread: float
    error: FloatArray
    counted: FloatArray | None
    seen: bool


def _straightened(camera: ExposedCamera, whole: Fit, exposure: float) -> tuple[ExposedCamera, Fit, _Lens]:
    """Return camera and fit with the likeliest errors of the lens, and what is left of them in the turn.

    Streaks that are displaced by much of their width ask for too small a correction: the fit goes on through
    the lens that they ask for, until they ask no more. It is worth its time where the stars show that the
    lens is another, and where not to know it is most of the doubt.
    """
    first = lens = _with_lens(camera, whole, exposure, None)
    if not lens.seen and np.trace(lens.described) < _WORTH**2 * np.sum(whole.scene.motion.whole**2):
        return camera, whole, lens
    through, fit, error = camera, whole, np.zeros(len(lens.error))
    for _ in range(_MOST_LENSES):
        if not np.any(np.abs(lens.error) > _SMALL_ERROR) or camera.work.exhausted:
            break
        error = error + lens.error
        through = bent_camera(replace(camera, growing=bool(whole.free[3])), error)
        again = refit(through, fit)
        if again is None:
            return camera, whole, first
        fit = again
        lens = _with_lens(through, fit, exposure, error)
    return through, fit, lens


def _with_lens(camera: ExposedCamera, last: Fit, exposure: float, counted: FloatArray | None) -> _Lens:
    """Return what errors of the camera's description make of the turn, beside those `counted` (m,)."""
    nothing = np.zeros((3, 3))
    equations = own_equations(last.evaluation, last.free)
    if equations is None:
        return _Lens(np.zeros(3), nothing, nothing, 1.0, np.zeros(0), counted, False)
    trusted = np.flatnonzero(last.scene.trusted)
    scene = last.scene.select(trusted)
    equations = OwnEquations(equations.kept, equations.information[trusted], equations.score[trusted])
    seeming = seeming_turns(camera, scene, exposure)
    spread = _spread(equations, scene)
    exact = _Lens(np.zeros(3), nothing, nothing, spread, np.zeros(0), counted, False)
    if not seeming.shape[2]:
        return exact
    described = seeming.shape[2] - int(camera.settings.shutter_unstated)
    shared = np.zeros((len(trusted), len(equations.kept), seeming.shape[2]))
    shared[:, :3] = seeming
    corrected, before = None, 1.0
    # The part of the disagreement that the camera's errors explain is not counted as noise.
    for _ in range(2):
        corrected = correct(equations.information, equations.score, shared, before, described, counted)
        if corrected is None:
            return exact
        left = replace(equations, score=corrected.score)
        before = max(1.0, min(spread, _spread(left, scene)))
    assert corrected is not None
    added, stated = corrected.added[:3, :3], corrected.described[:3, :3]
    seen = bool(corrected.step.any())
    return _Lens(
        corrected.step[:3], added, stated, before if seen else spread, corrected.error, counted, seen
    )


def _spread(equations: OwnEquations, scene: Scene) -> float:
    """Return by how much the stars contradict each other, in the variance of their noise."""
    everyone: BoolArray = np.ones(len(scene.light), dtype=np.bool_)
    return max(disagreement(estimates_of(equations, scene), everyone), contradiction(equations))


def _spread_doubt(left: LeftOver, scene: Scene, sigma: float, misfit: float) -> float:
    """Return by how many px the ends of streaks are uncertain by a point spread other than `sigma` px.

    Where the fit leaves nothing over about the ends the point spread is as wide along the streaks as across
    them, and of the model's shape, however wide. What is left over there may be another shape, or the light
    of a body that shakes too fast to be seen, whose ends are farther off than they seem.
    """
    described = sigma**2 + PIXEL_VARIANCE
    beyond = abs(scene.width**2 - described) - _SAME_SPREAD * described
    if beyond <= 0.0:
        return 0.0
    another = _END_SHARE * float(np.sqrt(beyond)) * max(misfit, 1.0)
    ends = displaced_ends(left, scene)
    if ends is None:
        return another
    seen = np.hypot(_END_SHOWN * ends.shown, _END_CHANCE * ends.chance)
    return min(another, float(np.hypot(_END_FLOOR, seen)))


def _aside(left: LeftOver, scene: Scene) -> float:
    sides = displaced_sides(left, scene)
    return 0.0 if sides is None else sides.shown
