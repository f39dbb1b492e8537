"""Tests of the positions and colours of marks on pictures, with solutions of known geometry."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from ground import pictures
from ground.pictures import (
    OBJECT,
    STREAK,
    UNUSED,
    draw_circle,
    draw_horizon,
    draw_marks,
    draw_ring,
    draw_solution,
    outlined,
)
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.camera.lens import Pinhole
from knightcube.vision.horizon.limb import Ellipsoid, LimbView

pytest.importorskip("PIL.Image", reason="needs the extra `images`")
Picture = npt.NDArray[np.uint8]
GREEN, YELLOW = (0, 158, 115), (240, 228, 66)


def grey(rows: int, columns: int) -> Picture:
    return np.full((rows, columns, 3), 100, np.uint8)


def places(picture: Picture, colour: tuple[int, int, int]) -> set[tuple[int, int]]:
    """Return (x, y) of each pixel with this colour."""
    rows, columns = np.nonzero(np.all(picture == colour, axis=2))
    return set(zip(columns.tolist(), rows.tolist(), strict=True))


def distances(picture: Picture, colour: tuple[int, int, int], x: float, y: float) -> FloatArray:
    """Return the distances (px) of all pixels of a colour from a point, as far as they are below 20 px."""
    found = np.array(sorted(places(picture, colour)), dtype=float).reshape(-1, 2)
    apart = np.hypot(found[:, 0] - x, found[:, 1] - y)
    return np.asarray(apart[apart < 20.0])


# Rings and outlines.


@pytest.mark.parametrize("radius", [1.0, 5.0, 12.0])
def test_a_ring_is_closed_and_has_its_radius(radius: float) -> None:
    picture = grey(60, 80)
    draw_ring(picture, np.array([40.3, 25.6]), radius, STREAK)
    apart = distances(picture, STREAK, 40.3, 25.6)
    assert np.abs(apart - radius).max() < 0.75
    angles = np.sort([np.arctan2(y - 25.6, x - 40.3) for x, y in places(picture, STREAK)])
    gaps = np.diff(np.append(angles, angles[0] + 2.0 * np.pi))
    assert gaps.max() * radius < 2.0, "no gap is wider than a diagonal step and the rounding"


def test_a_ring_is_clipped_at_the_edge_and_unknown_positions_have_no_ring() -> None:
    picture = grey(30, 40)
    draw_ring(picture, np.array([0.0, 29.0]), 4.0, OBJECT)
    assert {(4, 29), (0, 25)} <= places(picture, OBJECT)
    assert all(x >= 0 and y <= 29 for x, y in places(picture, OBJECT))
    draw_ring(picture, np.array([39.0, 0.0]), 3.0, UNUSED)
    assert {(36, 0), (39, 3)} <= places(picture, UNUSED)
    assert (0, 3) not in places(picture, UNUSED)
    plain = grey(30, 40)
    draw_ring(plain, np.array([np.nan, 5.0]), 4.0, OBJECT)
    assert not places(plain, OBJECT)


@pytest.mark.parametrize(("columns", "width"), [(300, 1), (1024, 2), (2048, 3)])
def test_the_outline_is_proportional_to_the_picture(columns: int, width: int) -> None:
    plain = grey(30, columns)
    drawn = plain.copy()
    drawn[15, 20] = STREAK
    edged = outlined(plain, drawn)
    assert places(edged, STREAK) == {(20, 15)}
    black = places(edged, (0, 0, 0))
    assert len(black) == (2 * width + 1) ** 2 - 1
    assert (20 + width, 15 + width) in black
    assert not places(drawn, (0, 0, 0))


def test_streaks_and_objects_have_their_colours_and_radii() -> None:
    ends = np.array([[[30.0, 30.0], [70.0, 30.0]], [[110.0, 30.0], [150.0, 30.0]]])
    objects = [np.array([[50.0, 90.0], [120.0, 90.0]])]
    drawn = draw_marks(grey(130, 200), ends, np.array([True, False]), objects)
    for x, colour in ((30.0, STREAK), (70.0, STREAK), (110.0, UNUSED), (150.0, UNUSED)):
        assert distances(drawn, colour, x, 30.0) == pytest.approx(6.0, abs=0.75)
        assert len(distances(drawn, colour, x, 30.0)) > 20
    for x in (50.0, 120.0):
        apart = distances(drawn, OBJECT, x, 90.0)
        assert (apart.min(), apart.max()) == pytest.approx((12.0, 13.0), abs=0.8)
        assert np.sum(apart > 12.75) > 20


# Plate solutions.

CAMERA = Pinhole(400, 300, 800.0)
SIRIUS, UNNAMED = 32349, 7


def sky(vectors: FloatArray, hips: list[int], magnitudes: list[float]) -> Any:
    """Return a catalogue of stars at directions in ICRS, the brightest first."""

    def brighter_than(limit: float) -> Any:
        kept = np.array(magnitudes) <= limit
        return SimpleNamespace(direction=vectors[kept], hip=np.array(hips)[kept])

    return SimpleNamespace(stars=SimpleNamespace(magnitude=np.array(magnitudes), brighter_than=brighter_than))


def solution(
    points: FloatArray, star: list[int], attitude: FloatArray | None, *, mirrored: bool = False
) -> Any:
    index = np.array(star, dtype=np.int64)
    fix = None if attitude is None else SimpleNamespace(quaternion=attitude)
    return SimpleNamespace(
        points=points, star=index, matched=index >= 0, fix=fix, camera=CAMERA, mirrored=mirrored
    )


def in_sky(points: list[tuple[float, float]], attitude: FloatArray) -> FloatArray:
    """Return the directions (n, 3) in ICRS of pixels."""
    x, y = np.array(points, dtype=float).T
    rays = np.stack([x - CAMERA.centre[0], y - CAMERA.centre[1], np.full(len(x), 800.0)], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True) @ attitude_matrix(attitude))


ATTITUDE = from_rotation_vector(np.array([0.3, -0.8, 0.5]))


def test_points_without_a_solution_have_blue_rings() -> None:
    points = np.array([[50.0, 60.0], [200.0, 100.0], [300.0, 250.0]])
    drawn = draw_solution(grey(300, 400), solution(points, [-1], None), sky(np.zeros((0, 3)), [], []))
    for x, y in points:
        assert distances(drawn, UNUSED, x, y) == pytest.approx(6.0, abs=0.75)
    assert not places(drawn, STREAK)
    assert not places(drawn, OBJECT)


@pytest.mark.parametrize("mirrored", [False, True])
def test_matched_and_expected_stars_have_their_rings(mirrored: bool) -> None:
    """The stars 0, 1 and 2 are as bright as the faintest matched star; star 3 is fainter."""
    at = [(100.0, 80.0), (250.0, 200.0), (330.0, 60.0), (60.0, 220.0)]
    stars = sky(in_sky(at, ATTITUDE), [UNNAMED, SIRIUS, 8, 9], [1.0, 2.0, 2.0, 3.0])
    points = np.array([[101.0, 80.0], [30.0, 30.0], [250.0, 199.0]])
    drawn = draw_solution(grey(300, 400), solution(points, [0, -1, 1], ATTITUDE, mirrored=mirrored), stars)
    for (x, y), colour in zip(points, (STREAK, UNUSED, STREAK), strict=True):
        apart = distances(drawn, colour, x, y)
        assert np.sum(np.abs(apart - 6.0) < 0.75) > 15
    for x, y in at[:3]:
        shown = 2.0 * CAMERA.centre[0] - x if mirrored else x
        apart = distances(drawn, GREEN, shown, y)
        assert np.sum(np.abs(apart - 9.0) < 0.75) > 25
    assert len(distances(drawn, GREEN, at[3][0], at[3][1])) == 0


def labels_of(drawn: Picture) -> FloatArray:
    """Return the positions (n, 2) of the pixels that belong to names."""
    rows, columns = np.nonzero(np.all(np.abs(drawn.astype(int) - YELLOW) < 25, axis=2))
    return np.stack([columns, rows], axis=1)


def test_a_name_is_right_of_its_star_or_left_at_the_edge_or_beside_another_name() -> None:
    at = [(100.0, 80.0), (385.0, 200.0), (112.0, 82.0)]
    stars = sky(in_sky(at, ATTITUDE), [SIRIUS, 24436, 24608], [1.0, 2.0, 2.0])
    found = solution(np.array([[101.0, 80.0], [20.0, 20.0]]), [1, -1], ATTITUDE)
    names = labels_of(draw_solution(grey(300, 400), found, stars))
    upper, lower = names[names[:, 1] < 120], names[names[:, 1] >= 120]
    assert lower[:, 0].max() <= 385 - 11
    assert lower[:, 0].min() > 300
    right, left = upper[upper[:, 0] > 106], upper[upper[:, 0] < 106]
    assert right[:, 0].min() == pytest.approx(111, abs=3)
    assert left[:, 0].max() == pytest.approx(112 - 11, abs=3)
    assert np.abs(upper[:, 1] - 80.0).max() < 12


def written(monkeypatch: pytest.MonkeyPatch, found: Any, stars: Any) -> list[str]:
    """Return the texts that are written beside stars, in their order."""
    shown: list[str] = []

    def noted(picture: Picture, labels: Any, *_: Any) -> Picture:
        shown.extend(text for _, text in labels)
        return picture

    monkeypatch.setattr(pictures, "_with_text", noted)
    draw_solution(grey(300, 400), found, stars)
    return shown


def test_stars_with_proper_names_are_named_first_and_then_the_eight_brightest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at = [(20.0 + 35.0 * k, 30.0 + 20.0 * k) for k in range(10)]
    hips = [101, SIRIUS, 103, 104, 105, 106, 107, 108, 109, 24436]
    stars = sky(in_sky(at, ATTITUDE), hips, [1.0] * 10)
    found = solution(np.array([[20.0, 30.0]]), [0], ATTITUDE)
    expected = ["Sirius", "Rigel", "HIP 101", *(f"HIP {hip}" for hip in range(103, 109))]
    assert written(monkeypatch, found, stars) == expected
    many = sky(in_sky(at * 4, ATTITUDE), [SIRIUS] * 40, [1.0] * 40)
    assert written(monkeypatch, found, many) == ["Sirius"] * 25


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("roll", [0.0, 0.7, 2.5, -1.9])
def test_the_compass_points_to_north_and_east(roll: float, mirrored: bool) -> None:
    """The directions are those of a small step from the boresight to the pole, and along the equator.

    The picture's mirror image has x reversed.
    """
    turned = multiply(from_rotation_vector(np.array([0.0, 0.0, roll])), ATTITUDE)
    matrix = attitude_matrix(turned)
    boresight = matrix[2]
    east = np.cross([0.0, 0.0, 1.0], boresight)
    east /= np.linalg.norm(east)
    north = np.cross(boresight, east)
    middle = np.array(CAMERA.centre)
    flip = np.array([-1.0 if mirrored else 1.0, 1.0])
    towards = {
        name: flip * (CAMERA.project((boresight + 1e-4 * step) @ matrix.T) - middle)
        for name, step in (("N", north), ("E", east))
    }
    stars = sky(in_sky([(200.0, 10.0)], turned), [UNNAMED], [1.0])
    drawn = draw_solution(
        grey(300, 400), solution(np.array([[200.0, 10.0]]), [0], turned, mirrored=mirrored), stars
    )
    size = 0.06 * 400
    origin = np.array([1.6 * size, 300 - 1.6 * size])
    red = places(drawn, OBJECT)

    def is_red(point: FloatArray) -> bool:
        x, y = np.rint(point).astype(int).tolist()
        return any((x + i, y + j) in red for i in range(-2, 3) for j in range(-2, 3))

    for name, length in (("N", size), ("E", 0.6 * size)):
        direction = towards[name] / np.linalg.norm(towards[name])
        assert all(is_red(origin + share * length * direction) for share in (0.3, 0.6, 0.95))
        assert not any(is_red(origin - share * length * direction) for share in (0.4, 0.8))
        # The letter is 12 px beyond the tip.
        assert is_red(origin + (length + 12.0) * direction) or any(
            is_red(origin + (length + 12.0) * direction + np.array(step)) for step in ((-3, 0), (3, 0))
        )


# Horizon.

WIDE = Pinhole(200, 160, 150.0)


def test_the_limb_of_a_sphere_is_a_circle_around_the_nadir() -> None:
    """From an altitude of h, the limb of a sphere of radius R is at the angle asin(R / (R + h))."""
    radius, altitude = 6.4e6, 2e7
    view = LimbView(np.eye(3), np.array([0.0, 0.0, -(radius + altitude)]),
                    Ellipsoid(np.array([0.0, 1.0, 0.0]), radius, radius), 0.0)  # fmt: skip
    points = np.array([[20.0, 30.0], [180.0, 30.0]])
    found: Any = SimpleNamespace(view=view, points=points, on_horizon=np.array([True, False]))
    drawn = draw_horizon(grey(160, 200), found, WIDE)
    size = 150.0 * np.tan(np.arcsin(radius / (radius + altitude)))
    middle = np.array(WIDE.centre)
    limb = np.array([one for one in sorted(places(drawn, STREAK)) if np.hypot(*(one - middle)) < 60.0])
    assert np.abs(np.hypot(*(limb - middle).T) - size).max() < 0.75
    assert len(limb) > 1.4 * np.pi * size, "the line has no gaps"
    assert distances(drawn, STREAK, 20.0, 30.0) == pytest.approx(5.0, abs=0.75)
    assert distances(drawn, UNUSED, 180.0, 30.0) == pytest.approx(5.0, abs=0.75)
    found.view = None
    assert not distances(draw_horizon(grey(160, 200), found, WIDE), STREAK, *middle).size


def test_the_fitted_circle_is_drawn_with_its_edge_points() -> None:
    circle = SimpleNamespace(centre=np.array([90.0, 70.0]), radius=45.0)
    seen: Any = SimpleNamespace(circle=circle, points=np.array([[20.0, 140.0]]))
    drawn = draw_circle(grey(160, 200), seen, WIDE)
    ring = np.array([one for one in sorted(places(drawn, STREAK)) if np.hypot(one[0] - 20, one[1] - 140) > 9])
    assert np.abs(np.hypot(ring[:, 0] - 90.0, ring[:, 1] - 70.0) - 45.0).max() < 0.75
    assert {(135, 70), (45, 70), (90, 115), (90, 25)} <= {(int(x), int(y)) for x, y in ring}
    assert distances(drawn, STREAK, 20.0, 140.0) == pytest.approx(5.0, abs=0.75)
