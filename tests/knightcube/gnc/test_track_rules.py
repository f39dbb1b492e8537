"""Tests of the rules by which tracks begin, are confirmed, take sightings and end, without noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from knightcube.astro.arrays import FloatArray
from knightcube.errors import ArgumentError
from knightcube.gnc.tracker import (
    FrameSightings,
    LineOfSightState,
    MotionModel,
    ObjectTracker,
    TrackSettings,
    begin,
    compare,
    predict,
    tides,
    update,
)

S = 1_000_000_000
SIGMA, ATTITUDE = 1e-5, 2e-5


def direction(seconds: float, rate: float = 2e-3, aside: float = 0.0) -> FloatArray:
    """Return the direction to an object that moves along a great circle at `rate` (rad/s)."""
    angle = rate * seconds
    found = np.array([math.sin(angle), aside, math.cos(angle)])
    return np.asarray(found / np.linalg.norm(found))


def frame(
    seconds: float, seen: Sequence[FloatArray], magnitudes: Sequence[float] | None = None
) -> FrameSightings:
    """Return a frame with exact sightings."""
    count = len(seen)
    return FrameSightings(
        round(seconds * S),
        np.array(seen).reshape(-1, 3),
        np.array([SIGMA**2 * (np.eye(3) - np.outer(one, one)) for one in seen]).reshape(-1, 3, 3),
        np.full(count, 4.0) if magnitudes is None else np.array(magnitudes, dtype=float),
        ATTITUDE**2 * np.eye(3),
    )


def settings(**changes: float) -> TrackSettings:
    """Return settings with which three of five sightings confirm a track, and four seconds end it."""
    values = {"needed": 3, "within": 5, "coast": 4.0, **changes}
    return TrackSettings(**values)  # type: ignore[arg-type]


def test_a_track_is_confirmed_by_its_last_needed_sighting_and_counts_everything() -> None:
    tracker = ObjectTracker(settings())
    assert [len(tracker.ingest(frame(t, [direction(t)]))[0]) for t in (0.0, 1.0)] == [0, 0]
    ((track,), ended) = tracker.ingest(frame(2.0, [direction(2.0)]))
    assert ended == []
    assert (track.number, track.sightings, track.frames, track.history) == (1, 3, 3, 0b111)
    assert track.seen
    assert track.confirmed
    assert track.seen_ns == track.line.time_ns == 2 * S
    np.testing.assert_allclose(track.measured, direction(2.0))
    assert track.measured_sigma == pytest.approx(math.hypot(SIGMA, ATTITUDE))
    assert track.magnitude == pytest.approx(4.0)
    assert track.magnitude_sigma == pytest.approx(0.0)
    assert np.linalg.norm(track.line.rate) == pytest.approx(2e-3, rel=1e-3)
    assert 0.0 <= track.chi_square < 0.1, "the sightings are exact"
    tracker.ingest(frame(3.0, []))
    (track,) = tracker.objects
    assert (track.history, track.sightings, track.frames, track.seen) == (0b1110, 3, 4, False)
    assert track.line.time_ns == 3 * S
    assert np.isnan(track.measured).all()
    assert math.isnan(track.measured_sigma)
    tracker.clear()
    assert tracker.objects == ()


@pytest.mark.parametrize(
    ("seen", "confirmed"), [((0, 2, 4), True), ((0, 2, 5), False), ((0, 1, 5), False), ((0, 3, 4), True)]
)
def test_the_needed_sightings_must_lie_within_five_frames(seen: tuple[int, ...], confirmed: bool) -> None:
    tracker = ObjectTracker(settings())
    for number in range(6):
        tracker.ingest(frame(float(number), [direction(float(number))] if number in seen else []))
    assert bool(tracker.objects) is confirmed


@pytest.mark.parametrize(("gap", "alive"), [(4.0, True), (4.1, False)])
def test_a_confirmed_track_ends_after_its_coast_and_is_returned(gap: float, alive: bool) -> None:
    tracker = ObjectTracker(settings())
    for t in (0.0, 1.0, 2.0):
        tracker.ingest(frame(t, [direction(t)]))
    _, ended = tracker.ingest(frame(2.0 + gap, []))
    assert bool(tracker.objects) is alive
    assert [track.number for track in ended] == ([] if alive else [1])


@pytest.mark.parametrize(("rate", "confirmed"), [(0.95e-3, False), (1.05e-3, True)])
def test_an_object_must_move_faster_than_the_minimum(rate: float, confirmed: bool) -> None:
    tracker = ObjectTracker(settings(minimum_rate=1e-3))
    for t in range(5):
        tracker.ingest(frame(float(t), [direction(float(t), rate)]))
    assert bool(tracker.objects) is confirmed


def test_an_object_must_move_by_several_standard_deviations() -> None:
    fast, slow = (
        ObjectTracker(settings(minimum_rate=0.0, moving=8.0)),
        ObjectTracker(settings(minimum_rate=0.0, moving=200.0)),
    )
    for t in range(3):
        for tracker in (fast, slow):
            tracker.ingest(frame(float(t), [direction(float(t), 2e-3)]))
    assert len(fast.objects) == 1
    assert slow.objects == ()


def test_a_tentative_track_takes_no_sighting_of_another_brightness_and_a_confirmed_one_does() -> None:
    tracker = ObjectTracker(settings(brightness=0.5))
    tracker.ingest(frame(0.0, [direction(0.0)], [4.0]))
    tracker.ingest(frame(1.0, [direction(1.0)], [5.1]))
    tracker.ingest(frame(2.0, [direction(2.0)], [5.1]))
    assert tracker.objects == (), "1.1 magnitudes are more than two standard deviations"
    like = ObjectTracker(settings(brightness=0.5))
    for t, magnitude in enumerate((4.0, 4.9, 4.4)):
        like.ingest(frame(float(t), [direction(float(t))], [magnitude]))
    assert len(like.objects) == 1
    like.ingest(frame(3.0, [direction(3.0)], [5.6]))
    assert like.objects[0].sightings == 4


def test_the_magnitude_is_the_mean_with_the_deviation_of_the_mean() -> None:
    tracker = ObjectTracker(settings(brightness=5.0))
    given = [4.0, 4.6, 4.2, 5.0]
    for t, magnitude in enumerate(given):
        tracker.ingest(frame(float(t), [direction(float(t))], [magnitude]))
        if t == 2:
            (track,) = tracker.objects
            assert track.magnitude_sigma == pytest.approx(np.std(given[:3], ddof=1) / math.sqrt(3.0))
    (track,) = tracker.objects
    assert track.magnitude == pytest.approx(np.mean(given))
    assert track.magnitude_sigma == pytest.approx(np.std(given, ddof=1) / 2.0)
    tracker.ingest(frame(4.0, [direction(4.0)], [math.nan]))
    assert tracker.objects[0].magnitude == pytest.approx(np.mean(given))
    unknown = ObjectTracker(settings())
    for t, magnitude in enumerate((math.nan, math.nan, 5.0)):
        unknown.ingest(frame(float(t), [direction(float(t))], [magnitude]))
    (track,) = unknown.objects
    assert track.magnitude == 5.0
    assert math.isnan(track.magnitude_sigma)


def test_the_brightest_sightings_begin_the_tracks_that_there_is_room_for() -> None:
    tracker = ObjectTracker(settings(maximum_tracks=2))
    asides, magnitudes = (0.0, 0.1, 0.2, 0.3), (6.0, 3.0, math.nan, 5.0)
    for t in range(3):
        seen = [direction(float(t), aside=aside) for aside in asides]
        tracker.ingest(frame(float(t), seen, magnitudes))
    assert sorted(track.magnitude for track in tracker.objects) == [3.0, 5.0]


def test_a_prediction_is_given_for_a_confirmed_track_from_its_time_on() -> None:
    tracker = ObjectTracker(settings())
    for t in (0.0, 1.0, 2.0):
        tracker.ingest(frame(t, [direction(t)]))
    found = tracker.predicted(1, 4 * S)
    assert found is not None
    np.testing.assert_allclose(found.direction, direction(4.0), atol=5e-5)
    assert tracker.predicted(1, 2 * S) is not None
    assert tracker.predicted(1, 2 * S - 1) is None
    assert tracker.predicted(2, 4 * S) is None
    assert tracker.predicted(0, 4 * S) is None


def test_a_new_line_of_sight_has_unknown_motion_and_no_variance_along_itself() -> None:
    motion = MotionModel(rate=0.02, closing=0.05)
    towards = direction(3.0, 0.1, 0.4)
    state = begin(7, towards, 4e-10 * np.eye(3), motion)
    assert state.time_ns == 7
    assert not state.velocity.any()
    spread = state.covariance
    np.testing.assert_allclose(spread[:3, :3] @ towards, 0.0, atol=1e-20)
    assert np.trace(spread[:3, :3]) == pytest.approx(8e-10)
    assert towards @ spread[3:, 3:] @ towards == pytest.approx(0.05**2)
    assert np.trace(spread[3:, 3:]) == pytest.approx(2 * 0.02**2 + 0.05**2)
    assert not spread[:3, 3:].any()


def test_a_prediction_moves_on_a_straight_line_and_spreads() -> None:
    """The relative position moves on a straight line, and is then divided by its length."""
    towards, velocity = np.array([0.0, 0.0, 1.0]), np.array([0.02, 0.0, -0.01])
    spread = np.diag([1e-10, 2e-10, 0.0, 1e-8, 2e-8, 3e-8])
    motion = MotionModel(wander=1e-9, residual_wander=0.0, bend=0.0)
    state = LineOfSightState(0, towards, velocity, spread)
    later = predict(state, 5 * S, motion)
    straight = towards + 5.0 * velocity
    size = np.linalg.norm(straight)
    np.testing.assert_allclose(later.direction, straight / size)
    np.testing.assert_allclose(later.velocity, velocity / size)
    across = np.array([0.0, 1.0, 0.0])
    expected = (2e-10 + 25.0 * 2e-8 + 1e-9 * 125.0 / 3.0) / size**2
    assert across @ later.covariance[:3, :3] @ across == pytest.approx(expected)
    assert across @ later.covariance[3:, 3:] @ across == pytest.approx((2e-8 + 5.0 * 1e-9) / size**2)
    assert across @ later.covariance[:3, 3:] @ across == pytest.approx((5.0 * 2e-8 + 12.5e-9) / size**2)
    known = predict(state, 5 * S, motion, np.zeros((3, 3)))
    assert across @ known.covariance[3:, 3:] @ across == pytest.approx(2e-8 / size**2), "other noise"
    assert predict(state, 0, motion) is state
    np.testing.assert_allclose(state.rate, [0.02, 0.0, 0.0])
    np.testing.assert_allclose(state.acceleration, [2.0 * 0.01 * 0.02, 0.0, 0.0])


def test_the_gravity_gradient_separates_objects_vertically_and_joins_them_horizontally() -> None:
    position = np.array([0.0, 7e6, 0.0])
    gradient = tides(position)
    strength = 3.986004418e14 / 7e6**3
    np.testing.assert_allclose(np.diag(gradient), [-strength, 2.0 * strength, -strength])
    motion = MotionModel()
    state = LineOfSightState(0, np.array([0.0, 1.0, 0.0]), np.zeros(3), np.zeros((6, 6)))
    later = predict(state, 10 * S, motion, gradient)
    assert later.velocity[1] == pytest.approx(10.0 * 2.0 * strength, rel=1e-3)


def test_an_update_weights_prediction_and_sighting_by_their_variances() -> None:
    towards = np.array([0.0, 0.0, 1.0])
    spread = np.zeros((6, 6))
    spread[0, 0] = spread[1, 1] = 3e-8
    spread[3, 3], spread[0, 3], spread[3, 0] = 4e-8, 1e-8, 1e-8
    state = LineOfSightState(0, towards, np.zeros(3), spread)
    seen = np.array([4e-4, -8e-4, 1.0])
    seen /= np.linalg.norm(seen)
    found = compare(state, seen, 1e-8 * np.eye(3))
    assert found.chi_square == pytest.approx((4e-4**2 + 8e-4**2) / 4e-8, rel=1e-5)
    np.testing.assert_allclose(found.covariance, 4e-8 * np.eye(2), atol=1e-20)
    better = update(state, seen, 1e-8 * np.eye(3))
    np.testing.assert_allclose(better.direction, [3e-4, -6e-4, 1.0], atol=1e-6)
    assert better.velocity[0] == pytest.approx(0.25 * 4e-4, rel=1e-3), "by the correlation"
    assert better.covariance[0, 0] == pytest.approx(0.75e-8, rel=1e-3)
    assert better.covariance[3, 3] == pytest.approx(4e-8 - 0.25e-8, rel=1e-3)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"needed": 7}, "needed: 7: give at most `within`, which is 6"),
        ({"missed": 1.0}, "missed: 1.0: give a probability below 1"),
        ({"coast": math.nan}, "coast: nan"),
        ({"motion": None}, "motion: None"),
    ],
)
def test_settings_out_of_their_range_are_refused(values: dict[str, object], words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        TrackSettings(**values)  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match=r"wander: -1\.0: give a finite number of 0 or more"):
        MotionModel(wander=-1.0)
