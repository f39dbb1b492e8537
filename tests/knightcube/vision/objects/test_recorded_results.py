"""Tests that objects found in small simulated frames equal the recorded objects to five digits."""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.frame_job import FrameFound, run
from knightcube.vision.objects.detect import detect_objects
from knightcube.vision.objects.settings import EndpointSettings, ObjectSettings
from knightcube.vision.objects.streak_ends import measure_streaks, segment_frame
from sim_hal.star_camera import SourceTrack
from tests.knightcube.vision.objects.space_objects import frame_with, motion_across, object_path
from tests.knightcube.vision.satellite_frames import CAMERA, EXPOSURE, HELD, TIMES, Shot, frame_job
from tests.support.recorded_results import check
from tests.support.streak_frames import rate_at, star_camera

SMALL = star_camera(400)
SETTINGS = EndpointSettings()
TURN: FloatArray = rate_at(1.2, 0.04, 0.7)


def shot(
    place: tuple[float, float], motion: tuple[float, float], magnitude: float, turn: float = 0.0
) -> FrameFound:
    """Return the result of the image-processing job for a satellite among stars."""
    return Shot(np.array(place), np.array(motion), magnitude, np.array([0.0, turn, 0.0])).found()


def test_a_satellite_that_hardly_moves_is_as_recorded() -> None:
    check(__file__, "slow", shot((250.3, 180.7), (0.6, -0.4), 4.0).objects)


def test_a_satellite_that_moves_by_pixels_is_as_recorded() -> None:
    check(__file__, "fast", shot((203.3, 301.8), (4.0, 1.5), 3.0).objects)


def test_a_satellite_among_streaks_is_as_recorded() -> None:
    check(__file__, "streaks", shot((203.3, 301.8), (2.5, 1.0), 2.0, 0.02).objects)


def test_two_satellites_are_as_recorded() -> None:
    tracks = []
    for place, motion, magnitude in (((120.0, 90.0), (1.0, 2.0), 4.5), ((330.0, 410.0), (-2.0, 0.5), 3.5)):
        ways = np.array(place) + np.outer(TIMES / EXPOSURE, motion)
        seen = CAMERA.pinhole.unit_vectors(ways) @ attitude_matrix(HELD)
        tracks.append(SourceTrack(TIMES, seen, magnitude))
    check(__file__, "two", run(frame_job(HELD, np.zeros(3), tracks, True)).objects)


def streaked() -> Image:
    """Return a frame of star streaks, with an object that moves differently."""
    direction = SMALL.pinhole.unit_vectors(np.array([[170.0, 230.0]]))[0]
    path = object_path(SMALL, direction, motion_across(direction, 0.03, 0.4), TURN)
    return frame_with(SMALL, TURN, 1.0, 7, [(path, 2.0)], 5.5)


def test_the_ends_of_streaks_are_as_recorded() -> None:
    pixels = streaked()
    frame = segment_frame(pixels, SETTINGS)
    check(__file__, "ends", [frame, measure_streaks(frame, SETTINGS)])


def test_objects_among_streaks_are_as_recorded() -> None:
    report = detect_objects(streaked(), SMALL.pinhole, TURN, 1.0, ObjectSettings())
    check(__file__, "indicators", report)


def test_a_bright_satellite_beside_a_star_is_as_recorded() -> None:
    found = Shot(np.array([60.0, 300.0]), np.array([1.5, -1.0]), -0.5, np.zeros(3), knows=False).found()
    check(__file__, "bright", [found.objects, found.solution])


def test_a_faint_satellite_near_the_border_is_as_recorded() -> None:
    check(__file__, "border", shot((4.0, 250.0), (1.0, 3.0), 5.5).objects)


def test_stars_alone_are_as_recorded() -> None:
    check(__file__, "alone", shot((-900.0, -900.0), (0.0, 0.0), 4.0).objects)
