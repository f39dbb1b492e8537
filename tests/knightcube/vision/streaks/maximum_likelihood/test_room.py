"""What a fit looks at is bounded: the pixels about streaks are foreseen, a crowd's faintest left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from knightcube.vision.streaks.maximum_likelihood import joint_fit
from knightcube.vision.streaks.maximum_likelihood.exposed_frame import expose_frame
from knightcube.vision.streaks.maximum_likelihood.iteration import ExposedCamera
from knightcube.vision.streaks.maximum_likelihood.motion import Motion
from knightcube.vision.streaks.maximum_likelihood.scene import Scene
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings
from knightcube.vision.streaks.maximum_likelihood.shutter import Shutter
from knightcube.vision.streaks.maximum_likelihood.windows import window_areas
from tests.knightcube.vision.streaks.maximum_likelihood.scenes import CAMERA, SATURATION, real_sky

_STARS = 40
_TRUSTED = 12
_ROOM = 20


def _taken(theta: float, length: float) -> tuple[ExposedCamera, Scene]:
    """Return a frame and its brightest stars as they are, the first of them with a say."""
    sky = real_sky(7, np.radians(theta), length, 1.0)
    frame = expose_frame(sky.pixels, SATURATION, CAMERA.gain)
    camera = ExposedCamera(frame, CAMERA.pinhole, Shutter(), LikelihoodSettings(), 1.0)
    order = np.argsort(-sky.electrons, kind="stable")[:_STARS]
    width = float(np.sqrt(CAMERA.psf_sigma**2 + 1.0 / 12.0))
    trusted = np.arange(len(order)) < _TRUSTED
    motion = Motion.steady(sky.rate * sky.exposure)
    light = sky.electrons[order] / CAMERA.gain
    return camera, Scene(motion, width, sky.stars[order], light, np.zeros(len(order)), trusted)


@pytest.mark.parametrize(("theta", "length"), [(90.0, 60.0), (60.0, 400.0), (30.0, 400.0), (3.0, 250.0)])
def test_the_pixels_about_streaks_are_foreseen(theta: float, length: float) -> None:
    """Within a third: straight, oblique, bent and leaving the frame."""
    camera, scene = _taken(theta, length)
    windows = camera.windows(scene)
    taken = windows.strips.index.size + windows.patches.index.size
    foreseen = float(window_areas(camera.pinhole, scene, camera.settings.reach).sum())
    assert 0.67 * taken < foreseen < 1.5 * taken


def test_a_crowd_is_fitted_as_far_as_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """In whatever order they come: the faintest are taken out, and the rate is as true as it claims."""
    camera, scene = _taken(60.0, 300.0)
    room = float(window_areas(camera.pinhole, scene, camera.settings.reach)[:_ROOM].sum())
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", room * 1.001)
    done = joint_fit.joint_fit(camera, scene.select(np.arange(len(scene.light))[::-1]))
    assert done is not None
    assert len(done.scene.light) == _ROOM
    apart = np.linalg.norm(done.scene.stars[:, None] - scene.stars[:_ROOM], axis=2).min(axis=0)
    assert np.median(apart) < 1.0
    error = (done.scene.motion.turn - scene.motion.turn)[:3]
    assert error @ np.linalg.solve(done.solution.covariance[:3, :3], error) < 25.0


def test_stars_with_a_say_are_fitted_whatever_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """However little room there is."""
    camera, scene = _taken(60.0, 300.0)
    monkeypatch.setattr(joint_fit, "_MOST_PIXELS", 1.0)
    done = joint_fit.joint_fit(camera, scene)
    assert done is not None
    assert len(done.scene.light) == _TRUSTED


def test_a_fit_whose_point_spread_outgrows_the_first_is_none() -> None:
    """Stars twice as wide as the fit set out with are not those it was given."""
    camera, scene = _taken(60.0, 300.0)
    assert joint_fit.joint_fit(camera, scene) is not None
    assert joint_fit.joint_fit(camera, replace(scene, width=0.5 * scene.width)) is None
