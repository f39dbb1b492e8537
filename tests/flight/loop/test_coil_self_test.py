"""Tests that the self-test drives idle coils by short currents, and only when it is permitted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from flight.loop.coil_monitor import SelfTest, SelfTestSettings
from flight.loop.coil_response import CoilResponse
from knightcube.astro.arrays import BoolArray, FloatArray

TICK_NS = 25_000_000
INTERVAL = 50.0
LIMIT = 0.148
STRONG: FloatArray = np.array([0.02, 0.03, 0.01])
"""Angular acceleration (rad/s^2) per ampere of each coil."""
ALL: BoolArray = np.ones(3, dtype=bool)


def _test(strength: FloatArray = STRONG, healthy: tuple[int, ...] = (), gyro_hz: float = 40.0) -> SelfTest:
    response = SimpleNamespace(
        strength=strength, is_healthy=lambda axis: axis in healthy, text=lambda axis: f"seen {axis}"
    )
    settings = SelfTestSettings(round(INTERVAL * 1e9), np.full(3, LIMIT), gyro_hz)
    return SelfTest(cast(CoilResponse, response), 4e-4, settings)


def _fly(
    test: SelfTest,
    seconds: float,
    wanted: FloatArray | None = None,
    usable: BoolArray = ALL,
    begin: float = 0.0,
) -> FloatArray:
    """Return the currents (n, 3), A, of the self-test from `begin` s on, or NaN while no test runs."""
    flown = []
    for cycle in range(round(begin * 40), round((begin + seconds) * 40)):
        asked = np.zeros(3) if wanted is None else wanted
        wave = test.wave(asked, lambda: usable, (cycle + 1) * TICK_NS)
        flown.append(np.full(3, np.nan) if wave is None else wave)
    return np.array(flown)


def _driven(flown: FloatArray) -> list[int]:
    """Return the coils in the order in which they were driven."""
    return list(dict.fromkeys(int(np.abs(one).argmax()) for one in np.nan_to_num(flown) if one.any()))


def test_a_gyro_with_more_samples_needs_a_smaller_impulse() -> None:
    slow, fast = (
        np.abs(np.nan_to_num(_fly(_test(gyro_hz=rate), INTERVAL + 30.0))).sum() for rate in (40.0, 160.0)
    )
    assert 0.0 < fast < 0.8 * slow


def test_each_coil_is_tested_alone_once_in_each_interval_without_a_lasting_effect() -> None:
    test = _test()
    flown = _fly(test, 2.0 * INTERVAL + 30.0)
    before = flown[: round(40 * INTERVAL) - 1]
    assert np.isnan(before).all(), "no test before the first interval has passed"
    currents = np.nan_to_num(flown)
    assert np.count_nonzero(currents, axis=1).max() == 1
    for axis in range(3):
        rate = np.cumsum(currents[:, axis]) / 40
        assert rate[-1] == pytest.approx(0.0, abs=1e-12)
        assert rate.sum() == pytest.approx(0.0, abs=1e-9), "the body is where it was before the test"
        begins = np.flatnonzero(np.diff((currents[:, axis] != 0.0).astype(int)) > 0)
        assert len(begins) == 2
        assert np.diff(begins)[0] / 40 > INTERVAL


@pytest.mark.parametrize("strength", [0.05, 0.01, 0.003])
def test_a_weaker_response_is_tested_by_more_current_and_then_for_longer(strength: float) -> None:
    current = np.nan_to_num(_fly(_test(np.array([strength, 1.0, 1.0])), INTERVAL + 30.0))[:, 0]
    driven = np.count_nonzero(current) / 40
    rate = strength * np.abs(np.cumsum(current)) / 40
    assert np.abs(current).max() <= LIMIT
    # The information increases with the squared rate that the self-test adds, and with the duration of this
    # rate.
    assert np.sqrt(np.square(rate).sum()) == pytest.approx(8.0 * 4e-4 / 0.7, rel=0.02)
    assert driven == pytest.approx(4.0, abs=0.1) or np.abs(current).max() == LIMIT


def test_a_coil_nearly_along_the_field_is_tested_when_the_field_has_turned() -> None:
    strength = np.array([0.02, 1e-5, 0.01])
    test = _test(strength)
    assert _driven(_fly(test, INTERVAL + 40.0)) == [0, 2]
    strength[1] = 0.02
    assert 1 in _driven(_fly(test, 80.0, begin=INTERVAL + 40.0))


def test_a_coil_that_the_motion_shows_and_a_coil_out_of_use_are_not_tested() -> None:
    assert _driven(_fly(_test(healthy=(0,)), INTERVAL + 40.0, usable=np.array([True, False, True]))) == [2]


def test_no_test_runs_while_the_coils_are_needed() -> None:
    test, needed = _test(), np.array([0.0, 0.05, 0.0])
    assert np.isnan(_fly(test, INTERVAL + 5.0, needed)).all()
    begun = _fly(test, 12.0, begin=INTERVAL + 5.0)
    assert np.isnan(begun[: 40 * 9]).all(), "the commands must have been small for 10 s"
    assert not np.isnan(begun[-1]).any()
    assert np.isnan(_fly(test, 5.0, needed, begin=INTERVAL + 17.0)).all(), "a running test is ended"
    assert _driven(_fly(test, 12.0, begin=INTERVAL + 22.0)) == [0], "and tried again"


def test_a_test_that_another_mode_interrupts_is_made_again() -> None:
    test = _test()
    assert _driven(_fly(test, INTERVAL + 2.0)) == [0]
    assert _driven(_fly(test, 20.0, begin=INTERVAL + 30.0)) == [0, 1, 2]


def test_all_coils_are_tested_at_once_on_request() -> None:
    test = _test()
    assert np.isnan(_fly(test, 15.0)).all()
    test.request()
    assert _driven(_fly(test, 20.0, begin=15.0)) == [0, 1, 2]


def test_the_results_are_reported_once_after_the_last_test() -> None:
    test = _test()
    told = []
    for cycle in range(40 * 80):
        now_ns = (cycle + 1) * TICK_NS
        test.wave(np.zeros(3), lambda: ALL, now_ns)
        if text := test.report(now_ns):
            told.append((cycle / 40, text))
    ((time, text),) = told
    assert text == "coil x: seen 0; coil y: seen 1; coil z: seen 2"
    assert time == pytest.approx(INTERVAL + 3 * 4.4 + 5.0, abs=0.3)
    test.request()
    _fly(test, 5.0, begin=80.0)
    test.stop()
    assert test.report(200 * 10**9) == "", "results from before a correction no longer hold"
