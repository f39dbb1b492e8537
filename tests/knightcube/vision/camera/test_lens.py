"""The calibrated camera: against the pinhole, against its own polynomial, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import CameraModel, Lens, LensError, Pinhole

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
    """At tan 10 deg east of the axis, f = 1000 px: 176.33 (1 - 0.3 x 0.031091 + 0.1 x 0.00096666) px."""
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
    # Where the curve is all but flat at the edge a pixel says little of the direction, yet is met again.
    vectors = lens.unit_vectors(points)
    assert np.max(np.abs(lens.project(vectors) - points)) < 1e-9
    assert np.allclose(np.linalg.norm(vectors, axis=-1), 1.0, rtol=0.0, atol=1e-14)


@given(k1=st.floats(-2.0, 2.0), k2=st.floats(-2.0, 2.0))
def test_a_lens_is_refused_exactly_when_its_image_folds_within_the_detector(k1: float, k2: float) -> None:
    """The stretched tangent, followed step by step, reaches the corner's before it stops to grow, or not."""
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


def test_a_direction_beyond_the_fold_is_not_seen_again_within() -> None:
    lens = Lens(200, 200, 1000.0, (99.5, 99.5), -0.5)
    tangents = np.array([0.1, 0.8, 1.0, 1.4])
    points = lens.project(np.stack([tangents, 0.0 * tangents, np.ones(4)], axis=-1))
    # The fold is at the tangent 1/sqrt(1.5) = 0.816; 1.4 (1 - 0.98) would be pixel 127.
    assert np.isfinite(points[:2]).all()
    assert np.isnan(points[2:]).all()
    assert np.isnan(lens.unit_vectors(np.array([[99.5 + 545.0, 99.5]]))).all()


def test_a_pixel_that_is_none_leaves_the_others_alone() -> None:
    lens = Lens(1024, 768, 1000.0, (511.5, 383.5), 0.2, 0.1)
    vectors = lens.unit_vectors(np.array([[np.nan, 5.0], [1000.0, 700.0]]))
    assert np.isnan(vectors[0]).all()
    assert lens.project(vectors[1:])[0] == pytest.approx([1000.0, 700.0], abs=1e-9)


def test_the_farthest_corner_counts_when_the_axis_is_off_the_middle() -> None:
    lens = Lens(1000, 1000, 1000.0, (399.5, 499.5))
    assert lens.half_diagonal == pytest.approx(np.arctan(np.hypot(0.6, 0.5)), abs=1e-12)
