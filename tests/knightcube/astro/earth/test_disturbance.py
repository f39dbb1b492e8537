"""Tests of the drag torque on bodies that are not boxes, computed from projected areas."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.earth.disturbance import AIR, Pressures, box_areas, pressures, shapes
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
def test_a_torque_seen_at_one_attitude_tells_those_at_all_others(name: str) -> None:
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
