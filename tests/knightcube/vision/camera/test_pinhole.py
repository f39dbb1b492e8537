"""The pinhole camera against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knightcube.vision.camera.lens import Pinhole

CAMERA = Pinhole.from_field_of_view(1024, 768, np.radians(20.0))
COLUMN = st.floats(-0.5, 1023.5)
ROW = st.floats(-0.5, 767.5)


def test_the_boresight_falls_between_the_middle_pixels() -> None:
    assert CAMERA.centre == (511.5, 383.5)
    assert CAMERA.project(np.array([[0.0, 0.0, 1.0]])).tolist() == [[511.5, 383.5]]


def test_the_field_of_view_ends_at_the_outer_edge_of_the_outermost_pixel() -> None:
    """Sease 2.4: half the field of view is half the columns; pixel 0 is a centre, so its edge is -0.5."""
    edge = np.radians(10.0)
    points = CAMERA.project(np.array([[np.sin(edge), 0.0, np.cos(edge)], [-np.sin(edge), 0.0, np.cos(edge)]]))
    assert points[:, 0] == pytest.approx([1023.5, -0.5], abs=1e-9)
    assert points[:, 1] == pytest.approx([383.5, 383.5], abs=1e-9)


def test_focal_length_of_a_right_angle_is_half_the_columns() -> None:
    assert Pinhole.from_field_of_view(1000, 10, 0.5 * np.pi).focal_length == pytest.approx(500.0)


def test_x_runs_along_columns_and_y_along_rows() -> None:
    right, down = CAMERA.project(np.array([[0.01, 0.0, 1.0], [0.0, 0.01, 1.0]]))
    assert right == pytest.approx([511.5 + 0.01 * CAMERA.focal_length, 383.5])
    assert down == pytest.approx([511.5, 383.5 + 0.01 * CAMERA.focal_length])


@given(COLUMN, ROW)
def test_pixels_round_trip_through_unit_vectors(x: float, y: float) -> None:
    vectors = CAMERA.unit_vectors(np.array([[x, y]]))
    assert np.linalg.norm(vectors[0]) == pytest.approx(1.0, abs=1e-14)
    assert CAMERA.project(vectors)[0] == pytest.approx([x, y], abs=1e-9)


@given(COLUMN, ROW, st.floats(1e-3, 1e6))
def test_projection_does_not_depend_on_distance(x: float, y: float, distance: float) -> None:
    vectors = CAMERA.unit_vectors(np.array([[x, y]]))
    assert CAMERA.project(distance * vectors)[0] == pytest.approx([x, y], abs=1e-6)


@given(COLUMN, ROW)
def test_what_is_behind_the_camera_has_no_pixel(x: float, y: float) -> None:
    """Errata to 2.1: the mirrored direction would project to the same pixel."""
    behind = CAMERA.project(-CAMERA.unit_vectors(np.array([[x, y]])))
    assert np.all(np.isnan(behind))
    assert not CAMERA.contains(behind, margin=1e9)[0]


def test_what_is_beside_the_camera_has_no_pixel() -> None:
    assert np.all(np.isnan(CAMERA.project(np.array([[1.0, 0.0, 0.0]]))))


def test_half_diagonal_is_the_angle_to_the_corner() -> None:
    corner = CAMERA.unit_vectors(np.array([[-0.5, -0.5]]))[0]
    assert CAMERA.half_diagonal == pytest.approx(np.arccos(corner[2]), abs=1e-12)


@given(COLUMN, ROW)
def test_nothing_on_the_detector_is_farther_than_the_half_diagonal(x: float, y: float) -> None:
    vector = CAMERA.unit_vectors(np.array([[x, y]]))[0]
    assert np.arccos(np.clip(vector[2], -1.0, 1.0)) <= CAMERA.half_diagonal + 1e-9


def test_contains_reaches_to_the_pixels_outer_edges_and_the_margin() -> None:
    points = np.array([[-0.5, 0.0], [-0.51, 0.0], [1023.5, 767.5], [1023.5, 767.6], [np.nan, 0.0]])
    assert CAMERA.contains(points).tolist() == [True, False, True, False, False]
    assert CAMERA.contains(points, margin=0.2).tolist() == [True, True, True, True, False]


def test_stacks_of_points_keep_their_shape() -> None:
    points = np.random.default_rng(3).uniform(0.0, 700.0, (4, 5, 2))
    assert CAMERA.project(CAMERA.unit_vectors(points)) == pytest.approx(points, abs=1e-9)
