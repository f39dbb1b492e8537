"""Tests of the fit of objects beside stars, on exact images and on frames of satellites near stars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro import catalogue
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.objects import measure
from knightcube.vision.objects.measure import (
    CatalogueTrails,
    FramePatches,
    ObjectPatch,
    Trails,
    measure_points,
)
from knightcube.vision.objects.settings import FLOOR_PX, ObjectMeasurementSettings
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.sky_map import SkyMap
from knightcube.vision.startracker.survey import DetectionSettings, survey
from knightcube.vision.streaks.streak_result import FrameMotion, StreakStatus
from tests.knightcube.vision.satellite_frames import CAMERA, HELD, Shot
from tests.sim_hal.star_camera.scenes import integrated_by_brute_force
from tests.support.scenes import catalogue as sky_to


def _star(brightest: float, faintest: float) -> FloatArray:
    """Return the position (2,) px of an isolated star in the magnitude range, away from the border."""
    stars, directions = sky_to(8.5)
    places = CAMERA.pinhole.project(directions @ attitude_matrix(HELD).T)
    inside = np.all((places > 60.0) & (places < 450.0), axis=1)
    for number in np.flatnonzero(inside & (stars.magnitude > brightest) & (stars.magnitude < faintest)):
        away = np.linalg.norm(places - places[number], axis=1)
        if np.sum(away < 12.0) == 1:
            return np.asarray(places[number])
    raise AssertionError("no star of that magnitude is alone")


@pytest.mark.parametrize(("apart", "magnitude", "star"), [(2.0, 4.0, 5.0), (3.0, 5.5, 5.0), (1.5, 3.0, 4.5)])
def test_an_object_beside_a_catalogue_star_is_measured_correctly(
    apart: float, magnitude: float, star: float
) -> None:
    place = _star(star - 0.5, star + 0.5) + apart * np.array([0.6, 0.8])
    shot = Shot(place, np.array([0.8, -0.3]), magnitude, np.zeros(3))
    sighted = shot.found().objects
    assert sighted is not None
    own = shot.sighting(sighted)
    assert own is not None
    focal = CAMERA.pinhole.focal_length
    claim = np.sqrt(0.5 * np.trace(sighted.covariance[own])) * focal
    assert claim < 0.06
    # The limit is the 99.99 % quantile of chi-square with two degrees of freedom.
    assert np.linalg.norm(sighted.points[own] - place) < 4.3 * claim
    assert abs(sighted.magnitudes[own] - magnitude) < 0.3
    assert len(sighted.points) == 1


def test_stars_alone_are_not_reported_as_objects() -> None:
    far = Shot(np.array([-900.0, -900.0]), np.zeros(2), 4.0, np.zeros(3))
    sighted = far.found().objects
    assert sighted is not None
    assert not len(sighted.points)


@pytest.mark.parametrize("knows", [True, False])
@pytest.mark.parametrize(("turn", "magnitude"), [(0.0, -1.0), (0.02, 2.0)])
def test_a_bright_satellite_is_not_identified_as_a_star(turn: float, magnitude: float, knows: bool) -> None:
    """Neither the star identification nor the second fit identifies a bright satellite as a star."""
    place, motion = np.array([203.3, 301.8]), np.array([2.5, 1.0])
    shot = Shot(place, motion, magnitude, np.array([0.0, turn, 0.0]), knows)
    found = shot.found()
    solution = found.solution
    assert solution is not None
    assert solution.fix is not None
    assert angle_between(solution.fix.quaternion, HELD) < 3e-4
    away = np.linalg.norm(solution.points - place, axis=1)
    assert not np.any((away < 3.0) & (solution.star >= 0))
    error = 6.0 * np.sqrt(np.trace(solution.fix.covariance))
    assert angle_between(solution.fix.quaternion, HELD) < error
    assert turn > 0.0 or shot.sighting(found.objects) is not None


def test_the_catalogue_holds_stars_only() -> None:
    """The catalogue contains only stars. Hipparcos numbers end at 120,416.

    The fastest star is Barnard's Star with 10.4" per year.
    """
    stars = catalogue.load()
    assert len(np.unique(stars.hip)) == len(stars.hip)
    assert stars.hip.min() >= 1
    assert stars.hip.max() <= 120_416
    assert np.linalg.norm(stars.proper_motion, axis=1).max() < np.radians(10.4 / 3600.0)
    guides = default_index().stars
    near = np.array([(stars.directions_at(guides.epoch) @ one).max() for one in guides.direction[::500]])
    assert np.all(np.arccos(np.clip(near, -1.0, 1.0)) < 1e-4)


def _drawn(
    shape: tuple[int, int], objects: list[tuple[float, float, float, float, float]], psf: float
) -> FloatArray:
    """Return the image of trails, each given by x, y, half extent (x, y) and flux."""
    image, part = np.zeros(shape), np.linspace(-1.0, 1.0, 400)[:, None]
    for x, y, dx, dy, flux in objects:
        where = np.array([x, y]) + part * np.array([dx, dy])
        image += integrated_by_brute_force(shape, where, flux, psf)
    return image


_CORNER = np.array([100, 200])


def _patch(light: FloatArray, ceiling: float = 1e9) -> ObjectPatch:
    return ObjectPatch(light, _CORNER, 5.0, 2.0, light < ceiling, 1.1, ceiling)


def test_the_points_of_a_trail_are_evenly_spaced_over_its_length() -> None:
    points, share = measure._trail(np.array([5.0, 7.0]), np.array([3.0, -4.0]))
    spacing = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert spacing == pytest.approx(np.full(len(points) - 1, 10.0 / len(points)))
    assert spacing[0] <= measure._STEP_PX < 10.0 / (len(points) - 1)
    assert points.mean(axis=0) == pytest.approx([5.0, 7.0])
    assert points == pytest.approx(np.array([5.0, 7.0]) + share[:, None] * np.array([3.0, -4.0]))
    assert share == pytest.approx(-share[::-1])
    assert len(measure._trail(np.zeros(2), np.array([0.1, 0.0]))[0]) == 4


def test_an_object_beside_a_star_is_fitted_exactly_in_an_exact_image() -> None:
    """The fit finds position and flux of an object beside a star that is brighter than in the catalogue.

    The covariance is the inverse information matrix of all unknowns, with the priors on extent and star.
    """
    ours, star = (112.3, 209.6, 2.0, -1.0, 4000.0), (117.8, 212.9, 1.0, 1.0, 2500.0)
    at_corner = [(x - 100.0, y - 200.0, dx, dy, flux) for x, y, dx, dy, flux in (ours, star)]
    light = _drawn((22, 26), at_corner, 1.1) + 3.0
    stars = Trails(np.array([star[:2]]), np.array([star[2:4]]), np.array([2300.0]))
    found = measure._fit_object(_patch(light), np.array([111.9, 209.9]), np.array([1.6, -0.8]), 3000.0, stars)
    assert found is not None
    assert found.middle == pytest.approx(ours[:2], abs=0.01)
    assert found.flux == pytest.approx(4000.0, rel=0.01)
    assert found.misfit < 0.05

    def counts(values: FloatArray) -> FloatArray:
        x, y, dx, dy, flux, sky, other = values
        own, beside = (x, y, dx, dy, flux), (*at_corner[1][:4], other)
        return np.asarray(_drawn((22, 26), [own, beside], 1.1) + sky).reshape(-1)

    true = np.array([12.3, 9.6, 2.0, -1.0, 4000.0, 3.0, 2500.0])
    steps = np.array([1e-3, 1e-3, 1e-3, 1e-3, 1.0, 0.01, 1.0])
    change = np.array([(counts(true + d) - counts(true - d)) / (2.0 * d.sum()) for d in np.diag(steps)])
    information = (change / (25.0 + light.ravel() / 2.0)) @ change.T
    sigma = measure.STAR_SIGMA * 2300.0
    information += np.diag([0.0, 0.0, measure._EXTENT**-2, measure._EXTENT**-2, 0.0, 0.0, sigma**-2])
    covariance = np.linalg.inv(information)
    assert found.covariance == pytest.approx(covariance[:2, :2], rel=0.03)
    assert found.flux_sigma == pytest.approx(np.sqrt(covariance[4, 4]), rel=0.03)


def test_residuals_beyond_the_noise_increase_the_covariance() -> None:
    rng = np.random.default_rng(6)
    light = _drawn((19, 21), [(10.2, 9.1, 0.5, 0.5, 6000.0)], 1.1)
    noise = rng.normal(size=light.shape) * np.sqrt(25.0 + light / 2.0)
    nobody = Trails(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    start = np.array([110.0, 209.0]), np.array([0.3, 0.3]), 5000.0, nobody
    usual = measure._fit_object(_patch(light + noise), *start)
    noisy = measure._fit_object(_patch(light + 3.0 * noise), *start)
    assert usual is not None
    assert noisy is not None
    assert usual.misfit == pytest.approx(1.0, abs=3.0 * np.sqrt(2.0 / 393.0))
    assert noisy.misfit == pytest.approx(9.0, rel=0.25)
    ratio = noisy.covariance / usual.covariance
    assert np.diag(ratio) == pytest.approx([noisy.misfit] * 2, rel=0.15)
    assert np.abs(usual.middle - [110.2, 209.1]).max() < 5.0 * np.sqrt(usual.covariance.max())


def test_the_fit_of_an_object_fails_without_light_or_pixels() -> None:
    light = _drawn((19, 21), [(10.2, 9.1, 0.5, 0.5, 6000.0)], 1.1)
    nobody = Trails(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    start = np.array([110.0, 209.0]), np.array([0.3, 0.3]), 5000.0, nobody
    assert measure._fit_object(_patch(light), *start) is not None
    assert measure._fit_object(_patch(-light), *start) is None
    few = _patch(light)
    for pixels, fails in ((7, True), (8, False)):
        usable = np.zeros(light.shape, dtype=np.bool_)
        usable.reshape(-1)[np.argsort(-light, axis=None)[:pixels]] = True
        assert (measure._fit_object(replace(few, usable=usable), *start) is None) == fails
    # Saturated pixels are not used. The flux is that of the other pixels.
    clipped = np.minimum(light, 500.0)
    assert np.count_nonzero(light >= 500.0) > 2
    found = measure._fit_object(_patch(clipped, 500.0), *start)
    assert found is not None
    assert found.flux == pytest.approx(6000.0, rel=0.05)
    assert found.middle == pytest.approx([110.2, 209.1], abs=0.02)


_PSF = 1.1


def _seen(objects: list[tuple[float, float, float, float, float]], noise: float = 4.0) -> FloatArray:
    draw = np.random.default_rng(3)
    return np.rint(300.0 + draw.normal(0.0, noise, (140, 170)) + _drawn((140, 170), objects, _PSF))


_STARS = CatalogueTrails(
    np.array([[60.4, 50.2], [120.7, 90.3], [30.0, 100.0]]), np.zeros((3, 2)), np.array([5.0, 6.0, 9.0])
)
_ZERO = 5.0 + 2.5 * np.log10(9000.0)
"""Magnitude of one count, so that the star of magnitude 5 has 9,000 counts."""
_POINTS = [(60.4, 50.2, 0.0, 0.0, 9000.0), (120.7, 90.3, 0.0, 0.0, 9000.0 * 10.0**-0.4)]


def _patches(objects: list[tuple[float, float, float, float, float]]) -> FramePatches:
    seen = survey(_seen(objects).astype(np.uint16), DetectionSettings(psf_sigma=_PSF, gain=1.0))
    return FramePatches(seen, _STARS, _ZERO, _PSF)


def test_an_object_merged_with_a_star_is_found_beside_it() -> None:
    """Light that the star beside it does not explain is an object, if it is bright and distant enough."""
    place = np.array([64.0, 52.5])
    found = _patches([*_POINTS, (*place, 0.0, 0.0, 4000.0)]).beside(np.array([61.0, 50.7]), 4.0, 25.0)
    assert found is not None
    assert found.middle == pytest.approx(place, abs=0.15)
    assert found.flux == pytest.approx(4000.0, rel=0.1)
    alone = _patches(_POINTS)
    assert alone.beside(np.array([60.4, 50.2]), 2.0, 25.0) is None
    # The second star of a close pair is too near the first to be an object.
    pair = _patches([*_POINTS, (60.9, 50.6, 0.0, 0.0, 4000.0)])
    assert pair.beside(np.array([60.5, 50.3]), 2.0, 25.0) is None
    # An object with a tenth of the star's light may be an error of the star's image.
    faint = _patches([*_POINTS, (*place, 0.0, 0.0, 900.0)])
    assert faint.beside(np.array([60.5, 50.3]), 4.0, 10.0) is None
    assert alone.beside(np.array([2.0, 50.0]), 2.0, 25.0) is None


def test_objects_are_fitted_within_the_image() -> None:
    patches = _patches([*_POINTS, (90.3, 30.6, 2.0, 1.0, 5000.0)])
    found = patches.measured(np.array([90.0, 31.0]), np.array([1.5, 0.8]), 4000.0)
    assert found is not None
    assert found.middle == pytest.approx([90.3, 30.6], abs=0.1)
    assert found.flux == pytest.approx(5000.0, rel=0.05)
    # The patch reaches five standard deviations of the PSF beyond the half extent.
    reach = measure._patch_reach(np.array([0.8, -1.5]), _PSF)
    assert reach == pytest.approx(1.5 + measure._REACH * _PSF)
    first, right, bottom = int(np.ceil(reach)), 169 - int(np.ceil(reach)), 139 - int(np.ceil(reach))
    for x, y in ((first, 60), (right, 60), (60, first), (60, bottom)):
        assert patches._patch(np.array([x, y]), reach) is not None
    for x, y in ((first - 1, 60), (right + 1, 60), (60, first - 1), (60, bottom + 1)):
        assert patches._patch(np.array([x, y]), reach) is None
    patch = patches._patch(np.array([90.2, 30.7]), 7.0)
    assert patch is not None
    assert patch.corner.tolist() == [83, 24]
    assert patch.light.shape == (15, 15)
    assert patch.noise == pytest.approx(4.0, rel=0.1)
    assert patch.light.sum() == pytest.approx(5000.0, rel=0.05)
    # Stars with a flux above three times the noise of a pixel are fitted together with the object.
    near = patches._near(np.array([90.0, 30.0]), patch)
    assert len(near.flux) == 0
    wide = patches._patch(np.array([72.0, 50.0]), 12.0)
    assert wide is not None
    assert patches._near(np.array([72.0, 50.0]), wide).flux == pytest.approx([9000.0])


def test_objects_among_points_are_areas_without_a_catalogue_star() -> None:
    """Areas far from catalogue stars are objects with a magnitude relative to the stars of the image."""
    objects = [*_POINTS, (30.2, 100.1, 0.0, 0.0, 9000.0 * 10.0**-1.6), (95.3, 30.6, 2.0, 1.0, 5000.0)]
    seen = survey(_seen(objects).astype(np.uint16), DetectionSettings(psf_sigma=_PSF, gain=1.0))
    settings = ObjectMeasurementSettings()
    ((fit, zero),) = measure._among_points(seen, _STARS, settings)
    assert fit.middle == pytest.approx([95.3, 30.6], abs=0.1)
    # The median of the stars' zero points is that of the star of magnitude 6.
    assert zero == pytest.approx(_ZERO, abs=0.15)
    magnitude = zero - 2.5 * np.log10(fit.flux)
    assert magnitude == pytest.approx(5.0 + 2.5 * np.log10(9.0 / 5.0), abs=0.2)
    brighter = replace(settings, faintest=float(magnitude) - 0.3)
    assert measure._among_points(seen, _STARS, brighter) == []
    far = replace(settings, clearance=200.0)
    assert measure._among_points(seen, _STARS, far) == []
    nobody = CatalogueTrails(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    assert measure._among_points(seen, nobody, settings) == []
    # Without a star at its catalogue position, no magnitude is known.
    elsewhere = CatalogueTrails(_STARS.middle + 30.0, _STARS.half, _STARS.magnitude)
    assert measure._among_points(seen, elsewhere, settings) == []


def test_points_of_light_are_measured_without_a_motion() -> None:
    """Significant areas of a frame are points, brightest first, with the errors of their centroids."""
    camera = Pinhole(170, 140, 900.0)
    objects = [*_POINTS, (95.3, 30.6, 0.0, 0.0, 20000.0), (2.2, 70.3, 0.0, 0.0, 9000.0)]
    frame = _seen(objects).astype(np.uint16)
    found = measure_points(
        frame,
        camera,
        0.2,
        FrameMotion(StreakStatus.TOO_SHORT, 0, 0.2),
        ObjectMeasurementSettings(),
        DetectionSettings(),
    )
    assert found.points == pytest.approx(np.array([[95.3, 30.6], [60.4, 50.2], [120.7, 90.3]]), abs=0.1)
    assert np.all(np.diff(found.flux) < 0.0)
    assert found.flux == pytest.approx([20000.0, 9000.0, 3583.0], rel=0.06)
    assert not found.moving.any()
    assert found.directions == pytest.approx(camera.unit_vectors(found.points))
    assert np.all(found.sigma >= FLOOR_PX / 900.0)
    assert np.all(found.sigma < 1.5 * FLOOR_PX / 900.0)


def test_catalogue_stars_have_the_trails_of_the_rotation() -> None:
    """A star moves as v' = -omega x v, half of the rotation before mid-exposure and half of it after."""
    camera = Pinhole(400, 300, 900.0)
    sky = SkyMap(camera, HELD)
    rotation = np.array([0.004, -0.01, 0.02])
    found = measure._stars_in(sky, 2026.0, (300, 400), rotation)
    still = measure._stars_in(sky, 2026.0, (300, 400), np.zeros(3))
    assert not still.half.any()
    assert np.array_equal(still.middle, found.middle)
    stars = catalogue.load()
    places = camera.project(stars.directions_at(2026.0) @ attitude_matrix(HELD).T)
    inside = camera.contains(places)
    assert np.count_nonzero(inside) > 20
    for place, magnitude in zip(places[inside], stars.magnitude[inside], strict=True):
        nearest = int(np.argmin(np.linalg.norm(found.middle - place, axis=1)))
        assert found.middle[nearest] == pytest.approx(place, abs=1e-6)
        assert np.any(found.magnitude[np.linalg.norm(found.middle - place, axis=1) < 1e-6] == magnitude)
        ray = camera.unit_vectors(place[None])
        step = 0.5 * np.cross(rotation, ray)
        moved = camera.project(ray - step) - camera.project(ray + step)
        assert found.half[nearest] == pytest.approx(0.5 * moved[0], abs=0.02)


def test_areas_have_a_significance_relative_to_the_noise_of_their_pixels() -> None:
    seen = survey(_seen(_POINTS).astype(np.uint16), DetectionSettings(psf_sigma=_PSF, gain=1.0))
    noise = float(np.median(seen.sky.noise.values))
    expected = seen.areas.flux / (noise * np.sqrt(seen.areas.pixels))
    assert measure._significances(seen) == pytest.approx(expected)
    assert noise == pytest.approx(4.0, rel=0.1)
    assert measure._faintness(np.array([100.0, 0.0])) == pytest.approx([5.0, -22.5])
