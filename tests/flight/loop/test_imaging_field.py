"""Tests of objects that are tracked relative to unidentified stars, with a test double of the worker."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link import events
from flight.link.telemetry.definitions import SIGHTINGS, TRACK
from flight.loop.imaging import CameraAttitude, ObjectTracks
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply, normalise
from knightcube.gnc.tracker import TrackSettings
from knightcube.vision.objects.settings import FieldPoints, MeasuredObjects
from knightcube.vision.streaks.streak_result import FrameMotion, StreakStatus

S = 1_000_000_000
EPOCH = 7 * S
START = normalise(np.array([0.3, -0.2, 0.5, 0.8]))
RATE = np.array([0.01, -0.02, 0.03])
STARS = normalise(np.random.default_rng(4).normal(size=(9, 3)) * 0.1 + np.array([0.2, 0.3, 0.9]))
SPREAD = np.array([[4e-6, 1e-6, 0.0], [1e-6, 9e-6, -2e-6], [0.0, -2e-6, 1e-6]])
SIGMA = 1e-5


def object_at(seconds: float) -> FloatArray:
    """Return the direction to an object that moves by 2 mrad/s among the stars."""
    return normalise(np.array([0.21, 0.25 + 2e-3 * seconds, 0.92]))


def camera_at(seconds: float) -> FloatArray:
    """Return the attitude (4,) of a camera that rotates about an axis fixed in the camera."""
    return multiply(from_rotation_vector(seconds * RATE), START)


class Bench:
    """The tracks of objects, connected to test doubles that record the calls."""

    def __init__(self) -> None:
        self.records: list[tuple[Any, dict[str, Any]]] = []
        self.reports: list[tuple[Any, str]] = []
        self.accepted: list[list[Any]] = []
        self.orbit: OrbitState | None = None
        body = SimpleNamespace(
            estimation=SimpleNamespace(orbit=lambda _: self.orbit),
            control=SimpleNamespace(accept_tracks=lambda tracks, _: self.accepted.append(list(tracks))),
        )
        services = SimpleNamespace(
            recorder=SimpleNamespace(
                epoch_ns=EPOCH, record=lambda packet, _, **values: self.records.append((packet, values))
            ),
            events=SimpleNamespace(report=lambda kind, _, text: self.reports.append((kind, text))),
        )
        settings = TrackSettings(needed=3, within=5, coast=4.0)
        self.tracks = ObjectTracks(settings, cast(Any, body), cast(Any, services))

    def frame(
        self, seconds: float, *, known: bool = True, rate: bool = False, others: FloatArray | None = None
    ) -> None:
        """Accept a frame with the stars and the object, optionally with an attitude and the streaks' rate."""
        turn = attitude_matrix(camera_at(seconds))
        sky = np.vstack([STARS if others is None else others, object_at(seconds)[None]])
        count = len(sky)
        points = np.stack([10.0 + np.arange(count), 20.0 + np.arange(count)], axis=1)
        found = FieldPoints(
            points, sky @ turn.T, np.full(count, SIGMA), np.ones(count), np.zeros(count, dtype=bool)
        )
        motion = FrameMotion(StreakStatus.RATE, 1, 0.2, rate=RATE if rate else None)
        attitude = CameraAttitude(camera_at(seconds), SPREAD) if known else None
        self.tracks.ingest_field(round(seconds), round(seconds * S), found, motion, attitude, 99)

    def of(self, packet: Any) -> list[dict[str, Any]]:
        """Return the values of all recorded packets of a type."""
        return [values for kind, values in self.records if kind is packet]


def test_an_object_among_unknown_stars_is_tracked_in_the_axes_of_the_estimate() -> None:
    bench = Bench()
    for seconds in range(1, 7):
        bench.frame(float(seconds))
    sightings = bench.of(SIGHTINGS)
    assert [values["found"] for values in sightings] == [0, 1, 1, 1, 1, 1], "the first frame shows stars only"
    assert (sightings[1]["x"][0], sightings[1]["y"][0]) == (19.0, 29.0), "the last point is the object"
    assert np.isnan(sightings[1]["magnitude"][0])
    assert sightings[1]["middle_ns"] == 2 * S - EPOCH
    values = bench.of(TRACK)[-1]
    np.testing.assert_allclose(values["direction"], object_at(6.0), atol=5e-5)
    np.testing.assert_allclose(values["measured"], object_at(6.0), atol=5e-5)
    motion = (object_at(6.5) - object_at(5.5)) / 1.0
    np.testing.assert_allclose(values["rate"], motion, atol=5e-5)
    assert (values["number"], values["relative"], values["seen"]) == (1, 1, 1)
    assert values["sightings"] == 5
    x, y, z = values["direction"]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    shared = cross @ SPREAD @ cross.T
    packed = [shared[0, 0], shared[1, 1], shared[2, 2], shared[0, 1], shared[0, 2], shared[1, 2]]
    np.testing.assert_allclose(values["covariance"], packed, atol=1e-9)
    assert values["measured_sigma"] == pytest.approx(float(np.sqrt(0.5 * np.trace(shared))), rel=1e-3)
    ((kind, text),) = bench.reports
    assert kind is events.OBJECT_FOUND
    assert text.endswith(" deg/s among the stars, brightness unknown")
    speed = float(text.split()[2])
    assert speed == pytest.approx(np.degrees(np.linalg.norm(motion)), abs=0.01)
    assert len(bench.accepted) == 6
    np.testing.assert_allclose(bench.accepted[-1][0].line.direction, object_at(6.0), atol=5e-5)


def test_without_an_attitude_the_streaks_predict_the_rotation_and_control_gets_no_track() -> None:
    bench = Bench()
    for seconds in range(1, 7):
        bench.frame(float(seconds), known=False, rate=True)
    assert [values["found"] for values in bench.of(SIGHTINGS)] == [0, 1, 1, 1, 1, 1]
    assert bench.accepted == []
    values = bench.of(TRACK)[-1]
    assert np.linalg.norm(values["rate"]) == pytest.approx(
        float(np.linalg.norm(object_at(6.5) - object_at(5.5))), rel=0.03
    )
    assert values["measured_sigma"] == pytest.approx(1.0, abs=1e-3), "the orientation is unknown"
    # The axes are those of the star field, whose orientation is that of the camera at the first frame.
    begun = attitude_matrix(camera_at(1.0))
    np.testing.assert_allclose(values["direction"], begun @ object_at(6.0), atol=2e-4)


def test_without_attitude_and_rate_the_camera_is_assumed_not_to_rotate() -> None:
    bench = Bench()
    bench.frame(1.0, known=False)
    bench.frame(2.0, known=False)
    assert [values["found"] for values in bench.of(SIGHTINGS)] == [0, 0], "no star is where it was"


def test_tracks_end_when_a_frame_shares_no_stars_with_earlier_ones() -> None:
    bench = Bench()
    for seconds in range(1, 5):
        bench.frame(float(seconds))
    assert [kind for kind, _ in bench.reports] == [events.OBJECT_FOUND]
    elsewhere = normalise(STARS + np.array([-0.9, 0.4, 0.3]))
    for seconds in range(5, 8):
        bench.frame(float(seconds), others=elsewhere)
    lost = [text for kind, text in bench.reports if kind is events.OBJECT_LOST]
    assert lost == ["object 1: the frame shares no stars with earlier frames"]


def test_tracks_among_unknown_stars_end_when_stars_are_identified_again() -> None:
    bench = Bench()
    for seconds in range(1, 5):
        bench.frame(float(seconds))
    nothing = np.zeros((0, 3))
    sighted = MeasuredObjects(np.zeros((0, 2)), nothing, np.zeros((0, 3, 3)), np.zeros(0), 1e-12 * np.eye(3))
    bench.tracks.ingest(5, 5 * S, sighted, 99)
    assert bench.reports[-1] == (events.OBJECT_LOST, "object 1: stars are identified again")
    bench.tracks.ingest(6, 6 * S, sighted, 99)
    assert len(bench.reports) == 2
    assert bench.accepted[-1] == []


def test_an_object_of_known_stars_is_recorded_with_the_position_of_the_satellite() -> None:
    bench = Bench()
    position, velocity = np.array([7e6, 1e5, 2e5]), np.array([10.0, 7e3, 3e3])
    bench.orbit = OrbitState(2_461_101.0, position, velocity, 120.0)
    for number in range(1, 4):
        sighted = MeasuredObjects(
            np.array([[5.0, 6.0]]), object_at(float(number))[None], 1e-10 * np.eye(3)[None],
            np.array([4.5]), 1e-12 * np.eye(3),
        )  # fmt: skip
        bench.tracks.ingest(number, number * S, sighted, 99)
    values = bench.of(TRACK)[-1]
    assert (values["place"], values["velocity"], values["place_sigma"]) == (
        position.tolist(), velocity.tolist(), 120.0,
    )  # fmt: skip
    assert values["relative"] == 0
    assert values["magnitude"] == pytest.approx(4.5)
    assert values["measured_sigma"] < 3e-5
    assert bench.reports[0][1].endswith(", V 4.5")
    d = np.array(values["direction"])
    xx, yy, zz, xy, xz, yz = values["rate_covariance"]
    spread = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    np.testing.assert_allclose(spread @ d, np.zeros(3), atol=1e-12)
    assert np.trace(spread) > 0.0


def test_a_lost_object_is_reported_with_its_age_and_sightings() -> None:
    bench = Bench()
    empty = MeasuredObjects(
        np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), 1e-12 * np.eye(3)
    )
    for number in range(1, 10):
        sighted = empty
        if number < 4:
            sighted = MeasuredObjects(
                np.array([[5.0, 6.0]]), object_at(float(number))[None], 1e-10 * np.eye(3)[None],
                np.array([4.5]), 1e-12 * np.eye(3),
            )  # fmt: skip
        bench.tracks.ingest(number, number * S, sighted, 99)
    assert bench.reports[-1][0] is events.OBJECT_LOST
    assert bench.reports[-1][1] in {f"object 1: not detected for {age}.0 s, 3 sightings" for age in (4, 5)}
