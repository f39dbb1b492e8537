"""Tests of the calibrated lens against the pinhole and against its polynomial, and of refused lenses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.errors import ArgumentError
from knightcube.vision.camera.lens import (
    CameraModel,
    DistortedPinhole,
    Exposures,
    Lens,
    LensError,
    MountedCamera,
    Pinhole,
    _distorted,
    _ideal_points,
    _image_motion,
    _undistorted,
    streak_camera,
)
from tests.support.compiled_forms import assert_forms_agree

_PINHOLE = Pinhole.from_field_of_view(1024, 768, np.radians(20.0))


def _points(seed: int, n: int = 200) -> FloatArray:
    return np.random.default_rng(seed).uniform([-0.5, -0.5], [1023.5, 767.5], (n, 2))


def test_without_distortion_it_is_the_pinhole() -> None:
    lens: CameraModel = Lens.of(_PINHOLE)
    points = _points(1)
    assert np.allclose(lens.unit_vectors(points), _PINHOLE.unit_vectors(points), rtol=0.0, atol=1e-15)
    vectors = np.vstack([_PINHOLE.unit_vectors(points), [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]])
    assert np.allclose(lens.project(vectors), _PINHOLE.project(vectors), rtol=0.0, atol=1e-10, equal_nan=True)
    assert lens.half_diagonal == pytest.approx(_PINHOLE.half_diagonal, abs=1e-12)
    around = np.array([[-0.5, 0.0], [-0.6, 0.0], [np.nan, 0.0], [1023.5, 767.5], [1024.0, 3.0]])
    for margin in (0.0, 2.0):
        assert np.array_equal(lens.contains(around, margin), _PINHOLE.contains(around, margin))


def test_a_star_falls_where_the_polynomial_says() -> None:
    """At f = 1000 px, a star 10 deg off axis is at 176.33 (1 - 0.3 x 0.031091 + 0.1 x 0.00096666) px."""
    lens = Lens(2000, 2000, 1000.0, (990.0, 1010.0), -0.3, 0.1)
    direction = np.array([[np.sin(np.radians(10.0)), 0.0, np.cos(np.radians(10.0))]])
    expected = [990.0 + 176.326981 * (1.0 - 0.3 * 0.0310912041 + 0.1 * 0.000966662976), 1010.0]
    assert lens.project(direction)[0] == pytest.approx(expected, abs=1e-5)


@given(
    field=st.floats(3.0, 110.0),
    k1=st.floats(-2.0, 2.0),
    k2=st.floats(-2.0, 2.0),
    shift=st.tuples(st.floats(-80.0, 80.0), st.floats(-80.0, 80.0)),
)
def test_unit_vectors_undo_the_projection_to_a_nanopixel(
    field: float, k1: float, k2: float, shift: tuple[float, float]
) -> None:
    focal_length = 512.0 / np.tan(0.5 * np.radians(field))
    try:
        lens = Lens(1024, 768, focal_length, (511.5 + shift[0], 383.5 + shift[1]), k1, k2)
    except LensError:
        assume(False)
    points = _points(2)
    # A direction is projected back onto its pixel, even if the distortion curve is nearly flat at the edge.
    vectors = lens.unit_vectors(points)
    assert np.max(np.abs(lens.project(vectors) - points)) < 1e-9
    assert np.allclose(np.linalg.norm(vectors, axis=-1), 1.0, rtol=0.0, atol=1e-14)


@given(k1=st.floats(-2.0, 2.0), k2=st.floats(-2.0, 2.0))
def test_a_lens_is_refused_exactly_when_its_image_folds_within_the_detector(k1: float, k2: float) -> None:
    """A lens is accepted if and only if the distorted tangent increases up to the corner of the image."""
    corner = np.hypot(512.0, 512.0) / 512.0
    tangent = np.linspace(0.0, 6.0, 60_001)
    stretched = tangent * (1.0 + k1 * tangent**2 + k2 * tangent**4)
    falls = np.flatnonzero(np.diff(stretched) <= 0.0)
    edge = stretched[falls[0]] if falls.size else np.inf
    assume(abs(edge - corner) > 1e-3 and stretched.max() > corner + 1e-3)
    if edge > corner:
        Lens(1024, 1024, 512.0, (511.5, 511.5), k1, k2)
    else:
        with pytest.raises(LensError, match="folds the image back"):
            Lens(1024, 1024, 512.0, (511.5, 511.5), k1, k2)


def test_a_direction_beyond_the_fold_is_not_imaged() -> None:
    lens = Lens(200, 200, 1000.0, (99.5, 99.5), -0.5)
    tangents = np.array([0.1, 0.8, 1.0, 1.4])
    points = lens.project(np.stack([tangents, 0.0 * tangents, np.ones(4)], axis=-1))
    # The distorted tangent decreases beyond 1/sqrt(1.5) = 0.816. A tangent of 1.4 would give the pixel 127.
    assert np.isfinite(points[:2]).all()
    assert np.isnan(points[2:]).all()
    assert np.isnan(lens.unit_vectors(np.array([[99.5 + 545.0, 99.5]]))).all()


@pytest.mark.parametrize("shape", [(0.02, 0.0, 0.0, 0.0), (0.0, -0.03, 0.0, 0.0), (0.01, 0.02, 0.05, -0.04)])
def test_pixels_and_directions_agree_with_aspect_shear_and_tangential_terms(
    shape: tuple[float, float, float, float],
) -> None:
    """With stretched and sheared axes and tangential terms, pixels and directions agree.

    The model of Brown (1966) gives the positions, which are then stretched and sheared about the axis.
    """
    aspect, shear, p1, p2 = shape
    lens = Lens(1000, 800, 1000.0, (490.0, 410.0), -0.1, 0.02, *shape)
    points = np.random.default_rng(2).uniform([-0.5, -0.5], [999.5, 799.5], (200, 2))
    vectors = lens.unit_vectors(points)
    x, y = vectors[:, 0] / vectors[:, 2], vectors[:, 1] / vectors[:, 2]
    square = x * x + y * y
    radial = 1.0 - 0.1 * square + 0.02 * square**2
    right = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    down = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    column = 490.0 + 1000.0 * ((1.0 + aspect) * right + shear * down)
    row = 410.0 + 1000.0 * (shear * right + (1.0 - aspect) * down)
    assert np.stack([column, row], axis=1) == pytest.approx(points, abs=1e-6)
    assert lens.project(vectors) == pytest.approx(points, abs=1e-6)
    assert Lens(**{**lens.to_mapping(), "centre": lens.centre}) == lens  # type: ignore[arg-type]  # of numbers


@pytest.mark.parametrize(
    ("terms", "complaint"),
    [
        ({"aspect": 0.4}, "aspect 0.4, shear 0.0: must be between"),
        ({"p1": np.nan}, "must be finite"),
        ({"p2": 2.0}, "cannot be inverted at the corners"),
    ],
)
def test_terms_that_no_lens_has_are_refused(terms: dict[str, float], complaint: str) -> None:
    with pytest.raises(LensError, match=complaint):
        Lens(1000, 800, 1000.0, (499.5, 399.5), **terms)


@pytest.mark.parametrize(
    ("size", "focal_length", "complaint"),
    [
        ((1024, 768), -5.0, r"focal length -5\.0 px: must be positive and finite"),
        ((1024, 768), np.nan, "focal length nan px"),
        ((1024, 768), np.inf, "focal length inf px"),
        ((0, 768), 900.0, "0 x 768 pixels: give positive whole numbers"),
        ((1024, -768), 900.0, "1024 x -768 pixels"),
        ((512.5, 768), 900.0, "512.5 x 768 pixels"),
    ],
)
def test_a_detector_that_cannot_exist_is_refused(
    size: tuple[int, int], focal_length: float, complaint: str
) -> None:
    with pytest.raises(LensError, match=complaint):
        Pinhole(*size, focal_length)
    with pytest.raises(LensError, match=complaint):
        Lens(*size, focal_length, (511.5, 383.5))


@pytest.mark.parametrize(
    ("field", "complaint"),
    [
        (11.4, r"11\.4 rad: must be between 0 and pi rad; 11\.4 deg are 0\.199 rad"),
        (20.0, r"20 deg are 0\.3491 rad"),
        (0.0, "field of view 0 rad: must be between 0 and pi rad$"),
        (-0.3, "field of view -0.3 rad"),
        (np.nan, "field of view nan rad"),
        (np.inf, "field of view inf rad: must be between 0 and pi rad$"),
    ],
)
def test_a_field_of_view_beyond_half_a_turn_is_refused(field: float, complaint: str) -> None:
    with pytest.raises(LensError, match=complaint):
        Pinhole.from_field_of_view(1024, 768, field)


def test_an_invalid_pixel_does_not_affect_the_others() -> None:
    lens = Lens(1024, 768, 1000.0, (511.5, 383.5), 0.2, 0.1)
    vectors = lens.unit_vectors(np.array([[np.nan, 5.0], [1000.0, 700.0]]))
    assert np.isnan(vectors[0]).all()
    assert lens.project(vectors[1:])[0] == pytest.approx([1000.0, 700.0], abs=1e-9)


def test_the_farthest_corner_counts_when_the_axis_is_off_the_middle() -> None:
    lens = Lens(1000, 1000, 1000.0, (399.5, 499.5))
    assert lens.half_diagonal == pytest.approx(np.arctan(np.hypot(0.6, 0.5)), abs=1e-12)


CAMERA = Pinhole.from_field_of_view(1024, 768, np.radians(20.0))
COLUMN = st.floats(-0.5, 1023.5)
ROW = st.floats(-0.5, 767.5)


def test_the_boresight_falls_between_the_middle_pixels() -> None:
    assert CAMERA.centre == (511.5, 383.5)
    assert CAMERA.project(np.array([[0.0, 0.0, 1.0]])).tolist() == [[511.5, 383.5]]


def test_the_field_of_view_ends_at_the_outer_edge_of_the_outermost_pixel() -> None:
    """The field of view ends at the outer edge of the outermost pixel, half the columns from the centre.

    Sease defines the angle in section 2.4. Coordinate 0 is the centre of a pixel, whose edge is at -0.5.
    """
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
def test_a_direction_behind_the_camera_has_no_pixel(x: float, y: float) -> None:
    """A direction behind the camera has no pixel, although its opposite projects to a pixel.

    The errata correct section 2.1 of the thesis, according to which opposite directions project to the same
    pixel.
    """
    behind = CAMERA.project(-CAMERA.unit_vectors(np.array([[x, y]])))
    assert np.all(np.isnan(behind))
    assert not CAMERA.contains(behind, margin=1e9)[0]


def test_a_direction_beside_the_camera_has_no_pixel() -> None:
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


EXPOSURES = Exposures(usual=0.2, least=0.1, most=1.0, scale=512 / np.radians(20.0))


@pytest.mark.parametrize("rate_deg", [0.2, 0.3, 0.5, 1.0, 2.0])
def test_streaks_of_a_slew_are_5_to_100_px_long(rate_deg: float) -> None:
    rate = np.radians(rate_deg)
    assert 5.0 <= rate * EXPOSURES.scale * EXPOSURES.at(rate) <= 100.0


def test_points_are_exposed_as_usual_and_the_slowest_streaks_longest() -> None:
    assert EXPOSURES.at(0.0) == EXPOSURES.usual
    assert EXPOSURES.at(np.radians(0.15)) == EXPOSURES.usual
    assert EXPOSURES.at(np.radians(0.2)) == EXPOSURES.most
    assert EXPOSURES.at(np.radians(90.0)) == EXPOSURES.least


@pytest.mark.parametrize(
    "lens",
    [
        Lens(1024, 768, 2900.0, (515.0, 380.0), 0.15, 0.4),
        Lens(1024, 768, 2900.0, (511.5, 383.5), -2.0, 3.0),
        Lens(1024, 768, 2900.0, (509.0, 390.0), -0.5, aspect=0.03, shear=-0.01, p1=0.04, p2=-0.02),
    ],
)
def test_the_camera_for_paths_of_stars_images_like_the_lens(lens: Lens) -> None:
    simple, points = streak_camera(lens), _points(3).reshape(20, 10, 2)
    vectors = lens.unit_vectors(points)
    assert np.abs(lens.ideal.project(vectors) - points).max() > 2.0
    assert simple.unit_vectors(points) == pytest.approx(vectors, abs=1e-11)
    assert simple.project(vectors) == pytest.approx(points, abs=1e-7)
    assert simple.half_diagonal == pytest.approx(lens.half_diagonal, abs=1e-9)
    assert simple.ideal == lens.ideal
    assert streak_camera(_PINHOLE) is _PINHOLE


def test_a_direction_beyond_the_fold_of_the_distortion_is_not_in_the_image() -> None:
    """The lens returns NaN, and the camera for star paths returns a point outside the image."""
    lens = Lens(1024, 768, 2900.0, (511.5, 383.5), k1=-2.4)
    angle = np.linspace(lens.half_diagonal, 1.5, 300)
    vectors = np.stack([np.sin(angle), np.zeros(300), np.cos(angle)], axis=1)
    assert np.isnan(lens.project(vectors)).any()
    places = streak_camera(lens).project(vectors)
    assert (np.diff(places[:, 0]) > 0.0).all()
    assert not lens.contains(places[1:]).any()


def test_the_compiled_distortion_equals_that_in_numpy() -> None:
    camera = DistortedPinhole(1024, 768, 2900.0, (3.0, -2.0), 1e-3, -0.12, 0.02, (0.02, -0.03), (0.02, 0.01))
    # Some of the points are beyond the fold, and one is undefined.
    points = np.random.default_rng(4).uniform(-1500.0, 2500.0, (60, 2))
    points[7] = np.nan
    velocity, acceleration = np.random.default_rng(5).normal(0.0, 50.0, (2, 60, 2))
    for function in (_distorted, _ideal_points):
        assert_forms_agree(function, points, camera._terms)
    assert_forms_agree(_image_motion, points[8:], velocity[8:], acceleration[8:], camera._terms)


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.2), (-0.2, 0.0), (0.4, -0.1), (0.1, 0.2)])
def test_the_compiled_inversion_of_the_distortion_equals_that_in_numpy(k1: float, k2: float) -> None:
    tangents = np.append(np.linspace(0.0, 0.9, 40), np.nan)
    assert_forms_agree(_undistorted, tangents, k1, k2, 0.7)


def test_whole_numbers_of_pixels_become_integers_and_huge_numbers_are_refused() -> None:
    count: Any = 512.0
    for camera in (Pinhole(count, count, 800.0), Lens(count, count, 800.0, (255.5, 255.5))):
        assert (type(camera.columns), type(camera.rows)) == (int, int)
    with pytest.raises(LensError, match="at most"):
        Pinhole(1e300 * count, 400, 800.0)


def test_a_mounting_of_rounded_numbers_is_normalised_and_one_of_another_length_is_refused() -> None:
    lens = Pinhole(512, 400, 800.0)
    mounted = MountedCamera(lens, np.array([0.7071, 0.0, 0.0, 0.7071]))
    np.testing.assert_allclose(mounted.to_camera @ mounted.to_camera.T, np.eye(3), atol=1e-12)
    with pytest.raises(ArgumentError, match=r"mounting: .*length 2"):
        MountedCamera(lens, np.array([0.0, 0.0, 0.0, 2.0]))
