"""Derives the settings of the tasks that every body has from a configuration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from flight.loop.body import Body
from flight.loop.tasks.frame_measurements import ImagingSettings
from flight.loop.tasks.navigation import NavigationSettings
from flight.loop.tasks.wide_imaging import WideSettings
from flight.schema.camera_model import camera_model, likelihood_settings
from flight.schema.devices import Camera, ObjectTracking
from flight.schema.orbit_devices import WideCamera
from flight.schema.sections import Config
from hal.interfaces.wires import SECOND_NS
from knightcube.gnc.tracking.tracker import TrackSettings
from knightcube.vision.camera.exposure import Exposures
from knightcube.vision.camera.knowledge import CameraKnowledge
from knightcube.vision.frame_job import TrackerSettings
from knightcube.vision.kept_frames import KeptFrames
from knightcube.vision.objects.sighted import SightSettings
from knightcube.vision.startracker.detection import DetectionSettings
from knightcube.vision.startracker.identification.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import SolveSettings
from knightcube.vision.streaks.corners.settings import StreakSettings
from knightcube.vision.streaks.maximum_likelihood.settings import LikelihoodSettings


def navigation_settings(config: Config) -> NavigationSettings:
    """Return the age limits of the inertial unit's readings."""
    section = config.estimation
    return NavigationSettings(
        round(config.inertial_unit.max_age * SECOND_NS),
        round(section.coast * SECOND_NS),
        round(SECOND_NS / config.executive.control_rate_hz),
    )


def imaging_settings(camera: Camera, body: Body, frames: Path | None) -> ImagingSettings:
    """Return the settings of imaging; `frames` is the folder of frames that are kept."""
    kept = KeptFrames(frames, camera.keep_frames) if frames is not None and camera.keep_frames else None
    return ImagingSettings(
        camera=camera_model(camera),
        exposures=_exposures(camera),
        # A trigger may come late, and the next on time.
        fine_rest_ns=round(((camera.fine_period or camera.period) - 0.5 * camera.period) * SECOND_NS),
        max_age_ns=round(camera.max_age * SECOND_NS),
        late_ns=round(camera.late_after * SECOND_NS),
        slow_ns=round(camera.vision_slow_after * SECOND_NS),
        max_rate=math.inf if camera.max_rate is None else camera.max_rate,
        mounting=np.array(camera.mounting),
        estimator=_estimator(camera),
        tracker=_tracker(camera),
        angular_acceleration_psd=body.angular_acceleration_psd,
        velocity=body.velocity,
        objects=None if camera.objects is None else SightSettings(faintest=camera.objects.faintest),
        knowledge=body.knowledge,
        seeks=body.seeks,
        calm=body.calm,
        kept=kept,
    )


def wide_settings(cameras: Sequence[WideCamera]) -> WideSettings:
    """Return the times of the wide cameras, those of the most frequent one for all."""
    fine_ns = round(min(camera.fine_period for camera in cameras) * SECOND_NS)
    period_ns = min(round(min(camera.period for camera in cameras) * SECOND_NS), fine_ns)
    return WideSettings(
        [round(camera.exposure * SECOND_NS) for camera in cameras],
        period_ns - SECOND_NS // 2,  # run once a second, which may come late
        fine_ns - SECOND_NS // 2,
        min(2 * SECOND_NS, period_ns),
        max(round(max(camera.max_age for camera in cameras) * SECOND_NS), 2 * fine_ns),
    )


def _exposures(camera: Camera) -> Exposures:
    """Return the exposures of the star camera."""
    least, most = camera.streak_exposure or (camera.exposure, camera.exposure)
    return Exposures(camera.exposure, least, most, camera_model(camera).focal_length)


def track_settings(section: ObjectTracking) -> TrackSettings:
    """Return how tracks of objects start, go on and end."""
    return TrackSettings(needed=section.needed, within=section.within, coast=section.coast)


def _tracker(camera: Camera) -> TrackerSettings | None:
    """Return the settings of the star tracker, None without one."""
    section = camera.star_tracker
    if section is None:
        return None
    detection = DetectionSettings(
        psf_sigma=camera.psf_sigma, gain=camera.gain, saturation=_saturation(camera)
    )
    spread = 1.0 + section.scale_error
    scale = (1.0 / spread, spread)
    index = Path(section.index) if section.index is not None else None
    velocity = None if section.velocity is None else np.array(section.velocity)
    # The camera is known on board: no mirror is in its path, and its focal length is as good as configured.
    identification = IdentificationSettings(mirror=False, hint_error=1.0)
    accuracy = camera.accuracy
    lens = CameraKnowledge(accuracy.focal_length, accuracy.centre, accuracy.distortion)
    solve = SolveSettings(detection=detection, identification=identification, velocity=velocity, lens=lens)
    return TrackerSettings(solve, scale, index)


def _saturation(camera: Camera) -> float:
    return camera.saturation or float(2**camera.bits - 1)


def _estimator(camera: Camera) -> StreakSettings | LikelihoodSettings:
    """Return the settings of the configured streak estimator."""
    saturation = _saturation(camera)
    if camera.estimator == "likelihood":
        return replace(likelihood_settings(camera), saturation=saturation)
    settings = StreakSettings.of(camera.estimator, saturation=saturation, gain=camera.gain)
    return settings if camera.endpoint_bias is None else replace(settings, endpoint_bias=camera.endpoint_bias)
