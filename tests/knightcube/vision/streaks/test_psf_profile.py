"""Tests of a point spread that is learned from the frame, on frames of an independent renderer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.camera.lens import EXACT, Pinhole
from knightcube.vision.streaks import estimate, first_fits
from knightcube.vision.streaks.camera_motion import CameraMotion
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.fit_windows import cut_windows
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import PsfProfile, Shutter, StreakScene
from knightcube.vision.streaks.scene_images import gaussian_lights, light_of, model_images
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult
from tests.support.supersampled import Optics, Sky, Spread, disc, light, ring

_PINHOLE = Pinhole.from_field_of_view(560, 560, np.radians(7.0))
_EXPOSURE = 0.2
_TURN = np.array([0.6, -0.7, 1.5]) * 60.0 / _PINHOLE.focal_length
_RATE = _TURN / _EXPOSURE


def _found(
    spread: Spread | None, seed: int, shake: Callable[[FloatArray], FloatArray] | None = None
) -> MotionResult:
    """Return the motion found in a frame of 14 stars with the given PSF and image displacement (m, 2), px."""
    rng = np.random.default_rng((seed, 3))

    def at(times: FloatArray) -> FloatArray:
        steady = from_rotation_vector(times[:, None] * _TURN)
        if shake is None:
            return steady
        aside = np.pad(shake(times), ((0, 0), (0, 1))) / _PINHOLE.focal_length
        return multiply(from_rotation_vector(aside), steady)

    stars = _PINHOLE.unit_vectors(rng.uniform(60.0, 500.0, (14, 2)))
    sky = Sky(stars, rng.uniform(3e4, 2e5, len(stars)))
    optics = Optics() if spread is None else Optics((spread,), radius=8.0)
    electrons = rng.poisson(light(_PINHOLE, optics, sky, at, 200.0, 0.0, rng) + 100.0)
    counts = np.clip(np.rint(electrons + rng.normal(0.0, 5.0, electrons.shape)), 0.0, 65_535.0)
    settings = LikelihoodSettings(gain=1.0, line_time=0.0, knowledge=EXACT)
    return estimate_motion(counts.astype(np.uint16), _PINHOLE, _EXPOSURE, settings, _RATE)


@pytest.mark.parametrize("spread", [disc(4.0), ring(4.0, 2.0), ring(6.0, 3.0)], ids=["disc", "4", "6"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_defocused_camera_gives_the_rate_within_its_covariance(spread: Spread, seed: int) -> None:
    found = _found(spread, seed)
    assert found.rate is not None, found.reason
    assert found.covariance is not None
    error = found.rate - _RATE
    assert error @ np.linalg.solve(found.covariance, error) < 4.0**2
    assert np.linalg.norm(error) < 0.012 * np.linalg.norm(_RATE)


def test_without_a_learned_profile_rings_give_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (first_fits, estimate):
        monkeypatch.setattr(module, "fit_profile", lambda *_: None)
    assert _found(ring(4.0, 2.0), 1).rate is None


@pytest.mark.parametrize("cycles", [40.0, 90.0])
def test_a_fast_vibration_is_not_treated_as_a_ring(cycles: float) -> None:
    """A vibration along a line widens streaks as a ring-shaped PSF does, but it does not widen their ends.

    The residuals at the ends make the rate uncertain, so the frame gives no rate. A ring-shaped PSF of this
    width alone gives a rate, as the test of a defocused camera shows.
    """

    def shake(times: FloatArray) -> FloatArray:
        return np.outer(3.0 * np.sin(2.0 * np.pi * cycles * times + 1.0), [0.6, 0.8])

    found = _found(None, 1, shake)
    assert found.rate is None
    assert found.reason.startswith("the rate is uncertain by")
    assert "or the point spread is" in found.reason


def _scene(rotation: FloatArray = 2.0 * _TURN) -> StreakScene:
    stars = np.array([[200.0, 210.0], [330.0, 300.0], [292.0, 255.0]])
    flux = np.array([3e4, 5e4, 2e4])
    scene = StreakScene.of(CameraMotion.steady(rotation), 1.4, stars, flux)
    return replace(scene, profile=PsfProfile((0.6, 1.0, 1.3), (-0.7, 2.0, -0.3)))


def test_the_light_of_a_profile_is_the_sum_of_its_gaussians() -> None:
    scene = _scene()
    frame = reduce_frame(np.full((560, 560), 100, dtype=np.uint16), 4095.0, 1.0)
    windows = cut_windows(frame, _PINHOLE, Shutter(), scene, 4.0)
    whole = light_of(_PINHOLE, Shutter(), scene, windows)
    lights = gaussian_lights(_PINHOLE, Shutter(), scene, windows)
    for width, own in zip(scene.profile.widths, lights, strict=True):
        one = replace(scene, width=width * scene.width, profile=PsfProfile((1.0,), (1.0,)))
        assert own == pytest.approx(light_of(_PINHOLE, Shutter(), one, windows))
    assert whole == pytest.approx(np.array(scene.profile.shares) @ lights, rel=1e-4, abs=1e-2)


def test_the_derivatives_by_the_width_are_those_of_the_light() -> None:
    """The derivatives of the images of long streaks and spots with respect to the PSF width are correct."""
    # A rotation about the boresight gives streaks far from the image centre and a spot near the centre.
    scene, step = _scene(np.array([0.0, 0.0, 0.3])), 2e-3
    frame = reduce_frame(np.full((560, 560), 100, dtype=np.uint16), 4095.0, 1.0)
    windows = cut_windows(frame, _PINHOLE, Shutter(), scene, 4.0)
    images, spots, change = model_images(_PINHOLE, Shutter(), scene, windows)
    more, less = (
        model_images(_PINHOLE, Shutter(), replace(scene, width=scene.width + by), windows)
        for by in (step, -step)
    )
    expected = (more[0][:, 0] - less[0][:, 0]) / (2.0 * step)
    assert np.abs(images[:, 5] - expected).max() < 0.02 * np.abs(expected).max()
    assert len(spots) == 1
    slope = change[:, 8] * scene.width / scene.sigma
    assert slope == pytest.approx((more[1] - less[1]) / (2.0 * step), rel=1e-3, abs=1e-6)
