"""Tests of the public star tracker on frames with known attitude."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from knightcube.astro.arrays import Image
from knightcube.astro.quaternion import (
    angle_between,
    conjugate,
    from_rotation_vector,
    multiply,
    to_rotation_vector,
)
from knightcube.errors import ArgumentError, InputError
from knightcube.vision.camera.lens import CameraKnowledge, Lens, Pinhole
from knightcube.vision.star_tracker import StarTracker, camera_of_field, field_of_view
from knightcube.vision.startracker.sky_map import Pointing
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from tests.knightcube.vision.startracker.frames import NARROW, SkyFrame, sky, sky_frame

ARCSECOND = math.radians(1.0 / 3600.0)


@pytest.fixture(scope="module")
def resting() -> SkyFrame:
    return sky_frame(np.random.default_rng(31), 0.0, 0.2)


@pytest.fixture(scope="module")
def streaked() -> SkyFrame:
    return sky_frame(np.random.default_rng(32), 40.0, 0.2)


def test_an_image_gives_its_attitude_within_the_covariance(resting: SkyFrame) -> None:
    solution = StarTracker(fov_deg=12.0).solve(resting.pixels)
    assert solution
    assert (solution.status, solution.reason) == ("solved", "")
    error = to_rotation_vector(multiply(solution.quaternion, conjugate(resting.attitude)))
    assert error @ np.linalg.solve(solution.covariance, error) < 16.3  # 99.9 % quantile, 3 degrees of freedom
    assert np.linalg.norm(error[:2]) < 15.0 * ARCSECOND
    assert solution.field_of_view_deg == pytest.approx(12.0, abs=0.01)
    assert not solution.mirrored
    assert solution.rate is None
    nearly_full = replace(solution, right_ascension=2.0 * math.pi - 1e-9, roll=2.0 * math.pi - 1e-9)
    assert "right ascension 0.0000, " in repr(nearly_full)
    assert "roll 0.000 deg" in repr(nearly_full)


def test_a_tracker_that_learns_its_lens_has_the_same_axes_in_all_images() -> None:
    """The attitudes are in the axes of the given camera, and not in those of the estimated lens.

    The axis of the estimated lens moves by up to 1 px (42 arcsec) between images. The optical axis of the
    second camera is 2 px from that of the given camera, so all attitudes are rotated by the same angle.
    """
    columns, rows, f = NARROW.pinhole.columns, NARROW.pinhole.rows, NARROW.pinhole.focal_length
    x, y = NARROW.pinhole.centre
    for offset in (0.0, 2.0):
        tracker = StarTracker(camera=Lens(columns, rows, f, (x + offset, y)), learn=True)
        for seed in (31, 33, 34):
            frame = sky_frame(np.random.default_rng(seed), 0.0, 0.2)
            solution = tracker.solve(frame.pixels)
            constant = from_rotation_vector(np.array([0.0, math.atan(offset / f), 0.0]))
            expected = multiply(constant, frame.attitude)
            error = to_rotation_vector(multiply(solution.quaternion, conjugate(expected)))
            assert np.linalg.norm(error[:2]) < 3.0 * ARCSECOND
            assert error @ np.linalg.solve(solution.covariance, error) < 16.3
            pointing = Pointing.of(solution.quaternion)
            assert solution.right_ascension == pytest.approx(pointing.right_ascension, abs=1e-12)


def test_images_of_another_size_are_refused_while_the_lens_is_estimated() -> None:
    tracker = StarTracker(fov_deg=12.0, learn=True, index=sky())
    tracker.solve(np.zeros((48, 64)))
    with pytest.raises(ArgumentError, match="64 x 32 pixels, but the earlier images have 64 x 48"):
        tracker.solve(np.zeros((32, 64)))
    tracker.solve(np.zeros((48, 64)))


def test_a_star_tracker_shows_its_field_of_view_or_its_camera() -> None:
    assert repr(StarTracker(index=sky())) == "<StarTracker: field of view unknown>"
    known = StarTracker(fov_deg=11.4, fov_error_deg=0.5, learn=True, index=sky())
    assert repr(known) == "<StarTracker: field of view 11.4 deg +- 0.5 deg, learns the lens>"
    camera = Pinhole(64, 48, 300.0)
    assert repr(StarTracker(camera=camera, index=sky())) == f"<StarTracker: {camera!r}>"


_COMPILED = """
import gc, sys
import numpy as np
import knightcube.vision.frame_job
from knightcube import StarTracker
from knightcube.compiled import HotFunction

def refused(*_):
    sys.exit("a numpy form was called")

for one in gc.get_objects():
    if isinstance(one, HotFunction):
        one.numpy_form = refused
found = StarTracker(fov_deg=12.0).solve(np.load(sys.argv[1]))
print(*found.quaternion, *found.covariance.ravel(), len(found.stars))
"""


@pytest.mark.slow
def test_the_compiled_forms_alone_give_the_same_attitude(resting: SkyFrame, tmp_path: Path) -> None:
    """The compiled implementations alone give the same attitude.

    The test program ends if a slow numpy implementation silently replaces a compiled implementation. In a new
    clone the program first compiles for up to a minute of processor time.
    """
    pytest.importorskip("numba", reason="numba is not installed: pip install knightcube[fast]")
    np.save(tmp_path / "image.npy", resting.pixels)
    environment = {**os.environ, "KNIGHTCUBE_COMPILED": "1"}
    words = [sys.executable, "-c", _COMPILED, str(tmp_path / "image.npy")]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=590, check=False)
    assert done.returncode == 0, done.stderr
    found = np.array(done.stdout.split(), dtype=float)
    expected = StarTracker(fov_deg=12.0).solve(resting.pixels)
    assert found[:4] == pytest.approx(expected.quaternion, abs=1e-9)
    assert found[4:13] == pytest.approx(expected.covariance.ravel(), rel=1e-5, abs=1e-14)
    assert found[13] == len(expected.stars)


def test_the_text_of_a_solution_states_a_mirrored_image(resting: SkyFrame) -> None:
    tracker = StarTracker(fov_deg=12.0)
    assert "mirrored" not in repr(tracker.solve(resting.pixels))
    assert repr(tracker.solve(resting.pixels[::-1])).endswith(" stars, mirrored>")


def test_right_ascension_declination_and_roll_are_those_of_the_quaternion(resting: SkyFrame) -> None:
    """The boresight is the third row of the attitude matrix, and north is up at zero roll."""
    solution = StarTracker(fov_deg=12.0).solve(resting.pixels)
    x, y, z, w = solution.quaternion
    boresight = [2.0 * (x * z + y * w), 2.0 * (y * z - x * w), 1.0 - 2.0 * (x * x + y * y)]
    ra, dec = solution.right_ascension, solution.declination
    expected = [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
    assert boresight == pytest.approx(expected, abs=1e-12)
    assert solution.right_ascension_deg == pytest.approx(math.degrees(ra))
    assert solution.declination_deg == pytest.approx(math.degrees(dec))
    assert solution.roll_deg == pytest.approx(math.degrees(solution.roll))


def test_the_matched_stars_lie_where_the_solution_predicts_them(resting: SkyFrame) -> None:
    solution = StarTracker(fov_deg=12.0).solve(resting.pixels)
    stars = solution.stars
    assert len(stars) > 10
    assert len(set(stars.hip.tolist())) == len(stars)
    assert solution.sky_map is not None
    predicted = solution.sky_map.pixels(stars.directions)
    np.testing.assert_allclose(stars.points - predicted, stars.residuals, atol=1e-6)
    nearest = np.linalg.norm(stars.points[:, None] - resting.stars, axis=2).min(axis=1)
    assert np.median(nearest) < 0.2


def test_an_image_without_stars_gives_the_reason() -> None:
    noise = np.random.default_rng(5).normal(100.0, 5.0, (256, 256)).astype(np.uint16)
    solution = StarTracker(fov_deg=12.0).solve(noise)
    assert not solution
    assert solution.status in {"no-stars", "too-few-stars"}
    assert solution.reason
    assert math.isnan(solution.right_ascension)
    assert np.isnan(solution.quaternion).all()
    assert np.isnan(solution.covariance).all()
    assert len(solution.stars) == 0
    assert solution.sky_map is None


def test_streaks_give_the_rate_and_a_prediction_its_sign(streaked: SkyFrame) -> None:
    frame = streaked
    tracker = StarTracker(fov_deg=12.0)
    alone = tracker.solve(frame.pixels, exposure=frame.exposure)
    assert alone.rate is not None
    assert not alone.rate_sign_known
    assert np.linalg.norm(alone.rate) == pytest.approx(np.linalg.norm(frame.rate), rel=0.02)
    known = tracker.solve(frame.pixels, exposure=frame.exposure, rate=0.8 * frame.rate)
    assert known.rate is not None
    assert known.rate_sign_known
    assert known.rate @ frame.rate > 0.0
    assert tracker.solve(frame.pixels).rate is None


@pytest.mark.parametrize("learn", [False, True])
@pytest.mark.parametrize("kind", ["resting", "streaked"])
@pytest.mark.parametrize("dtype", ["int16", "int64", "uint32", ">i2", ">f4", "float64", "long double"])
def test_whole_numbers_of_any_type_give_the_same_solution(
    dtype: str, kind: str, learn: bool, request: pytest.FixtureRequest
) -> None:
    frame: SkyFrame = request.getfixturevalue(kind)
    image = frame.pixels.astype(np.longdouble if dtype == "long double" else dtype)
    solutions = [
        StarTracker(fov_deg=12.0, learn=learn).solve(pixels, exposure=frame.exposure)
        for pixels in (image, frame.pixels)
    ]
    assert solutions[0]
    np.testing.assert_array_equal(solutions[0].quaternion, solutions[1].quaternion)
    np.testing.assert_array_equal(solutions[0].covariance, solutions[1].covariance)


@pytest.mark.parametrize("kind", ["resting", "streaked"])
@pytest.mark.parametrize(
    "altered",
    [
        lambda pixels: pixels.astype(np.int64) + 10**15,
        lambda pixels: pixels.astype(np.int16) - 300,
        lambda pixels: pixels.astype(np.float16),
        lambda pixels: pixels / 65_535.0,
        lambda pixels: 0.37 * pixels - 12.5,
    ],
)
def test_scaled_and_displaced_pixel_values_give_nearly_the_same_solution(
    altered: Callable[[Image], Image], kind: str, request: pytest.FixtureRequest
) -> None:
    frame: SkyFrame = request.getfixturevalue(kind)
    tracker = StarTracker(fov_deg=12.0)
    found, usual = (
        tracker.solve(pixels, exposure=frame.exposure) for pixels in (altered(frame.pixels), frame.pixels)
    )
    assert found
    sigma = math.sqrt(float(np.trace(usual.covariance)))
    assert angle_between(found.quaternion, usual.quaternion) < 0.2 * sigma
    assert np.trace(found.covariance) == pytest.approx(np.trace(usual.covariance), rel=0.1)
    if usual.rate is not None and usual.rate_covariance is not None:
        assert found.rate is not None
        off = found.rate - usual.rate
        # The gain of one electron per pixel value does not hold for scaled pixel values.
        assert off @ np.linalg.solve(usual.rate_covariance, off) < 0.5


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.full((64, 64), 65_535, np.uint16), "the frame is overexposed"),
        (np.full((64, 64), 255, np.uint8), "the frame is overexposed"),
        (np.full((64, 64), 65_535.0), "the frame is overexposed"),
        (np.where(np.indices((64, 64))[0] < 30, 4_095, np.indices((64, 64))[1]), "the frame is overexposed"),
        (np.full((64, 64), 0.7), "all pixels of the frame are equal"),
        (np.zeros((64, 64)), "all pixels of the frame are equal"),
    ],
)
def test_an_overexposed_image_and_an_empty_one_are_named(image: Image, reason: str) -> None:
    solution = StarTracker(fov_deg=12.0).solve(image)
    assert (solution.status, solution.reason) == ("no-stars", reason)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"exposure": -1.0}, "exposure: -1.0: give a positive, finite number of seconds"),
        ({"exposure": math.nan}, "exposure: nan"),
        ({"exposure": "0.2"}, "exposure: '0.2'"),
        ({"rate": np.full(3, np.nan), "exposure": 0.2}, "rate: [nan, nan, nan]: give finite numbers"),
        ({"rate": 0.1, "exposure": 0.2}, "rate: an array of shape (): give finite numbers of shape (3,)"),
        ({"rate": [0.1, 0.0, 0.0]}, "exposure: None: a predicted rate needs the exposure time"),
        (
            {"rate": np.zeros(3), "rate_sigma": -1.0},
            "rate_sigma: -1.0: give a standard deviation of",
        ),
        (
            {"attitude": np.eye(4)[3], "attitude_sigma": -1.0},
            "attitude_sigma: -1.0: give a standard deviation of",
        ),
        ({"attitude": np.eye(4)[3], "attitude_sigma": math.nan}, "attitude_sigma: nan"),
        ({"attitude_sigma": -1.0}, "attitude_sigma: -1.0: give a standard deviation of"),
        ({"rate_sigma": math.nan}, "rate_sigma: nan: give a standard deviation of"),
        ({"attitude": np.zeros(4)}, "give a quaternion of length 1, scalar part last"),
        ({"attitude": np.full(4, np.nan)}, "attitude: [nan, nan, nan, nan]: give finite numbers"),
        (
            {"attitude": [0.0, 0.0, 1.0]},
            "attitude: an array of shape (3,): give finite numbers of shape (4,)",
        ),
        ({"utc": "2026-01-01"}, "utc: '2026-01-01': give a datetime"),
        ({"utc": date(2026, 1, 1)}, "utc: datetime.date(2026, 1, 1): give a datetime"),
    ],
)
def test_a_wrong_argument_of_solve_is_named(resting: SkyFrame, given: dict[str, Any], message: str) -> None:
    tracker = StarTracker(fov_deg=12.0)
    with pytest.raises(ArgumentError, match=re.escape(message)):
        tracker.solve(resting.pixels, **given)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 1e6, math.inf])
def test_a_large_deviation_is_an_unknown_prediction(resting: SkyFrame, sigma: float) -> None:
    anything = np.array([0.0, 0.0, 0.0, 1.0])
    assert StarTracker(fov_deg=12.0).solve(resting.pixels, attitude=anything, attitude_sigma=sigma)


def test_a_wrong_field_of_view_is_refused_with_the_searched_fields(resting: SkyFrame) -> None:
    solution = StarTracker(fov_deg=30.0, fov_error_deg=3.0).solve(resting.pixels)
    assert solution.status == "no-match"
    assert solution.reason.endswith("; fields of view of 27 to 33 deg were searched")
    rows, columns = resting.pixels.shape
    camera = Pinhole.from_field_of_view(columns, rows, math.radians(60.0))
    solution = StarTracker(camera=camera, fov_error_deg=15.0).solve(resting.pixels)
    assert solution.reason.endswith("; fields of view of 45 to 75 deg were searched")


def test_a_colour_image_has_the_solution_of_its_luminance(resting: SkyFrame) -> None:
    """A colour image has the solution of its luminance. Three equal colour values are the luminance."""
    colours = np.repeat(resting.pixels[..., None], 4, axis=2)
    colours[..., 3] = 7  # the alpha channel
    tracker = StarTracker(fov_deg=12.0)
    grey = tracker.solve(resting.pixels)
    for image in (colours, colours[..., :3], colours[..., :1]):
        np.testing.assert_array_equal(tracker.solve(image).quaternion, grey.quaternion)


def test_wide_stars_of_a_large_image_are_solved_in_sums_of_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images whose stars cover several pixels are binned before they are solved.

    Large photographs have such stars, and the noise of neighbouring pixels is correlated.
    """
    resting = sky_frame(np.random.default_rng(5), 0.0, 0.1)
    spread = gaussian_filter(np.kron(resting.pixels.astype(float), np.ones((3, 3))), 3.0)
    image = np.rint(spread[1:-1, 1:-1] + 20_000.0).astype(np.uint16)
    # The stated settings refer to the image, not to the binned image.
    stated = DetectionSettings(saturation=65_535.0, psf_sigma=4.0)
    tracker = StarTracker(fov_deg=12.0, settings=SolveSettings(detection=stated))
    solution = tracker.solve(image)
    assert solution, "the sums of 3 x 3 px leave two pixels at each side"
    error = to_rotation_vector(multiply(solution.quaternion, conjugate(resting.attitude)))
    assert error @ np.linalg.solve(solution.covariance, error) < 16.3  # 99.9 % of chi-square(3)
    assert solution.sky_map is not None
    places = solution.sky_map.pixels(solution.stars.directions)
    np.testing.assert_allclose(places, solution.stars.points - solution.stars.residuals, atol=1e-6)
    assert np.abs(solution.stars.residuals).max() < 3.0
    brightest = resting.stars[
        np.argsort(np.linalg.norm(3.0 * resting.stars - solution.stars.points[0], axis=1))[0]
    ]
    np.testing.assert_allclose(solution.stars.points[0], 3.0 * brightest, atol=1.5)
    monkeypatch.setattr("knightcube.vision.star_tracker.BIN_SIZES", ())
    assert not tracker.solve(image)


def test_a_predicted_attitude_is_used_and_a_wrong_one_does_no_harm(resting: SkyFrame) -> None:
    tracker = StarTracker(camera=resting.camera.pinhole)
    near = tracker.solve(resting.pixels, attitude=resting.attitude, attitude_sigma=1e-3)
    assert near
    assert near.frame.tracked
    wrong = tracker.solve(resting.pixels, attitude=np.array([0.0, 0.0, 0.0, 1.0]), attitude_sigma=1e-3)
    assert wrong
    assert not wrong.frame.tracked
    assert angle_between(near.quaternion, wrong.quaternion) < 5.0 * ARCSECOND
    assert near.field_of_view_sigma == 0.0


def test_the_date_corrects_aberration_by_at_most_its_constant(resting: SkyFrame) -> None:
    """A date changes the attitude by at most the constant of aberration, 20.5".

    The frame is simulated without aberration.
    """
    tracker = StarTracker(camera=resting.camera.pinhole)
    plain = tracker.solve(resting.pixels)
    naive, aware = datetime(2026, 7, 2, 12), datetime(2026, 7, 2, 12, tzinfo=UTC)
    dated = tracker.solve(resting.pixels, utc=aware).quaternion
    np.testing.assert_array_equal(tracker.solve(resting.pixels, utc=naive).quaternion, dated)
    assert 2.0 * ARCSECOND < angle_between(dated, plain.quaternion) < 21.0 * ARCSECOND


def test_wrong_arguments_are_refused_with_the_value(tmp_path: Path) -> None:
    lens = Pinhole.from_field_of_view(64, 48, 0.2)
    with pytest.raises(InputError, match=r"field of view: 0\.5: give 1 to 120 degrees"):
        StarTracker(fov_deg=0.5)
    with pytest.raises(InputError, match=r"-1\.0: give 0 or more degrees"):
        StarTracker(fov_deg=10.0, fov_error_deg=-1.0)
    for value in (True, "11", math.nan, [11.0]):
        with pytest.raises(InputError, match=re.escape(f"field of view: {value!r}: give 1 to 120 degrees")):
            StarTracker(fov_deg=value)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=re.escape(f"error of the field of view: {value!r}: give 0")):
            StarTracker(camera=lens, fov_error_deg=value)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="not both"):
        StarTracker(fov_deg=10.0, camera=lens)
    with pytest.raises(ArgumentError, match="camera: 'lens': give a Pinhole or a Lens"):
        StarTracker(camera="lens")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match=r"settings\.lens: .* as CameraKnowledge\(\*\*accuracy\)"):
        StarTracker(camera=lens, settings=SolveSettings(lens={"centre": 0.1}))  # type: ignore[arg-type]
    deviation = "give a standard deviation of 0"
    wrong: tuple[tuple[Any, str], ...] = ((-1.0, deviation), (math.nan, deviation), ("0.1", "give a number"))
    for name in ("focal_length", "centre", "distortion", "line_time", "psf_sigma"):
        for value, remedy in wrong:
            text = re.escape(f"settings.lens.{name}: {value!r}: {remedy}")
            knowledge = replace(CameraKnowledge(), **{name: value})
            with pytest.raises(ArgumentError, match=text):
                StarTracker(camera=lens, settings=SolveSettings(lens=knowledge))
    with pytest.raises(ArgumentError, match=r"fov_error_deg: 2\.0: give `fov_deg` or `camera` too"):
        StarTracker(fov_error_deg=2.0)
    with pytest.raises(InputError, match=r"none\.index"):
        StarTracker(index=tmp_path / "none.index")
    with pytest.raises(InputError, match="48 x 64 pixels, but the camera has 64 x 48"):
        StarTracker(camera=lens, index=sky()).solve(np.zeros((64, 48)))
    with pytest.raises(ValueError, match=r"shape \(3, 64, 64\): give \(rows, columns\), or"):
        StarTracker().solve(np.zeros((3, 64, 64)))
    with pytest.raises(ValueError, match=r"night\.png: give an array of pixels, such as read_image\('night"):
        StarTracker().solve("night.png")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="16 or more"):
        StarTracker().solve(np.zeros((8, 8)))


def test_a_field_of_view_gives_a_camera_and_the_range_of_its_scale() -> None:
    camera, scale = camera_of_field(10.0, 1.0, (300, 400))
    tangents = [factor * 200.0 / camera.focal_length for factor in scale]
    assert [math.degrees(2.0 * math.atan(tangent)) for tangent in tangents] == pytest.approx([9.0, 11.0])
    assert camera_of_field(None, None, (300, 400))[1][1] > 3.0
    # A field of view without a calibrated lens is not exact.
    for error in (0.0, 1e-6):
        certain, (lowest, highest) = camera_of_field(10.0, error, (300, 400))
        assert math.degrees(field_of_view(certain)) == pytest.approx(10.0)
        assert (lowest, highest) == pytest.approx((0.999, 1.001), abs=1e-4)
