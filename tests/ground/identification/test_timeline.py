"""Tests of records and timelines of artificial signals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ground.identification.record import IdentificationError, Record, Timeline, read_record
from tests.support.packed_run import packed_run

RECORD = Record(
    time=np.array([0.0, 0.02, 0.04, 0.10]),
    angle=np.zeros(4),
    rate=np.zeros(4),
    switch_time=np.array([-0.01, 0.03, 0.05, 0.2]),
    current=np.array([0.1, 0.1, 0.0, 0.5]),
    clipped=np.array([False, True, False, False]),
    period=0.025,
    field=None,
)


def test_the_events_are_samples_switches_and_cuts_of_long_steps_in_order() -> None:
    """An interval of 0.06 s between two samples is divided into three steps of at most 0.025 s."""
    timeline = Timeline.of(RECORD, 0.0)
    times = np.cumsum(timeline.span)
    np.testing.assert_allclose(times, [0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.10])
    assert timeline.sample.tolist() == [1, -1, 2, -1, -1, -1, 3]
    np.testing.assert_allclose(timeline.current, [0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(timeline.jump, [0.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(timeline.variance, [1.0, 1.0, 100.0, 100.0, 0.0, 0.0, 0.0])


def test_a_delay_moves_the_switches_only() -> None:
    timeline = Timeline.of(replace(RECORD, time=np.array([0.0, 0.02, 0.04])), 0.015)
    np.testing.assert_allclose(np.cumsum(timeline.span), [0.005, 0.02, 0.04])
    assert timeline.sample.tolist() == [-1, 1, 2]
    np.testing.assert_allclose(timeline.current, [0.0, 0.1, 0.1])
    np.testing.assert_allclose(timeline.jump, [0.1, 0.0, 0.0])


LABEL = {
    "supply_voltage": 3.4,
    "coil_resistance": [20.0] * 3,
    "current_limit": 0.15,
    "control_period_ns": 25_000_000,
}


def flown(cycles: list[tuple[float, float, float]], samples: int = 240, **label: Any) -> Record:
    """Return the record of cycles (time, requested and written current) with 40 samples per second."""
    imu = [
        (
            0.025 * k,
            {
                "sample_time_ns": 25_000_000 * k + (3_000_000 if k % 7 else 0),
                "device_time_ns": 7_000_000_000 + 25_000_000 * k,
                "quaternion": [0.0, math.sin(0.01 * k), 0.0, math.cos(0.01 * k)],
                "rate": [0.0, 0.8, 0.0],
                "field": [5e-5 * math.cos(0.02 * k), 9e-5, 5e-5 * math.sin(0.02 * k)],
            },
        )
        for k in range(samples)
    ]
    control = [
        (time, {"current_command": [asked, 0.0, 0.0], "current_written": [done, 0.0, 0.0]})
        for time, asked, done in cycles
    ]
    return read_record(packed_run(run=[(0.0, {**LABEL, **label})], imu=imu, control=control), 0.25)


def test_samples_have_the_time_of_the_unit_at_the_earliest_arrival_and_a_continuous_angle() -> None:
    record = flown([(0.01, 0.0, 0.0), (0.2, 0.0, 0.0)])
    np.testing.assert_allclose(record.time, 0.025 * np.arange(240), atol=1e-9)
    np.testing.assert_allclose(record.angle, 0.02 * np.arange(240), atol=1e-12)
    assert record.period == 0.025
    assert record.field is not None
    assert record.field.magnitude == pytest.approx(5e-5)
    assert record.field.samples == 239, "the first sample is before the first cycle"


def test_a_current_counts_from_its_request_and_falls_to_zero_without_commands() -> None:
    record = flown([(0.0, 0.1, 0.0), (0.1, 0.1, 0.1), (0.2, 0.0, 0.1), (0.5, 0.0, 0.0)])
    np.testing.assert_allclose(record.switch_time, [0.0, 0.1, 0.2, 0.45, 0.5])
    np.testing.assert_allclose(record.current, [0.1, 0.1, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("current", "resistance", "clipped"),
    [
        (0.1454, 20.0, False),
        (0.1456, 20.0, True),
        (-0.1456, 20.0, True),
        (0.0969, 34.0, False),
        (0.0971, 34.0, True),
    ],
)
def test_a_current_within_3_percent_of_the_limit_may_be_clipped(
    current: float, resistance: float, clipped: bool
) -> None:
    """The current limit is the smaller of 0.15 A and the current at 3.4 V through 20 or 34 ohm."""
    record = flown([(0.0, current, current), (0.1, current, current)], coil_resistance=[resistance] * 3)
    assert record.clipped.tolist() == [clipped, clipped]


def test_the_field_is_measured_half_a_second_after_the_coils_went_off() -> None:
    record = flown([(0.0, 0.1, 0.1), (0.25, 0.1, 0.1), (0.5, 0.0, 0.0)])
    assert record.field is not None
    assert record.field.samples == sum(0.025 * k > 0.5 + 0.5 + 1e-9 for k in range(240))
    always = [(0.2 * k, 0.1, 0.1) for k in range(40)]
    assert flown(always).field is None


def test_a_flight_of_200_samples_is_long_enough() -> None:
    assert len(flown([(0.0, 0.0, 0.0), (0.2, 0.0, 0.0)], samples=200).time) == 200
    with pytest.raises(
        IdentificationError, match=r"199 samples .* too short, identification needs 200 samples"
    ):
        flown([(0.0, 0.0, 0.0), (0.2, 0.0, 0.0)], samples=199)
