"""Tests of the lens calibration: recovery of simulated lenses, and omission of undetermined terms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix, normalise
from knightcube.vision.camera.lens import Lens, Pinhole
from knightcube.vision.lens_calibration import (
    Calibration,
    DeterminedLens,
    LensCalibration,
    LensPrior,
    _mirrored_back,
    calibrate,
    calibrate_determined,
    calibrate_one_lens,
    lens_accuracy,
)
from knightcube.vision.lens_knowledge import (
    PARAMETERS,
    CalibrationError,
    LensFit,
    MatchedFrame,
    parameters_of,
    residuals,
    step,
)

_OPEN = LensPrior(np.inf, np.inf, np.inf, np.inf)


def _begun(field_deg: float = 20.0) -> Pinhole:
    return Pinhole.from_field_of_view(1024, 1024, np.radians(field_deg))


def _lens(rng: np.random.Generator, begun: Pinhole) -> Lens:
    """Return a lens that differs from the initial lens by about 2 %, 10 px and some corner distortion."""
    return Lens(
        begun.columns,
        begun.rows,
        begun.focal_length * (1.0 + 0.02 * rng.normal()),
        (begun.centre[0] + 10.0 * rng.normal(), begun.centre[1] + 10.0 * rng.normal()),
        -0.1 + 0.05 * rng.normal(),
        0.05 * rng.normal(),
    )


def _frames(
    rng: np.random.Generator, lens: Lens, count: int, stars: int, wrong: float = 0.0, noise: float = 0.1
) -> tuple[list[MatchedFrame], FloatArray]:
    """Return frames at random attitudes (count, 4).

    For the fraction `wrong` of the matches, the catalogue directions are exchanged.
    """
    frames, attitudes = [], []
    for _ in range(count):
        attitude = normalise(rng.normal(size=4))
        points = rng.uniform(0.0, 1023.0, (stars, 2))
        directions = lens.unit_vectors(points) @ attitude_matrix(attitude)
        sigma = noise * rng.uniform(0.5, 2.0, stars)
        exchanged = np.flatnonzero(rng.uniform(size=stars) < wrong)
        directions[exchanged] = directions[np.roll(exchanged, 1)]
        frames.append(MatchedFrame(points + sigma[:, None] * rng.normal(size=(stars, 2)), sigma, directions))
        attitudes.append(attitude)
    return frames, np.array(attitudes)


def _squared_error(found: Calibration, truth: Lens) -> float:
    error = parameters_of(found.lens) - parameters_of(truth)
    return float(error @ np.linalg.solve(found.covariance, error))


@pytest.mark.parametrize("wrong", [0.0, 0.1, 0.3])
def test_the_lens_agrees_with_its_covariance_with_and_without_wrong_matches(wrong: float) -> None:
    rng = np.random.default_rng(81)
    runs, errors, misfit, degrees = 12, 0.0, 0.0, 0
    for _ in range(runs):
        truth = _lens(rng, _begun())
        frames, _ = _frames(rng, truth, 6, 25, wrong)
        found = calibrate(frames, _begun())
        assert found.undetermined == ()
        assert found.rms_after < 0.25 < found.rms_before
        errors += _squared_error(found, truth)
        misfit += found.chi_square
        degrees += found.degrees
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 5 * runs)
    assert low < errors < high
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], degrees)
    assert low < misfit < high


def test_without_a_prior_the_stars_alone_give_the_same_lens() -> None:
    rng = np.random.default_rng(82)
    truth = _lens(rng, _begun())
    frames, attitudes = _frames(rng, truth, 10, 40)
    found = calibrate(frames, _begun(), _OPEN)
    assert _squared_error(found, truth) < chi2.ppf(0.9999, 5)
    assert found.sigma["centre_x"] < 1.0
    assert found.degrees == 10 * 40 * 2 - 5 - 30
    # The attitude error about axes normal to the boresight is 0.1 px/sqrt(40). The error about the boresight
    # is larger.
    assert np.max(angle_between(found.attitudes, attitudes)) < 5.0 / truth.focal_length


@pytest.mark.parametrize("noise", [1e-7, 1e-9, 1e-11], ids=["small", "smaller", "below rounding"])
def test_without_noise_the_lens_is_exact(noise: float) -> None:
    rng = np.random.default_rng(83)
    truth = _lens(rng, _begun())
    frames, _ = _frames(rng, truth, 3, 20, noise=noise)
    found = calibrate(frames, _begun(), _OPEN)
    assert parameters_of(found.lens) == pytest.approx(parameters_of(truth), rel=1e-6, abs=1e-6)
    assert found.rms_after < 5e-7


def test_the_wrong_matches_are_reported() -> None:
    rng = np.random.default_rng(84)
    truth = _lens(rng, _begun())
    frames, _ = _frames(rng, truth, 5, 30)
    shifted = frames[2].points.copy()
    shifted[[3, 17]] += [[4.0, 0.0], [0.0, -60.0]]
    frames[2] = MatchedFrame(shifted, frames[2].sigma, frames[2].directions)
    found = calibrate(frames, _begun())
    assert found.rejected_count == 2
    assert np.flatnonzero(~found.used[2]).tolist() == [3, 17]


def test_a_lens_far_from_the_initial_lens_is_found() -> None:
    """A lens far from the initial lens is found.

    The initial focal length is wrong by 8 %, and the distortion at the corners is 40 px.
    """
    rng = np.random.default_rng(85)
    begun = _begun()
    truth = Lens(1024, 1024, 1.08 * begun.focal_length, (540.0, 490.0), -1.0, 0.5)
    frames, _ = _frames(rng, truth, 6, 30, wrong=0.1)
    assert _squared_error(calibrate(frames, begun), truth) < chi2.ppf(0.9999, 5)


def test_one_narrow_frame_does_not_determine_centre_and_distortion() -> None:
    rng = np.random.default_rng(86)
    begun = _begun(3.0)
    frames, _ = _frames(rng, Lens.of(begun), 1, 15, noise=0.3)
    found = calibrate(frames, begun)
    assert set(found.undetermined) >= {"centre_x", "centre_y", "k2"}
    assert "focal_length" not in found.undetermined
    assert found.sigma["centre_x"] > 0.5 * LensPrior().centre
    with pytest.raises(CalibrationError, match="give a prior"):
        calibrate(frames, begun, _OPEN)


def test_the_covariance_with_a_prior_agrees_with_the_errors() -> None:
    """For lenses drawn from the prior, with two narrow frames each, the errors agree with the covariance."""
    rng = np.random.default_rng(87)
    prior = LensPrior(0.01, 8.0, 0.1, 0.2)
    runs, errors = 40, 0.0
    begun = _begun(8.0)
    for _ in range(runs):
        truth = Lens(
            1024,
            1024,
            begun.focal_length * (1.0 + prior.focal_length * rng.normal()),
            (511.5 + prior.centre * rng.normal(), 511.5 + prior.centre * rng.normal()),
            prior.k1 * rng.normal(),
            prior.k2 * rng.normal(),
        )
        errors += _squared_error(calibrate(_frames(rng, truth, 2, 15)[0], begun, prior), truth)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 5 * runs)
    assert low < errors < high


def test_standard_deviations_that_are_too_small_increase_the_covariance() -> None:
    rng = np.random.default_rng(88)
    runs, errors = 20, 0.0
    for _ in range(runs):
        truth = _lens(rng, _begun())
        frames, _ = _frames(rng, truth, 6, 25)
        boasting = [MatchedFrame(f.points, f.sigma / 4.0, f.directions) for f in frames]
        found = calibrate(boasting, _begun())
        assert found.chi_square / found.degrees == pytest.approx(16.0, rel=0.3)
        errors += _squared_error(found, truth)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], 5 * runs)
    assert low < errors < high


def test_the_derivatives_are_those_of_the_projection() -> None:
    """The derivatives are correct: one step of the fit from near the truth leaves a quadratic error."""
    rng = np.random.default_rng(89)
    truth = Lens(1024, 1024, 1500.0, (500.0, 530.0), -0.2, 0.3, 0.02, -0.03, 0.04, 0.05)
    frames, attitudes = _frames(rng, truth, 2, 20, noise=1e-9)
    exact = parameters_of(truth)
    none = np.zeros(9)
    size = np.array([100.0, 50.0, 50.0, 0.3, 0.3, 0.1, 0.1, 0.1, 0.1])
    for scale in (1e-3, 1e-4):
        start = exact + scale * size * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0])
        turned = normalise(attitudes + scale * 0.1 * rng.normal(size=attitudes.shape))
        after = step(frames, LensFit(start, turned), [np.ones(20)] * 2, none, none).fit
        left = np.abs(after.parameters - exact) / size
        assert np.max(left) < 20.0 * scale**2
        assert np.max(np.abs(residuals(frames[0], LensFit(exact, attitudes), 0))) < 6.0


@pytest.mark.parametrize("shape", [
    {"aspect": 0.01}, {"aspect": -0.02, "shear": 0.01}, {"p1": 0.02},
    {"p1": -0.01, "p2": 0.03, "shear": 0.005}, {},
])  # fmt: skip
def test_the_terms_that_the_stars_show_are_fitted_and_others_stay_zero(shape: dict[str, float]) -> None:
    rng = np.random.default_rng(93)
    for _ in range(4):
        truth = replace(_lens(rng, _begun()), **shape)  # type: ignore[arg-type]  # of numbers
        frames, _ = _frames(rng, truth, 6, 30, 0.1)
        lens = calibrate_determined(frames, _begun())
        found, sigma = lens.calibration.lens, lens.calibration.sigma
        for pair in (("aspect", "shear"), ("p1", "p2")):
            fitted = bool(set(pair) & set(shape))
            for name in pair:
                assert (name in sigma) is fitted
                off = getattr(found, name) - getattr(truth, name)
                assert abs(off) < (4.5 * sigma[name] if fitted else 1e-12)
        assert lens.calibration.rms_after < 0.3


def test_the_lens_of_mirrored_images_is_that_of_the_images_as_they_are() -> None:
    """The lens found in mirrored images describes the images as they are, not their mirror images.

    In a mirrored image and in its sky, left and right are exchanged.
    """
    lens = Lens(1000, 800, 1500.0, (490.0, 410.0), -0.1, 0.02, 0.01, 0.02, 0.05, -0.04)
    unused = (np.ones(9, dtype=bool),)
    found = Calibration(lens, np.eye(9), (), np.zeros((1, 4)), unused, 1.0, 1, 0.2, 0.1)
    back = _mirrored_back(LensCalibration(DeterminedLens(found, {}, {}), ())).lens
    assert back is not None
    rays = lens.unit_vectors(np.random.default_rng(2).uniform([0.0, 0.0], [999.0, 799.0], (50, 2)))
    expected = np.array([999.0, 0.0]) + np.array([-1.0, 1.0]) * lens.project(rays)
    assert back.project(rays * np.array([-1.0, 1.0, 1.0])) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("count", [1, 2])
def test_frames_of_another_focus_are_excluded_also_if_they_are_half_of_the_frames(count: int) -> None:
    rng = np.random.default_rng(92)
    begun, other = _begun(20.0), _begun(22.0)
    frames = [*_frames(rng, Lens.of(begun), count, 40)[0], *_frames(rng, Lens.of(other), count, 40)[0]]
    focal_lengths = np.repeat([begun.focal_length, other.focal_length], count)
    found, excluded = calibrate_one_lens(frames, begun, focal_lengths, np.full(2 * count, 0.5))
    assert found.calibration.lens.focal_length == pytest.approx(begun.focal_length, rel=2e-3)
    assert set(excluded) == set(range(count, 2 * count))
    assert all("its focal length is" in reason for reason in excluded.values())


@pytest.mark.parametrize("sixth_power", [0.0, 0.01])
def test_distortion_that_the_lens_does_not_contain_increases_the_covariance(sixth_power: float) -> None:
    """A sixth-power distortion of 1 % at the corners biases focal length and distortion by many sigma.

    The standard deviations of a lens without this distortion do not increase.
    """
    rng = np.random.default_rng(96)
    begun = _begun(20.0)
    frames, attitudes = _frames(rng, Lens.of(begun), 8, 60, noise=0.03)
    corner = math.hypot(*begun.centre)
    distorted = []
    for frame, attitude in zip(frames, attitudes, strict=True):
        off = begun.project(frame.directions @ attitude_matrix(attitude).T) - begun.centre
        power = (np.linalg.norm(off, axis=1, keepdims=True) / corner) ** 6
        distorted.append(replace(frame, points=frame.points + sixth_power * off * power))
    found = calibrate_determined(distorted, begun)
    lens = found.calibration.lens
    error = lens.focal_length / begun.focal_length - 1.0
    assert abs(error) < 4.0 * found.accuracy["focal_length"]
    points = rng.uniform(0.0, 1023.0, (500, 2))
    off = points - begun.centre
    true = points + sixth_power * off * (np.linalg.norm(off, axis=1, keepdims=True) / corner) ** 6
    displaced = lens.project(begun.unit_vectors(points)) - true
    # A common displacement is an error of the optical axis.
    assert np.linalg.norm(displaced.std(axis=0)) < 4.0 * found.accuracy["distortion"] * corner
    assert (found.accuracy["focal_length"] > 1e-4) == (sixth_power > 0.0)
    assert found.accuracy["distortion"] < 3e-3


def test_frames_whose_stars_are_all_rejected_are_excluded() -> None:
    """Frames whose stars are all rejected, because their focal length differs by 0.5 %, are excluded."""
    rng = np.random.default_rng(95)
    begun = _begun(20.0)
    frames = [
        *_frames(rng, Lens.of(begun.rescaled(1.005)), 2, 40, noise=0.01)[0],
        *_frames(rng, Lens.of(begun), 6, 40, noise=0.01)[0],
    ]
    focal_lengths = begun.focal_length * np.repeat([1.005, 1.0], [2, 6])
    found, excluded = calibrate_one_lens(frames, begun, focal_lengths, np.full(8, 0.1))
    assert set(excluded) == {0, 1}
    error = found.calibration.lens.focal_length - begun.focal_length
    assert abs(error) < 4.0 * found.calibration.sigma["focal_length"]


def test_malformed_frames_are_refused() -> None:
    rng = np.random.default_rng(90)
    (good,), _ = _frames(rng, Lens.of(_begun()), 1, 20)
    points, sigma, directions = good.points, good.sigma, good.directions
    nan = np.where(points > 500.0, np.nan, points)
    for frames, says in (
        ([], "no frames"),
        (
            [good, MatchedFrame(points[:5], sigma, directions)],
            "frame 1: points, sigma and directions have shapes",
        ),
        ([MatchedFrame(nan, sigma, directions)], "must be finite"),
        ([MatchedFrame(points, 0.0 * sigma, directions)], "frame 0: sigma"),
        ([MatchedFrame(points[:1], sigma[:1], directions[:1])], "frame 0: 1 observed"),
    ):
        with pytest.raises(CalibrationError, match=says):
            calibrate(frames, _begun())
    with pytest.raises(CalibrationError, match="must be positive"):
        calibrate([good], _begun(), LensPrior(centre=0.0))
    few = MatchedFrame(points[:3], sigma[:3], directions[:3])
    with pytest.raises(CalibrationError, match=r"give a prior|too few to check"):
        calibrate([few], _begun(), _OPEN)


@pytest.mark.parametrize("wrong", [0.6, 0.8, 1.0])
def test_mostly_wrong_matches_are_refused(wrong: float) -> None:
    rng = np.random.default_rng(91)
    frames, _ = _frames(rng, _lens(rng, _begun()), 4, 20, wrong=wrong)
    with pytest.raises(CalibrationError):
        calibrate(frames, _begun())


def test_each_standard_deviation_has_the_name_of_its_parameter() -> None:
    rng = np.random.default_rng(92)
    found = calibrate(_frames(rng, _lens(rng, _begun()), 4, 20)[0], _begun())
    assert tuple(found.sigma) == PARAMETERS[:5]
    assert [getattr(found.lens, name) for name in PARAMETERS[5:]] == [0.0] * 4
    assert found.sigma["k2"] == pytest.approx(np.sqrt(found.covariance[4, 4]))


def _errors(found: DeterminedLens, truth: Lens, begun: Pinhole) -> dict[str, float]:
    """Return the error of each key of `camera.accuracy`, as the configuration schema defines it."""
    lens = found.calibration.lens
    square = (math.hypot(*begun.centre) / lens.focal_length) ** 2
    corner = [
        one.focal_length / lens.focal_length * (1.0 + square * (one.k1 + square * one.k2))
        for one in (lens, truth)
    ]
    off: FloatArray = np.array(lens.centre) - truth.centre
    return {
        "focal_length": lens.focal_length / truth.focal_length - 1.0,
        "centre": float(np.linalg.norm(off) / math.sqrt(2.0)),
        "distortion": corner[0] - corner[1],
    }


@pytest.mark.parametrize(("field_deg", "count", "stars"), [(20.0, 1, 40), (12.0, 1, 15), (20.0, 3, 20)])
def test_the_accuracy_of_a_lens_is_that_of_its_errors(field_deg: float, count: int, stars: int) -> None:
    """The accuracy of a lens includes the errors due to omitted terms."""
    rng, begun = np.random.default_rng(61), _begun(field_deg)
    ratios: dict[str, list[float]] = {"focal_length": [], "centre": [], "distortion": []}
    for _ in range(12):
        truth = _lens(rng, begun)
        found = calibrate_determined(_frames(rng, truth, count, stars)[0], begun)
        errors = _errors(found, truth, begun)
        for name, sigma in found.accuracy.items():
            ratios[name].append(errors[name] / sigma)
    for name, values in ratios.items():
        assert len(values) >= 8, name
        assert 0.3 < np.sqrt(np.mean(np.square(values))) < 1.9, name


def test_an_undetermined_term_is_omitted_whatever_its_fitted_value() -> None:
    """A term that is not determined is omitted, whatever its fitted value is.

    In a narrow image, the fitted k2 is half its prior standard deviation and has no meaning.
    """
    rng, begun = np.random.default_rng(62), _begun(6.0)
    for _ in range(5):
        truth = _lens(rng, begun)
        found = calibrate_determined(_frames(rng, truth, 2, 20)[0], begun)
        gone = found.omitted["k2"]
        assert found.calibration.lens.k2 == pytest.approx(0.0, abs=1e-6)
        assert gone.sigmas[0] > 1.0
        for name, left in found.omitted.items():
            assert name == "centre" or left.sigmas[0] > min(0.5, abs(left.values[0])), name
        assert "centre" not in found.accuracy or "centre" not in found.omitted


def test_determined_terms_are_all_kept() -> None:
    rng, begun = np.random.default_rng(63), _begun(40.0)
    truth = Lens(1024, 1024, 1.01 * begun.focal_length, (520.0, 505.0), -0.2, 0.08)
    found = calibrate_determined(_frames(rng, truth, 6, 40)[0], begun)
    assert found.omitted == {}
    assert found.calibration.lens.k2 == pytest.approx(0.08, abs=0.01)
    assert set(found.accuracy) == {"focal_length", "centre", "distortion"}


def test_missing_distortion_and_an_undetermined_centre_are_omitted() -> None:
    rng, begun = np.random.default_rng(64), _begun(3.0)
    found = calibrate_determined(_frames(rng, Lens.of(begun), 1, 15, noise=0.3)[0], begun)
    assert set(found.omitted) == {"k1", "k2", "centre"}
    lens = found.calibration.lens
    assert (*lens.centre, lens.k1, lens.k2) == pytest.approx((511.5, 511.5, 0.0, 0.0), abs=2e-3)
    assert "centre" not in found.accuracy, "nobody knows more of the axis than before"


@pytest.mark.parametrize(("share", "known"), [(0.45, True), (0.55, False)])
def test_the_distortion_is_stated_if_it_is_below_half_of_the_prior(share: float, known: bool) -> None:
    """The distortion is stated if its uncertainty is below half of the prior uncertainty.

    The displacement of a corner is computed for k1 = 1 and k2 = 3 at a squared tangent of 0.25.
    """
    lens = Lens(1024, 1024, 2.0 * math.hypot(511.5, 511.5), (511.5, 511.5), 0.0, 0.0)
    corner = math.hypot(1.0 * 0.25, 3.0 * 0.25**2)
    covariance = np.diag([0.0, 4.0, 4.0, (share * corner / 0.25) ** 2, *[0.0] * 5])
    whole = Calibration(lens, covariance, (), np.zeros((1, 4)), (np.ones(9, bool),), 1.0, 1, 0.2, 0.1)
    accuracy = lens_accuracy(whole, whole, {})
    assert accuracy["focal_length"] == 0.0
    assert accuracy["centre"] == pytest.approx(2.0)
    assert accuracy.get("distortion") == (pytest.approx(share * corner) if known else None)
    shorter = replace(whole, lens=replace(lens, focal_length=lens.focal_length / 1.01))
    assert lens_accuracy(whole, shorter, {})["focal_length"] == pytest.approx(0.01), "of the omitted terms"
