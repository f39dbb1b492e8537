"""Objects that cross in the frame, from pixels to tracks; and a crowded sky at rest has an attitude."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import angle_between, attitude_matrix, from_matrix
from knightcube.gnc.tracking.tracker import FrameSightings, ObjectTracker, TrackSettings
from knightcube.vision.frame_job import run
from knightcube.vision.streaks.streak_result import StreakStatus
from sim_hal.star_camera import SourceTrack
from tests.knightcube.vision.satellite_frames import CAMERA, EXPOSURE, TIMES, frame_job

HELD: FloatArray = np.array([0.5, -0.1, 0.3, np.sqrt(0.65)])
MEETING = np.array([251.3, 262.8])
"""px, where both are after 7 s."""
MOTIONS = np.array([[8.0, 2.0], [5.0, -5.5]])
"""px/s: 0.33 and 0.30 deg/s."""
MAGNITUDE = 4.5


def _looking_at(right_ascension_deg: float, declination_deg: float) -> FloatArray:
    """Return the attitude (4,) of a camera with this boresight and north up."""
    right, up = np.radians([right_ascension_deg, declination_deg])
    sight = np.array([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)])
    east = np.array([-np.sin(right), np.cos(right), 0.0])
    return from_matrix(np.array([-east, np.cross(sight, -east), sight]))


def _places(since: FloatArray) -> FloatArray:
    """Return the places (k, 2, 2) px of both at times (k,) s after they meet."""
    return np.asarray(MEETING + since[:, None, None] * MOTIONS)


def test_two_objects_as_bright_as_each_other_cross_in_the_frame_and_keep_their_tracks() -> None:
    tracker, own = ObjectTracker(TrackSettings()), {}
    focal = CAMERA.pinhole.focal_length
    for second in range(15):
        ways = _places(second - 7.0 + TIMES)
        satellites = [
            SourceTrack(TIMES, CAMERA.pinhole.unit_vectors(ways[:, k]) @ attitude_matrix(HELD), MAGNITUDE)
            for k in range(2)
        ]
        sighted = run(frame_job(HELD, np.zeros(3), satellites, seed=second)).objects
        assert sighted is not None
        assert len(sighted.points) <= 2
        frame = sighted.directions, sighted.covariance, sighted.magnitudes, sighted.attitude
        tracker.ingest(FrameSightings(second * 1_000_000_000, *frame))
        true = CAMERA.pinhole.unit_vectors(_places(np.array([second - 7.0]))[0]) @ attitude_matrix(HELD)
        away = {
            track.number: focal * np.linalg.norm(true - track.line.direction, axis=1)
            for track in tracker.objects
        }
        own[second] = {number: int(off.argmin()) for number, off in away.items()}
        assert all(off.min() < 1.0 for off in away.values())
    assert own[14] == own[5]
    assert sorted(own[14].values()) == [0, 1]


@pytest.mark.parametrize(("right", "up"), [(-131.5, -72.95), (102.7, -39.5)])
@pytest.mark.parametrize("rate_deg", [0.0, 0.3])
def test_a_crowded_sky_at_rest_or_nearly_so_has_an_attitude(right: float, up: float, rate_deg: float) -> None:
    """Its faint regions run together and look long; the streaks are at most 1.5 px."""
    held = _looking_at(right, up)
    turn = np.array([0.0, np.radians(rate_deg), 0.0])
    found = run(frame_job(held, turn, []))
    assert found.motion.status is not StreakStatus.RATE
    assert found.solution is not None
    assert found.solution.fix is not None
    assert angle_between(found.solution.fix.quaternion, held) < 0.3 / CAMERA.pinhole.focal_length
    assert found.objects is not None
    assert not len(found.objects.points)
    assert EXPOSURE * turn[1] * CAMERA.pinhole.focal_length < 1.6
