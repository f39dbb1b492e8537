"""Frames of the real sky with satellites, as jobs of the image-processing worker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.vision.frame_job import FrameFound, FrameJob, TrackerSettings, run
from knightcube.vision.objects.settings import MeasuredObjects, ObjectMeasurementSettings
from knightcube.vision.startracker.solve import AttitudePrior, RatePrior, SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings
from sim_hal.star_camera import SourceTrack, StarCameraModel, render
from tests.support.scenes import catalogue

CAMERA = StarCameraModel(columns=512, rows=512)
EXPOSURE = 0.2
TIMES = np.linspace(-0.1, 0.1, 9)
"""Times (s) from mid-exposure."""


def frame_job(
    held: FloatArray, turn: FloatArray, satellites: Sequence[SourceTrack], knows: bool = True, seed: int = 11
) -> FrameJob:
    """Return the job for a frame with attitude `held` (4,) at mid-exposure, and rate `turn` (3,), rad/s.

    If `knows` is set, the job has prior values of attitude and rate with errors of 1e-4.
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


HELD: FloatArray = np.array([0.5, -0.1, 0.3, np.sqrt(0.65)])


@dataclass(frozen=True)
class Shot:
    """A satellite at `place` (2,), px, at mid-exposure, its motion (2,), px, and the rate `turn` (3,)."""

    place: FloatArray
    motion: FloatArray
    magnitude: float
    turn: FloatArray
    knows: bool = True

    def found(self) -> FrameFound:
        """Return the result of the image-processing job."""
        ways = self.place + np.outer(TIMES / EXPOSURE, self.motion)
        seen = CAMERA.pinhole.unit_vectors(ways) @ attitude_matrix(HELD)
        return run(frame_job(HELD, self.turn, [SourceTrack(TIMES, seen, self.magnitude)], self.knows))

    def sighting(self, sighted: MeasuredObjects | None) -> int | None:
        """Return the index of the detection within a pixel of the satellite, or None."""
        assert sighted is not None
        away = np.linalg.norm(sighted.points - self.place, axis=1)
        return int(away.argmin()) if len(away) and away.min() < 1.0 else None
