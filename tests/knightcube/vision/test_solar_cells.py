"""Tests of the solar strings with simulated currents: Sun, eclipse, Earth light, and camera order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from knightcube.astro import quaternion
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.earth.sun import ASTRONOMICAL_UNIT, sunlit_share
from knightcube.errors import ArgumentError, UsageError
from knightcube.vision import solar_cells
from knightcube.vision.camera.lens import MountedCamera, Pinhole
from knightcube.vision.solar_cells import (
    CoarseSun,
    CoarseSunStatus,
    FieldAndStrings,
    KnownDirections,
    SolarStringModel,
    StringFix,
    coarse_sun,
)
from knightcube.vision.sun import cameras_by_sun
from sim_hal.emulators.power import SolarCellsModel
from tests.sim_hal.earth_camera.scenes import pointing, random_direction

STRINGS = SolarStringModel()
IDEAL = SolarCellsModel(STRINGS.normals, STRINGS.peaks, np.zeros(6), grazing=0.0, noise=0.0, albedo=0.0)
CAMERA = Pinhole.from_field_of_view(512, 512, np.radians(67.0))


def _reading(seed: int, nadir_known: bool, count: int = 400) -> tuple[FloatArray, FloatArray, int, int]:
    """Return errors (n,), rad, normalised squared errors (n,), and the numbers of both wrong decisions.

    The first number counts sunlit readings that were judged dark. The second number counts dark readings that
    were judged sunlit.
    """
    generator = np.random.default_rng(seed)
    errors, squares, false_dark, false_light = [], [], 0, 0
    for _ in range(count):
        model = SolarCellsModel(STRINGS.normals, STRINGS.peaks, 0.02 * generator.standard_normal(6))
        position = (EARTH_RADIUS + generator.uniform(200e3, 2000e3)) * random_direction(generator)
        sun = ASTRONOMICAL_UNIT * random_direction(generator)
        body = quaternion.attitude_matrix(quaternion.normalise(generator.standard_normal(4)))
        nadir = -body @ position / np.linalg.norm(position) if nadir_known else None
        reading = coarse_sun(model.currents(position, sun, body, generator), STRINGS, nadir)
        lit = float(sunlit_share(position, sun))
        false_dark += lit > 0.9 and reading.status is CoarseSunStatus.DARK
        false_light += lit == 0.0 and reading.status is not CoarseSunStatus.DARK
        if reading.direction is None or reading.basis is None or reading.tangent_covariance is None:
            continue
        truth = body @ (sun - position) / np.linalg.norm(sun - position)
        off = reading.basis @ truth
        errors.append(np.arccos(np.clip(truth @ reading.direction, -1.0, 1.0)))
        squares.append(off @ np.linalg.solve(reading.tangent_covariance, off))
    return np.array(errors), np.array(squares), false_dark, false_light


@pytest.mark.parametrize(("nadir_known", "limit"), [(True, 2.0), (False, 3.5)])
def test_the_coarse_sun_is_accurate_to_a_few_degrees_with_its_covariance(
    nadir_known: bool, limit: float
) -> None:
    """The coarse Sun direction is accurate to a few degrees, and agrees with its covariance.

    The readings are from 400 random positions and attitudes. Each string has a gain error of 2 %, and the
    albedo is 0.3.
    """
    errors, squares, false_dark, false_light = _reading(5, nadir_known)
    assert len(errors) > 250
    assert np.degrees(np.sqrt(np.mean(errors**2))) < limit
    assert np.mean(squares) < 2.3
    assert np.percentile(squares, 95) < 6.0  # 95 % quantile of chi-square with two degrees of freedom
    assert false_dark == 0
    assert false_light == 0


def test_ideal_strings_obey_the_cosine_law_and_give_the_exact_direction() -> None:
    generator = np.random.default_rng(6)
    position = np.array([0.0, 0.0, 7e6])
    for _ in range(20):
        to_sun = random_direction(generator)
        to_sun[2] = abs(to_sun[2])
        sun = position + ASTRONOMICAL_UNIT * to_sun
        currents = IDEAL.currents(position, sun, np.eye(3), generator)
        assert currents == pytest.approx(np.maximum(STRINGS.normals @ to_sun, 0.0), abs=1e-9)
        reading = coarse_sun(currents, SolarStringModel(albedo=1e-3, albedo_sigma=1e-3), None)
        assert reading.direction is not None
        assert np.degrees(np.arccos(min(1.0, float(reading.direction @ to_sun)))) < 3.0


def test_earthlight_on_a_plate_that_faces_the_subsolar_ground_is_albedo_times_the_view_factor() -> None:
    """The Earth light on a plate that faces the subsolar point is the albedo times the view factor (R/r)^2.

    At an altitude of 200 km, the mean solar cosine of the visible ground is within a few per cent of one.
    """
    position = np.array([EARTH_RADIUS + 200e3, 0.0, 0.0])
    model = SolarCellsModel(STRINGS.normals, STRINGS.peaks, np.zeros(6), grazing=0.0, noise=0.0)
    sun = np.array([ASTRONOMICAL_UNIT, 0.0, 0.0])
    currents = model.currents(position, sun, np.eye(3), np.random.default_rng(0))
    view = (EARTH_RADIUS / position[0]) ** 2
    assert currents[0] == pytest.approx(1.0, abs=1e-4)
    assert currents[3] == pytest.approx(0.3 * view, rel=0.05)
    # The four vertical plates receive equal light, at most half of that on the plate that faces the Earth.
    sides = currents[[1, 2, 4, 5]]
    assert np.ptp(sides) < 2e-3
    assert 0.2 * currents[3] < sides.mean() < 0.5 * currents[3]


def test_an_unknown_nadir_gives_the_mean_and_the_covariance_of_all_directions_and_albedos() -> None:
    """If nadir is unknown, the Sun direction has the mean and the covariance over all nadirs and albedos.

    The readings are simulated for 200,000 random nadir directions and albedos.
    """
    generator = np.random.default_rng(11)
    directions = generator.standard_normal((200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    albedo = STRINGS.albedo + STRINGS.albedo_sigma * generator.standard_normal((200_000, 1))
    readings = 0.5 * albedo * (1.0 + directions @ STRINGS.normals.T)
    readings += STRINGS.sigma * generator.standard_normal(readings.shape)
    mean, covariance = solar_cells._earthlight(STRINGS, None)
    assert mean == pytest.approx(readings.mean(axis=0), abs=1e-3)
    assert covariance == pytest.approx(np.cov(readings.T), abs=2e-4)
    assert np.diag(covariance) == pytest.approx(readings.var(axis=0), rel=0.02)


def test_in_eclipse_the_solar_strings_report_darkness() -> None:
    model = SolarCellsModel(STRINGS.normals, STRINGS.peaks, np.zeros(6))
    position = np.array([-7e6, 0.0, 0.0])
    sun = np.array([ASTRONOMICAL_UNIT, 0.0, 0.0])
    reading = coarse_sun(model.currents(position, sun, np.eye(3), np.random.default_rng(1)), STRINGS)
    assert reading.status is CoarseSunStatus.DARK
    assert reading.sigma == np.inf


def test_currents_that_no_sun_direction_explains_are_uncertain() -> None:
    """Currents that no Sun direction explains give an uncertain Sun.

    One string has 1.5 times the largest possible current, or opposite faces have full currents.
    """
    towards = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    good = np.maximum(STRINGS.normals @ towards, 0.0)
    assert coarse_sun(good, STRINGS).status is CoarseSunStatus.FOUND
    for broken in (np.where(np.arange(6) == 1, 1.5, good), np.array([0.9, 0.1, 0.0, 0.9, 0.0, 0.0])):
        assert coarse_sun(broken, STRINGS).status is CoarseSunStatus.UNCERTAIN


def test_the_search_for_the_sun_never_alternates_between_two_directions() -> None:
    """In 300 readings with Earth light, the basis of the last step is normal to the final direction."""
    rng, off = np.random.default_rng(2), []
    for number in range(300):
        towards, nadir = random_direction(rng), random_direction(rng)
        earthlight = 0.5 * max(0.15 + 0.15 * rng.standard_normal(), 0.0) * (1.0 + STRINGS.normals @ nadir)
        currents = np.maximum(STRINGS.normals @ towards, 0.0) + earthlight + 0.025 * rng.standard_normal(6)
        found = coarse_sun(currents, STRINGS, nadir if number % 2 else None)
        if found.direction is not None and found.basis is not None:
            off.append(float(np.abs(found.basis @ found.direction).max()))
    assert len(off) > 250
    assert max(off) < 0.02


def test_wrong_currents_and_strings_are_refused() -> None:
    with pytest.raises(ArgumentError, match=r"currents: .*shape \(6,\)"):
        coarse_sun(np.array([1.0, 2.0]), STRINGS)
    with pytest.raises(ArgumentError, match=r"currents: .*finite"):
        coarse_sun(np.full(6, np.nan), STRINGS)
    for nadir in (np.full(3, np.nan), np.zeros(3), np.ones(2)):
        with pytest.raises(ArgumentError, match="nadir"):
            coarse_sun(np.eye(6)[0], STRINGS, nadir)
    with pytest.raises(UsageError, match="sigma None"):
        SolarStringModel(sigma=None)  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(UsageError, match="normals"):
        SolarStringModel(normals=np.eye(3))
    with pytest.raises(UsageError, match="peaks"):
        SolarStringModel(peaks=np.zeros(6))
    with pytest.raises(UsageError, match="sigma"):
        SolarStringModel(sigma=0.0)


def _cameras() -> list[MountedCamera]:
    """Return the cameras of UW: three side cameras 120 deg apart and a top camera (Meller et al., 4.2)."""
    angles = np.radians([0.0, 120.0, 240.0])
    sides = [np.array([np.cos(a), np.sin(a), 0.0]) for a in angles]
    down = np.array([0.0, 0.0, -1.0])
    mountings = [*(pointing(side, down) for side in sides), pointing(-down, np.array([1.0, 0.0, 0.0]))]
    return [MountedCamera(CAMERA, mounting) for mounting in mountings]


def test_the_camera_that_has_the_sun_is_read_first() -> None:
    cameras = _cameras()
    for index, camera in enumerate(cameras):
        boresight = camera.to_camera[2]
        shares = np.maximum(STRINGS.normals @ boresight, 0.0)
        order = cameras_by_sun(coarse_sun(shares, STRINGS), cameras)
        assert order[0].index == index
        assert order[0].likely
        assert [choice.index for choice in order if choice.likely] == [index]
        assert sorted(choice.index for choice in order) == [0, 1, 2, 3]


def test_a_sun_between_two_fields_is_possible_in_the_nearest_only() -> None:
    """If the Sun is between two fields of view, only the nearest camera counts as a possible one.

    The Sun is 2 deg beyond the edge of a field of view, and the coarse Sun has an error of 3 deg.
    """
    towards = np.array([np.cos(np.radians(35.5)), np.sin(np.radians(35.5)), 0.0])
    basis = np.array([[-towards[1], towards[0], 0.0], [0.0, 0.0, 1.0]])
    sun = CoarseSun(CoarseSunStatus.FOUND, towards, basis, np.radians(3.0) ** 2 * np.eye(2))
    order = cameras_by_sun(sun, _cameras())
    assert not any(choice.likely for choice in order)
    assert [choice.index for choice in order if choice.possible] == [0]


def test_no_camera_is_read_in_the_dark_and_all_without_a_coarse_sun() -> None:
    dark = cameras_by_sun(CoarseSun(CoarseSunStatus.DARK), _cameras())
    assert dark == []
    doubt = cameras_by_sun(CoarseSun(CoarseSunStatus.UNCERTAIN), _cameras())
    assert [choice.index for choice in doubt] == [0, 1, 2, 3]
    assert all(choice.possible for choice in doubt)


_PLATES = SolarStringModel(
    normals=np.array(
        [
            [1.0, 0.0, 0.0],
            [-1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, -1.0, 0.0],
            [0.0, 0.6, 0.8],
            [0.0, 0.0, -1.0],
        ]
    ),
    peaks=np.array([0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),
)


def _unit(x: float, y: float, z: float) -> FloatArray:
    return np.asarray(np.array([x, y, z]) / np.linalg.norm([x, y, z]))


_SKY = KnownDirections(3e-5 * _unit(0.2, 0.5, -0.8), _unit(0.9, -0.3, 0.2), _unit(-0.1, 0.4, 0.9), 0.1, 0.05)


def _currents(attitude: FloatArray, sky: KnownDirections = _SKY) -> FloatArray:
    """Return the currents of the plates for an attitude, by the cosine law and the light of the Earth."""
    matrix = quaternion.attitude_matrix(attitude)
    direct = np.maximum(_PLATES.normals @ matrix @ sky.sun, 0.0)
    reflected = sky.light * 0.5 * (1.0 + _PLATES.normals @ matrix @ sky.nadir)
    return np.asarray(_PLATES.peaks * (direct + reflected))


def _accepted(
    estimator: FieldAndStrings, attitude: FloatArray, currents: FloatArray | None = None
) -> StringFix | None:
    field = quaternion.attitude_matrix(attitude) @ _SKY.field
    known = _currents(attitude) if currents is None else currents
    return estimator.accept(known, field, 1e-7, _SKY)


@pytest.mark.parametrize("seed", range(6))
def test_field_and_strings_give_the_attitude(seed: int) -> None:
    """The attitude maps the known field onto the measured field, and its rotation about the field is found.

    The covariance across the field is that of the measured field; about the field, it is that of the possible
    rotations.
    """
    truth = quaternion.normalise(np.random.default_rng(seed).normal(size=4))
    estimator = FieldAndStrings(_PLATES)
    found = _accepted(estimator, truth)
    assert found is not None
    assert estimator.wrong == ""
    body = quaternion.attitude_matrix(found.quaternion)
    axis = quaternion.attitude_matrix(truth) @ _SKY.field / 3e-5
    assert found.axis == pytest.approx(axis)
    assert body @ _SKY.field / 3e-5 == pytest.approx(axis, abs=1e-9)
    off = quaternion.angle_between(found.quaternion, truth)
    assert off < 5.0 * found.about + np.radians(1.0)
    assert found.about < np.radians(8.0)
    across = 1e-7 / 3e-5
    along = np.outer(axis, axis)
    assert found.covariance == pytest.approx(found.about**2 * along + across**2 * (np.eye(3) - along))


def test_a_failed_string_is_named_and_does_not_change_the_attitude() -> None:
    truth = quaternion.normalise(np.array([0.3, -0.5, 0.2, 0.7]))
    usual = _accepted(FieldAndStrings(_PLATES), truth)
    assert usual is not None
    estimator = FieldAndStrings(_PLATES)
    currents = _currents(truth)
    brightest = int(np.argmax(currents / _PLATES.peaks))
    currents[brightest] = 0.0
    found = _accepted(estimator, truth, currents)
    assert found is not None
    assert estimator.wrong == f"string {brightest + 1} contradicts the other strings or the field"
    assert quaternion.angle_between(found.quaternion, truth) < 5.0 * found.about + np.radians(1.0)


def test_no_attitude_is_found_in_the_dark_or_from_impossible_currents() -> None:
    truth = quaternion.normalise(np.array([0.3, -0.5, 0.2, 0.7]))
    estimator = FieldAndStrings(_PLATES)
    assert _accepted(estimator, truth, 0.09 * _PLATES.peaks) is None
    assert estimator.wrong == "no string has 0.1 of its peak current"
    assert _accepted(estimator, truth, 0.9 * _PLATES.peaks) is None
    assert "contradicts" in estimator.wrong
    assert _accepted(estimator, truth) is not None
    assert estimator.wrong == ""


def test_the_sun_along_the_field_leaves_the_rotation_about_it_undetermined() -> None:
    sky = KnownDirections(3e-5 * _SKY.sun, _SKY.sun, _SKY.sun, 0.1, 0.05)
    truth = quaternion.normalise(np.array([0.3, -0.5, 0.2, 0.7]))
    field = quaternion.attitude_matrix(truth) @ sky.field
    estimator = FieldAndStrings(_PLATES)
    assert estimator.accept(_currents(truth, sky), field, 1e-7, sky) is None
    assert estimator.wrong == ""


def test_earlier_readings_are_propagated_and_forgotten_after_two_minutes() -> None:
    """The possible rotations rotate with the body. Evidence against rotations is forgotten in 120 s."""
    truth = quaternion.normalise(np.array([0.3, -0.5, 0.2, 0.7]))
    step = quaternion.from_rotation_vector(np.array([0.5, -0.3, 0.4]))
    after = quaternion.multiply(step, truth)
    estimator = FieldAndStrings(_PLATES)
    first = _accepted(estimator, truth)
    assert first is not None
    estimator.turn(step, 1.0)
    second = _accepted(estimator, after)
    assert second is not None
    assert quaternion.angle_between(second.quaternion, after) < 5.0 * second.about + np.radians(1.0)
    assert second.about <= first.about + np.radians(1.0)
    against = estimator._against.copy()
    assert against.max() == solar_cells._MOST_VIOLATION
    estimator.turn(quaternion.IDENTITY, 30.0)
    assert estimator._against == pytest.approx(np.maximum(against - 0.75, 0.0))
    estimator.turn(quaternion.IDENTITY, 90.0)
    assert not estimator._against.any()
    _accepted(estimator, after)
    estimator.forget()
    assert not estimator._against.any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_known_field_is_rotated_onto_the_measured_field(sign: float) -> None:
    """A known field that is nearly opposite to the measured field is also rotated onto it."""
    estimator = FieldAndStrings(_PLATES)
    axis = _unit(0.3, 0.4, -0.5)
    known = sign * _unit(0.3, 0.41, -0.5)
    base = estimator._aligned(axis, known)
    assert quaternion.attitude_matrix(base) @ known == pytest.approx(axis, abs=1e-9)
    assert np.linalg.norm(base) == pytest.approx(1.0)
    again = estimator._aligned(axis, known)
    assert quaternion.angle_between(again, base) < 1e-9


def test_misfits_are_chi_squares_with_and_without_each_string() -> None:
    estimator = FieldAndStrings(_PLATES)
    base = quaternion.attitude_matrix(quaternion.normalise(np.array([0.1, 0.2, -0.4, 0.9])))
    axis, tilt = _unit(0.2, -0.6, 0.7), 0.03
    shares = np.array([0.4, 0.1, 0.3, 0.2, 0.7, 0.05])
    whole, without = estimator._misfits(base, shares, axis, tilt, _SKY)
    assert whole.shape == (solar_cells._TURNS,)
    assert without.shape == (6, solar_cells._TURNS)
    for trial in (0, 37, 121):
        turn = quaternion.attitude_matrix(quaternion.from_rotation_vector(np.radians(2.0 * trial) * axis))
        sunlight, slope = solar_cells._sunlight(_PLATES.normals @ turn @ base @ _SKY.sun)
        earth = 0.5 * (1.0 + _PLATES.normals @ turn @ base @ _SKY.nadir)
        left = shares - sunlight - 0.1 * earth
        own = _PLATES.sigma**2 + (tilt**2 + np.radians(2.0) ** 2 / 12.0) * slope**2
        common = solar_cells._COMMON**2 * np.outer(sunlight, sunlight) + 0.05**2 * np.outer(earth, earth)
        covariance = np.diag(own) + common
        assert whole[trial] == pytest.approx(left @ np.linalg.solve(covariance, left))
        for omitted in range(6):
            kept = np.delete(np.arange(6), omitted)
            part = left[kept] @ np.linalg.solve(covariance[np.ix_(kept, kept)], left[kept])
            assert without[omitted, trial] == pytest.approx(part)


def test_a_nadir_of_another_length_and_currents_of_any_size_have_a_result() -> None:
    currents, nadir = np.array([0.8, 0.6, 0.1, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    usual, longer = (coarse_sun(currents, STRINGS, length * nadir) for length in (1.0, 7e6))
    assert usual.direction is not None
    assert longer.direction is not None
    np.testing.assert_allclose(longer.direction, usual.direction, atol=1e-12)
    assert coarse_sun(1e200 * currents, STRINGS, nadir).status is CoarseSunStatus.UNCERTAIN


def test_a_reading_that_is_not_finite_is_refused_and_the_next_one_gives_an_attitude() -> None:
    """A NaN in the excess chi-squares would make every later reading useless."""
    truth, estimator = quaternion.IDENTITY, FieldAndStrings(_PLATES)
    good: dict[str, Any] = {"currents": _currents(truth), "field": _SKY.field, "sigma": 1e-7, "blur": 0.0}
    for name, value in good.items():
        with pytest.raises(ArgumentError, match=name):
            estimator.accept(**{**good, name: np.nan * value}, sky=_SKY)
    for wrong, seconds in ((np.nan * truth, 1.0), (2.0 * truth, 1.0), (truth, np.nan), (truth, -1.0)):
        with pytest.raises(ArgumentError, match=r"^(rotation|seconds): "):
            estimator.turn(wrong, seconds)
    assert estimator.accept(**good, sky=_SKY) is not None
    changes: list[dict[str, Any]] = [
        {"field": np.zeros(3)},
        {"sun": np.nan * _SKY.sun},
        {"light_sigma": -1.0},
    ]
    for change in changes:
        with pytest.raises(ArgumentError, match=next(iter(change))):
            replace(_SKY, **change)
