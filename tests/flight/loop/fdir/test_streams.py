"""Liveness, rate and validity of a stream are checked separately; a stale stream is never good."""

from __future__ import annotations

import math

import pytest

from flight.loop.fdir.facts import IMU_POOR, POWER_POOR
from flight.loop.fdir.streams import Stream, Streams, StreamState, StreamWatch, streams_of
from tests.scenario.flights import demo_config

ROW = Stream("imu", 40.0, 0.1, IMU_POOR, 0.0, 1.0)
PERIOD = 25_000_000


def fed(seconds: float, every: int = 1, value: float = 0.5, row: Stream = ROW) -> tuple[StreamWatch, int]:
    """Return a watch that got every n-th sample for some seconds, and the time after them."""
    watch = StreamWatch(row, 0)
    count = round(seconds * 40)
    for k in range(0, count, every):
        watch.note(k * PERIOD, value)
    return watch, (count - 1) * PERIOD


def test_before_the_first_reading_it_never_came() -> None:
    assert StreamWatch(ROW, 0).state(0) is StreamState.NEVER
    assert StreamWatch(ROW, 0).age(0) == math.inf


def test_it_is_good_while_it_comes_at_its_rate_and_stale_once_older_than_its_limit() -> None:
    watch, now = fed(3.0)
    assert watch.state(now) is StreamState.GOOD
    assert watch.rate(now) == pytest.approx(40.0, abs=0.5)
    assert watch.state(now + 100_000_000) is StreamState.GOOD
    assert watch.state(now + 100_000_001) is StreamState.STALE


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, math.inf])
def test_a_value_out_of_its_range_is_invalid_however_fresh(value: float) -> None:
    watch, now = fed(3.0, value=value)
    assert watch.state(now) is StreamState.INVALID


def test_half_its_rate_is_slow_once_a_whole_window_has_been_seen() -> None:
    early, now = fed(1.5, every=2)
    assert early.state(now) is StreamState.GOOD, "not known yet"
    late, now = fed(4.0, every=2)
    assert late.state(now) is StreamState.SLOW


def test_after_a_silence_the_rate_is_counted_again() -> None:
    watch, now = fed(4.0)
    for k in range(40):
        watch.note(now + 5_000_000_000 + k * PERIOD, 0.5)
    assert watch.state(now + 6_000_000_000) is StreamState.GOOD


def test_what_is_not_fitted_takes_no_notes() -> None:
    streams = Streams((ROW,))
    streams.note("camera", 1)
    assert streams.state("camera", 2) is StreamState.NOT_FITTED
    assert streams.state("imu", 2) is StreamState.NEVER


def test_silence_that_another_alarm_reports_is_not_reported_twice_and_any_other_is() -> None:
    quiet = Stream("power", 4.0, 3.0, POWER_POOR, has_silence_alarm=False)
    streams = Streams((ROW, quiet))
    for name in ("imu", "power"):
        streams.note(name, 0, 0.5)
    imu, power = streams.look(10_000_000_000)
    assert imu[1:] == (None, "")
    assert power[1:] == (True, "power: stale, 10.00 s old, 3 s allowed")


def test_the_streams_of_a_configuration_are_those_of_its_devices() -> None:
    assert [row.name for row in streams_of(demo_config(10.0))] == ["imu", "field", "coils", "power", "camera"]
    assert "camera" not in [row.name for row in streams_of(demo_config(10.0, camera=False))]
