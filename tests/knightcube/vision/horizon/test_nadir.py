"""Tests of the nadir from rendered frames: by day, at the terminator, and without a limb.

For several cameras, the tests include a joint fit of the limb, and a coarse nadir without a limb in view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray, Image, tangent_basis
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector
from knightcube.errors import UsageError
from knightcube.reference.horizon import fit_circle
from knightcube.vision.camera.images import read_image
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon import nadir as nadir_module
from knightcube.vision.horizon.edges import find_edges
from knightcube.vision.horizon.hypothesis import Hypothesis, examine
from knightcube.vision.horizon.illumination import coarse_nadir, image_brightness
from knightcube.vision.horizon.initial_guess import limb_radius_sigma
from knightcube.vision.horizon.limb import UNIT_DEPTH_HEIGHT, limb_light
from knightcube.vision.horizon.nadir import (
    HorizonSolution,
    HorizonStatus,
    JointNadir,
    NadirMeasurement,
    find_nadir,
    limited_normal,
    nadir_of_cameras,
    nadir_of_uncertain_field,
)
from knightcube.vision.horizon.settings import (
    EdgeSettings,
    HorizonKnowledge,
    HorizonSettings,
    RoughAttitude,
    SensedDirection,
)
from sim_hal.earth_camera import EarthScene, nadir, render
from sim_hal.earth_light import Atmosphere
from tests.knightcube.vision.horizon.instants import ALTITUDE, UW, VT, WIDE_MODEL, Instant, instant
from tests.sim_hal.earth_camera.scenes import limb_scene, random_scene
from tests.support.earth_truth import limb_truth
from tests.support.limb_frames import camera_model, coarse_knowledge, finder_settings

MODEL = camera_model()
SETTINGS = finder_settings(MODEL)
PHOTOGRAPH = Path(__file__).resolve().parents[5] / "shared/data/limb/opssat1_2020-08-16T062350.png"


def _error_deg(found: HorizonSolution, scene: EarthScene) -> float:
    assert found.nadir is not None, found.reason
    return float(np.degrees(np.arccos(min(1.0, float(found.nadir.direction @ nadir(scene))))))


@pytest.fixture(scope="module")
def day() -> tuple[EarthScene, Image]:
    """Return a sunlit limb across the image centre, from 600 km above 45 deg north."""
    generator = np.random.default_rng(1)
    scene = limb_scene(zenith=np.array([1.0, 0.0, 1.0]), sun=np.array([1.0, 0.6, 0.5]), texture=3)
    return scene, render(MODEL, scene, generator)


def _gps(scene: EarthScene) -> HorizonKnowledge:
    return HorizonKnowledge(position=scene.position, sun=scene.sun, pole=scene.pole)


def test_the_profile_of_the_air_agrees_with_the_simulator() -> None:
    """The estimator's optical depth, a sum along the ray, agrees with Chapman's function in the simulator."""
    air, _, _, _ = limb_light(np.array([[0.0, 10e3, UNIT_DEPTH_HEIGHT, 18.4e3, 40e3]]), np.array([500.0]))[
        :, 0
    ]
    depth = Atmosphere().tangent_depth(np.array([0.0, 10e3, UNIT_DEPTH_HEIGHT, 18.4e3, 40e3], np.float32))
    assert air[1:] == pytest.approx(1.0 - np.exp(-depth[1:]), abs=2e-3)
    assert depth[2] == pytest.approx(1.0, rel=1e-3)


def test_edges_lie_on_the_true_limb_to_a_fraction_of_a_pixel(day: tuple[EarthScene, Image]) -> None:
    scene, frame = day
    edges, _ = find_edges(frame, SETTINGS.edges)
    truth = limb_truth(scene, MODEL, height=UNIT_DEPTH_HEIGHT).points
    apart = np.min(np.linalg.norm(edges.points[:, None] - truth[None], axis=2), axis=1)
    assert np.count_nonzero(apart < 0.7) > 25


@pytest.mark.parametrize("blur", [0.6, 1.5, 3.0, 4.0])
def test_a_defocused_camera_gives_a_nadir_within_its_uncertainty(blur: float) -> None:
    """The limb of a camera whose optics blur more than stated is not displaced by the excess blur."""
    camera = Pinhole.from_field_of_view(columns=512, rows=512, field_of_view=np.radians(67.0))
    column, row = np.meshgrid(np.arange(512.0), np.arange(512.0))
    rays = camera.unit_vectors(np.stack([column.ravel(), row.ravel()], axis=-1))
    ratios = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        altitude, tilt, roll = generator.uniform([4e5, 0.8, 0.0], [8e5, 1.3, 2.0 * np.pi]).tolist()
        truth = np.array([np.sin(tilt) * np.sin(roll), np.sin(tilt) * np.cos(roll), np.cos(tilt)])
        distance = 6_371_009.0 + altitude
        height = distance * np.sin(np.arccos(np.clip(rays @ truth, -1.0, 1.0))) - 6_371_009.0
        light = 1.0 - np.exp(-np.exp(np.minimum((UNIT_DEPTH_HEIGHT - height) / 8e3, 50.0)))
        image = 5.0 + gaussian_filter(150.0 * light.reshape(512, 512), blur)
        image += generator.normal(0.0, 1.0, image.shape)
        found = find_nadir(image, camera, HorizonKnowledge(altitude=altitude))
        if found.nadir is not None:
            error = float(np.arccos(min(1.0, float(found.nadir.direction @ truth))))
            ratios.append(error / found.nadir.sigma)
    assert len(ratios) >= 4
    assert np.sqrt(np.mean(np.square(ratios))) < 1.0


def test_a_solution_is_true_if_it_has_a_nadir(day: tuple[EarthScene, Image]) -> None:
    found = find_nadir(day[1], MODEL.lens, settings=SETTINGS)
    assert bool(found) is (found.nadir is not None) is True
    assert found.reason == ""
    dark = find_nadir(np.zeros_like(day[1]), MODEL.lens)
    assert not dark
    assert dark.reason == "no significant horizon among 0 edges"


def test_only_the_scanned_lines_are_read(day: tuple[EarthScene, Image]) -> None:
    _, lines = find_edges(day[1], EdgeSettings(lines=8))
    assert lines.pixels == 16 * 512
    assert lines.columns.tolist() == lines.rows.tolist() == list(range(32, 512, 64))


@pytest.mark.parametrize(("value", "rows"), [(0, 1), (0, 40), (255, 2)])
def test_lost_rows_are_not_evaluated(day: tuple[EarthScene, Image], value: int, rows: int) -> None:
    """Lost rows do not change the black level, and their edges do not count.

    A camera with an offset has no pixels of zero counts, unless they were lost.
    """
    scene, image = day
    whole = find_nadir(image, MODEL.lens, _gps(scene), SETTINGS)
    lost = image.copy()
    for first in (100, 300, 420):
        lost[first : first + rows] = value
    found = find_nadir(lost, MODEL.lens, _gps(scene), SETTINGS)
    assert _error_deg(found, scene) < _error_deg(whole, scene) + 0.05
    assert np.all((found.points[:, 1] < 99.0) | (found.points[:, 1] > 100.0 + rows))


def test_a_torn_image_is_ambiguous(day: tuple[EarthScene, Image]) -> None:
    """If the lower rows are from another exposure, each part has a horizon, and the nadir is ambiguous."""
    scene, image = day
    torn = np.concatenate([image[:300], np.roll(image, 40, axis=0)[300:]])
    assert find_nadir(image, MODEL.lens, _gps(scene), SETTINGS)
    found = find_nadir(torn, MODEL.lens, _gps(scene), SETTINGS)
    assert found.status is HorizonStatus.AMBIGUOUS
    assert "a part of the image is displaced" in found.reason


def test_only_whole_rows_between_other_rows_count_as_lost() -> None:
    image = np.arange(64 * 48, dtype=np.uint16).reshape(64, 48)
    assert not nadir_module._lost_rows(image).any()
    image[[0, 1, 20, 21, 63]] = 7
    assert np.flatnonzero(nadir_module._lost_rows(image)).tolist() == [20, 21]
    image[21] = image[22]
    assert np.flatnonzero(nadir_module._lost_rows(image)).tolist() == [20]
    image[10:40] = 0
    assert not nadir_module._lost_rows(image).any()
    assert not nadir_module._lost_rows(0 * image).any()
    dark_sky_with_a_star = np.zeros((40, 50), dtype=np.uint8)
    dark_sky_with_a_star[3, 7] = 90
    dark_sky_with_a_star[25:] = 200
    assert not nadir_module._lost_rows(dark_sky_with_a_star).any()


def test_a_rough_attitude_gives_what_the_coarse_sensors_give(day: tuple[EarthScene, Image]) -> None:
    scene, frame = day
    tilted = quaternion.multiply(quaternion.from_rotation_vector(np.full(3, 0.02)), scene.attitude)
    for help_ in (
        {"attitude": RoughAttitude(tilted, 0.03)},
        {"sensed": (SensedDirection(scene.camera_matrix @ scene.sun, scene.sun, 0.1),)},
    ):
        found = find_nadir(frame, MODEL.lens, replace(_gps(scene), **help_), SETTINGS)
        assert found.status is HorizonStatus.FOUND
        assert _error_deg(found, scene) < 0.05
        assert found.nadir is not None
        assert abs(found.nadir.altitude - 600e3) < 15e3
        assert found.nadir.residual < 0.3


def test_without_the_flattenings_direction_the_allowance_covers_the_error(
    day: tuple[EarthScene, Image],
) -> None:
    """If the direction of the Earth's axis is unknown, the uncertainty covers the error by the flattening.

    At a latitude of 45 deg, the ellipsoid tilts the horizon most.
    """
    scene, frame = day
    for knowledge in (_gps(scene), HorizonKnowledge(altitude=600e3)):
        found = find_nadir(frame, MODEL.lens, knowledge, SETTINGS)
        assert found.nadir is not None
        assert _error_deg(found, scene) < 3.0 * np.degrees(found.nadir.sigma)
        assert found.nadir.sigma > SETTINGS.sphere_sigma


def test_the_fitted_altitude_stays_within_the_given_range(day: tuple[EarthScene, Image]) -> None:
    """A permitted range of altitudes that begins two sigmas above the best fit limits the fitted altitude.

    The limit changes the nadir in the same direction as prior knowledge of this altitude.
    """
    frame = day[1]
    free = find_nadir(frame, MODEL.lens, HorizonKnowledge(), SETTINGS).nadir
    assert free is not None
    low = free.altitude + 2.0 * free.altitude_sigma
    settings = replace(SETTINGS, altitudes=(low, 2000e3))
    found = find_nadir(frame, MODEL.lens, HorizonKnowledge(), settings).nadir
    held = find_nadir(frame, MODEL.lens, HorizonKnowledge(altitude=low), SETTINGS).nadir
    assert found is not None
    assert held is not None
    assert low < found.altitude < low + free.altitude_sigma
    assert found.altitude_sigma < 0.7 * free.altitude_sigma
    assert (found.direction - free.direction) @ (held.direction - free.direction) > 0.0


@pytest.mark.parametrize(("limits", "mean", "share"), [
    ((-np.inf, np.inf), 0.0, 1.0),
    ((0.0, 1e9), np.sqrt(2.0 / np.pi), 1.0 - 2.0 / np.pi),
    ((-1.0, 1.0), 0.0, 0.291125),
    ((20.0, 1e9), 20.04975, 0.00246),
    ((-50.0, -49.0), -49.0204, 0.000416),
])  # fmt: skip
def test_a_limited_normal_distribution_has_the_published_moments(
    limits: tuple[float, float], mean: float, share: float
) -> None:
    """A truncated normal distribution has the moments of Johnson, Kotz and Balakrishnan.

    The source is Continuous Univariate Distributions 1, section 13.10.1.
    """
    found = limited_normal(7.0, 3.0, (7.0 + 3.0 * limits[0], 7.0 + 3.0 * limits[1]))
    assert found[0] == pytest.approx(7.0 + 3.0 * mean, abs=0.01)
    assert found[1] == pytest.approx(share, rel=0.02)


def test_an_unknown_altitude_is_fitted_with_its_spread(day: tuple[EarthScene, Image]) -> None:
    scene, frame = day
    found = find_nadir(frame, MODEL.lens, HorizonKnowledge(), SETTINGS)
    assert found.nadir is not None
    assert 10e3 < found.nadir.altitude_sigma < 300e3
    assert abs(found.nadir.altitude - 600e3) < 4.0 * np.hypot(found.nadir.altitude_sigma, 20e3)
    assert _error_deg(found, scene) < 4.0 * np.degrees(found.nadir.sigma)


def test_a_horizon_that_contradicts_the_coarse_sun_is_refused(day: tuple[EarthScene, Image]) -> None:
    scene, frame = day
    # The opposite of the true Sun direction contradicts the horizon.
    wrong = SensedDirection(-(scene.camera_matrix @ scene.sun), scene.sun, np.radians(5.0))
    found = find_nadir(frame, MODEL.lens, replace(_gps(scene), sensed=(wrong,)), SETTINGS)
    assert found.status is HorizonStatus.REFUSED
    assert "contradicts a coarse direction" in found.reason
    assert found.nadir is None
    assert len(found.candidates) >= 1


def test_a_horizon_with_bright_sky_is_refused(day: tuple[EarthScene, Image]) -> None:
    """A horizon with bright sky is refused.

    The image is rotated by 180 deg, but the known attitude belongs to the original image.
    """
    scene, frame = day
    found = find_nadir(
        frame[::-1, ::-1],
        MODEL.lens,
        replace(_gps(scene), attitude=RoughAttitude(scene.attitude, 0.02)),
        SETTINGS,
    )
    assert found.status is HorizonStatus.REFUSED


def test_a_horizon_of_few_edges_is_read_more_closely_where_it_runs() -> None:
    """A horizon with few edges is searched in a second pass on more lines near the limb.

    The first pass reads 14 lines in each direction, and the second pass reads 42 lines near the limb. The
    second pass reads fewer pixels, and its result is more accurate.
    """
    generator = np.random.default_rng((3, 0, 1))
    scene = random_scene(generator, MODEL, "sunlit", (400e3, 700e3))
    frame = render(MODEL, scene, generator)
    knowledge = coarse_knowledge(scene, generator)
    few = EdgeSettings(lines=14, more_lines=42, response=SETTINGS.edges.response)
    # An uneven limb would dominate the uncertainties of both results.
    even = replace(SETTINGS, edges=few, uneven_limb_sigma=0.0)
    once = find_nadir(frame, MODEL.lens, knowledge, replace(even, enough_edges=8))
    twice = find_nadir(frame, MODEL.lens, knowledge, replace(even, enough_edges=200))
    assert once.nadir is not None
    assert twice.nadir is not None
    assert twice.nadir.used > 1.5 * once.nadir.used
    assert twice.nadir.sigma < once.nadir.sigma
    assert once.pixels_read < twice.pixels_read < once.pixels_read + 2 * 42 * 512
    assert _error_deg(twice, scene) < 3.0 * np.degrees(twice.nadir.sigma)


@pytest.mark.parametrize("factor", [0.95, 1.0, 1.05])
def test_a_limb_that_contradicts_the_known_altitude_has_a_larger_uncertainty(
    day: tuple[EarthScene, Image], factor: float
) -> None:
    """With a wrong focal length, the edges imply another altitude by up to three standard deviations."""
    scene, frame = day
    camera = MODEL.lens.rescaled(factor)
    measured = find_nadir(frame, camera, _gps(scene), SETTINGS).nadir
    assert measured is not None
    error = measured.basis @ (measured.direction - nadir(scene))
    assert error @ np.linalg.solve(measured.tangent_covariance, error) < 13.8  # 99.9 % quantile
    assert (np.degrees(measured.sigma) < 0.15) == (factor == 1.0)


@pytest.mark.parametrize("altitude", [400e3, 450e3, 800e3])
def test_a_wrong_altitude_is_refused_with_the_altitude_of_the_limb(
    day: tuple[EarthScene, Image], altitude: float
) -> None:
    """The scene is at 600 km. The nadir of a limb that is fitted at another altitude is degrees off."""
    found = find_nadir(day[1], MODEL.lens, HorizonKnowledge(altitude=altitude), SETTINGS)
    assert found.status is HorizonStatus.REFUSED
    assert f"not {1e-3 * altitude:.0f} km: correct the altitude or the field of view" in found.reason
    implied = float(found.reason.split("an altitude of ")[1].split(" km")[0])
    assert abs(implied - 600.0) < 60.0
    right = find_nadir(day[1], MODEL.lens, HorizonKnowledge(altitude=600e3), SETTINGS)
    assert right.status is HorizonStatus.FOUND


@pytest.mark.parametrize("level", [0.0, 90.0])
def test_sky_alone_and_noise_alone_show_no_horizon(level: float) -> None:
    frame = np.random.default_rng(2).normal(10.0 + level, 1.2, (512, 512)).clip(0, 255).astype(np.uint8)
    found = find_nadir(frame, MODEL.lens, HorizonKnowledge(altitude=600e3), SETTINGS)
    assert found.status is HorizonStatus.NO_HORIZON
    assert found.nadir is None


def test_a_band_between_two_equal_arcs_is_ambiguous_and_both_are_reported() -> None:
    """A band between two equal arcs gives an ambiguous result with both horizons.

    In the paper's uniqueness problem (Fig. 14), either edge of the band may be the limb.
    """
    scene = limb_scene(1000e3, zenith=np.array([1.0, 0.2, 0.3]), sun=np.array([1.0, 0.3, 0.2]), dip=0.25)
    frame = render(MODEL, scene, np.random.default_rng(4))
    band = np.minimum(frame, frame[::-1])
    found = find_nadir(band, MODEL.lens, HorizonKnowledge(altitude=1000e3), SETTINGS)
    assert found.status is HorizonStatus.AMBIGUOUS
    assert found.nadir is None
    down = nadir(scene)
    truths = [down, down * [1.0, -1.0, 1.0]]
    nearest = [max(float(each.direction @ truth) for each in found.candidates) for truth in truths]
    assert np.degrees(np.arccos(np.minimum(1.0, nearest))).max() < 0.5


def test_the_terminator_is_distinguished_from_the_limb() -> None:
    """The terminator of a crescent is not fitted, although it is as bright and as round as the limb."""
    generator = np.random.default_rng(34)
    scene = random_scene(generator, MODEL, "terminator", (1200e3, 1800e3))
    frame = render(MODEL, scene, generator)
    found = find_nadir(frame, MODEL.lens, coarse_knowledge(scene, generator), SETTINGS)
    assert found.status is HorizonStatus.FOUND
    assert _error_deg(found, scene) < 0.15
    truth = limb_truth(scene, MODEL, height=UNIT_DEPTH_HEIGHT).points
    used: FloatArray = found.points[found.on_horizon]
    assert np.min(np.linalg.norm(used[:, None] - truth[None], axis=2), axis=1).max() < 2.5


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({"position": np.array([np.nan, 0.0, 7e6])}, "finite"),
        ({"position": np.array([0.0, 0.0, 7000.0])}, "inside the Earth"),
        ({"altitude": -5.0}, "give metres"),
        ({"altitude": 5e3}, "50000 at least"),
        ({"sun": np.zeros(2)}, "finite"),
    ],
)
def test_impossible_knowledge_is_refused(wrong: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        HorizonKnowledge(**wrong)  # type: ignore[arg-type]  # each key's own


def test_a_photograph_from_orbit_is_fitted_to_less_than_half_a_pixel() -> None:
    """The horizon in a photograph from OPS-SAT-1 is fitted on 27 scan lines to less than half a pixel.

    The README of the photograph reports an independent fit with 0.44 px rms.
    """
    if not PHOTOGRAPH.exists():
        pytest.skip("needs ../shared/data/limb")
    pixels = read_image(PHOTOGRAPH)
    rows, columns = pixels.shape
    camera = Pinhole.from_field_of_view(columns, rows, np.radians(12.8))
    found = find_nadir(pixels, camera)
    assert found.nadir is not None, found.reason
    assert found.nadir.residual <= 0.5
    assert found.nadir.used >= 20
    # The sky is at the top of the photograph, so nadir is below the image. The limb rises to the right.
    assert found.nadir.direction[1] > 0.9
    circle = fit_circle(found.points[found.on_horizon])
    assert circle.radius == pytest.approx(22_211.0, rel=0.2)
    assert abs(found.nadir.altitude - 515e3) < 4.0 * found.nadir.altitude_sigma


def test_a_frame_of_another_size_than_the_camera_is_refused(day: tuple[EarthScene, Image]) -> None:
    with pytest.raises(ValueError, match=r"shape \(512, 256\), but the camera has 512 x 512"):
        find_nadir(day[1][:, :256], MODEL.lens)
    with pytest.raises(ValueError, match="not finite"):
        find_nadir(np.full((512, 512), np.nan), MODEL.lens)


def test_invalid_settings_are_refused() -> None:
    for wrong in ({"lines": 1}, {"run": 4}, {"threshold": 1.5}, {"contrast": 0.0}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            EdgeSettings(**wrong)
    assert HorizonSettings().edges.lines == 32


JOINT_SETTINGS = finder_settings(WIDE_MODEL)
EARTHLIGHT = 30.0
"""Counts of the logarithmic camera at the relative intensity 0.025."""


def error_deg(found: JointNadir, truth: FloatArray) -> float:
    """Return the error (deg) of a nadir direction."""
    assert found.nadir is not None, found.reason
    return float(np.degrees(np.linalg.norm(tangent_basis(truth) @ found.nadir.direction)))


@pytest.fixture(scope="module")
def level() -> Instant:
    """Return a level satellite by day. Three cameras see the limb, and the fourth camera sees the sky."""
    return instant(UW, np.array([0.02, -0.03, 1.0]), np.array([0.8, 0.5, 0.3]), 11)


def test_all_cameras_together_are_more_accurate_than_each_camera(level: Instant) -> None:
    found = nadir_of_cameras(level.frames, UW, level.knowledge(), JOINT_SETTINGS)
    assert found.status is HorizonStatus.FOUND
    assert sorted(found.cameras) == [0, 1, 2]
    assert found.nadir is not None
    alone = [found.each[number].nadir for number in found.cameras]
    assert found.nadir.sigma < 0.5 * min(one.sigma for one in alone if one is not None)
    off = tangent_basis(level.nadir) @ found.nadir.direction
    assert error_deg(found, level.nadir) < 0.03
    assert float(np.linalg.norm(off)) < 4.0 * found.nadir.sigma


def test_an_exactly_known_sun_does_not_reject_a_true_limb(level: Instant) -> None:
    """An exactly known Sun direction does not lead to the refusal of a true limb.

    Before the limb fit, a cone through the edges has an error of 0.1 to 0.3 deg.
    """
    rough = level.knowledge()
    for sigma in (np.radians(0.005), np.radians(1.0)):
        seen = replace(rough, sensed=(SensedDirection(level.sun_in_body, level.sun, sigma),))
        found = nadir_of_cameras(level.frames, UW, seen, JOINT_SETTINGS)
        assert found.status is HorizonStatus.FOUND, found.reason
        assert sorted(found.cameras) == [0, 1, 2]
    elsewhere = attitude_matrix(from_rotation_vector(np.array([0.0, 0.05, 0.0]))) @ level.sun_in_body
    false = replace(rough, sensed=(SensedDirection(elsewhere, level.sun, np.radians(0.005)),))
    assert nadir_of_cameras(level.frames, UW, false, JOINT_SETTINGS).status is not HorizonStatus.FOUND


def test_air_higher_than_believed_shifts_one_cameras_nadir_but_not_that_of_three(level: Instant) -> None:
    """If the atmosphere is higher than assumed, three opposite cameras give a better nadir than one camera.

    All limbs are 6 km higher than assumed. Under this error, the fit of a single limb has a nadir error of
    0.13 deg.
    """
    joint = nadir_of_cameras(level.frames, UW, level.knowledge(), JOINT_SETTINGS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{nadir_of_cameras.__module__}.UNIT_DEPTH_HEIGHT", UNIT_DEPTH_HEIGHT - 6e3)
        shifted = nadir_of_cameras(level.frames, UW, level.knowledge(), JOINT_SETTINGS)
        single = nadir_of_cameras({0: level.frames[0]}, UW, level.knowledge(), JOINT_SETTINGS)
    assert error_deg(shifted, level.nadir) < 0.02 + error_deg(joint, level.nadir)
    assert error_deg(single, level.nadir) > 3.0 * error_deg(shifted, level.nadir)


def test_two_cameras_that_disagree_leave_the_nadir_ambiguous(level: Instant) -> None:
    """If two cameras disagree and no other information decides, the nadir is ambiguous.

    One of the two images is flipped vertically.
    """
    frames = {0: level.frames[0], 1: np.ascontiguousarray(level.frames[1][::-1])}
    found = nadir_of_cameras(frames, UW, HorizonKnowledge(position=level.position), JOINT_SETTINGS)
    assert found.nadir is None
    assert found.status is HorizonStatus.AMBIGUOUS
    assert "two horizons" in found.reason


def test_two_cameras_outvote_a_third(level: Instant) -> None:
    frames = {0: level.frames[0], 1: level.frames[1], 2: np.ascontiguousarray(level.frames[2][::-1])}
    found = nadir_of_cameras(frames, UW, HorizonKnowledge(position=level.position), JOINT_SETTINGS)
    assert set(found.cameras) == {0, 1}
    assert error_deg(found, level.nadir) < 0.5


def test_an_ambiguous_image_is_searched_again_with_the_nadir_of_the_other_cameras() -> None:
    """The nadir of the other cameras decides which edge of the band in the third image is the limb."""
    tilted = instant(UW, np.array([-0.22, -0.38, 1.0]), np.array([0.8, 0.5, 0.3]), 12)
    frames = {**tilted.frames, 2: np.minimum(tilted.frames[2], tilted.frames[2][::-1])}
    knowledge = HorizonKnowledge(position=tilted.position)
    alone = nadir_of_cameras({2: frames[2]}, UW, knowledge, JOINT_SETTINGS)
    assert alone.status is HorizonStatus.AMBIGUOUS
    found = nadir_of_cameras({k: frames[k] for k in (0, 1, 2)}, UW, knowledge, JOINT_SETTINGS)
    assert found.each[2].nadir is not None
    assert found.each[2].pixels_read > alone.each[2].pixels_read
    assert sorted(found.cameras) == [0, 1, 2]
    assert error_deg(found, tilted.nadir) < 0.3


def test_one_camera_filled_and_the_others_dark_give_a_coarse_nadir() -> None:
    """If the Earth fills one camera and the others are dark, the nadir is coarse.

    The limb is 68 deg from nadir, so the Earth fills a field of 33 deg half width if its centre is up to 25
    deg from nadir.
    """
    boresight = VT[0].in_body(np.array([0.0, 0.0, 1.0]))
    aside = tangent_basis(boresight)
    for seed, off in enumerate((np.array([0.0, 0.0]), np.array([0.15, 0.1]))):
        nadir = boresight + off @ aside
        seen = instant(VT, nadir / np.linalg.norm(nadir), np.array([0.9, 0.3, 0.1]), seed)
        assert nadir_of_cameras(seen.frames, VT, seen.knowledge(), JOINT_SETTINGS).nadir is None
        looks = [image_brightness(frame, VT[number], EARTHLIGHT) for number, frame in seen.frames.items()]
        assert [round(look.share, 1) for look in looks] == [1.0, 0.0, 0.0]
        coarse = coarse_nadir(looks, ALTITUDE, seen.sun_in_body)
        assert coarse is not None
        error = np.arccos(float(coarse.direction @ seen.nadir))
        assert np.degrees(error) < 20.0
        assert np.radians(5.0) < coarse.sigma < np.radians(16.0)
        assert error < 3.0 * coarse.sigma


def test_dark_images_give_no_coarse_nadir() -> None:
    dark = np.full((512, 512), 8, dtype=np.uint8)
    looks = [image_brightness(dark, camera, EARTHLIGHT) for camera in VT]
    assert coarse_nadir(looks, ALTITUDE, np.array([0.0, 0.0, 1.0])) is None


def _changed(changes: Callable[[Hypothesis], Hypothesis]) -> Callable[..., Hypothesis | None]:
    """Return a replacement of `examine` that applies `changes` to every hypothesis."""

    def examined(*arguments: Any) -> Hypothesis | None:
        found = examine(*arguments)
        return None if found is None else changes(found)

    return examined


@pytest.mark.parametrize(
    ("evidence", "sound", "wrong", "status"),
    [
        ("chance", -6.2, -5.8, HorizonStatus.NO_HORIZON),
        ("breadth", 0.14, 0.11, HorizonStatus.NO_HORIZON),
        ("breadth", 1.9, 2.1, HorizonStatus.NO_HORIZON),
        ("altitude_off", 2.9, 3.1, HorizonStatus.REFUSED),
        ("coverage", 0.62, 0.58, HorizonStatus.REFUSED),
        ("night", 0.09, 0.11, HorizonStatus.REFUSED),
    ],
)
def test_a_horizon_counts_up_to_the_limit_of_each_evidence(
    day: tuple[EarthScene, Image],
    monkeypatch: pytest.MonkeyPatch,
    evidence: str,
    sound: float,
    wrong: float,
    status: HorizonStatus,
) -> None:
    """A horizon is accepted up to the documented limit of each quantity, and refused beyond it.

    All other quantities are as in a sunlit frame.
    """
    scene, frame = day
    for value, expected in ((sound, HorizonStatus.FOUND), (wrong, status)):
        changed = _changed(lambda one, value=value: replace(one, **{evidence: value}))  # type: ignore[misc]
        monkeypatch.setattr(f"{find_nadir.__module__}.examine", changed)
        assert find_nadir(frame, MODEL.lens, _gps(scene), SETTINGS).status is expected


@pytest.mark.parametrize(("stray", "status"), [(0.045, HorizonStatus.FOUND), (0.055, HorizonStatus.REFUSED)])
def test_a_twentieth_of_the_dark_sky_may_be_bright(
    day: tuple[EarthScene, Image], monkeypatch: pytest.MonkeyPatch, stray: float, status: HorizonStatus
) -> None:
    scene, frame = day
    changed = _changed(lambda one: replace(one, lighting=replace(one.lighting, stray=stray)))
    monkeypatch.setattr(f"{find_nadir.__module__}.examine", changed)
    found = find_nadir(frame, MODEL.lens, _gps(scene), SETTINGS)
    assert found.status is status
    assert ("bright" in found.reason) is (status is HorizonStatus.REFUSED)


@pytest.mark.parametrize(
    ("enough", "some", "again"), [(1, 4, False), (10_000, 4, True), (10_000, 10_000, False)]
)
def test_an_image_is_read_again_if_it_has_some_edges_but_not_enough(
    day: tuple[EarthScene, Image], enough: int, some: int, again: bool
) -> None:
    scene, frame = day
    settings = replace(SETTINGS, enough_edges=enough, some_edges=some)
    found = find_nadir(frame, MODEL.lens, _gps(scene), settings)
    assert (found.pixels_read > 2 * 32 * 512) is again
    assert found.nadir is not None


def test_a_measurement_states_its_altitude_points_and_tangent_covariance(
    day: tuple[EarthScene, Image],
) -> None:
    scene, frame = day
    found = find_nadir(frame, MODEL.lens, _gps(scene), SETTINGS)
    assert found.nadir is not None
    assert found.view is not None
    assert found.nadir.used == np.count_nonzero(found.on_horizon) == len(found.limb) == len(found.limb_sigma)
    assert found.nadir.altitude == pytest.approx(600e3, abs=15e3)
    assert found.nadir.altitude_sigma == pytest.approx(SETTINGS.altitude_sigma, rel=0.01)
    # The trace of a covariance does not depend on the axes, and the variance along the direction is zero.
    tangent = found.nadir.tangent_covariance
    assert np.trace(tangent) == pytest.approx(np.trace(found.nadir.covariance), rel=1e-6)
    assert found.nadir.sigma == pytest.approx(np.sqrt(0.5 * np.trace(tangent)), rel=1e-6)
    assert found.nadir.covariance @ found.nadir.direction == pytest.approx(np.zeros(3), abs=1e-12)
    assert found.nadir.direction == pytest.approx(found.view.nadir)
    # Because of the Earth's flattening, an altitude above the mean sphere is wrong, and the limb fit improves
    # it.
    sphere = find_nadir(frame, MODEL.lens, HorizonKnowledge(altitude=600e3), SETTINGS)
    assert sphere.nadir is not None
    assert 2e3 < sphere.nadir.altitude_sigma < limb_radius_sigma(600e3)


_FOCAL_SIGMA = 0.02
_TILT, _CLIMB = 0.03, 20e3
"""Change of the nadir (rad) and of the altitude (m) per standard deviation of the focal length."""


def _searched_by_focal_length(
    best: float, width: float, refused: Callable[[float], bool]
) -> Callable[..., SimpleNamespace]:
    """Return a search whose horizon depends on the focal length, which is `step` sigmas from nominal.

    The sum of the squared residuals of the horizon is ((step - best)/width)^2. The tilt of the nadir about y
    and the altitude change linearly with `step`. The trial is `refused` at some focal lengths.
    """

    def searched(image: Any, *_: object) -> SimpleNamespace:
        step = float(np.log(image.camera.focal_length / MODEL.lens.focal_length)) / _FOCAL_SIGMA
        tilt = _TILT * step
        direction = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
        own = 1e-6 * (np.eye(3) - np.outer(direction, direction))
        nadir = NadirMeasurement(direction, own, 600e3 + _CLIMB * step, 5e3, 0.2, 40)
        squares = np.full(60, ((step - best) / width) ** 2 / 60.0)
        squares[0] = np.nan
        squares[1] *= 2.0
        status = HorizonStatus.REFUSED if refused(step) else HorizonStatus.FOUND
        reason = f"refused at {step:.2f}" if refused(step) else ""
        solution = HorizonSolution(status, reason, None if refused(step) else nadir)
        horizon = SimpleNamespace(squares=squares, fit=SimpleNamespace(correlation=1.0, prior=0.0))
        return SimpleNamespace(hypotheses=[horizon], solution=lambda: solution, measured=lambda _: nadir)

    return searched


def _uncertain(
    monkeypatch: pytest.MonkeyPatch, best: float, width: float, refused: Callable[[float], bool]
) -> HorizonSolution:
    found = HorizonSolution(HorizonStatus.NO_HORIZON, "none", points=np.zeros((90, 2)))
    monkeypatch.setattr(nadir_module, "find_nadir", lambda *_: found)
    monkeypatch.setattr(nadir_module, "_contradiction", lambda _: "")
    monkeypatch.setattr(nadir_module, "_search", _searched_by_focal_length(best, width, refused))
    image = np.zeros((512, 512), np.uint8)
    return nadir_of_uncertain_field(image, MODEL.lens, _FOCAL_SIGMA, settings=SETTINGS)


@pytest.mark.parametrize(("best", "width"), [(0.8, 0.5), (-0.5, 2.0), (0.9, 0.1)])
def test_an_uncertain_focal_length_is_weighted_by_its_probability(
    best: float, width: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nadir is the mean over the focal lengths, whose prior and misfit are both normal distributions.

    The product of the two distributions has the mean b/(1 + w^2) and the variance w^2/(1 + w^2). The
    covariance is the sum of that of one horizon and the contribution of the focal length.
    """
    found = _uncertain(monkeypatch, best, width, lambda _: False).nadir
    assert found is not None
    mean, variance = best / (1.0 + width**2), width**2 / (1.0 + width**2)
    assert found.direction == pytest.approx([np.sin(_TILT * mean), 0.0, np.cos(_TILT * mean)], abs=2e-3)
    assert found.altitude == pytest.approx(600e3 + _CLIMB * mean, abs=1.5e3)
    across = np.array([np.cos(_TILT * mean), 0.0, -np.sin(_TILT * mean)])
    assert across @ found.covariance @ across == pytest.approx(1e-6 + _TILT**2 * variance, rel=0.1)
    assert found.covariance[1, 1] == pytest.approx(1e-6, rel=0.01)
    assert found.altitude_sigma == pytest.approx(np.hypot(5e3, _CLIMB * np.sqrt(variance)), rel=0.06)
    assert found.used == 40


def test_an_uncertain_focal_length_is_refused_if_most_of_its_probability_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = _uncertain(monkeypatch, 0.8, 0.5, lambda step: step > 1.3)
    assert few.status is HorizonStatus.FOUND
    assert few.nadir is not None
    # Refused horizons contribute to the mean.
    assert few.nadir.altitude == pytest.approx(600e3 + _CLIMB * 0.64, abs=1.5e3)
    most = _uncertain(monkeypatch, 0.8, 0.5, lambda step: step > 0.4)
    assert most.status is HorizonStatus.REFUSED
    assert most.nadir is None
    # The reason for the refusal is that of the most probable refused focal length.
    assert abs(float(most.reason.removeprefix("refused at ")) - 0.64) < 0.3


def test_an_image_without_edges_is_not_searched_again_with_other_focal_lengths(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object) -> SimpleNamespace:
        raise AssertionError

    image = np.zeros((512, 512), np.uint8)
    few = HorizonSolution(HorizonStatus.NO_HORIZON, "none", points=np.zeros((SETTINGS.some_edges - 1, 2)))
    monkeypatch.setattr(nadir_module, "find_nadir", lambda *_: few)
    monkeypatch.setattr(nadir_module, "_search", fails)
    assert nadir_of_uncertain_field(image, MODEL.lens, 0.02, settings=SETTINGS) is few
    some = replace(few, points=np.zeros((SETTINGS.some_edges, 2)))
    monkeypatch.setattr(nadir_module, "find_nadir", lambda *_: some)
    monkeypatch.setattr(nadir_module, "_search", lambda *_: SimpleNamespace(hypotheses=[]))
    again = nadir_of_uncertain_field(image, MODEL.lens, 0.02, settings=SETTINGS)
    assert (again.status, again.reason, again.nadir) == (HorizonStatus.NO_HORIZON, "none", None)


def _vote(camera: int, tilt: float, edges: int, sigma: float = 1e-3) -> nadir_module._Vote:
    return nadir_module._Vote(
        camera, np.array([np.sin(tilt), 0.0, np.cos(tilt)]), sigma**2 * np.diag([1.0, 1.0, 0.0]), edges
    )


def test_nadirs_agree_within_the_quantile_of_their_difference() -> None:
    """The variance of the difference is twice the sum of the variances.

    A chi-square with two degrees of freedom exceeds 27.6 with a probability of 1e-6.
    """
    limit = np.sqrt(-2.0 * np.log(1e-6) * 2.0 * 5.0) * 1e-3
    for share, agrees in ((0.99, True), (1.01, False)):
        assert nadir_module._same(_vote(0, 0.0, 9), _vote(1, share * limit, 9, 2e-3)) == agrees
    assert not nadir_module._same(_vote(0, 0.0, 9, 9.0), _vote(1, np.pi, 9, 9.0))


def test_the_nadir_of_most_cameras_is_selected() -> None:
    """The group with the most cameras is selected, and of equal groups the one with the most edges.

    Another group of as many cameras makes the result ambiguous if it has more than 30 % of these edges.
    """
    one, two, three = _vote(0, 0.0, 30), _vote(1, 1e-3, 20), _vote(2, 0.8, 90)
    group, rival = nadir_module._agreed([three, one, two])
    assert sorted(vote.camera for vote in group) == [0, 1]
    assert rival == ""
    group, rival = nadir_module._agreed([one, _vote(2, 0.8, 10)])
    assert (len(group), rival) == (0, "the cameras show two horizons 45.8 deg apart")
    group, rival = nadir_module._agreed([one, _vote(2, 0.8, 9)])
    assert ([vote.camera for vote in group], rival) == ([0], "")
    assert nadir_module._agreed([]) == ([], "")
    # Two candidates of one camera do not support each other.
    group, rival = nadir_module._agreed([_vote(0, 0.0, 30), _vote(0, 1e-4, 20), _vote(1, 0.8, 8)])
    assert [vote.camera for vote in group] == [0]
    assert [vote.edges for vote in group] == [30]
    # Of two candidates of one camera, the nearer to the other camera's nadir is used.
    group, _ = nadir_module._agreed([_vote(0, 3e-3, 30), _vote(1, 0.0, 20), _vote(0, 1e-3, 10)])
    assert sum(vote.edges for vote in group) in (30, 50)
    assert len(group) == 2


def test_the_reason_is_that_of_the_most_favourable_camera() -> None:
    none = HorizonSolution(HorizonStatus.NO_HORIZON, "no edges")
    refused = HorizonSolution(HorizonStatus.REFUSED, "bright sky")
    ambiguous = HorizonSolution(HorizonStatus.AMBIGUOUS, "two horizons")
    assert nadir_module._why_none({3: none, 5: refused, 6: ambiguous}) == (
        HorizonStatus.AMBIGUOUS,
        "camera 6: two horizons",
    )
    assert nadir_module._why_none({3: none, 5: refused}) == (HorizonStatus.REFUSED, "camera 5: bright sky")
    assert nadir_module._why_none({3: none}) == (HorizonStatus.NO_HORIZON, "camera 3: no edges")
    assert nadir_module._why_none({}) == (HorizonStatus.NO_HORIZON, "no image")


def test_a_solution_describes_itself_in_one_line() -> None:
    sigma = np.radians([0.3, 0.1])
    nadir = NadirMeasurement(
        np.array([0.0, 0.6, 0.8]),
        np.diag([sigma[0] ** 2, 0.0, 0.0]),
        600e3,
        1e3,
        0.2,
        30,
    )
    found = HorizonSolution(HorizonStatus.FOUND, nadir=nadir)
    assert repr(found) == "<HorizonSolution found: nadir [0.00000, 0.60000, 0.80000], 1 sigma 0.3 deg>"
    refused = HorizonSolution(HorizonStatus.REFUSED, "bright sky")
    assert repr(refused) == "<HorizonSolution refused: bright sky>"
    assert nadir.sigma == pytest.approx(sigma[0] / np.sqrt(2.0))
