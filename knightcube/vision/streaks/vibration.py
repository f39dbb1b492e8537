"""Fit of a vibration of the camera, which displaces all streaks of a frame at the same instants.

A vibration displaces the stars across their paths and changes their speed, and thereby the intensity, along
their paths. The residuals of a fit without vibration show the displacements and the changes of intensity as
functions of time. The rotation vector of the vibration is modelled as a sum of few sinusoids. The initial
value of each frequency is the trial frequency that decreases chi-square most. Gauss-Newton steps improve
frequencies and amplitudes, and the motion and the stars are fitted again between the steps.

In the search for a frequency, the residuals in one time bin depend linearly on 12 numbers: the rotation
vector, its time derivative, and the rotation vectors at the start and the end of the exposure, which move the
ends of the streaks. The Gauss-Newton steps use the derivatives of `vibrating_streaks`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from knightcube.astro.arrays import Float32Array, FloatArray, IntArray
from knightcube.compiled import compiled_form_of, loop_helper
from knightcube.vision.streaks import vibrating_streaks
from knightcube.vision.streaks.camera_motion import Vibration
from knightcube.vision.streaks.fit_windows import LINES, SLOWEST, Strips
from knightcube.vision.streaks.geometry import StreakScene, image_flow, path_lengths, paths
from knightcube.vision.streaks.joint_fit import FitProblem, StreakFit
from knightcube.vision.streaks.normal_equations import SATURATION_MARGIN, Pixels, residuals
from knightcube.vision.streaks.scene_images import model_images
from knightcube.vision.streaks.vibrating_streaks import Rotations

# Residual (standard deviations) above which a pixel contains flux of another star.
_FOREIGN_SIGMAS = 5.0
# Addition to this limit, as a fraction of the largest modelled counts of the star on the same line of pixels.
_FOREIGN_SHARE = 0.6


@dataclass(frozen=True, eq=False)
class StreakResiduals:
    """Residuals of the streaks that determine the motion, on b blocks of pixels.

    Attributes:
        strips: pixels of the blocks.
        star: index in the scene of each block's star (b,).
        time: time at which the star crosses each line of pixels (b, LINES), in exposure times since
            mid-exposure.
        images: images that are combined to model a streak, on lines of k pixels (b, IMAGES, LINES, k).
        weight: inverse variance of each pixel (b, LINES, k), 0 for excluded pixels.
        residual: measured minus modelled counts of each pixel (b, LINES, k).
    """

    strips: Strips
    star: IntArray
    time: FloatArray
    images: Float32Array
    weight: Float32Array
    residual: Float32Array

    def trust(self, stars: int) -> FloatArray:
        """Return the weight (n,) of each star, which is limited by the scatter of its residuals."""
        star, sums = np.repeat(self.star, LINES), self.line_sums
        scatter = np.bincount(star, sums.squares, stars) / np.maximum(np.bincount(star, sums.used, stars), 1)
        return np.asarray(1.0 / np.maximum(scatter, 1.0))

    @functools.cached_property
    def line_sums(self) -> LineSums:
        """The sums over each line of pixels for displacements across the paths and for the rate."""
        return self.sums_of_lines(2)

    def sums_of_lines(self, rows: int) -> LineSums:
        """Return the sums over each line of pixels for the first `rows` images of `_ROTATION_IMAGES`."""
        return LineSums(*_line_sums(self.images, self.weight, self.residual, rows))


class LineSums(NamedTuple):
    """Sums over the pixels of each of l lines of products of r images, see `_ROTATION_IMAGES`.

    The array `gram` (l, r, r) contains the weighted products of two images, `score` (l, r) those of image and
    residual, `squares` (l,) the weighted squared residuals, and `used` (l,) the number of fitted pixels.
    """

    gram: FloatArray
    score: FloatArray
    squares: FloatArray
    used: IntArray


# Indices of the images for the rotation, its rate, and the rotations at start and end of the exposure.
_ROTATION_IMAGES = (1, 0, 3, 4)


def _line_sums_numpy(
    images: Float32Array, weight: Float32Array, residual: Float32Array, rows: int
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return the attributes of `LineSums` for the attributes of `StreakResiduals`."""
    images = images[:, _ROTATION_IMAGES[:rows]]
    weighted = (images * weight[:, None]).transpose(0, 2, 1, 3)
    gram = (weighted @ images.transpose(0, 2, 3, 1)).reshape(-1, rows, rows).astype(np.float64)
    score = (weighted @ residual[..., None]).reshape(-1, rows).astype(np.float64)
    squares = np.sum(weight * residual * residual, axis=2).reshape(-1).astype(np.float64)
    return gram, score, squares, np.count_nonzero(weight, axis=2).reshape(-1)


@compiled_form_of(_line_sums_numpy)
def _line_sums(
    images: Float32Array, weight: Float32Array, residual: Float32Array, rows: int
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    blocks, lines, size = weight.shape
    gram, score = np.empty((blocks * lines, rows, rows)), np.empty((blocks * lines, rows))
    squares, used = np.empty(blocks * lines), np.empty(blocks * lines, np.int64)
    weighted = np.empty((rows + 1, size), np.float32)
    for b in range(blocks):
        for i in range(lines):
            line, weights, left = b * lines + i, weight[b, i], residual[b, i]
            used[line] = np.count_nonzero(weights)
            _multiply(weighted[rows], weights, left)
            squares[line] = _scalar_product(weighted[rows], left)
            for r in range(rows):
                image = images[b, _ROTATION_IMAGES[r], i]
                score[line, r] = _scalar_product(weighted[rows], image)
                _multiply(weighted[r], weights, image)
                for c in range(r + 1):
                    gram[line, r, c] = _scalar_product(weighted[c], image)
                    gram[line, c, r] = gram[line, r, c]
    return gram, score, squares, used


@loop_helper
def _multiply(out: Float32Array, one: Float32Array, other: Float32Array) -> None:
    for k in range(len(out)):
        out[k] = one[k] * other[k]


@loop_helper
def _scalar_product(one: Float32Array, other: Float32Array) -> np.float32:
    total = np.float32(0.0)
    for k in range(len(one)):
        total += one[k] * other[k]
    return total


def residuals_of_fit(camera: FitProblem, fit: StreakFit) -> StreakResiduals:
    """Return the residuals of the fit on the pixels of the long streaks that determine the motion."""
    scene, windows = fit.scene, fit.windows
    images, spots, _ = model_images(camera.pinhole, camera.shutter, scene, windows)
    of_block = windows.long[windows.strips.star]
    view = windows.on_strips
    pixels = view.slot, view.inside, view.signal, view.floor, view.ceiling
    total = windows.total(images, spots, scene.light, scene.sky)
    chosen = np.flatnonzero(scene.trusted[of_block])
    star, gain = of_block[chosen], float(view.gain)
    weight, residual = _chosen_residuals(images, scene.light[star], chosen, total, pixels, gain)
    images = images if len(chosen) == len(images) else images[chosen]
    strips = windows.strips.select(chosen)
    return StreakResiduals(strips, star, strips.time, images, weight, residual)


def _chosen_residuals_numpy(
    images: Float32Array,
    light: FloatArray,
    chosen: IntArray,
    total: Float32Array,
    pixels: Pixels,
    gain: float,
) -> tuple[Float32Array, Float32Array]:
    """Return weights and residuals of the blocks `chosen` (c,), see `StreakResiduals`.

    The array `light` (c,) is the flux of the star of each chosen block. The arguments `total`, `pixels` (of
    all blocks) and `gain` are described in `normal_equations.residuals`. Pixels that contain flux of another
    star get the weight 0.
    """
    slot, inside, signal, floor, ceiling = pixels
    own = slot[chosen], inside[chosen], signal[chosen], floor[chosen], ceiling[chosen]
    weight, residual = residuals(total, own, (gain, 0.0))
    peak = (images[chosen, 0] * light[:, None, None].astype(np.float32)).max(
        axis=2, keepdims=True, initial=0.0
    )
    with np.errstate(divide="ignore"):
        foreign = np.abs(residual) > _FOREIGN_SIGMAS / np.sqrt(weight) + _FOREIGN_SHARE * peak
    weight[foreign] = 0.0
    return weight, residual


@compiled_form_of(_chosen_residuals_numpy)
def _chosen_residuals(
    images: Float32Array,
    light: FloatArray,
    chosen: IntArray,
    total: Float32Array,
    pixels: Pixels,
    gain: float,
) -> tuple[Float32Array, Float32Array]:
    slot, inside, signal, floor, ceiling = pixels
    (_, lines, size), count = slot.shape, len(chosen)
    weight, residual = np.empty((count, lines, size), np.float32), np.empty((count, lines, size), np.float32)
    per_count, margin, least = np.float32(1.0 / gain), np.float32(SATURATION_MARGIN), np.float32(0.0)
    sigmas, share = np.float32(_FOREIGN_SIGMAS), np.float32(_FOREIGN_SHARE)
    for c in range(count):
        b, flux = chosen[c], np.float32(light[c])
        for i in range(lines):
            peak = least
            for k in range(size):
                peak = max(peak, images[b, 0, i, k] * flux)
            for k in range(size):
                model = total[slot[b, i, k]]
                variance = max(model, least) * per_count + floor[b, i, k]
                deviation, off = np.float32(math.sqrt(variance)), signal[b, i, k] - model
                good = inside[b, i, k] and model + margin * deviation < ceiling[b, i, k]
                residual[c, i, k] = off if good else least
                known = good and abs(off) <= sigmas * deviation + share * peak
                weight[c, i, k] = np.float32(1.0) / variance if known else least
    return weight, residual


# Number of time bins over the exposure for the estimate of the motion common to all streaks.
_BINS = 48
# Minimum significance (standard deviations) of a motion common to all streaks.
_SIGNIFICANT = 4.0


@dataclass(frozen=True, slots=True)
class CommonMotion:
    """RMS vibration common to all streaks (deviation from the smooth motion), or 0 if not significant.

    The attribute `across` is the displacement of the streaks across their paths, px. The attribute `along` is
    the change of brightness along the paths, as a fraction of the brightness.
    """

    across: float = 0.0
    along: float = 0.0


def find_common_motion(camera: FitProblem, scene: StreakScene, left: StreakResiduals) -> CommonMotion:
    """Return the vibration common to the long streaks that determine the motion; 0 without long streaks.

    At each time, vibration displaces all streaks equally across their paths. Along the paths, vibration
    changes the speed of the stars and thereby their intensity. The residuals of all stars are averaged in
    bins of time. Only products of the residuals of different stars are summed, so that an unmodelled
    neighbour of a single star has no effect.
    """
    if not len(left.star):
        return CommonMotion()
    time, star = left.time, left.star
    stars = scene.stars[star]
    velocity = paths(camera.pinhole, scene.motion, np.repeat(stars, LINES, axis=0), time.reshape(-1)).velocity
    tangent = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    light = np.repeat(scene.light[star], LINES)
    place = np.clip(((time + 0.5) * _BINS).astype(np.int64), 0, _BINS - 1).reshape(-1)
    within = (np.abs(time) < 0.5).reshape(-1)
    owner = np.repeat(star, LINES)
    sums, found = left.line_sums, []
    for row, way in ((0, normal), (1, tangent)):
        score, information = light * sums.score[:, row], light**2 * sums.gram[:, row, row]
        cell = (owner * _BINS + place)[within]
        found.append(_common_rms(cell, score[within, None] * way[within], information[within]))
    return CommonMotion(*found)


def _common_rms(cell: IntArray, score: FloatArray, information: FloatArray) -> float:
    """Return the rms displacement common to all stars, or 0 if it is not significant.

    The gradients `score` (m, 2) and `information` (m,) of m lines of pixels are summed for each pair of a
    star and a time bin; `cell` (m,) is the index of the pair.
    """
    size = (int(cell.max()) // _BINS + 1) * _BINS if len(cell) else 0
    if size < 2 * _BINS:
        return 0.0
    own = np.stack([np.bincount(cell, score[:, axis], size) for axis in (0, 1)], axis=-1)
    own = own.reshape(-1, _BINS, 2)
    known = np.bincount(cell, information, size).reshape(-1, _BINS)
    # The weight of a star is limited by the scatter of its residuals, which includes model errors.
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


# Number of time bins for the fit of a vibration, and half of their total duration, in exposure times.
_FINE_BINS, _RANGE = 512, 0.56
# Highest frequency (cycles per exposure) that the time bins resolve, with two bins per cycle.
_HIGHEST = _FINE_BINS / (4.0 * _RANGE)
# Prior standard deviations (px): of a vibration, and of each error of position, rate and acceleration.
_USUAL, _LOOSE = 1.0, 10.0
# Lowest frequency of a vibration, and step between trial frequencies, in cycles per exposure.
_LOWEST, _GRID = 0.75, 0.2
# Shortest fitted wavelength of a vibration along the streaks, in point-spread widths.
_SHORTEST_WAVE = 4.0
# Limits of the wavelength of an unresolved vibration along the streaks, in point-spread widths.
_UNRESOLVED = (2.2, 6.0)
# Number of samples of the spectrum of the residuals.
_SPECTRUM = 4096
# Minimum decrease of chi-square by an unresolved vibration. Noise decreased it by at most 33 in 190 frames.
_LEAST_UNRESOLVED = 36.0
# Minimum decrease of chi-square by a fitted sinusoid: absolute, and as a fraction of the excess chi-square.
_LEAST_GAIN, _LEAST_SHARE = 60.0, 0.2
# Maximum number of sinusoids, and minimum difference (cycles per exposure) between their frequencies.
_MOST_SINUSOIDS, _LEAST_APART = 2, 1.0
# Maximum number of Gauss-Newton steps, and displacement (px) by one step below which the fit has converged.
_MOST_STEPS, _CONVERGED = 4, 0.02
# Largest change of a frequency in one step, in cycles per exposure.
_MOST_DETUNED = 0.3
# Largest accepted amplitude of a vibration, px.
_LARGEST = 2.5
# Error of the streak ends due to motions other than the sinusoids, as a fraction of their amplitudes.
_MODEL_ERROR = 0.02
# Instants at which the change of a vibration by a step is evaluated, in exposure times since mid-exposure.
_SAMPLES = np.linspace(-0.5, 0.5, 257)
# Start and end of the exposure, relative to mid-exposure and in units of the exposure time.
_ENDS = np.array([-0.5, 0.5])


def fit_vibration(
    camera: FitProblem, fit: StreakFit, again: Callable[[StreakScene], StreakFit | None]
) -> StreakFit | None:
    """Return `fit` with the vibration that its residuals show, or None if they show no vibration.

    The function `again` repeats the fit from a scene with a vibration, and returns None if it does not
    succeed. If `fit` already includes a vibration, this vibration is improved. Returns None also if the
    vibration is too large.
    """
    best = _converged(camera, fit, again) if fit.scene.motion.vibration.exists else fit
    if best is None or _too_large(camera, best):
        return None
    while len(best.scene.motion.vibration.frequency) < _MOST_SINUSOIDS:
        vibration = best.scene.motion.vibration
        sums = _rotation_sums(camera, best.scene, residuals_of_fit(camera, best))
        highest = _median_length(camera, best.scene) / (_SHORTEST_WAVE * best.scene.width)
        frequency = _strongest_frequency(sums, vibration, highest)
        if frequency is None:
            break
        motion = replace(best.scene.motion, vibration=vibration.with_frequency(frequency))
        more = _converged(camera, replace(best, scene=replace(best.scene, motion=motion)), again)
        if more is None or _too_large(camera, more):
            break
        gain = _excess(best) - _excess(more)
        if gain < max(_LEAST_GAIN, _LEAST_SHARE * _excess(best)):
            break
        best = more
    return best if best.scene.motion.vibration.exists else None


def _converged(
    camera: FitProblem, fit: StreakFit, again: Callable[[StreakScene], StreakFit | None]
) -> StreakFit | None:
    """Return `fit` after Gauss-Newton steps of its vibration, each followed by a fit of motion and stars.

    Returns None if a fit does not succeed, or if no long streak shows the vibration.
    """
    before = _excess(fit)
    for turn in range(_MOST_STEPS):
        vibration, left = fit.scene.motion.vibration, residuals_of_fit(camera, fit)
        if not len(left.star):
            return None
        after, _ = _improved(camera, fit.scene, left)
        moved = np.abs(after.rotation(_SAMPLES) - vibration.rotation(_SAMPLES)).max()
        once_more = again(replace(fit.scene, motion=replace(fit.scene.motion, vibration=after)))
        if once_more is None:
            return None
        fit = once_more
        if moved * camera.pinhole.focal_length < _CONVERGED or (turn and _excess(fit) >= before):
            break
    return fit


def _excess(fit: StreakFit) -> float:
    """Return chi-square minus the number of pixels, both before the last step of the fit."""
    return float(np.sum(fit.evaluation.chi2 - fit.evaluation.pixels))


def _too_large(camera: FitProblem, fit: StreakFit) -> bool:
    """Return whether the amplitude of a sinusoid of the fitted vibration exceeds its limit."""
    return bool(np.any(fit.scene.motion.vibration.amplitude * camera.pinhole.focal_length > _LARGEST))


def vibration_covariance(
    camera: FitProblem, scene: StreakScene, left: StreakResiduals
) -> tuple[FloatArray, float]:
    """Return the covariance (3, 3), rad^2, added by vibrations, and the amplitude (rad) of an unresolved one.

    The covariance applies to the rotation over the exposure. It includes the displacement of the streak ends
    by a fast vibration that is not fitted but is significant in the spectrum of the residuals. The amplitude
    of this fast vibration is 0 if none is significant.
    """
    vibration = scene.motion.vibration
    if not len(left.star):
        return np.zeros((3, 3)), 0.0
    # The rotations at start and end of the exposure do not affect the amplitude of an unresolved vibration.
    sums = _rotation_sums(camera, scene, left, 4 if vibration.exists else 2)
    length = _median_length(camera, scene)
    amplitude = _unresolved_amplitude(sums, vibration, length / scene.width)
    fast = amplitude**2 * np.eye(3)
    if not vibration.exists:
        return fast, amplitude
    unmodelled = float(np.sum((_MODEL_ERROR * vibration.amplitude) ** 2))
    return fast + _improved(camera, scene, left)[1] + unmodelled * np.eye(3), amplitude


def _kept_share(frequency: FloatArray, length: float) -> FloatArray:
    """Return the fraction of the amplitude that remains after averaging over the point spread function.

    The streaks have a `length` in point-spread widths, and the frequencies are in cycles per exposure.
    """
    return np.asarray(np.exp(-0.5 * (2.0 * np.pi * frequency / length) ** 2))


def _unresolved_amplitude(sums: _RotationSums, known: Vibration, length: float) -> float:
    """Return the amplitude, rad, of the most significant unresolved vibration, or 0 if none is significant.

    The streaks have a `length` in point-spread widths. The point spread function reduces the amplitude in the
    residuals, and the returned amplitude is corrected for this reduction. The spectrum neglects correlations
    between sine and cosine and between the vibration and errors of the smooth motion.
    """
    step = sums.time[1] - sums.time[0]
    frequency = np.fft.rfftfreq(_SPECTRUM, step)
    chosen = (frequency > length / _UNRESOLVED[1]) & (frequency < length / _UNRESOLVED[0])
    chosen &= (np.abs(frequency[:, None] - known.frequency) >= _LEAST_APART).all(axis=1)
    frequency = frequency[chosen]
    if not len(frequency):
        return 0.0
    angular = 2.0 * np.pi * frequency[:, None]
    value, slope = (np.fft.rfft(sums.score[:, i].T, _SPECTRUM)[:, chosen].T for i in (0, 1))
    # The derivative of exp(-i w t) with respect to time is -i w exp(-i w t), with `angular` as w.
    score = value - 1j * angular * slope
    parts = np.stack([score.real, score.imag], axis=-1)
    constant, square = (0.5 * sums.information[:, i, :, i].sum(axis=0) for i in (0, 1))
    information = constant + angular[..., None] ** 2 * square
    information = information + (sums.focal_length / _USUAL) ** 2 * np.eye(3)
    amplitude = _solved(information, parts)
    gain = np.sum(parts * amplitude, axis=(1, 2))
    best = int(np.argmax(gain))
    if gain[best] <= _LEAST_UNRESOLVED:
        return 0.0
    shown = float(np.linalg.norm(amplitude[best]))
    return min(shown / float(_kept_share(frequency, length)[best]), _LARGEST / sums.focal_length)


def _median_length(camera: FitProblem, scene: StreakScene) -> float:
    """Return the median length (px) of the paths of the stars that determine the motion."""
    return float(np.median(path_lengths(camera.pinhole, scene.motion.smooth, scene.stars[scene.trusted])))


@dataclass(frozen=True, slots=True, eq=False)
class _RotationSums:
    """Normal equations of b time bins for the rotation, its rate, and the rotations at both exposure ends.

    The equations consist of the Fisher information (b, 4, 3, 4, 3) and the gradient (b, 4, 3) of the
    log-likelihood (`score`). The attribute `time` (b,) contains the middles of the bins, in exposure times
    since mid-exposure.
    """

    time: FloatArray
    information: FloatArray
    score: FloatArray
    focal_length: float

    def normal_equations(self, functions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return information (3n, 3n) and gradient (3n,) of the coefficients of n `functions` (n, b, 4)."""
        return self.joint_information(functions, functions), self.gradient(functions)

    def gradient(self, functions: FloatArray) -> FloatArray:
        """Return the gradient (3n,) of the coefficients of n `functions` (n, b, 4)."""
        return np.asarray(functions.reshape(len(functions), -1) @ self.score.reshape(-1, 3)).reshape(-1)

    def joint_information(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return the joint information (3n, 3m) of functions `first` (n, b, 4) and `second` (m, b, 4)."""
        n, m = len(first), len(second)
        half = np.einsum("fbi,bikjl->fklbj", first, self.information, optimize=True)
        whole = half.reshape(9 * n, -1) @ second.reshape(m, -1).T
        return np.asarray(whole.reshape(3 * n, 3, m).transpose(0, 2, 1).reshape(3 * n, 3 * m))

    def information_of_pairs(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return the joint information (n, 3, 3) of pairs of functions in `first` and `second` (n, b, 4)."""
        products = (first[..., None] * second[..., None, :]).reshape(len(first), -1)
        return (products @ self.information.transpose(0, 1, 3, 2, 4).reshape(-1, 9)).reshape(-1, 3, 3)


def _rotation_sums(
    camera: FitProblem, scene: StreakScene, left: StreakResiduals, rows: int = 4
) -> _RotationSums:
    """Return the normal equations of a common rotation of the stars as a function of time.

    The equations contain the first `rows` of the four quantities of `_RotationSums`. The weight of a star is
    limited by the scatter of its residuals, which includes model errors.
    """
    time, star = left.time.reshape(-1), np.repeat(left.star, LINES)
    path = paths(camera.pinhole, scene.motion, scene.stars[star], time)
    speed = np.maximum(np.hypot(*path.velocity.T), SLOWEST)
    tangent = path.velocity / speed[:, None]
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    flow = image_flow(camera.pinhole, path.position)
    across, along = (np.einsum("li,lij->lj", way, flow) for way in (normal, tangent))
    sums = left.line_sums if rows == 2 else left.sums_of_lines(rows)
    trust = left.trust(len(scene.stars))[star]
    light = scene.light[star]
    design = np.stack([across, -along / speed[:, None], -along, along][:rows], axis=1)
    place = np.clip(((time / _RANGE + 1.0) * 0.5 * _FINE_BINS).astype(np.int64), 0, _FINE_BINS - 1)
    products = sums.gram * (trust * light**2)[:, None, None], sums.score * (trust * light)[:, None]
    information, gradient = _binned_equations(*products, design, place, _FINE_BINS)
    middles = _RANGE * (2.0 * (np.arange(_FINE_BINS) + 0.5) / _FINE_BINS - 1.0)
    return _RotationSums(middles, information, gradient, camera.pinhole.focal_length)


def _binned_equations_numpy(
    gram: FloatArray, score: FloatArray, design: FloatArray, place: IntArray, bins: int
) -> tuple[FloatArray, FloatArray]:
    """Return the information (bins, r, 3, r, 3) and the gradient (bins, r, 3) of `_RotationSums`.

    The arrays `gram` (l, r, r) and `score` (l, r) are the information and the gradient of the r displacements
    of each of l lines of pixels, and `place` (l,) is the time bin of each line. The matrices `design` (l, r,
    3) are the derivatives of each line's r displacements with respect to the three components of a rotation.
    """
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], np.arange(bins))
    of_line = np.einsum("lia,lij,ljb->liajb", design, gram, design, optimize=True)
    return _sums_from(of_line[order], first), _sums_from((design * score[..., None])[order], first)


@compiled_form_of(_binned_equations_numpy)
def _binned_equations(
    gram: FloatArray, score: FloatArray, design: FloatArray, place: IntArray, bins: int
) -> tuple[FloatArray, FloatArray]:
    lines, rows, _ = design.shape
    information, gradient = np.zeros((bins, rows, 3, rows, 3)), np.zeros((bins, rows, 3))
    for line in range(lines):
        at = place[line]
        for i in range(rows):
            for c in range(3):
                gradient[at, i, c] += design[line, i, c] * score[line, i]
                for j in range(rows):
                    product = design[line, i, c] * gram[line, i, j]
                    for d in range(3):
                        information[at, i, c, j, d] += product * design[line, j, d]
    return information, gradient


def _sums_from(values: FloatArray, first: IntArray) -> FloatArray:
    """Return the sums of consecutive rows of `values`, each from an index in `first` to the next index."""
    total = np.zeros((len(values) + 1, *values.shape[1:]))
    np.cumsum(values, axis=0, out=total[1:])
    return np.asarray(np.diff(total[np.append(first, len(values))], axis=0))


def _functions(values: FloatArray, slopes: FloatArray, at_ends: FloatArray) -> FloatArray:
    """Return n functions of time as an array (n, b, 4) of four values in each of b time bins.

    The four values are the function and its derivative in the bin, and the function at the start and at the
    end of the exposure.
    """
    ends = np.broadcast_to(at_ends[:, None], (*values.shape, 2))
    return np.concatenate([values[..., None], slopes[..., None], ends], axis=2)


def _powers(time: FloatArray) -> FloatArray:
    """Return the functions 1, t and t^2 of the time t as an array (3, b, 4), see `_functions`.

    The functions describe errors of position, rate and acceleration that are common to all stars.
    """
    one = np.ones_like(time)
    values, slopes = np.stack([one, time, time**2]), np.stack([0.0 * one, one, 2.0 * time])
    return _functions(values, slopes, np.stack([_ENDS**0, _ENDS, _ENDS**2]))


def _waves(frequency: FloatArray, time: FloatArray) -> FloatArray:
    """Return the functions (2k, b, 4): k sines, then k cosines minus 1, of the frequencies (k,)."""
    w = 2.0 * np.pi * frequency[:, None]
    sine, cosine = np.sin(w * time), np.cos(w * time)
    at_ends = np.concatenate([np.sin(w * _ENDS), np.cos(w * _ENDS) - 1.0])
    return _functions(np.concatenate([sine, cosine - 1.0]), np.concatenate([w * cosine, -w * sine]), at_ends)


def _precisions(focal_length: float, sinusoids: int) -> FloatArray:
    """Return the inverse prior variances, 1/rad^2, of the coefficients of powers and sinusoids."""
    return np.repeat([(focal_length / _LOOSE) ** 2, (focal_length / _USUAL) ** 2], [9, 6 * sinusoids])


def _strongest_frequency(sums: _RotationSums, known: Vibration, highest: float) -> float | None:
    """Return the frequency of the sinusoid that decreases chi-square most, or None if none is significant."""
    grid = np.arange(_LOWEST, min(highest, _HIGHEST), _GRID)
    grid = grid[(np.abs(grid[:, None] - known.frequency) >= _LEAST_APART).all(axis=1)]
    if not len(grid):
        return None
    decrease = _decrease_of_chi2(sums, known, grid)
    best = int(np.argmax(decrease))
    return float(grid[best]) if decrease[best] > _LEAST_GAIN else None


def _decrease_of_chi2(sums: _RotationSums, known: Vibration, frequency: FloatArray) -> FloatArray:
    """Return the decrease (g,) of chi-square by one more sinusoid, for each of the g frequencies."""
    base = np.concatenate([_powers(sums.time), _waves(known.frequency, sums.time)])
    n, waves = 3 * len(base), _waves(frequency, sums.time)
    precision = _precisions(sums.focal_length, len(known.frequency) + 1)
    information, score = sums.normal_equations(base)
    by_function = sums.joint_information(base, waves).reshape(n, 2, len(frequency), 3)
    joint = by_function.transpose(2, 0, 1, 3).reshape(len(frequency), n, 6)
    sine, cosine = np.split(waves, 2)
    mixed = sums.information_of_pairs(sine, cosine)
    own = np.block(
        [
            [sums.information_of_pairs(sine, sine), mixed],
            [mixed.transpose(0, 2, 1), sums.information_of_pairs(cosine, cosine)],
        ]
    )
    # The Schur complement eliminates the coefficients of `base`.
    gain = _solved(information + np.diag(precision[:n]), joint)
    remaining = own + np.diag(precision[n:]) - joint.transpose(0, 2, 1) @ gain
    asked = sums.gradient(waves).reshape(2, len(frequency), 3).transpose(1, 0, 2).reshape(len(frequency), 6)
    asked = asked - score @ gain
    return np.asarray(np.sum(asked * _solved(remaining, asked[..., None])[..., 0], axis=1))


def _solved(matrix: FloatArray, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the solution of a linear system; if it is singular, the least-squares solution of least norm."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrix) @ right)


def _improved(camera: FitProblem, scene: StreakScene, left: StreakResiduals) -> tuple[Vibration, FloatArray]:
    """Return the vibration after a Gauss-Newton step, and the covariance (3, 3), rad^2, that it adds.

    The vibration adds this covariance to the rotation over the exposure. Errors of rate, acceleration and
    point-spread width, and of all stars, are estimated together with the vibration.
    """
    vibration = scene.motion.vibration
    k = len(vibration.frequency)
    information, score = _normal_equations(camera, scene, left)
    smooth, loose = 7, (camera.pinhole.focal_length / _LOOSE) ** 2
    usual = np.full(6 * k, (camera.pinhole.focal_length / _USUAL) ** 2)
    prior = np.concatenate([np.full(6, loose), [1.0], usual, np.full(k, _MOST_DETUNED**-2)])
    amplitudes = np.stack([vibration.sine, vibration.cosine])
    mean = np.concatenate([np.zeros(smooth), amplitudes.reshape(-1), np.zeros(k)])
    matrix = information + np.diag(prior)
    step = _solved(matrix, score - prior * mean)
    sine, cosine = amplitudes + step[smooth : smooth + 6 * k].reshape(2, k, 3)
    detuned = np.clip(step[smooth + 6 * k :], -_MOST_DETUNED, _MOST_DETUNED)
    frequency = np.maximum(vibration.frequency + detuned, _LOWEST)
    # The derivative of the rotation over the exposure with respect to the width is zero.
    begin, end = _rotations(vibration)(_ENDS).transpose(2, 1, 0)
    rotation = np.insert(end - begin, smooth - 1, 0.0, axis=1)
    total = rotation @ _solved(matrix, rotation.T)
    without = _solved(matrix[:smooth, :smooth], np.eye(smooth))[:3, :3]
    size, axes = np.linalg.eigh(total - without)
    return Vibration(frequency, sine, cosine), np.asarray(axes * np.maximum(size, 0.0) @ axes.T)


def _rotations(vibration: Vibration) -> Rotations:
    """Return a function of time for the rotations due to changes of rate, acceleration and `vibration`.

    The parameters of k sinusoids are the amplitudes of the sines (k, 3) and of the cosines (k, 3), and the
    frequencies (k,).
    """
    axes, angular = np.eye(3)[None, :, :, None], 2.0 * np.pi * vibration.frequency[:, None]

    def at(time: FloatArray) -> FloatArray:
        sine, cosine = np.sin(angular * time), np.cos(angular * time)
        functions = np.concatenate([[time, time**2], sine, cosine - 1.0])
        detuned = vibration.sine[..., None] * cosine[:, None] - vibration.cosine[..., None] * sine[:, None]
        along_axes = (functions[:, None, None] * axes).reshape(-1, 3, len(time))
        return np.concatenate([along_axes, 2.0 * np.pi * time * detuned])

    return at


def _normal_equations(
    camera: FitProblem, scene: StreakScene, left: StreakResiduals
) -> tuple[FloatArray, FloatArray]:
    """Return information (p, p) and gradient (p,) of the p parameters that all stars share.

    The parameters are those of `_rotations`, with the point-spread width after rate and acceleration. The
    position, the flux and the sky level of each star are eliminated. The weight of a star is limited by the
    scatter of its residuals, which includes model errors.
    """
    star, light = left.star, scene.light[left.star, None, None, None]
    strips, rotations = replace(left.strips, star=star), _rotations(scene.motion.vibration)
    images = vibrating_streaks.derivatives(
        camera.pinhole, scene.motion, camera.shutter, scene.stars, scene.width, strips, rotations
    )
    shared, position = images[:, :-2], images[:, -2:]
    by_width = left.images[:, None, 5]
    design = light * np.concatenate([shared[:, :6], by_width, shared[:, 6:], position], axis=1)
    design = np.concatenate([design, left.images[:, [0, 6]]], axis=1)
    blocks, size = design.shape[:2]
    design, weight = design.reshape(blocks, size, -1), left.weight.reshape(blocks, 1, -1)
    weighted = design * weight
    first = np.flatnonzero(np.diff(star, prepend=-1))
    gram = np.add.reduceat(weighted @ design.swapaxes(1, 2), first)
    score = np.add.reduceat(np.einsum("bqp,bp->bq", weighted, left.residual.reshape(blocks, -1)), first)
    own = slice(size - 4, size)
    gain = np.stack([_solved(each[own, own], each[own, : size - 4]) for each in gram])
    information = gram[:, : size - 4, : size - 4] - gram[:, : size - 4, own] @ gain
    gradient = score[:, : size - 4] - np.einsum("sop,so->sp", gain, score[:, own])
    trust = left.trust(len(scene.stars))[star[first]]
    return np.einsum("s,spq->pq", trust, information), trust @ gradient
