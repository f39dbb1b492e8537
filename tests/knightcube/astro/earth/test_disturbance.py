"""Tests of the drag torque on bodies that are not boxes, computed from projected areas."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.earth.disturbance import (
    AIR,
    Pressures,
    box_areas,
    exposed_area,
    mean_density,
    pressures,
    shapes,
)
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.gnc.control.pointing_job import slew
from knightcube.gnc.guidance.slew_model import along
from sim_hal.worlds.free_body import CRAFTS, air_torque, box
from tests.knightcube.gnc.control.pointing_cases import ORBIT
from tests.knightcube.gnc.control.pointing_requests import (
    AXES,
    BEGIN,
    NADIR,
    WISH,
)

ARM = np.array([0.012, -0.009, 0.013])
"""Vector (m) from the centre of mass to the centre of pressure."""
VIEWS = attitude_matrix(normalise(np.random.default_rng(5).normal(size=(200, 4))))
SPEED, DENSITY = 7_600.0, 1e-12


@pytest.mark.parametrize("name", ["knightcube", "cubesat_3u"])
def test_coefficients_fitted_at_ten_attitudes_predict_the_torque_at_others(name: str) -> None:
    """Torque coefficients that are fitted at ten attitudes predict the drag torque at 190 other attitudes.

    Without the projected areas, the errors are more than twice as large.
    """
    craft = CRAFTS[name]
    faces = box(craft.size, ARM, np.zeros(6))
    flight = np.array([1.0, 0.0, 0.0])
    air = Pressures(np.tile(flight, (len(VIEWS), 1)), np.zeros((len(VIEWS), 3)))
    flows = (SPEED * (VIEWS @ flight)).tolist()
    true = np.array([air_torque(faces, (x, y, z), DENSITY) for x, y, z in flows])
    missed = []
    for pressed in (air.facing(box_areas(craft.inertia), VIEWS), air):
        shape = shapes(pressed, VIEWS)[:, :, AIR]
        size = np.linalg.lstsq(shape[:10].reshape(-1, 3), true[:10].reshape(-1), rcond=None)[0]
        error = true[10:] - shape[10:] @ size
        missed.append(float(np.sqrt(np.mean(error**2) / np.mean(true**2))))
    assert missed[0] < 0.05, "the cube's moments are not those of an even cube"
    assert missed[1] > 2.0 * missed[0]


def test_areas_are_one_in_the_mean_also_of_a_body_other_than_a_box() -> None:
    for moments in ([1.0, 1.0, 1.0], [0.0066, 0.0333, 0.0333], [1.0, 1.0, 2.5]):
        areas = box_areas(np.diag(moments))
        assert areas.sum() == pytest.approx(2.0), "the mean share of a side is half its area"
        assert (areas > 0.0).all()


def test_a_slew_meets_the_air_by_the_area_shown_along_its_path() -> None:
    path = slew(BEGIN, WISH, NADIR, AXES, ORBIT, np.inf)
    assert path is not None
    times, areas = np.linspace(0.0, path.horizon, 5), box_areas(BEGIN.inertia)
    met = along(ORBIT, 10.0, areas, path)(times).pressures
    assert met is not None
    plain = pressures(ORBIT, 10.0 + times).air
    share = np.linalg.norm(met.air, axis=1) / np.linalg.norm(plain, axis=1)
    seen = np.einsum("nij,nj->ni", attitude_matrix(path.references(times).quaternion), plain)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    assert share == pytest.approx(np.abs(seen) @ areas)


def test_the_air_meets_a_satellite_along_its_velocity_relative_to_the_rotating_earth() -> None:
    times = np.array([0.0, 700.0, 2_000.0])
    found = pressures(ORBIT, times)
    position, velocity = ORBIT.position_at(times), ORBIT.velocity_at(times)
    omega = 2.0 * np.pi / 86_164.1
    wind = omega * np.stack([-position[:, 1], position[:, 0], np.zeros(3)], axis=1)
    relative = velocity - wind
    towards = found.air / np.linalg.norm(found.air, axis=1, keepdims=True)
    expected = relative / np.linalg.norm(relative, axis=1, keepdims=True)
    np.testing.assert_allclose(towards, expected, atol=1e-5)
    np.testing.assert_allclose(found.light, np.tile([1.0, 0.0, 0.0], (3, 1)), atol=1e-4)


def test_the_air_is_denser_by_day_and_thinner_higher_up() -> None:
    times = np.linspace(0.0, 5_600.0, 57)
    density = np.linalg.norm(pressures(ORBIT, times).air, axis=1)
    position = ORBIT.position_at(times)
    noon = position[:, 0] / np.linalg.norm(position, axis=1)
    assert density[noon > 0.9].min() > 1.5 * density[noon < -0.9].max()
    assert mean_density(EARTH_RADIUS + 500e3) == pytest.approx(1.0, abs=0.05)
    ratios = [mean_density(EARTH_RADIUS + height) for height in (400e3, 450e3, 500e3, 550e3)]
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[0] / ratios[1] == pytest.approx(ratios[2] / ratios[3])
    # At 400 km the density is 3 to 7 times that at 500 km (US Standard Atmosphere 1976: 4.0).
    assert 3.0 < ratios[0] / ratios[2] < 7.0


def test_a_box_shows_its_faces_in_proportion_to_the_cosines() -> None:
    areas = np.array([0.5, 0.7, 0.8])
    directions = np.array([[3.0, 0.0, 0.0], [0.0, -2.0, 0.0], [1.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
    expected = [[0.5], [0.7], [2.0 / np.sqrt(3.0)], [0.0]]
    np.testing.assert_allclose(exposed_area(areas, directions), expected)


@pytest.mark.parametrize("size", [(0.1, 0.1, 0.34), (0.3, 0.2, 0.1)])
def test_the_areas_of_a_homogeneous_box_follow_from_its_moments(size: tuple[float, float, float]) -> None:
    x, y, z = size
    moments = np.array([y**2 + z**2, z**2 + x**2, x**2 + y**2]) * 4.0 / 12.0
    faces = np.array([y * z, z * x, x * y])
    np.testing.assert_allclose(box_areas(np.diag(moments)), 2.0 * faces / faces.sum())


def test_the_torques_are_arms_crossed_with_pressures_in_body_axes() -> None:
    turn = VIEWS[:2]
    air, light = np.array([[1.0, 0.2, 0.0], [0.0, 0.9, -0.3]]), np.array([[0.0, 1.0, 0.5], [0.4, 0.0, 1.0]])
    sizes = np.arange(1.0, 10.0)
    torque = shapes(Pressures(air, light), turn) @ sizes
    for k in range(2):
        expected = np.array([1.0, 2.0, 3.0]) + np.cross([4.0, 5.0, 6.0], turn[k] @ air[k])
        expected += np.cross([7.0, 8.0, 9.0], turn[k] @ light[k])
        np.testing.assert_allclose(torque[k], expected)
