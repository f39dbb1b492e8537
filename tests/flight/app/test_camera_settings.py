"""Tests of camera settings from configuration sections: times in ns, lens, star tracker and estimator."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.app.flight import horizon_camera_settings, imaging_settings, lens_knowledge
from flight.loop.state import Learned
from flight.schema.devices import Camera, CameraAccuracy, ObjectTracking, StarTrackerSection, WideCamera
from flight.schema.document import ConfigError
from knightcube.vision.streaks.streak_result import LikelihoodSettings

S = 1_000_000_000


def body(streak_estimator: Any = None) -> Any:
    """Return a body whose functions are distinguishable dummy objects."""
    estimation = SimpleNamespace(angular_acceleration_psd="psd", velocity="velocity", knowledge="knowledge")
    control = SimpleNamespace(follows_objects="follows", exposure_start="calm")
    return cast(
        Any, SimpleNamespace(estimation=estimation, control=control, streak_estimator=streak_estimator)
    )


def test_the_times_of_the_star_camera_are_in_ns() -> None:
    camera = Camera(
        period=5.0, fine_period=10.0, max_age=30.0, late_after=1.5, vision_slow_after=2.5, max_rate=0.02
    )
    made = imaging_settings(camera, body(), None)
    assert made.fine_rest_ns == round(7.5 * S), "half a period before the fine one"
    assert (made.max_age_ns, made.late_ns, made.slow_ns) == (30 * S, round(1.5 * S), round(2.5 * S))
    assert (made.max_rate, made.kept, made.objects, made.tracker) == (0.02, None, None, None)
    marks: Any = (made.velocity, made.seeks, made.calm, made.knowledge)
    assert marks == ("velocity", "follows", "calm", "knowledge")
    plain = imaging_settings(Camera(period=5.0, mounting=(0.0, 0.6, 0.0, 0.8)), body(), Path("frames"))
    assert plain.fine_rest_ns == round(2.5 * S)
    assert plain.max_rate == math.inf
    assert plain.kept is None, "no frames are kept by default"
    assert plain.mounting.tolist() == [0.0, 0.6, 0.0, 0.8]


def test_exposures_frames_and_objects_are_as_configured() -> None:
    section = ObjectTracking(faintest=6.5)
    camera = Camera(exposure=0.2, streak_exposure=(0.1, 1.0), keep_frames=7, objects=section)
    made = imaging_settings(camera, body(), Path("frames"))
    exposures = made.exposures
    assert (exposures.usual, exposures.least, exposures.most) == (0.2, 0.1, 1.0)
    assert exposures.scale == made.camera.focal_length
    assert made.kept is not None
    assert (made.kept.folder, made.kept.most) == (Path("frames"), 7)
    assert made.objects is not None
    assert made.objects.faintest == 6.5
    fixed = imaging_settings(Camera(exposure=0.3), body(), None).exposures
    assert (fixed.least, fixed.most) == (0.3, 0.3)


def test_the_star_tracker_knows_lens_scale_and_velocity() -> None:
    tracker = StarTrackerSection(index="sky.index", scale_error=0.25, velocity=(1.0, 2.0, 3.0))
    accuracy = CameraAccuracy(focal_length=1e-3, centre=2.0, distortion=3e-3)
    camera = Camera(star_tracker=tracker, accuracy=accuracy, psf_sigma=1.3, gain=2.0, bits=12)
    found = imaging_settings(camera, body(), None).tracker
    assert found is not None
    assert (found.index, found.scale) == (Path("sky.index"), (0.8, 1.25))
    assert found.solve.velocity is not None
    assert found.solve.velocity.tolist() == [1.0, 2.0, 3.0]
    lens, detection = found.solve.lens, found.solve.detection
    assert lens is not None
    assert (lens.focal_length, lens.centre, lens.distortion) == (1e-3, 2.0, 3e-3)
    assert (detection.psf_sigma, detection.gain, detection.saturation) == (1.3, 2.0, 4095.0)
    plain = imaging_settings(
        Camera(star_tracker=StarTrackerSection(), saturation=900.0), body(), None
    ).tracker
    assert plain is not None
    assert (plain.index, plain.scale, plain.solve.velocity) == (None, (1.0, 1.0), None)
    assert plain.solve.detection.saturation == 900.0


def test_the_lens_is_learned_from_the_last_boot_unless_it_is_exact_or_switched_off() -> None:
    def configured(**changes: Any) -> Any:
        camera = Camera(**{"star_tracker": StarTrackerSection(), **changes})
        return SimpleNamespace(camera=camera, estimation=SimpleNamespace(changed=0.3))

    problems: list[str] = []
    exact = CameraAccuracy(centre=0.0, distortion=0.0)
    assert lens_knowledge(configured(learn_lens=False), {}, problems) is None
    assert lens_knowledge(configured(star_tracker=None), {}, problems) is None
    assert lens_knowledge(configured(accuracy=exact, line_time=0.0), {}, problems) is None
    assert lens_knowledge(configured(accuracy=exact), {}, problems) is not None, "its line time is unknown"
    begun = lens_knowledge(configured(), {}, problems)
    assert begun is not None
    assert not begun.usable
    values, covariance = begun.learned
    moved = values + np.array([0.0, 1.5, -1.0, 0.0, 0.0, 1e-5, 0.1])
    found = lens_knowledge(configured(), {"lens": Learned.of(moved, 0.01 * covariance)}, problems)
    assert found is not None
    assert found.usable
    assert np.array_equal(found.learned[0], moved)
    assert problems == []
    moved[1] += 15.0  # the configuration states an accuracy of 2 px
    other = lens_knowledge(configured(), {"lens": Learned.of(moved, 0.01 * covariance)}, problems)
    assert other is not None
    assert not other.usable
    assert problems[0].startswith("lens [")


def test_the_estimator_of_streaks_is_that_of_the_section_or_of_the_body() -> None:
    likelihood = imaging_settings(Camera(bits=10), body(), None).estimator
    assert isinstance(likelihood, LikelihoodSettings)
    assert likelihood.saturation == 1023.0
    camera = Camera(estimator=cast(Any, "another"))
    own: Any = imaging_settings(camera, body("own"), None).estimator
    assert own == "own"
    with pytest.raises(ConfigError, match="estimator"):
        imaging_settings(camera, body(), None)


def test_the_most_frequent_horizon_camera_sets_the_times() -> None:
    cameras = [
        WideCamera(mounting=(0.0, 0.0, 0.0, 1.0), field_of_view_deg=92.0, period=period, exposure=exposure)
        for period, exposure in ((10.0, 0.01), (8.0, 0.02))
    ]
    made = horizon_camera_settings(cameras)
    numbers = [getattr(made, name) for name in made.__dataclass_fields__]
    fine = round(min(camera.fine_period for camera in cameras) * S)
    period = min(8 * S, fine)
    age = max(round(max(camera.max_age for camera in cameras) * S), 2 * fine)
    assert numbers[0] == [10_000_000, 20_000_000]
    assert numbers[1:5] == [period - S // 2, fine - S // 2, min(2 * S, period), age]
