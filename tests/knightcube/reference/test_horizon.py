"""Tests of the Graphic and the Vector Method with the worked example of their paper."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.reference.horizon import (
    GraphicMethodError,
    HorizonCircle,
    LevelCamera,
    NoCircleError,
    first_edges,
    fit_circle,
    graphic_nadir,
    high_average,
    horizon_plane_depth,
    horizon_points,
    propagated_nadir,
)
from knightcube.vision.horizon.edges import run_filtered
from knightcube.vision.horizon.initial_guess import shortest_turn
from knightcube.vision.horizon.limb import turn

PAPER_POINTS = np.array([[258.0, 128.0], [215.0, 256.0], [200.0, 384.0]])
"""Edge points (px) of the MAQSAT picture in the paper (Meller et al., section 3.1)."""


def test_the_papers_three_points_give_its_circle_to_its_digits() -> None:
    circle = fit_circle(PAPER_POINTS)
    # The paper states (837.17, 393.79) and 637.3. The unrounded values are 837.1786, 393.7905 and 637.2538.
    assert circle.centre == pytest.approx([837.1786, 393.7905], abs=5e-5)
    assert circle.radius == pytest.approx(637.2538, abs=5e-5)
    assert np.floor(100.0 * circle.centre) / 100.0 == pytest.approx([837.17, 393.79])
    assert round(circle.radius, 1) == 637.3
    assert circle.distances(PAPER_POINTS) == pytest.approx(np.zeros(3), abs=1e-9)


def test_scan_lines_with_the_papers_edges_lead_to_the_papers_circle() -> None:
    """Scan lines with the paper's edge points give the circle of the paper.

    Each line has a dark sky, a bright Earth from the published pixels on, noise, a star and a dark gap.
    """
    generator = np.random.default_rng(3)
    lines = generator.normal(12.0, 3.0, (3, 512))
    for line, (start, _) in zip(lines, PAPER_POINTS, strict=True):
        line[int(start) :] += generator.uniform(150.0, 200.0, 512 - int(start))
        line[100] = 255.0
        line[int(start) + 60 : int(start) + 62] = 20.0
    found = horizon_points(np.clip(lines, 0, 255).astype(np.uint8))
    assert found.tolist() == [258, 215, 200]
    circle = fit_circle(np.stack([found, PAPER_POINTS[:, 1]], axis=1))
    assert circle.radius == pytest.approx(637.25, abs=0.01)


def test_the_high_average_is_of_the_bright_half() -> None:
    assert high_average(np.array([[0, 10, 100, 200], [5, 5, 5, 5]])).tolist() == [150.0, 5.0]


def test_short_runs_are_filtered_whichever_way_they_go() -> None:
    line = np.zeros((1, 30), dtype=bool)
    line[0, 12:] = True
    spoilt = line.copy()
    spoilt[0, [4, 20, 21]] = [True, False, False]
    assert np.array_equal(run_filtered(spoilt), line)
    assert first_edges(run_filtered(spoilt)).tolist() == [12]
    assert first_edges(np.ones((1, 5), dtype=bool)).tolist() == [-1]


def test_more_than_three_points_of_a_circle_give_it_too() -> None:
    angle = np.linspace(0.3, 1.4, 9)
    points = 50.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + [3.0, -7.0]
    circle = fit_circle(points)
    assert circle.centre == pytest.approx([3.0, -7.0], abs=1e-9)
    assert circle.radius == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("points", "complaint"),
    [
        (np.zeros((2, 2)), "needs at least three"),
        (np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]]), "one line"),
    ],
)
def test_points_on_no_circle_are_refused(points: FloatArray, complaint: str) -> None:
    with pytest.raises(NoCircleError, match=complaint):
        fit_circle(points)


ALTITUDE = 380e3
FOCAL = 386.77
"""Focal length (px): 512 px across 67 deg."""
CAMERAS = (
    # If the boresight is along body x, body y is to the right. If the boresight is along body y, -x is to the
    # right. Rows run down along body z.
    LevelCamera(np.array([0.0, 1.0]), (255.5, 255.5)),
    LevelCamera(np.array([-1.0, 0.0]), (255.5, 255.5)),
)
BORESIGHTS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _seen_circle(camera: LevelCamera, boresight: FloatArray, nadir: FloatArray) -> HorizonCircle:
    """Return the circle through three limb points near the image centre, projected exactly."""
    right = np.array([*camera.right, 0.0])
    down = np.array([0.0, 0.0, 1.0])
    cosine = np.sqrt(1.0 - (6_371_008.8 / (6_371_008.8 + ALTITUDE)) ** 2)
    x = np.array([-20.0, 0.0, 20.0]) / FOCAL
    # Bisection solves (b + x r + y d) . n = cosine |b + x r + y d| for y.
    low, high = np.full(3, -2.0), np.full(3, 5.0)
    for _ in range(80):
        y = 0.5 * (low + high)
        ray = boresight + x[:, None] * right + y[:, None] * down
        inside = ray @ nadir > cosine * np.linalg.norm(ray, axis=1)
        low, high = np.where(inside, low, y), np.where(inside, y, high)
    return fit_circle(np.stack([x, y], axis=1) * FOCAL + camera.axis)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (2.0, 0.0), (0.0, -2.0), (1.5, 1.0)])
def test_two_level_cameras_show_a_small_tilt(tilt_deg: tuple[float, float]) -> None:
    tilt = np.radians(tilt_deg)
    nadir = turn(np.array([tilt[0], tilt[1], 0.0])) @ np.array([0.0, 0.0, 1.0])
    circles = [_seen_circle(camera, sight, nadir) for camera, sight in zip(CAMERAS, BORESIGHTS, strict=True)]
    found = graphic_nadir(CAMERAS, (circles[0], circles[1]), ALTITUDE)
    assert np.degrees(np.arccos(min(1.0, found @ nadir))) < 0.05 * np.hypot(*tilt_deg) + 0.01


def test_the_horizon_plane_lies_below_by_the_tangents_projection() -> None:
    """The plane of the horizon is 739 km lower than the projection of the tangent suggests (errata, 4.1).

    At an altitude of 380 km, the limb is 2,233 km away and 19.3 deg below the horizontal.
    """
    assert horizon_plane_depth(ALTITUDE) == pytest.approx(2_233e3 * np.sin(np.radians(19.32)), rel=1e-3)


def test_cameras_that_look_the_same_way_are_refused() -> None:
    circle = HorizonCircle(np.array([255.5, 900.0]), 600.0)
    with pytest.raises(GraphicMethodError, match="nearly parallel"):
        graphic_nadir((CAMERAS[0], CAMERAS[0]), (circle, circle), ALTITUDE)


def test_nadir_is_propagated_by_the_shortest_rotation_of_a_line_of_sight() -> None:
    """Nadir is propagated exactly by the shortest rotation of a line of sight, as equation (6) states.

    The axis of the shortest rotation is normal to the line of sight.
    """
    before = np.array([0.0, 0.0, 1.0])
    rotation = turn(np.array([0.02, -0.01, 0.0]))
    nadir = np.array([0.1, 0.9, 0.3])
    nadir /= np.linalg.norm(nadir)
    assert propagated_nadir(nadir, before, rotation @ before) == pytest.approx(rotation @ nadir, abs=1e-12)


def test_the_shortest_turn_is_a_rotation_even_between_opposites() -> None:
    generator = np.random.default_rng(1)
    for _ in range(20):
        one, other = (v / np.linalg.norm(v) for v in generator.standard_normal((2, 3)))
        for target in (other, -one, one):
            matrix = shortest_turn(one, target)
            assert matrix @ one == pytest.approx(target, abs=1e-9)
            assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
            assert np.linalg.det(matrix) == pytest.approx(1.0)
