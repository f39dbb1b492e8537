"""Tests of the correction of streak lengths and of the selection of fitted stars."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.vision.streaks import joint_fit
from knightcube.vision.streaks.fit_windows import window_areas
from knightcube.vision.streaks.frame import reduce_frame
from knightcube.vision.streaks.geometry import CameraMotion, Shutter, StreakScene, positions
from knightcube.vision.streaks.joint_fit import FitProblem, find_light_ends, stretched
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from tests.knightcube.vision.streaks.scenes import CAMERA, SATURATION, real_sky

_STARS = 16


def _seen(theta: float, length: float, turned: float) -> tuple[FitProblem, StreakScene, CameraMotion]:
    """Return a frame, its brightest stars for `turned` times the true motion, and the true motion."""
    sky = real_sky(21, np.radians(theta), length, 0.2)
    frame = reduce_frame(sky.pixels, SATURATION, CAMERA.gain)
    camera = FitProblem(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(), 1.0)
    order = np.argsort(-sky.electrons, kind="stable")[:_STARS]
    true = CameraMotion.steady(sky.rate * sky.exposure)
    motion = CameraMotion.steady(turned * true.rate)
    light, everyone = sky.electrons[order] / CAMERA.gain, np.ones(_STARS, dtype=np.bool_)
    return camera, StreakScene(motion, 1.04, sky.stars[order], light, np.zeros(_STARS), everyone), true


@pytest.mark.parametrize(("theta", "length"), [(90.0, 120.0), (60.0, 300.0), (20.0, 300.0)])
def test_the_light_ends_at_the_ends_of_the_true_motion(theta: float, length: float) -> None:
    camera, scene, _ = _seen(theta, length, 1.0)
    beyond, _ = find_light_ends(camera, scene)
    assert np.count_nonzero(np.isfinite(beyond)) >= 8
    assert float(np.nanmedian(np.abs(beyond))) < 2.0
    assert stretched(camera, scene) is None


@pytest.mark.parametrize("turned", [0.96, 1.04])
@pytest.mark.parametrize(("theta", "length"), [(90.0, 200.0), (60.0, 300.0)])
def test_a_motion_of_wrong_length_is_corrected(theta: float, length: float, turned: float) -> None:
    camera, scene, true = _seen(theta, length, turned)
    mended = stretched(camera, scene)
    assert mended is not None
    assert np.linalg.norm(mended.motion.rate - true.rate) < 0.006 * np.linalg.norm(true.rate)
    assert stretched(camera, mended) is None


def test_stars_with_one_correct_end_are_moved_between_their_ends() -> None:
    """Stars with one correct end are moved, so that their centres are between their ends.

    The rotation is 4 % too large and the first ends are correct, so that the centres are wrong by 6 px.
    """
    camera, scene, true = _seen(90.0, 300.0, 1.0)
    ahead = positions(camera.pinhole, true, scene.stars, np.full(_STARS, 0.02))
    off = replace(scene, motion=CameraMotion.steady(1.04 * true.rate), stars=ahead)
    assert float(np.median(np.linalg.norm(ahead - scene.stars, axis=1))) > 5.0
    mended = stretched(camera, off)
    assert mended is not None
    assert float(np.median(np.linalg.norm(mended.stars - scene.stars, axis=1))) < 1.5


_CROWD = 40
_TRUSTED = 12
_ROOM = 20


def _taken(theta: float, length: float) -> tuple[FitProblem, StreakScene]:
    """Return a frame and its brightest stars at their true positions. The first stars are trusted."""
    sky = real_sky(7, np.radians(theta), length, 1.0)
    frame = reduce_frame(sky.pixels, SATURATION, CAMERA.gain)
    camera = FitProblem(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(), 1.0)
    order = np.argsort(-sky.electrons, kind="stable")[:_CROWD]
    width = float(np.sqrt(CAMERA.psf_sigma**2 + 1.0 / 12.0))
    trusted = np.arange(len(order)) < _TRUSTED
    motion = CameraMotion.steady(sky.rate * sky.exposure)
    light = sky.electrons[order] / CAMERA.gain
    return camera, StreakScene(motion, width, sky.stars[order], light, np.zeros(len(order)), trusted)


@pytest.mark.parametrize(("theta", "length"), [(90.0, 60.0), (60.0, 400.0), (30.0, 400.0), (3.0, 250.0)])
def test_the_number_of_pixels_of_windows_is_predicted(theta: float, length: float) -> None:
    """The predicted number of pixels in windows is within a third of the true number.

    The tested streaks are straight, oblique, curved, or only partly visible.
    """
    camera, scene = _taken(theta, length)
    windows = camera.windows(scene)
    taken = windows.strips.index.size + windows.patches.index.size
    foreseen = float(window_areas(camera.pinhole, scene, camera.settings.reach).sum())
    assert 0.67 * taken < foreseen < 1.5 * taken


def test_the_brightest_stars_are_fitted_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The brightest stars are fitted up to the limit of pixels.

    The result does not depend on the order of the stars, and the rate error agrees with its covariance.
    """
    camera, scene = _taken(60.0, 300.0)
    room = float(window_areas(camera.pinhole, scene, camera.settings.reach)[:_ROOM].sum())
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", room * 1.001)
    done = joint_fit.joint_fit(camera, scene.select(np.arange(len(scene.light))[::-1]))
    assert done is not None
    assert len(done.scene.light) == _ROOM
    apart = np.linalg.norm(done.scene.stars[:, None] - scene.stars[:_ROOM], axis=2).min(axis=0)
    assert np.median(apart) < 1.0
    error = (done.scene.motion.rate - scene.motion.rate)[:3]
    assert error @ np.linalg.solve(done.solution.covariance[:3, :3], error) < 25.0


def test_trusted_stars_are_fitted_without_regard_to_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trusted stars are fitted regardless of the limit of pixels.

    With a limit of one pixel, only the trusted stars are fitted.
    """
    camera, scene = _taken(60.0, 300.0)
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", 1.0)
    done = joint_fit.joint_fit(camera, scene)
    assert done is not None
    assert len(done.scene.light) == _TRUSTED


def test_a_fit_with_a_much_wider_point_spread_is_rejected() -> None:
    """A fit whose point spread is twice as wide as initially assumed is rejected as a wrong model."""
    camera, scene = _taken(60.0, 300.0)
    assert joint_fit.joint_fit(camera, scene) is not None
    assert joint_fit.joint_fit(camera, replace(scene, width=0.5 * scene.width)) is None
