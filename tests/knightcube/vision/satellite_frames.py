"""Frames of the real sky with satellites, as jobs of the vision worker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import from_rotation_vector, multiply
from knightcube.vision.frame_job import FrameJob, TrackerSettings
from knightcube.vision.objects.settings import ObjectMeasurementSettings
from knightcube.vision.startracker.detection import DetectionSettings
from knightcube.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from knightcube.vision.streaks.settings import LikelihoodSettings
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.support.scenes import catalogue

CAMERA = StarCameraModel(columns=512, rows=512)
EXPOSURE = 0.2
TIMES = np.linspace(-0.1, 0.1, 9)
"""s from mid-exposure."""


def frame_job(
    held: FloatArray, turn: FloatArray, satellites: Sequence[SourceTrack], knows: bool = True, seed: int = 11
) -> FrameJob:
    """Return the job for a frame with attitude `held` (4,) at mid-exposure and rate `turn` (3,) rad/s.

    `knows` states whether attitude and rate are known in advance, to 1e-4.
    """
    rng = np.random.default_rng(seed)
    attitudes = np.array([multiply(from_rotation_vector(turn * t), held) for t in TIMES])
    stars, directions = catalogue(8.5)
    pixels = render(CAMERA, directions, stars.magnitude, TIMES, attitudes, rng, list(satellites))
    top = float(CAMERA.highest_count)
    detection = DetectionSettings(psf_sigma=CAMERA.psf_sigma, gain=CAMERA.gain, saturation=top)
    likelihood = LikelihoodSettings(gain=CAMERA.gain, saturation=top, psf_sigma=CAMERA.psf_sigma)
    tracker = TrackerSettings(SolveSettings(detection=detection), (1.0, 1.0))
    off = from_rotation_vector(np.array([1e-4, -1e-4, 1e-4]))
    rate = RatePrior(turn, 1e-4) if knows else None
    attitude = AttitudePrior(multiply(off, held), 1e-4) if knows else None
    return FrameJob(
        pixels,
        CAMERA.pinhole,
        EXPOSURE,
        likelihood,
        tracker,
        rate,
        attitude,
        objects=ObjectMeasurementSettings(),
    )
