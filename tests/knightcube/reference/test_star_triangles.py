"""Tests of area, polar moment and their variances, against closed forms, integration and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad

from knightcube.astro.arrays import FloatArray
from knightcube.reference.star_tables import (
    MeasuredShape,
    Shape,
    measured_planar_shape,
    measured_spherical_shape,
    ordered,
    planar_shape,
    side_lengths,
    spherical_shape,
)


def _corners(seed: int, half_width: float = 0.12) -> FloatArray:
    rng = np.random.default_rng(seed)
    drawn = np.append(rng.uniform(-half_width, half_width, (3, 2)), np.ones((3, 1)), axis=1)
    return np.asarray(drawn / np.linalg.norm(drawn, axis=-1, keepdims=True))


def _moment_of_plane_triangle(corners: FloatArray) -> float:
    """Return the integral of the squared distance from the centroid, by iterated quadrature."""
    p, q, r = corners
    centroid = corners.mean(axis=0)
    double_area = float(np.linalg.norm(np.cross(q - p, r - p)))

    def squared(v: float, u: float) -> float:
        return float(np.sum((p + u * (q - p) + v * (r - p) - centroid) ** 2))

    return float(double_area * dblquad(squared, 0.0, 1.0, 0.0, lambda u: 1.0 - u)[0])


@pytest.mark.parametrize("seed", range(4))
def test_plane_area_and_moment_are_those_of_vector_product_and_integral(seed: int) -> None:
    corners = _corners(seed)
    area, moment = planar_shape(corners[None])
    p, q, r = corners
    assert area[0] == pytest.approx(0.5 * np.linalg.norm(np.cross(q - p, r - p)), rel=1e-9)
    assert moment[0] == pytest.approx(_moment_of_plane_triangle(corners), rel=1e-8)


def test_an_octant_has_the_area_of_an_eighth_of_the_sphere() -> None:
    area, _ = spherical_shape(np.eye(3)[None])
    assert area[0] == pytest.approx(np.pi / 2.0, rel=1e-14)


@pytest.mark.parametrize("seed", range(4))
def test_spherical_area_is_that_of_the_sum_of_angles_and_of_equation_32(seed: int) -> None:
    corners = _corners(seed, 0.3)
    p, q, r = corners
    excess = -np.pi
    for at, one, other in ((p, q, r), (q, r, p), (r, p, q)):
        n1, n2 = np.cross(at, one), np.cross(at, other)
        excess += np.arctan2(np.linalg.norm(np.cross(n1, n2)), n1 @ n2)
    area, _ = spherical_shape(corners[None])
    assert area[0] == pytest.approx(excess, rel=1e-10)
    a, b, c = np.arccos(p @ q), np.arccos(q @ r), np.arccos(r @ p)
    s = 0.5 * (a + b + c)
    product = np.tan(s / 2) * np.tan((s - a) / 2) * np.tan((s - b) / 2) * np.tan((s - c) / 2)
    assert area[0] == pytest.approx(4.0 * np.arctan(np.sqrt(product)), rel=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_spherical_moment_is_the_adaptive_integral_of_its_definition(seed: int) -> None:
    """The polar moment equals its definition (34), integrated by iterated adaptive quadrature.

    The integral over theta uses its cosine and sine.
    """
    corners = _corners(seed)
    middle = corners.sum(axis=0) / np.linalg.norm(corners.sum(axis=0))
    volume = abs(float(np.linalg.det(corners)))

    def element(v: float, u: float) -> float:
        p = (1.0 - u - v) * corners[0] + u * corners[1] + v * corners[2]
        theta = np.arctan2(np.linalg.norm(np.cross(p, middle)), p @ middle)
        return float(theta**2 * volume / np.linalg.norm(p) ** 3)

    integral = dblquad(element, 0.0, 1.0, 0.0, lambda u: 1.0 - u, epsabs=1e-15, epsrel=1e-9)[0]
    assert spherical_shape(corners[None])[1][0] == pytest.approx(integral, rel=1e-8)


def test_spherical_moment_is_the_sum_over_ever_smaller_triangles() -> None:
    """The polar moment equals the sum (34) of Cole & Crassidis over triangles that are quartered 7 times."""
    corners = _corners(1)
    middle = corners.sum(axis=0) / np.linalg.norm(corners.sum(axis=0))
    triangles = corners[None]
    for _ in range(7):
        p, q, r = np.moveaxis(triangles, 1, 0)
        halves = [(one + other) for one, other in ((p, q), (q, r), (r, p))]
        pq, qr, rp = (half / np.linalg.norm(half, axis=-1, keepdims=True) for half in halves)
        parts = [(p, pq, rp), (pq, q, qr), (rp, qr, r), (pq, qr, rp)]
        triangles = np.concatenate([np.stack(part, axis=1) for part in parts])
    centre = triangles.sum(axis=1)
    centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
    theta = 2.0 * np.arcsin(0.5 * np.linalg.norm(centre - middle, axis=-1))
    total = float(np.sum(theta**2 * spherical_shape(triangles)[0]))
    # Each division reduces the error to a quarter, and seven divisions reduce it to about (1/128)^2 of the
    # moment.
    assert spherical_shape(corners[None])[1][0] == pytest.approx(total, rel=2e-4)


@pytest.mark.parametrize(
    ("shape", "measured_shape"),
    [(planar_shape, measured_planar_shape), (spherical_shape, measured_spherical_shape)],
    ids=["planar", "spherical"],
)
@pytest.mark.parametrize("seed", range(3))
def test_propagated_variances_agree_with_a_monte_carlo(
    shape: Shape, measured_shape: MeasuredShape, seed: int
) -> None:
    """The propagated variances (eq. 40-48) agree with 20,000 random draws, for unequal errors of corners.

    The random draws determine a standard deviation to within 0.5 %.
    """
    corners = _corners(seed)
    sigma = np.array([3e-5, 6e-5, 9e-5])
    rng = np.random.default_rng(seed)
    noisy = corners + sigma[:, None] * rng.standard_normal((20_000, 3, 3))
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    areas, moments = shape(noisy)
    claimed = measured_shape(corners[None], sigma[None])
    assert claimed.sigma_area[0] == pytest.approx(areas.std(), rel=0.02)
    assert claimed.sigma_moment[0] == pytest.approx(moments.std(), rel=0.02)


def test_a_plane_triangle_without_area_has_no_finite_variance() -> None:
    p, r = _corners(1)[:2]
    claimed = measured_planar_shape(np.stack([p, r, r])[None], np.full((1, 3), 1e-5))
    assert np.isinf(claimed.sigma_area[0])
    assert np.isinf(claimed.sigma_moment[0])


def test_shapes_do_not_change_when_the_camera_turns() -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))
    for shape in (planar_shape, spherical_shape):
        for before, after in zip(shape(_corners(5)[None]), shape(_corners(5)[None] @ turn.T), strict=True):
            np.testing.assert_allclose(after, before, rtol=1e-9)


def test_ordered_corners_stand_opposite_ever_longer_sides() -> None:
    direction = np.concatenate([_corners(seed) for seed in range(4)])
    triangles = np.arange(12).reshape(4, 3)
    sides = side_lengths(direction[ordered(direction, triangles)])
    assert np.all(np.diff(sides, axis=-1) >= 0.0)
