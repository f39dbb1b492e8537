"""Tests that the arguments of `knightcube command ... point` give the attitude that they describe."""

from __future__ import annotations

import argparse
import math

import numpy as np
import pytest

from flight.link.commands import Point, unpack
from ground.commands import satellite
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import celestial_to_terrestrial, geodetic
from knightcube.astro.quaternion import attitude_matrix
from knightcube.gnc.guidance.attitude_law import BodyAxes, law_of
from tests.support.circular_orbits import JULIAN_DATE, circular

ORBIT = circular(700.0)
TIME = np.array([300.0])
AXES = BodyAxes(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
BEGUN = np.array([0.5, -0.5, 0.1, 0.7]) / np.linalg.norm([0.5, -0.5, 0.1, 0.7])


def turned_by(words: list[str]) -> FloatArray:
    """Return the attitude matrix (3, 3), ICRS to body, that a command gives at `TIME` after packing."""
    parser = argparse.ArgumentParser()
    satellite.configure_command(parser)
    options = parser.parse_args(["--to", "127.0.0.1:1", "point", *words])
    arrived = unpack(satellite.packet_of(options))
    assert isinstance(arrived, Point)
    return attitude_matrix(law_of(arrived.target, AXES, BEGUN, ORBIT, 300.0)(ORBIT, TIME)[0])


UP = ORBIT.position_at(TIME)[0] / np.linalg.norm(ORBIT.position_at(TIME)[0])
AHEAD = np.array([-UP[2], 0.0, UP[0]])
"""Position above the +x axis and direction of motion, on a circular polar orbit."""


@pytest.mark.parametrize(
    ("goal", "direction", "second"),
    [
        ("nadir", -UP, AHEAD),
        ("velocity", AHEAD, -UP),
        ("sun", np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])),
    ],
)
def test_a_goal_is_pointed_at_and_its_roll_is_kept(
    goal: str, direction: FloatArray, second: FloatArray
) -> None:
    free = turned_by([goal])
    np.testing.assert_allclose(free[2], direction, atol=1e-3)
    np.testing.assert_allclose(turned_by([goal, "--roll", "0"])[0], second, atol=2e-3)
    quarter = turned_by([goal, "--roll", "90"])
    np.testing.assert_allclose(quarter[2], direction, atol=1e-3)
    assert abs(float(quarter[0] @ second)) < 2e-3


def test_a_place_below_the_satellite_has_the_attitude_of_nadir() -> None:
    longitude, latitude, _ = geodetic(celestial_to_terrestrial(JULIAN_DATE + 300.0 / 86_400.0) @ (7e6 * UP))
    place = [f"{math.degrees(float(angle)):.6f}" for angle in (latitude, longitude)]
    for roll in ([], ["--roll", "0"]):
        np.testing.assert_allclose(turned_by(["ground", *place, *roll])[2], -UP, atol=0.01)


def test_an_inertial_attitude_is_the_one_that_was_written() -> None:
    found = turned_by(["inertial", "0.6", "0", "0", "0.8"])
    np.testing.assert_allclose(found, attitude_matrix(np.array([0.6, 0.0, 0.0, 0.8])), atol=1e-9)
