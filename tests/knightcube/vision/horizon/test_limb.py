"""Tests of the limb model by another method, finite differences, and the covariance of many fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray, tangent_basis
from knightcube.astro.earth.figure import SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS
from knightcube.astro.quaternion import attitude_matrix, normalise
from knightcube.vision.horizon.illumination import limb_rays, sun_elevation
from knightcube.vision.horizon.initial_guess import nadirs_of_pairs, nadirs_of_triples
from knightcube.vision.horizon.limb import (
    MEAN_RADIUS,
    PARAMETERS,
    LimbView,
    Prior,
    earth,
    fit_limb,
    limb_gradients,
    limb_residuals,
    mean_sphere,
    stepped,
)
from sim_hal.earth_camera import EarthScene
from tests.support.earth_truth import limb_directions

HEIGHT = 15e3


def _view(
    generator: np.random.Generator, altitude: float = 700e3, pole: FloatArray | None = None
) -> LimbView:
    rotation = attitude_matrix(normalise(generator.standard_normal(4)))
    zenith = normalise(generator.standard_normal(3))
    surface = earth(np.array([0.0, 0.0, 1.0]) if pole is None else pole)
    return LimbView(rotation, (SEMI_MAJOR_AXIS + altitude) * zenith, surface, HEIGHT)


def test_rays_along_the_limb_touch_the_ellipsoid_at_its_height() -> None:
    """Rays along the limb touch the ellipsoid: the minimum of (x/a)^2 + (y/a)^2 + (z/b)^2 is one."""
    view = _view(np.random.default_rng(1))
    rays = limb_rays(view, 90) @ view.rotation
    axes = np.array([SEMI_MAJOR_AXIS, SEMI_MAJOR_AXIS, SEMI_MINOR_AXIS]) + HEIGHT
    origin, steps = view.position / axes, rays / axes
    nearest = origin - (steps @ origin / np.sum(steps**2, axis=1))[:, None] * steps
    assert np.linalg.norm(nearest, axis=1) == pytest.approx(np.ones(90), abs=1e-12)
    assert limb_residuals(view, rays @ view.rotation.T) == pytest.approx(np.zeros(90), abs=1e-12)


def test_limb_and_sun_elevation_agree_with_the_simulator() -> None:
    """Limb and Sun elevation agree with the simulator, which has independent code for the limb."""
    generator = np.random.default_rng(2)
    attitude = normalise(generator.standard_normal(4))
    sun = 1.5e11 * normalise(generator.standard_normal(3))
    pole = normalise(np.array([0.05, -0.02, 1.0]))
    scene = EarthScene(8e6 * normalise(generator.standard_normal(3)), attitude, sun, pole=pole)
    view = LimbView(scene.camera_matrix, scene.position, earth(pole), HEIGHT)
    rays, _ = limb_directions(scene, 100, HEIGHT)
    assert limb_residuals(view, rays) == pytest.approx(np.zeros(100), abs=1e-9)
    rays, cosines = limb_directions(scene, 100, 0.0)
    elevation = sun_elevation(view, rays, sun / np.linalg.norm(sun))
    assert np.sin(elevation) == pytest.approx(cosines, abs=1e-6)


def test_the_quadratic_cone_is_zero_on_the_limb_and_positive_within() -> None:
    """The quadratic form of the limb is zero on the limb and positive within the limb.

    M = Q r r' Q - (r' Q r - 1) Q is the discriminant in t of |L (r + t u)| = 1, with Q = L' L.
    """
    view = _view(np.random.default_rng(3))
    stretching = view.surface.stretching(view.limb_height)
    form = stretching @ stretching
    normal = form @ view.position
    cone = (
        view.rotation @ (np.outer(normal, normal) - (view.position @ normal - 1.0) * form) @ view.rotation.T
    )
    limb = limb_rays(view, 60)
    scale = np.abs(cone).max()
    assert np.einsum("ij,jk,ik->i", limb, cone, limb) / scale == pytest.approx(np.zeros(60), abs=1e-9)
    within = 0.9 * limb + 0.1 * view.nadir
    assert np.all(np.einsum("ij,jk,ik->i", within, cone, within) > 0.0)
    assert np.all(limb_residuals(view, within / np.linalg.norm(within, axis=1, keepdims=True)) < 0.0)


def test_gradients_are_those_of_finite_differences() -> None:
    view = _view(np.random.default_rng(4), pole=np.array([0.3, 0.1, 0.9]))
    rays = normalise(np.random.default_rng(5).standard_normal((30, 3)))
    residuals, gradients = limb_gradients(view, rays)
    assert residuals == pytest.approx(limb_residuals(view, rays), abs=1e-14)
    for column, size in enumerate([1e-6, 1e-6, 1e-6, 10.0, 10.0]):
        step = np.zeros(5)
        step[column] = size
        slope = (limb_residuals(view.moved(step), rays) - limb_residuals(view.moved(-step), rays)) / (
            2 * size
        )
        assert gradients[:, column] == pytest.approx(slope, rel=1e-5, abs=1e-7 / size * 1e-3)


def test_the_height_above_ellipsoid_and_sphere() -> None:
    pole = np.array([0.0, 0.0, 1.0])
    assert earth(pole).height_of((SEMI_MINOR_AXIS + 5e5) * pole) == pytest.approx(5e5)
    assert mean_sphere().height_of(np.array([0.0, 7e6, 0.0])) == pytest.approx(7e6 - 6_371_008.8, abs=0.1)


def test_pairs_and_triples_of_rays_determine_their_cone() -> None:
    generator = np.random.default_rng(6)
    nadir = normalise(generator.standard_normal(3))
    view = LimbView(np.eye(3), -7e6 * nadir, mean_sphere(), 0.0)
    rays, cosine = limb_rays(view, 60), float(np.sqrt(1.0 - (MEAN_RADIUS / 7e6) ** 2))
    pairs = nadirs_of_pairs(rays[:20], rays[20:40], cosine)
    assert np.max(pairs @ nadir, axis=0) == pytest.approx(np.ones(20), abs=1e-9)
    directions, cosines = nadirs_of_triples(rays[:20], rays[20:40], rays[40:])
    assert directions @ nadir == pytest.approx(np.ones(20), abs=1e-9)
    assert cosines == pytest.approx(np.full(20, cosine), abs=1e-9)
    assert np.all(np.isnan(nadirs_of_pairs(rays[:1], rays[:1], cosine)))


def _arc(view: LimbView, generator: np.random.Generator, sigma: float) -> FloatArray:
    """Return forty rays along a quarter of the limb, with errors across the limb."""
    rays = limb_rays(view, 160)[:40]
    # `outward` is normal to the ray and points away from nadir.
    outward = (rays @ view.nadir)[:, None] * rays - view.nadir
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return np.asarray(normalise(rays + sigma * generator.standard_normal((40, 1)) * outward))


def test_the_fits_covariance_is_that_of_its_errors() -> None:
    """The summed NEES of 200 fits agrees with a chi-square with 400 degrees of freedom.

    The 99.9 % limits of the sum are 310 and 497.
    """
    generator = np.random.default_rng(7)
    sigma, prior = 3e-4, Prior(0.05, 1000.0, 50.0)
    total = 0.0
    for _ in range(200):
        view = _view(generator)
        rays = _arc(view, generator, sigma)
        believed = view.moved(
            np.array([*(prior.azimuth * generator.standard_normal() * view.nadir), 0.0, 0.0])
        )
        shifted = believed.moved(
            np.array(
                [0.0, 0.0, 0.0, 1000.0 * generator.standard_normal(), 50.0 * generator.standard_normal()]
            )
        )
        fitted = fit_limb(shifted, rays, np.full(40, sigma), prior)
        assert fitted is not None
        error = np.cross(fitted.view.nadir, view.nadir)
        basis = tangent_basis(fitted.view.nadir)
        small = basis @ fitted.covariance[:3, :3] @ basis.T
        total += float((basis @ error) @ np.linalg.solve(small, basis @ error))
    assert 310.0 < total < 497.0


def test_the_covariance_includes_a_limb_height_that_varies_along_the_limb() -> None:
    """The NEES also has its expected value if the limb is higher on one side, as towards a low Sun.

    The height of the limb varies with the cosine of the azimuth, with an amplitude of 2.8 km (2 km rms). The
    fit of a quarter of the limb absorbs the variation. Without `uneven`, the errors exceed the stated
    covariance.
    """
    generator = np.random.default_rng(5)
    claims = {0.0: 0.0, 2000.0: 0.0}
    for _ in range(60):
        view = _view(generator)
        rays = _arc(view, generator, 1e-4)
        aside = rays @ tangent_basis(view.nadir).T
        azimuth = np.arctan2(aside[:, 1], aside[:, 0]) - generator.uniform(0.0, 2.0 * np.pi)
        higher = 2000.0 * np.sqrt(2.0) * np.cos(azimuth) / view.limb_distance
        outward = normalise((rays @ view.nadir)[:, None] * rays - view.nadir)
        moved = normalise(rays + higher[:, None] * outward)
        for uneven in claims:
            fitted = fit_limb(view, moved, np.full(40, 3e-4), Prior(0.05, 3000.0, 50.0, uneven))
            assert fitted is not None
            basis = tangent_basis(fitted.view.nadir)
            error = basis @ view.nadir
            claims[uneven] += float(error @ np.linalg.solve(basis @ fitted.nadir_covariance @ basis.T, error))
    assert claims[0.0] > 5.0 * claims[2000.0]
    assert 0.3 < claims[2000.0] / 120.0 < 1.5


def test_wrong_edges_do_not_move_the_fit() -> None:
    generator = np.random.default_rng(8)
    view = _view(generator)
    rays = _arc(view, generator, 1e-4)
    rays[::5] = normalise(rays[::5] + 0.05 * view.nadir)
    fitted = fit_limb(view, rays, np.full(40, 1e-4), Prior(0.05, 100.0, 50.0))
    assert fitted is not None
    assert not np.any(fitted.used[::5])
    assert np.count_nonzero(fitted.used) > 28
    assert np.degrees(np.arccos(min(1.0, float(fitted.view.nadir @ view.nadir)))) < 0.03


@pytest.mark.parametrize("height", [-6.4e6, -7e6, -2e7])
def test_a_limb_below_the_centre_of_the_earth_is_refused(height: float) -> None:
    """A limb far below the ground is refused, because the surface would have negative semi-axes."""
    view = _view(np.random.default_rng(3))
    below = replace(view, limb_height=height)
    agreeing = np.zeros(20), np.random.default_rng(4).normal(size=(20, PARAMETERS)), np.full(20, 1e-4)
    prior = Prior(1.0, 1e3, 1e3)
    assert stepped(view, *agreeing, prior) is not None
    assert stepped(below, *agreeing, prior) is None


def test_edges_all_in_one_place_give_no_limb() -> None:
    view = _view(np.random.default_rng(9))
    rays = np.repeat(limb_rays(view, 4)[:1], 10, axis=0)
    fitted = fit_limb(view, rays, np.full(10, 1e-4), Prior(1.0, 1000.0, 1e9))
    assert fitted is None or np.sqrt(np.max(np.linalg.eigvalsh(fitted.covariance[:3, :3]))) > 0.1


def test_points_with_correlated_errors_get_a_smaller_weight() -> None:
    """Four successive points with the same error determine the limb no better than a single point."""
    generator = np.random.default_rng(8)
    view = _view(generator)
    rays = limb_rays(view, 240)[:80]
    errors = 1e-4 * generator.standard_normal(80)
    outward = rays - view.nadir * (rays @ view.nadir)[:, None]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    prior = Prior(1.0, 10.0, 10.0)
    sizes = []
    for each in (errors, np.repeat(errors[::4], 4)):
        moved = rays + each[:, None] * outward
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        fitted = fit_limb(view, moved, np.full(80, 1e-4), prior)
        assert fitted is not None
        sizes.append(np.trace(fitted.nadir_covariance))
    assert sizes[1] > 2.0 * sizes[0]


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_residuals_beyond_the_sigmas_increase_the_covariance(share: float) -> None:
    """Residuals beyond the stated sigmas increase the covariance.

    Some or all of the points have errors of four times their stated sigmas.
    """
    generator = np.random.default_rng(12)
    view = _view(generator)
    prior, sizes = Prior(1.0, 10.0, 10.0), []
    for factor in (1.0, 4.0):
        size = 0.0
        for _ in range(20):
            rays = limb_rays(view, 120)[:60]
            outward = normalise(rays * (rays @ view.nadir)[:, None] - view.nadir)
            spread = np.where(generator.random(60) < share, factor, 1.0)
            errors = 1e-4 * spread * generator.standard_normal(60)
            moved = normalise(rays + errors[:, None] * outward)
            fitted = fit_limb(view, moved, np.full(60, 1e-4), prior)
            assert fitted is not None
            size += float(np.trace(fitted.nadir_covariance))
        sizes.append(size)
    assert sizes[1] > (1.2 if share < 1.0 else 8.0) * sizes[0]
