"""Tests of the conversion from current to PWM counts: Table 5.2 of the thesis, limits and resolution."""

from __future__ import annotations

import math

import pytest

from hal.drivers.coils import counts_for, current_step, inputs_for, largest_counts
from hal.drivers.pca9685 import FULL_OFF, FULL_ON

STEP = current_step(23.0, 3.4)


@pytest.mark.parametrize(
    ("counts", "input_a", "input_b"),
    [
        (+1, (0, 1), FULL_OFF),
        (+1024, (0, 1024), FULL_OFF),
        (+4095, (0, 4095), FULL_OFF),
        (+4096, FULL_ON, FULL_OFF),
        (-1, FULL_OFF, (0, 1)),
        (-1024, FULL_OFF, (0, 1024)),
        (-4096, FULL_OFF, FULL_ON),
        (0, FULL_OFF, FULL_OFF),
    ],
)
def test_inputs_follow_table_5_2(counts: int, input_a: tuple[int, int], input_b: tuple[int, int]) -> None:
    assert inputs_for(counts) == (input_a, input_b)


def test_no_counts_are_ever_equal_and_both_inputs_are_never_driven_at_once() -> None:
    for counts in range(-4096, 4097):
        pins = inputs_for(counts)
        assert all(on != off for on, off in pins)
        assert FULL_OFF in pins


def test_full_drive_is_the_thesis_maximum_current() -> None:
    """The largest current is 3.4 V / 23 ohm = 0.1478 A. The thesis states 0.148 A (ch. 5)."""
    assert largest_counts(STEP, 0.148) == 4096
    assert pytest.approx(3.4 / 23.0, rel=1e-15) == 4096 * STEP


def test_a_lower_limit_is_never_exceeded_by_rounding() -> None:
    largest = largest_counts(STEP, 0.1)
    assert largest * STEP <= 0.1 < (largest + 1) * STEP


def test_a_limit_of_whole_counts_loses_none() -> None:
    assert all(largest_counts(STEP, counts * STEP) == counts for counts in range(1, 4097))


@pytest.mark.parametrize(
    ("current", "counts", "limited"),
    [
        (0.0, 0, False),
        (0.4 * STEP, 0, False),
        (0.6 * STEP, 1, False),
        (-0.6 * STEP, -1, False),
        (1e3, 4096, True),
        (-1e3, -4096, True),
        (math.inf, 4096, True),
        (-math.inf, -4096, True),
    ],
)
def test_counts_are_the_nearest_and_limits_are_reported(current: float, counts: int, limited: bool) -> None:
    assert counts_for(current, STEP, 4096) == (counts, limited)


def test_a_duty_of_a_half_is_half_of_the_supply() -> None:
    """By Sease 5.33, V_equivalent = duty x V_supply. A duty cycle of 0.5 gives 1.7 V across 23 ohm."""
    assert counts_for(1.7 / 23.0, STEP, 4096) == (2048, False)


def test_nan_is_refused_as_a_current() -> None:
    with pytest.raises(ValueError, match="NaN"):
        counts_for(math.nan, STEP, 4096)
