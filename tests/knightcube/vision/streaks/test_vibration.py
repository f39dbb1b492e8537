"""Tests of a vibration that all streaks of a frame have in common, on frames of an independent renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import conjugate, from_rotation_vector, multiply, to_rotation_vector
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.streaks import vibration
from knightcube.vision.streaks.camera_motion import CameraMotion, Vibration
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.fit_windows import LINES, Strips
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import Shutter, StreakScene, paths
from knightcube.vision.streaks.joint_fit import FitProblem
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from knightcube.vision.streaks.vibration import CommonMotion, StreakResiduals, find_common_motion
from tests.support.supersampled import Optics, Sky, light

_PINHOLE = Pinhole.from_field_of_view(560, 560, np.radians(7.0))
_EXPOSURE = 0.2
_TWO = Vibration(
    np.array([2.3, 7.0]),
    np.array([[1e-3, 2e-3, 0.0], [0.0, 1e-3, 1e-3]]),
    np.array([[0.0, 1e-3, -2e-3], [3e-3, 0.0, 0.0]]),
)


_NO_STRIPS = cast("Strips", None)
"""Stands for strips in tests of functions that do not use them."""


@dataclass(frozen=True)
class _Frame:
    """A frame with its true mean rate (3,), rad/s."""

    pixels: Image
    rate: FloatArray

    def motion(self, psf_sigma: float = 1.0) -> MotionResult:
        """Return the motion that the estimator finds in the frame."""
        settings = LikelihoodSettings(gain=1.0, line_time=0.0, psf_sigma=psf_sigma, knowledge=EXACT)
        return estimate_motion(self.pixels, _PINHOLE, _EXPOSURE, settings, self.rate)


def _frame(cycles: float, amplitude: float, seed: int) -> _Frame:
    """Return a frame of 14 stars with streaks of 80 px and a sinusoidal vibration of `amplitude` px."""
    rng = np.random.default_rng((seed, 11))
    focal = _PINHOLE.focal_length
    turn = np.array([0.6, -0.7, 1.5]) * 80.0 / focal
    way, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    shake = amplitude / focal * np.array([np.cos(way), np.sin(way), 0.0])

    def at(times: FloatArray) -> FloatArray:
        wave = np.sin(2.0 * np.pi * cycles * times + phase)
        return multiply(
            from_rotation_vector(wave[:, None] * shake), from_rotation_vector(times[:, None] * turn)
        )

    stars = _PINHOLE.unit_vectors(rng.uniform(60.0, 500.0, (14, 2)))
    sky = Sky(stars, rng.uniform(3e4, 2e5, len(stars)))
    electrons = rng.poisson(light(_PINHOLE, Optics(), sky, at, 200.0, 0.0, rng) + 100.0)
    begin, end = at(np.array([-0.5, 0.5]))
    rate = to_rotation_vector(multiply(end, np.array([-1.0, -1.0, -1.0, 1.0]) * begin)) / _EXPOSURE
    counts = electrons + rng.normal(0.0, 5.0, electrons.shape)
    return _Frame(np.clip(np.rint(counts), 0.0, 65_535.0).astype(np.uint16), np.asarray(rate))


def _sigmas(frame: _Frame, found: MotionResult) -> float:
    """Return the error of the rate in units of its standard deviations."""
    assert found.rate is not None
    assert found.covariance is not None
    error = found.rate - frame.rate
    return float(np.sqrt(error @ np.linalg.solve(found.covariance, error)))


def test_a_vibration_is_at_rest_at_mid_exposure_and_has_the_derivatives_of_its_rotation() -> None:
    time, step = np.linspace(-0.5, 0.5, 31), 1e-5
    assert np.abs(_TWO.rotation(np.zeros(1))).max() == 0.0
    for derivative in (0, 1):
        slope = (_TWO.rotation(time + step, derivative) - _TWO.rotation(time - step, derivative)) / (
            2.0 * step
        )
        assert _TWO.rotation(time, derivative + 1) == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_a_vibration_turns_the_camera_after_the_smooth_motion() -> None:
    """The motion is the product of two rotations about different axes, to second order in the rotation."""
    rate, acceleration = np.array([0.03, 0.02, 0.1]), np.array([0.0, 0.01, 0.0])
    shaking = Vibration(_TWO.frequency, 0.1 * _TWO.sine, 0.1 * _TWO.cosine)
    motion = CameraMotion(rate, acceleration, vibration=shaking)
    time = np.linspace(-0.5, 0.5, 21)
    smooth, shake = motion.smooth, shaking.rotation(time).T
    turn = time[:, None] * rate + 0.5 * time[:, None] ** 2 * acceleration + smooth.higher(time).T
    product = to_rotation_vector(multiply(from_rotation_vector(shake), from_rotation_vector(turn)))
    expected = product - turn + smooth.higher(time).T
    found = motion.higher(time).T
    assert found == pytest.approx(expected, abs=6e-7)
    assert np.abs(shake - expected).max() > 1e-5
    step = 1e-5
    for order in (0, 1):
        slope = (motion.higher(time + step, order) - motion.higher(time - step, order)) / (2.0 * step)
        assert motion.higher(time, order + 1) == pytest.approx(slope, rel=1e-5, abs=1e-6)
    begin, end = from_rotation_vector(shaking.rotation(np.array([-0.5, 0.5])).T)
    over = multiply(multiply(end, from_rotation_vector(rate)), conjugate(begin))
    constant = CameraMotion(rate, np.zeros(3), vibration=shaking)
    assert constant.rotation == pytest.approx(to_rotation_vector(over), abs=6e-7)


def test_a_motion_with_a_vibration_has_an_exact_time_reversal() -> None:
    motion = CameraMotion(np.array([0.03, 0.02, 0.1]), np.zeros(3), vibration=_TWO)
    back = motion.directed(-motion.rotation)
    time = np.linspace(-0.5, 0.5, 21)
    stars = np.tile([[200.0, 90.0]], (len(time), 1))
    there, again = (paths(_PINHOLE, one, stars, t) for one, t in ((motion, time), (back, -time)))
    assert again.position == pytest.approx(there.position, abs=1e-9)
    assert again.velocity == pytest.approx(-there.velocity, abs=1e-6)


@pytest.mark.parametrize(
    ("cycles", "amplitude", "seed", "share"),
    [
        (1.6, 0.8, 0, 2e-3),
        (4.3, 0.6, 0, 2e-3),
        (4.3, 1.5, 0, 2e-3),
        (9.0, 0.5, 3, 2e-3),
        (14.0, 0.5, 1, 4e-3),
    ],
)
def test_the_rate_of_a_resolved_vibration_is_within_its_claim(
    cycles: float, amplitude: float, seed: int, share: float
) -> None:
    """If the streaks resolve a vibration, the rate error is below `share` of the rate and within 4 sigma.

    The wavelengths along the streaks are 6 to 50 px. Without a vibration in its model, the estimator refuses
    the frame.
    """
    frame = _frame(cycles, amplitude, seed)
    found = frame.motion()
    assert found.status is StreakStatus.RATE
    assert found.rate is not None
    assert _sigmas(frame, found) < 4.0
    assert np.linalg.norm(found.rate - frame.rate) < share * np.linalg.norm(frame.rate)


def test_a_vibration_that_no_streak_resolves_is_refused_or_within_the_claim() -> None:
    """A vibration that no streak resolves is refused, or the rate error is within its uncertainty.

    The streaks look as if the point spread were slightly wider, but their ends are displaced. A tolerance of
    5 % of the point spread's variance would leave an error of 5.7 sigma in the rate of seed 5.
    """
    for seed in (2, 5, 6):
        frame = _frame(41.0, 0.45, seed)
        found = frame.motion()
        assert found.rate is None or _sigmas(frame, found) < 4.0


def _functions_are_those_of_time(functions: FloatArray, time: FloatArray, at: list[FloatArray]) -> None:
    """Check the values, slopes and end values of functions (n, b, 4) of `time` (b,).

    `at` contains the values just before, at, and just after each time, and at both ends.
    """
    before, here, after, ends = at
    assert functions[:, :, 0] == pytest.approx(here)
    assert functions[:, :, 1] == pytest.approx((after - before) / 2e-5, rel=1e-5, abs=1e-5)
    assert functions[:, :, 2] == pytest.approx(np.tile(ends[:, :1], len(time)))
    assert functions[:, :, 3] == pytest.approx(np.tile(ends[:, 1:], len(time)))


_TIME = np.linspace(-0.55, 0.55, 23)
_TIMES = _TIME - 1e-5, _TIME, _TIME + 1e-5, np.array([-0.5, 0.5])
_FREQUENCIES = np.array([1.3, 4.2])


def _waves(frequency: FloatArray, time: FloatArray) -> FloatArray:
    angle = 2.0 * np.pi * frequency[:, None] * time
    return np.concatenate([np.sin(angle), np.cos(angle) - 1.0])


def test_functions_of_time_have_their_slopes_and_ends() -> None:
    powers = [np.stack([np.ones_like(t), t, t**2]) for t in _TIMES]
    _functions_are_those_of_time(vibration._powers(_TIME), _TIME, powers)
    waves = [_waves(_FREQUENCIES, t) for t in _TIMES]
    _functions_are_those_of_time(vibration._waves(_FREQUENCIES, _TIME), _TIME, waves)


def _sums(true: FloatArray, bins: int = 200, noise: float = 0.0) -> vibration._RotationSums:
    """Return exact normal equations of a rotation, given as a function (3, b, 4) of time about each axis."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(bins, 12, 14)) * 3e4
    information = root @ root.swapaxes(1, 2)
    values = true.transpose(1, 2, 0).reshape(bins, 12, 1)
    score = information @ values + noise * root @ rng.normal(size=(bins, 14, 1))
    time = np.linspace(-0.55, 0.55, bins)
    return vibration._RotationSums(
        time, information.reshape(bins, 4, 3, 4, 3), score.reshape(bins, 4, 3), 3000.0
    )


def _true_rotation(one: Vibration, bins: int = 200) -> FloatArray:
    time = np.linspace(-0.55, 0.55, bins)
    values, slopes = one.rotation(time), one.rotation(time, 1)
    ends = one.rotation(np.array([-0.5, 0.5]))
    tiled = np.broadcast_to(ends[:, None], (3, bins, 2))
    return np.asarray(np.concatenate([values[..., None], slopes[..., None], tiled], axis=2))


def test_normal_equations_of_functions_are_sums_over_the_bins() -> None:
    functions = np.random.default_rng(1).normal(size=(3, 6, 4))
    sums = _sums(np.random.default_rng(2).normal(size=(3, 6, 4)), 6)
    information, score = sums.normal_equations(functions)
    expected, gradient = np.zeros((9, 9)), np.zeros(9)
    for b in range(6):
        # The coefficient of a function about one axis changes the four values of this axis.
        design = np.einsum("fi,kl->fkil", functions[:, b], np.eye(3)).reshape(9, 12)
        expected += design @ sums.information[b].reshape(12, 12) @ design.T
        gradient += design @ sums.score[b].reshape(12)
    assert information == pytest.approx(expected)
    assert score == pytest.approx(gradient)


@pytest.mark.parametrize("known", [Vibration(), _TWO], ids=["none", "two"])
def test_the_decrease_of_chi_square_is_that_of_a_fit_with_the_additional_sinusoid(known: Vibration) -> None:
    sums, frequency = _sums(_true_rotation(_TWO), noise=1.0), np.array([1.3, 4.0, 11.0])
    base = np.concatenate([vibration._powers(sums.time), vibration._waves(known.frequency, sums.time)])

    def least(functions: FloatArray, sinusoids: int) -> float:
        information, score = sums.normal_equations(functions)
        prior = vibration._precisions(sums.focal_length, sinusoids)[: len(score)]
        return float(score @ np.linalg.solve(information + np.diag(prior), score))

    k = len(known.frequency)
    expected = [
        least(np.concatenate([base, vibration._waves(np.array([one]), sums.time)]), k + 1) - least(base, k)
        for one in frequency
    ]
    found = vibration._decrease_of_chi2(sums, known, frequency)
    # The expected values are differences of large numbers.
    assert found == pytest.approx(expected, rel=1e-4)


def test_rotations_are_the_derivatives_of_the_motion() -> None:
    """The derivatives are those with respect to rate, acceleration, sines, cosines and frequencies."""
    found = vibration._rotations(_TWO)(_TIME)
    axes = np.eye(3)[:, :, None]
    assert found[:6] == pytest.approx(np.concatenate([axes * _TIME, axes * _TIME**2]))
    step = 1e-6
    for index, change in enumerate(np.eye(14) * step):
        sine, cosine = change[:12].reshape(2, 2, 3)
        before, after = (
            Vibration(
                _TWO.frequency + sign * change[12:], _TWO.sine + sign * sine, _TWO.cosine + sign * cosine
            )
            for sign in (-1.0, 1.0)
        )
        slope = (after.rotation(_TIME) - before.rotation(_TIME)) / (2.0 * step)
        assert found[6 + index] == pytest.approx(slope, rel=1e-6, abs=1e-8)


def _solved_steps(
    monkeypatch: pytest.MonkeyPatch, true: Vibration, start: Vibration, steps: int
) -> tuple[Vibration, FloatArray]:
    """Return a vibration and its covariance after steps towards the `true` vibration.

    The normal equations are those of measured rotation vectors at many instants.
    """
    camera, scene = _plain_camera()
    time = np.linspace(-0.5, 0.5, 400)

    def equations(_: object, changed: StreakScene, __: object) -> tuple[FloatArray, FloatArray]:
        one = changed.motion.vibration
        design = vibration._rotations(one)(time).reshape(6 + 7 * len(one.frequency), -1)
        # Index 6, the width of the point spread after rate and acceleration, has zero derivatives.
        design = 1e6 * np.insert(design, 6, 0.0, axis=0)
        left = 1e6 * (true.rotation(time) - one.rotation(time)).reshape(-1)
        return design @ design.T, design @ left

    monkeypatch.setattr(vibration, "_normal_equations", equations)
    found, added = start, np.zeros((3, 3))
    for _ in range(steps):
        changed = replace(scene, motion=replace(scene.motion, vibration=found))
        found, added = vibration._improved(camera, changed, cast("StreakResiduals", None))
    return found, added


def test_a_step_finds_amplitudes_and_frequency_of_a_vibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeated steps find the true vibration, whose frequency is 0.15 cycles off at the beginning."""
    sine, cosine = np.array([[2e-4, -1e-4, 0.0]]), np.array([[1e-4, 1e-4, -2e-4]])
    true = Vibration(np.array([3.15]), sine, cosine)
    found, added = _solved_steps(monkeypatch, true, Vibration().with_frequency(3.0), 6)
    assert found.frequency == pytest.approx([3.15], abs=1e-4)
    assert found.sine == pytest.approx(sine, abs=1e-6)
    assert found.cosine == pytest.approx(cosine, abs=1e-6)
    assert np.all(np.linalg.eigvalsh(added) > 0.0)
    # A step of the frequency is limited, and the frequency is not below the lowest.
    far, _ = _solved_steps(monkeypatch, true, Vibration(np.array([4.5]), sine, cosine), 1)
    assert abs(far.frequency[0] - 4.5) <= vibration._MOST_DETUNED + 1e-12
    slow, _ = _solved_steps(monkeypatch, true, Vibration(np.array([0.5]), sine, cosine), 1)
    assert slow.frequency[0] >= vibration._LOWEST


def test_the_strongest_frequency_is_that_of_the_vibration() -> None:
    one = Vibration(np.array([3.15]), np.array([[2e-4, -1e-4, 0.0]]), np.array([[1e-4, 1e-4, -2e-4]]))
    sums = _sums(_true_rotation(one), noise=1.0)
    found = vibration._strongest_frequency(sums, Vibration(), 9.0)
    assert found == pytest.approx(3.15, abs=0.5 * vibration._GRID + 1e-9)
    # A frequency near a known frequency, or above the highest, is not tried.
    other = vibration._strongest_frequency(sums, Vibration().with_frequency(3.15), 9.0)
    assert other is None or abs(other - 3.15) >= vibration._LEAST_APART
    assert vibration._strongest_frequency(sums, Vibration(), vibration._LOWEST) is None
    nothing = _sums(np.zeros((3, 200, 4)), noise=1.0)
    assert vibration._strongest_frequency(nothing, Vibration(), 9.0) is None


def test_no_frequency_is_tried_that_the_time_bins_do_not_resolve(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if the paths of the stars are extremely long, each cycle has at least two bins."""
    tried: list[float] = []

    def waves(frequency: FloatArray, time: FloatArray) -> FloatArray:
        tried.extend(frequency.tolist())
        return np.zeros((2 * len(frequency), len(time), 4))

    monkeypatch.setattr(vibration, "_waves", waves)
    sums = _sums(np.zeros((3, 20, 4)), 20)
    assert vibration._strongest_frequency(sums, Vibration(), 1_000.0) is None
    assert max(tried) == pytest.approx(vibration._FINE_BINS / (4.0 * vibration._RANGE), abs=vibration._GRID)


def test_values_are_summed_from_one_index_to_the_next() -> None:
    values = np.arange(12.0).reshape(6, 2)
    found = vibration._sums_from(values, np.array([0, 2, 2, 5]))
    assert found.tolist() == [[2.0, 4.0], [0.0, 0.0], [18.0, 21.0], [10.0, 11.0]]
    assert vibration._precisions(3000.0, 2) == pytest.approx(
        [(3000.0 / vibration._LOOSE) ** 2] * 9 + [(3000.0 / vibration._USUAL) ** 2] * 12
    )


@pytest.mark.parametrize("shift", [0.05, 0.2])
def test_a_displacement_of_all_stars_is_a_common_motion(shift: float) -> None:
    """The rms of a displacement that all stars have at the same time is measured, unless it is noise.

    The displacement of a single star is not a common motion.
    """
    rng = np.random.default_rng(7)
    stars, bins = 20, vibration._BINS
    cell = np.repeat(np.arange(stars * bins), 3)
    way = np.random.default_rng(8).normal(size=(bins, 2))
    way *= shift / np.sqrt(np.mean(np.sum(way**2, axis=1)))
    information = rng.uniform(200.0, 900.0, len(cell))
    noise = rng.normal(size=(len(cell), 2)) * np.sqrt(0.5 * information)[:, None]
    common = information[:, None] * np.tile(np.repeat(way, 3, axis=0), (stars, 1))
    assert vibration._common_rms(cell, noise + common, information) == pytest.approx(shift, rel=0.25)
    assert vibration._common_rms(cell, noise, information) == 0.0
    single = np.where((cell // bins == 3)[:, None], 20.0 * common, 0.0)
    assert vibration._common_rms(cell, noise + single, information) == 0.0
    assert vibration._common_rms(cell[: 3 * bins], common[: 3 * bins], information[: 3 * bins]) == 0.0
    assert vibration._common_rms(cell[:0], common[:0], information[:0]) == 0.0


@pytest.mark.parametrize(("across", "along"), [(0.1, 0.0), (0.0, 0.08), (0.0, 0.0)])
def test_residuals_at_equal_times_are_a_common_motion(across: float, along: float) -> None:
    """Displacements across all streaks, and changes of their brightness, are measured as rms values.

    The streaks of twelve stars are along rows. The residuals are those of a displacement (px) or of a
    relative change of brightness, which is a sine of the time.
    """
    rng = np.random.default_rng(6)
    pinhole, n, blocks = Pinhole(400, 300, 1200.0), 12, 6
    motion = CameraMotion.steady(np.array([0.0, 0.06, 0.0]))
    stars, light = rng.uniform([100.0, 50.0], [300.0, 250.0], (n, 2)), rng.uniform(3e3, 9e3, n)
    scene = StreakScene(motion, 1.1, stars, light, np.zeros(n), np.ones(n, dtype=np.bool_))
    star = np.repeat(np.arange(n), blocks)
    time = np.tile(np.linspace(-0.49, 0.49, blocks * LINES).reshape(blocks, LINES), (n, 1))
    images = np.zeros((n * blocks, 7, LINES, 5), dtype=np.float32)
    images[:, 0] = rng.uniform(0.01, 0.03, images[:, 0].shape)
    images[:, 1] = rng.uniform(-0.02, 0.02, images[:, 0].shape)
    wave = np.sin(2.0 * np.pi * 2.0 * time)[..., None]
    counts = light[star, None, None]
    # Positive displacements are along the normal of the path, which is to the left of the motion.
    residual = counts * (across * wave * images[:, 1] + along * wave * images[:, 0])
    residual = residual + rng.normal(0.0, 1.0, residual.shape)
    weight = np.ones(residual.shape, dtype=np.float32)
    left = StreakResiduals(_NO_STRIPS, star, time, images, weight, residual.astype(np.float32))
    frame = reduce_frame(np.full((300, 400), 100, np.uint16), 60000.0, 1.0)
    camera = FitProblem(frame, pinhole, Shutter(), LikelihoodSettings(), 1.0)
    found = find_common_motion(camera, scene, left)
    assert found.across == pytest.approx(across / np.sqrt(2.0), rel=0.2)
    assert found.along == pytest.approx(along / np.sqrt(2.0), rel=0.2)
    none = StreakResiduals(_NO_STRIPS, star[:0], time[:0], images[:0], weight[:0], left.residual[:0])
    assert find_common_motion(camera, scene, none) == CommonMotion(0.0, 0.0)


def test_the_normal_equations_of_a_rotation_are_sums_over_the_lines_of_each_bin() -> None:
    """A rotation changes each pixel through the displacement, the speed and the ends of the streak.

    A rotation displaces the streak across its path by the image flow. Along the path, the speed changes the
    brightness, and the rotations at start and end move the ends. The weight of a star is limited by the
    scatter of its residuals.
    """
    rng = np.random.default_rng(4)
    pinhole = Pinhole(400, 300, 1200.0)
    motion = CameraMotion.steady(np.array([0.02, 0.06, 0.1]))
    stars, light = np.array([[120.0, 80.0], [260.0, 200.0]]), np.array([4e3, 7e3])
    scene = StreakScene(motion, 1.1, stars, light, np.zeros(2), np.ones(2, dtype=np.bool_))
    star = np.array([0, 1, 1])
    time = np.stack(
        [np.linspace(-0.401, -0.1, LINES), np.linspace(-0.2, 0.11, LINES), np.linspace(0.101, 0.5, LINES)]
    )
    images = rng.normal(size=(3, 7, LINES, 4)).astype(np.float32) * np.float32(0.01)
    weight = rng.uniform(0.5, 2.0, (3, LINES, 4)).astype(np.float32)
    residual = rng.normal(size=(3, LINES, 4)).astype(np.float32)
    residual[0] *= 4.0
    left = StreakResiduals(_NO_STRIPS, star, time, images, weight, residual)
    frame = reduce_frame(np.full((300, 400), 100, np.uint16), 60000.0, 1.0)
    camera = FitProblem(frame, pinhole, Shutter(), LikelihoodSettings(), 1.0)
    found = vibration._rotation_sums(camera, scene, left)
    information, score = np.zeros((12, 12)), np.zeros(12)
    by_bin: dict[int, FloatArray] = {}
    for b, line in np.ndindex(3, LINES):
        own = star == star[b]
        scatter = np.sum((weight * residual**2)[own]) / weight[own].size
        trust = 1.0 / max(float(scatter), 1.0)
        path = paths(pinhole, motion, stars[star[b]][None], time[b, line][None])
        (x, y), (vx, vy) = (path.position[0] - pinhole.centre) / 1200.0, path.velocity[0]
        speed = float(np.hypot(vx, vy))
        flow = 1200.0 * np.array([[x * y, -1.0 - x * x, y], [1.0 + y * y, -x * y, -x]])
        tangent = np.array([vx, vy]) / speed
        across, along = np.array([-tangent[1], tangent[0]]) @ flow, tangent @ flow
        changes = [across, -along / speed, -along, along]
        design = np.zeros((4, 12))
        for part, (image, change) in enumerate(zip((1, 0, 3, 4), changes, strict=True)):
            design[:, 3 * part : 3 * part + 3] = light[star[b]] * np.outer(images[b, image, line], change)
        own_information = trust * (design.T * weight[b, line]) @ design
        information += own_information
        score += trust * (design.T * weight[b, line]) @ residual[b, line]
        place = int(np.argmin(np.abs(found.time - time[b, line])))
        by_bin[place] = by_bin.get(place, 0.0) + own_information
    whole = found.information.reshape(-1, 12, 12)
    assert whole.sum(axis=0) == pytest.approx(information, rel=1e-3, abs=1e-4 * np.abs(information).max())
    assert found.score.reshape(-1, 12).sum(axis=0) == pytest.approx(
        score, rel=1e-3, abs=1e-3 * np.abs(score).max()
    )
    for place, expected in by_bin.items():
        assert whole[place] == pytest.approx(expected, rel=1e-3, abs=1e-4 * np.abs(information).max())
    assert found.focal_length == 1200.0


def _plain_camera() -> tuple[FitProblem, StreakScene]:
    frame = reduce_frame(np.full((300, 400), 100, np.uint16), 60000.0, 1.0)
    camera = FitProblem(frame, Pinhole(400, 300, 1200.0), Shutter(), LikelihoodSettings(), 1.0)
    motion = CameraMotion.steady(np.array([0.0, 0.06, 0.0]))
    stars = np.array([[120.0, 80.0], [260.0, 200.0]])
    trusted = np.array([True, True])
    return camera, StreakScene(motion, 1.1, stars, np.array([4e3, 7e3]), np.zeros(2), trusted)


def _fitted_vibration(
    monkeypatch: pytest.MonkeyPatch,
    frequencies: list[float | None],
    sizes: list[float],
    fails: int = 99,
    excess: Sequence[float] = (),
    streaks: bool = True,
) -> tuple[Any, int]:
    """Return the fit for given trial frequencies and successive amplitudes (px), and the number of fits.

    The excess chi-square is 10,000 before the first fit, and `excess` after each fit. By default, each fit
    halves the excess. If `streaks` is false, the frame has no long streaks.
    """
    camera, scene = _plain_camera()
    trials, steps, made = iter(frequencies), iter(sizes), []
    excesses = iter(excess or [10_000.0 / 2.0**fit for fit in range(1, 9)])

    def improved(_: object, changed: StreakScene, __: object) -> tuple[Vibration, None]:
        one, size = changed.motion.vibration, next(steps) / 1200.0
        sine = np.zeros((len(one.frequency), 3))
        sine[:, 0] = size
        return Vibration(one.frequency, sine, 0.0 * sine), None

    def again(changed: StreakScene) -> Any:
        made.append(changed)
        return None if len(made) >= fails else _SimpleFit(changed, next(excesses))

    star = np.zeros(1 if streaks else 0, np.int64)
    unused: Any = np.zeros(0)
    left = StreakResiduals(_NO_STRIPS, star, unused, unused, unused, unused)
    monkeypatch.setattr(vibration, "residuals_of_fit", lambda *_: left)
    monkeypatch.setattr(vibration, "_rotation_sums", lambda *_: None)
    monkeypatch.setattr(vibration, "_excess", lambda fit: fit.excess)
    monkeypatch.setattr(vibration, "_improved", improved)
    monkeypatch.setattr(vibration, "_strongest_frequency", lambda *_: next(trials))
    first: Any = _SimpleFit(scene, 10_000.0)
    found = vibration.fit_vibration(camera, first, again)
    return found, len(made)


@dataclass(frozen=True)
class _SimpleFit:
    """A stand-in for a fit with only its scene and its excess chi-square."""

    scene: StreakScene
    excess: float


def test_a_vibration_is_fitted_until_its_steps_are_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each sinusoid is improved at most four times, and until a step is below 0.02 px."""
    assert _fitted_vibration(monkeypatch, [None], []) == (None, 0)
    found, made = _fitted_vibration(monkeypatch, [2.0, None], [0.5, 0.51, 9.0])
    assert made == 2
    assert found.scene.motion.vibration.frequency.tolist() == [2.0]
    assert found.scene.motion.vibration.amplitude * 1200.0 == pytest.approx([0.51])
    found, made = _fitted_vibration(monkeypatch, [2.0, None], [0.5, 0.9, 0.5, 0.9, 9.0])
    assert made == vibration._MOST_STEPS
    two, made = _fitted_vibration(monkeypatch, [2.0, 5.0], [0.5, 0.51, 0.6, 0.61])
    assert made == 4
    assert two.scene.motion.vibration.frequency.tolist() == [2.0, 5.0]
    # A vibration that is too large, or that cannot be fitted, is not accepted.
    assert _fitted_vibration(monkeypatch, [2.0, None], [2.55, 2.56])[0] is None
    assert _fitted_vibration(monkeypatch, [2.0, None], [2.44, 2.45])[0] is not None
    assert _fitted_vibration(monkeypatch, [2.0, None], [0.5, 0.51], fails=2) == (None, 2)
    assert _fitted_vibration(monkeypatch, [2.0, None], [0.5, 0.51], streaks=False) == (None, 0)


def test_a_sinusoid_that_explains_little_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sinusoid must explain a fifth of the excess chi-square. A step that explains nothing is the last."""
    found, made = _fitted_vibration(monkeypatch, [2.0], [0.5, 0.51], excess=[9000.0, 8200.0])
    assert (found, made) == (None, 2)
    found, made = _fitted_vibration(monkeypatch, [2.0], [0.5, 0.9, 0.5], excess=[11_000.0, 10_500.0, 0.0])
    assert (found, made) == (None, 2)
    one, made = _fitted_vibration(
        monkeypatch, [2.0, 5.0], [0.5, 0.51, 0.6, 0.61], excess=[900.0, 800.0, 790.0, 750.0]
    )
    assert made == 4
    assert one.scene.motion.vibration.frequency.tolist() == [2.0]
    # A second sinusoid that is too large does not end the first.
    one, _ = _fitted_vibration(monkeypatch, [2.0, 5.0], [0.5, 0.51, 2.6, 2.61])
    assert one.scene.motion.vibration.frequency.tolist() == [2.0]


def test_a_vibration_adds_its_covariance_and_a_share_of_its_amplitudes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera, scene = _plain_camera()
    star, nothing = np.zeros(1, np.int64), np.zeros((1, 7, LINES, 3), np.float32)
    left = StreakResiduals(_NO_STRIPS, star, np.zeros((1, LINES)), nothing, nothing[:, 0], nothing[:, 0])
    assert not vibration.vibration_covariance(camera, scene, left)[0].any()
    shaking = Vibration(np.array([3.0, 7.0]), 1e-4 * np.eye(3)[:2], 2e-4 * np.eye(3)[1:])
    shaken = replace(scene, motion=replace(scene.motion, vibration=shaking))
    added = np.diag([1e-9, 2e-9, 3e-9])
    monkeypatch.setattr(vibration, "_improved", lambda *_: (shaking, added))
    found, fast = vibration.vibration_covariance(camera, shaken, left)
    assert fast == 0.0
    unmodelled = 2.0 * (vibration._MODEL_ERROR * np.sqrt(5.0) * 1e-4) ** 2
    assert found == pytest.approx(added + unmodelled * np.eye(3))
    none = StreakResiduals(_NO_STRIPS, star[:0], left.time[:0], nothing[:0], nothing[:0, 0], nothing[:0, 0])
    assert not vibration.vibration_covariance(camera, shaken, none)[0].any()


@pytest.mark.parametrize("cycles", [20.0, 34.0])
def test_the_spectrum_shows_the_true_amplitude_of_an_unresolved_vibration(cycles: float) -> None:
    """The point spread reduces the residuals of a vibration, but the true amplitude is stated."""
    length, amplitude, focal = 90.0, np.array([2e-4, -1e-4, 3e-5]), 1200.0
    time = 0.56 * (2.0 * (np.arange(512) + 0.5) / 512 - 1.0)
    information = np.zeros((512, 4, 3, 4, 3))
    within = np.abs(time) < 0.5
    information[within, 1, :, 1, :] = 4e5 * np.eye(3)
    kept = np.exp(-0.5 * (2.0 * np.pi * cycles / length) ** 2)
    slope = 2.0 * np.pi * cycles * np.cos(2.0 * np.pi * cycles * time + 0.7) * within
    score = np.zeros((512, 4, 3))
    score[:, 1] = 4e5 * kept * slope[:, None] * amplitude
    sums = vibration._RotationSums(time, information, score, focal)
    found = vibration._unresolved_amplitude(sums, Vibration(), length)
    assert found == pytest.approx(np.linalg.norm(amplitude), rel=0.1)
    weak = vibration._RotationSums(time, information, 1e-3 * score, focal)
    assert vibration._unresolved_amplitude(weak, Vibration(), length) == 0.0
    assert vibration._unresolved_amplitude(sums, Vibration(), 2.0) == 0.0


def test_a_singular_system_has_the_solution_of_smallest_norm() -> None:
    matrix = np.array([[2.0, 2.0], [2.0, 2.0]])
    assert vibration._solved(matrix, np.array([4.0, 4.0])) == pytest.approx([1.0, 1.0])
    assert vibration._solved(np.diag([2.0, 4.0]), np.array([2.0, 2.0])) == pytest.approx([1.0, 0.5])
