"""A camera that does not move: brightness, position and shape of a star's image."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.interfaces.errors import OutOfRange
from knightcube.astro import catalogue, quaternion
from sim_hal.star_camera import StarCameraModel, expected_electrons
from tests.sim_hal.star_camera.scenes import POINTING, at_pixels, centroid, integrated_by_brute_force, still

SMALL = StarCameraModel(columns=64, rows=48, field_of_view=np.radians(4.0))


def test_a_star_of_magnitude_zero_gives_liebes_flux() -> None:
    """19,000 e-/s for each mm^2 of a 25 mm aperture, 0.2 s: 1.8653e6 e-."""
    image = expected_electrons(SMALL, at_pixels(SMALL, [30.2, 20.7]), [0.0], *still(0.2))
    assert image.sum() == pytest.approx(19_000 * math.pi * 12.5**2 * 0.2, rel=1e-5)


@pytest.mark.parametrize("psf", ["integrated", "bilinear"])
@pytest.mark.parametrize("point", [(30.0, 20.0), (30.5, 20.5), (31.27, 22.93)])
def test_no_light_is_lost_whatever_the_place_in_the_pixel(psf: str, point: tuple[float, float]) -> None:
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf=psf)  # type: ignore[arg-type] # a str to mypy
    image = expected_electrons(model, at_pixels(model, point), [5.0], *still())
    assert image.sum() == pytest.approx(float(model.electrons(5.0, 1.0)), rel=1e-5)


def test_five_magnitudes_are_a_factor_of_a_hundred() -> None:
    """Errata to 2.8: Pogson, not 2.5 a magnitude (which would give 97.7)."""
    star, history = at_pixels(SMALL, [30.2, 20.7]), still()
    bright, faint = (expected_electrons(SMALL, star, [v], *history).sum() for v in (1.0, 6.0))
    assert bright / faint == pytest.approx(100.0, rel=1e-5)


def test_light_grows_with_exposure_and_with_the_square_of_the_aperture() -> None:
    star = at_pixels(SMALL, [30.2, 20.7])
    wide = StarCameraModel(columns=64, rows=48, field_of_view=SMALL.field_of_view, aperture=0.05)
    once = expected_electrons(SMALL, star, [4.0], *still(0.5)).sum()
    assert expected_electrons(SMALL, star, [4.0], *still(1.0)).sum() == pytest.approx(2.0 * once, rel=1e-5)
    assert expected_electrons(wide, star, [4.0], *still(0.5)).sum() == pytest.approx(4.0 * once, rel=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.floats(12.0, 50.0), st.floats(12.0, 35.0), st.sampled_from([0.6, 1.0, 1.7]))
def test_the_centroid_is_the_projection(x: float, y: float, sigma: float) -> None:
    """An undersampled image (sigma 0.3 px, say) would be biased by the pixels: that is the pixels' doing."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf_sigma=sigma)
    image = expected_electrons(model, at_pixels(model, [x, y]), [-5.0], *still())
    assert centroid(image) == pytest.approx([x, y], abs=1e-3)


@pytest.mark.parametrize("sigma", [0.25, 0.5, 1.0, 2.5])
def test_the_image_is_the_gaussian_integrated_over_each_pixel(sigma: float) -> None:
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf_sigma=sigma)
    point = np.array([[31.31, 22.84]])
    image = expected_electrons(model, at_pixels(model, point), [3.0], *still())
    expected = integrated_by_brute_force((48, 64), point, float(model.electrons(3.0, 1.0)), sigma)
    assert np.abs(image - expected).max() < 2e-4 * expected.max()


def test_the_thesis_kernel_appears_around_a_star_in_the_middle_of_a_pixel() -> None:
    """Sease 2.9, printed to four digits."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear")
    image = expected_electrons(model, at_pixels(model, [30.0, 20.0]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    printed = [[0.0751, 0.1238, 0.0751], [0.1238, 0.2041, 0.1238], [0.0751, 0.1238, 0.0751]]
    assert image[19:22, 29:32] == pytest.approx(np.array(printed), abs=1.1e-4)
    assert np.count_nonzero(image > 1e-6) == 9


def test_the_thesis_placement_shares_a_star_among_four_pixels() -> None:
    """2.5, 2.6 by hand at (30.25, 20.4), with the kernel so narrow (sigma 0.2) that 3.7e-6 leaves a pixel."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear", psf_sigma=0.2)
    image = expected_electrons(model, at_pixels(model, [30.25, 20.4]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    assert image[20:22, 30:32] == pytest.approx(np.array([[0.45, 0.15], [0.30, 0.10]]), abs=1e-5)


def test_the_thesis_placement_and_kernel_together() -> None:
    """At (30.5, 20): across (g1/2, (g1 + g0)/2, again, g1/2), down (g1, g0, g1), g0 = 0.4519, g1 = 0.2741."""
    model = StarCameraModel(columns=64, rows=48, field_of_view=0.07, psf="bilinear")
    image = expected_electrons(model, at_pixels(model, [30.5, 20.0]), [3.0], *still()) / model.electrons(
        3.0, 1.0
    )
    across, down = np.array([0.13703, 0.36297, 0.36297, 0.13703]), np.array([0.27407, 0.45186, 0.27407])
    assert image[19:22, 29:33] == pytest.approx(np.outer(down, across), abs=2e-5)


def test_a_star_behind_the_camera_gives_no_light() -> None:
    """Errata to 2.1: through the collinearity equations alone it would fall on the same pixel."""
    star = at_pixels(SMALL, [30.2, 20.7])
    assert expected_electrons(SMALL, -star, [0.0], *still()).max() == 0.0
    assert expected_electrons(SMALL, star, [0.0], *still()).max() > 0.0


def test_a_star_on_the_detectors_edge_gives_half_its_light() -> None:
    image = expected_electrons(SMALL, at_pixels(SMALL, [-0.5, 20.0]), [3.0], *still())
    assert image.sum() == pytest.approx(0.5 * float(SMALL.electrons(3.0, 1.0)), rel=1e-3)
    corner = expected_electrons(SMALL, at_pixels(SMALL, [63.5, 47.5]), [3.0], *still())
    assert corner.sum() == pytest.approx(0.25 * float(SMALL.electrons(3.0, 1.0)), rel=1e-3)


def test_images_of_several_stars_add_up() -> None:
    points, magnitudes = [[20.3, 20.0], [24.1, 21.6], [50.0, 40.0]], [3.0, 4.0, 2.0]
    together = expected_electrons(SMALL, at_pixels(SMALL, points), magnitudes, *still())
    singly = [
        expected_electrons(SMALL, at_pixels(SMALL, point), [magnitude], *still())
        for point, magnitude in zip(points, magnitudes, strict=True)
    ]
    assert together == pytest.approx(sum(singly), abs=1e-6 * together.max())


def test_the_real_sky_puts_each_bright_star_where_the_pinhole_does() -> None:
    """Orion's belt, from the catalogue: the light around each is centred on its projection."""
    stars = catalogue.load()
    belt = [int(np.flatnonzero(stars.hip == hip)[0]) for hip in (25930, 26311, 26727)]
    directions = stars.directions_at(2000.0)
    z = directions[belt[1]]
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    attitude = quaternion.from_matrix(np.stack([x, np.cross(z, x), z]))
    model = StarCameraModel(columns=512, rows=512)
    image = expected_electrons(
        model, directions, stars.magnitude, np.array([0.0, 0.2]), np.stack([attitude] * 2)
    )
    pixels = model.pinhole.project(directions[belt] @ quaternion.attitude_matrix(attitude).T)
    assert pixels[1] == pytest.approx([255.5, 255.5], abs=1e-6)
    for pixel in pixels:
        column, row = np.rint(pixel).astype(int)
        window = image[row - 5 : row + 6, column - 5 : column + 6]
        assert centroid(window) + np.array([column - 5, row - 5]) == pytest.approx(pixel, abs=0.02)


@pytest.mark.parametrize(
    ("name", "value"),
    [("columns", 0), ("field_of_view", 3.2), ("gain", 0.0), ("read_noise", float("nan")), ("bits", 17)],
)
def test_a_camera_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(OutOfRange, match=name):
        StarCameraModel(**{name: value})  # type: ignore[arg-type] # wrong on purpose


def test_unknown_options_and_hot_pixels_off_the_detector_are_refused() -> None:
    with pytest.raises(ValueError, match="integrated or bilinear"):
        StarCameraModel(psf="airy")  # type: ignore[arg-type] # wrong on purpose
    with pytest.raises(OutOfRange, match="hot pixel's column"):
        StarCameraModel(hot_pixels=((1024, 0, 10.0),))


def test_stars_and_attitudes_that_cannot_be_are_refused() -> None:
    star, (times, attitudes) = at_pixels(SMALL, [30.0, 20.0]), still()
    with pytest.raises(ValueError, match="finite"):
        expected_electrons(SMALL, star * np.nan, [3.0], times, attitudes)
    with pytest.raises(ValueError, match=r"\(n, 3\) and \(n,\)"):
        expected_electrons(SMALL, star, [3.0, 4.0], times, attitudes)
    with pytest.raises(ValueError, match="k of 2 or more"):
        expected_electrons(SMALL, star, [3.0], times[:1], attitudes[:1])
    with pytest.raises(OutOfRange, match="time between"):
        expected_electrons(SMALL, star, [3.0], times[::-1], attitudes)
    with pytest.raises(OutOfRange, match="norm of an attitude"):
        expected_electrons(SMALL, star, [3.0], times, attitudes * np.nan)
    with pytest.raises(OutOfRange, match="norm of an attitude"):
        expected_electrons(SMALL, star, [3.0], times, 1.01 * attitudes)
    flipped = quaternion.multiply(quaternion.from_rotation_vector(np.array([3.0, 0.0, 0.0])), POINTING)
    with pytest.raises(OutOfRange, match="turn between"):
        expected_electrons(SMALL, star, [3.0], times, np.stack([POINTING, flipped]))


def test_no_plotting_library_is_imported() -> None:
    code = (
        "import sys, sim_hal.star_camera, knightcube.astro.catalogue; sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
