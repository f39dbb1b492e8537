"""Tests of tracks from bearings alone: uncertainty, several objects, outages, and no false tracks."""

from __future__ import annotations

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import attitude_matrix, from_rotation_vector, multiply
from knightcube.gnc.tracker import (
    LineOfSightState,
    MotionModel,
    ObjectTracker,
    TrackSettings,
    begin,
    predict,
    tides,
    update,
)
from tests.support.object_passes import PIXEL, Pass, a_pass, sightings

_SIGMA, _ATTITUDE = 0.1 * PIXEL, 0.05 * PIXEL
_PERIOD = 1.0


def _nees(flown: Pass, rng: np.random.Generator, sigma: float, known: bool) -> tuple[FloatArray, FloatArray]:
    """Return the NEES of direction and of rate in each frame, with two degrees of freedom each.

    `sigma` (rad) is the standard deviation of a sighting. The standard deviation of the attitude is half of
    `sigma`. If `known` is set, the tracker knows the gravity gradient.
    """
    motion = MotionModel()
    state = None
    places: list[float] = []
    rates: list[float] = []
    basis = np.zeros((2, 3))
    for index, time in enumerate(flown.times):
        frame = sightings(rng, time, flown.directions[index : index + 1], sigma, 0.5 * sigma)
        spread = frame.covariance[0] + frame.attitude
        if state is None:
            state = begin(frame.time_ns, frame.directions[0], spread, motion)
            continue
        tide = tides(flown.observer[index]) if known else None
        state = update(predict(state, frame.time_ns, motion, tide), frame.directions[0], spread)
        basis = np.linalg.svd(state.direction[None])[2][1:]
        for kept, error, block in (
            (places, flown.directions[index] - state.direction, slice(0, 3)),
            (rates, flown.rates[index] - state.rate, slice(3, 6)),
        ):
            across = basis @ error
            covariance = basis @ state.covariance[block, block] @ basis.T
            kept.append(float(across @ np.linalg.solve(covariance, across)))
    return np.array(places[8:]), np.array(rates[8:])


@pytest.mark.parametrize("known", [False, True])
def test_the_errors_agree_with_the_covariance(known: bool) -> None:
    """The sum of the NEES at the ends of 60 passes is a chi-square with 120 degrees of freedom."""
    rng = np.random.default_rng(16)
    times = np.arange(0.0, 24.0, _PERIOD)
    place, rate = [], []
    for rate_deg in np.geomspace(0.05, 0.6, 60):
        flown = a_pass(rng, np.radians(rate_deg), times, rng.uniform(0.0, 24.0))
        places, rates = _nees(flown, rng, _SIGMA, known)
        place.append(places[-1])
        rate.append(rates[-1])
    # The 99 % interval of chi-square(120) / 60 lies between 1.25 and 2.9.
    assert 1.25 < np.mean(place) < 2.9
    assert 1.25 < np.mean(rate) < 2.9


def test_the_gravity_gradient_takes_the_tides_out_of_a_minute_s_prediction() -> None:
    """With the gravity gradient, the error of a prediction over a minute decreases to less than a tenth.

    In ten passes within 250 km, a straight-line extrapolation has errors of at least 1.2e-3 rad.
    """
    rng = np.random.default_rng(9)
    times = np.arange(0.0, 60.5, 2.0)
    for _ in range(10):
        flown = a_pass(rng, np.radians(rng.uniform(0.9, 1.2)), times, 30.0)
        far = np.linalg.norm(flown.relative, axis=1)
        off = []
        for known in (False, True):
            velocity = flown.relative_velocity[0] / far[0]
            line = LineOfSightState(0, flown.directions[0], velocity, np.zeros((6, 6)))
            for k in range(1, len(times)):
                tide = tides(0.5 * (flown.observer[k - 1] + flown.observer[k])) if known else None
                line = predict(line, round(times[k] * 1e9), MotionModel(), tide)
            off.append(float(np.linalg.norm(line.direction - flown.directions[-1])))
        assert far.max() < 250e3
        assert off[0] > 1.2e-3
        assert off[1] < 0.1 * off[0]


def test_no_pass_of_a_tracked_object_is_lost_or_doubled_through_ten_seconds_without_it() -> None:
    rng = np.random.default_rng(3)
    times = np.arange(0.0, 40.0, _PERIOD)
    for rate_deg in (0.05, 0.15, 0.3, 0.6):
        flown = a_pass(rng, np.radians(rate_deg), times, 20.0)
        tracker = ObjectTracker(TrackSettings())
        for index, time in enumerate(times):
            lost = 14.0 <= time < 24.0
            seen = flown.directions[index : index + 1] if not lost else np.zeros((0, 3))
            confirmed, ended = tracker.ingest(sightings(rng, time, seen, _SIGMA, _ATTITUDE))
            assert not ended
            assert len(confirmed) == (time == 3.0)
            if lost and time == 23.0:
                (track,) = tracker.objects
                away = np.linalg.norm(track.line.direction - flown.directions[index])
                assert away < 3.0 * PIXEL
        (track,) = tracker.objects
        assert track.number == 1
        assert np.linalg.norm(track.line.direction - flown.directions[-1]) < 0.5 * PIXEL


def test_a_track_ends_when_its_object_stays_away() -> None:
    rng = np.random.default_rng(4)
    flown = a_pass(rng, np.radians(0.2), np.arange(0.0, 30.0, 1.0), 10.0)
    tracker = ObjectTracker(TrackSettings())
    ends = []
    for index, time in enumerate(flown.times):
        seen = flown.directions[index : index + 1] if time < 8.0 else np.zeros((0, 3))
        ends += [time for _ in tracker.ingest(sightings(rng, time, seen, _SIGMA, _ATTITUDE))[1]]
    # The last sighting is at 7 s. The track ends at the first frame after the longest time without a
    # sighting.
    assert ends == [7.0 + TrackSettings().coast + 1.0]
    assert tracker.objects == ()


def test_two_objects_that_cross_keep_their_numbers() -> None:
    rng = np.random.default_rng(5)
    times = np.arange(0.0, 30.0, 1.0)
    slow = a_pass(rng, np.radians(0.1), times, 15.0).directions
    # The second path is the first path, mirrored at a plane through its middle, where both paths cross.
    middle = slow[15]
    normal = np.cross(middle, slow[16])
    normal /= np.linalg.norm(normal)
    aside = np.cross(normal, middle)
    fast = slow - 2.0 * np.outer(slow @ aside, aside)
    fast = fast + 0.02 * np.radians(times - 15.0)[:, None] * normal
    fast /= np.linalg.norm(fast, axis=1, keepdims=True)
    tracker = ObjectTracker(TrackSettings())
    for index, time in enumerate(times):
        both = np.array([slow[index], fast[index]])
        tracker.ingest(sightings(rng, time, both, _SIGMA, _ATTITUDE, np.array([3.0, 5.0])))
    first, second = sorted(tracker.objects, key=lambda track: track.magnitude)
    assert np.linalg.norm(first.line.direction - slow[-1]) < PIXEL
    assert np.linalg.norm(second.line.direction - fast[-1]) < PIXEL
    assert second.magnitude == pytest.approx(5.0)


def test_objects_as_bright_as_each_other_that_cross_keep_their_numbers() -> None:
    """Two equally bright objects that cross keep their track numbers, in twenty tested pairs.

    While the objects are within 3 px, the frame shows one object with the summed flux.
    """
    rng = np.random.default_rng(77)
    times = np.arange(0.0, 30.0, 1.0)
    for _ in range(20):
        rates = np.radians(rng.uniform(0.05, 0.6, 2))
        one, two = (a_pass(rng, rate, times, 15.0).directions for rate in rates)
        turn = _turn_onto(two[15], one[15], rng.uniform(0.0, 2.0 * np.pi))
        paths = np.stack([one, two @ turn.T], axis=1)
        tracker = ObjectTracker(TrackSettings())
        own: list[dict[int, int]] = []
        for time, both in zip(times, paths, strict=True):
            middle = both.mean(axis=0) / np.linalg.norm(both.mean(axis=0))
            near = np.linalg.norm(both[0] - both[1]) < 3.0 * PIXEL
            seen, magnitudes = (middle[None], np.array([3.25])) if near else (both, np.full(2, 4.0))
            tracker.ingest(sightings(rng, time, seen, _SIGMA, _ATTITUDE, magnitudes))
            off = {
                track.number: np.linalg.norm(both - track.line.direction, axis=1) for track in tracker.objects
            }
            own.append({number: int(np.argmin(away)) for number, away in off.items()})
        assert set(own[10]) == {1, 2}
        assert own[10] == own[-1]
        assert set(own[-1].values()) == {0, 1}


def _turn_onto(start: FloatArray, end: FloatArray, roll: float) -> FloatArray:
    """Return the matrix (3, 3) that rotates `start` to `end`, and then by `roll` about `end`."""
    across = np.cross(start, end)
    turn = np.arctan2(np.linalg.norm(across), start @ end) * across / np.linalg.norm(across)
    both = multiply(from_rotation_vector(-roll * end), from_rotation_vector(-turn))
    return attitude_matrix(both)


def test_an_object_that_flashes_by_four_magnitudes_is_one_track() -> None:
    rng = np.random.default_rng(8)
    times = np.arange(0.0, 60.0, 1.0)
    flown = a_pass(rng, np.radians(0.3), times, 30.0)
    tracker = ObjectTracker(TrackSettings())
    for index, time in enumerate(times):
        magnitude = np.array([5.0 + 3.0 * np.sin(2.0 * np.pi * time / 25.0)])
        seen = flown.directions[index : index + 1]
        if magnitude[0] > 6.0:  # too faint for the camera
            seen, magnitude = np.zeros((0, 3)), np.zeros(0)
        _, ended = tracker.ingest(sightings(rng, time, seen, _SIGMA, _ATTITUDE, magnitude))
        assert not ended
    assert [track.number for track in tracker.objects] == [1]
    assert tracker.objects[0].sightings >= 28


@pytest.mark.parametrize("flash", [2.5, 6.0, -6.0])
def test_a_sudden_flash_belongs_to_the_track_of_its_object(flash: float) -> None:
    rng = np.random.default_rng(8)
    times = np.arange(0.0, 20.0, 1.0)
    flown = a_pass(rng, np.radians(0.3), times, 30.0)
    tracker = ObjectTracker(TrackSettings())
    for index, time in enumerate(times):
        magnitude = np.array([6.0 - (flash if index == 15 else 0.0)])
        tracker.ingest(
            sightings(rng, time, flown.directions[index : index + 1], _SIGMA, _ATTITUDE, magnitude)
        )
    assert [track.sightings for track in tracker.objects] == [len(times)]


def test_noise_and_stars_that_no_catalogue_has_make_no_track_in_100_frames() -> None:
    rng = np.random.default_rng(6)
    fixed = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.17, 0.17, size=(5, 3)) * [1.0, 1.0, 0.0]
    tracker = ObjectTracker(TrackSettings())
    for index in range(100):
        noise = np.array([0.0, 0.0, 1.0]) + rng.uniform(-0.17, 0.17, size=(3, 3)) * [1.0, 1.0, 0.0]
        seen = np.vstack([fixed, noise])
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        frame = sightings(rng, index * _PERIOD, seen, _SIGMA, _ATTITUDE, rng.uniform(2.0, 6.0, len(seen)))
        confirmed, _ = tracker.ingest(frame)
        assert not confirmed


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("time", [4.0, 5.0])
def test_a_frame_that_is_not_later_than_the_last_is_refused(time: float, count: int) -> None:
    rng = np.random.default_rng(7)
    tracker = ObjectTracker(TrackSettings())
    one = np.array([[0.0, 0.0, 1.0]])
    tracker.ingest(sightings(rng, 5.0, one[:count], _SIGMA, _ATTITUDE))
    with pytest.raises(ValueError, match="must be after 5000000000"):
        tracker.ingest(sightings(rng, time, one, _SIGMA, _ATTITUDE))
    tracker.clear()
    tracker.ingest(sightings(rng, time, one, _SIGMA, _ATTITUDE))
