"""Tests of the testbed without a gyro: angle from the magnetometer, field of the coils, and control."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from flight.bodies.testbed import body as body_module
from flight.bodies.testbed.body import UnitFeed, attitude_filter, surrounding_field
from flight.bodies.testbed.control import plant_of
from flight.loop import facts
from flight.loop.navigation import Navigation, NavigationSettings
from flight.schema.reader import replace
from ground.telemetry import Run
from hal.interfaces.devices import ImuReading
from hal.interfaces.errors import DeviceError
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import about_axis_y, angle_about_axis_y, attitude_matrix
from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from sim_hal.settings import FaultEntry
from tests.support.flights import config_for, demo_config, demo_world, event_names, fly

PERIOD_NS = 25_000_000
CONFIG = demo_config(10.0)
FIELD = surrounding_field(CONFIG)


def feed_of(field: FloatArray = FIELD) -> tuple[UnitFeed, AttitudeFilter]:
    """Return the measurement feed and the filter of the demonstration in a given field (reference axes)."""
    filter_ = attitude_filter(CONFIG, plant_of(CONFIG), {})[0]
    return UnitFeed(filter_, CONFIG, lambda _: field), filter_


def reading(time_ns: int, field: FloatArray, rate: float = math.nan) -> ImuReading:
    """Return a reading with a wrong attitude, so that only its field can give the angle."""
    wrong = about_axis_y(2.0)
    return ImuReading(time_ns, time_ns, time_ns, wrong, np.full(3, rate), field, np.zeros(3))


@pytest.mark.parametrize("rate", [0.0, -0.1, 0.3])
@pytest.mark.parametrize("field", [FIELD, np.array([2e-4, 3e-5, 1e-4])], ids=["along z", "slanting"])
def test_the_field_alone_gives_angle_and_rate_within_a_second(rate: float, field: FloatArray) -> None:
    feed, filter_ = feed_of(field)
    for step in range(41):
        turn = attitude_matrix(about_axis_y(0.4 + rate * 0.025 * step))
        assert feed.accept(reading(step * PERIOD_NS, turn @ field)).holds
    found = filter_.at(40 * PERIOD_NS)
    angle_sigma, rate_sigma = (math.sqrt(found.covariance[k, k]) for k in (1, 4))
    assert angle_about_axis_y(found.quaternion) == pytest.approx(0.4 + rate, abs=2.0 * angle_sigma)
    assert found.rate[1] == pytest.approx(rate, abs=2.0 * rate_sigma)
    assert angle_sigma < 2.2e-3
    assert rate_sigma < 6e-3


def test_a_weak_field_gives_no_heading() -> None:
    feed, filter_ = feed_of()
    agreement = feed.accept(reading(0, 0.4 * FIELD))
    assert not agreement.holds
    assert "field 1.80e-04 T, expected 4.50e-04 T" in agreement.objection
    assert not filter_.started


def test_the_field_of_the_coils_hardly_moves_the_estimate_and_rest_restores_its_weight() -> None:
    """A field error of 0.1 rad that the coils cause for 5 s moves the estimate by less than 2 sigma.

    With the coils off, the magnetometer has its full weight again.
    """
    feed, filter_ = feed_of()
    for step in range(40):
        feed.accept(reading(step * PERIOD_NS, FIELD))
    # A dipole along the axis of the suspension thread gives no torque.
    filter_.command(40 * PERIOD_NS, np.array([0.0, 0.05, 0.0]))
    offset = attitude_matrix(about_axis_y(0.1)) @ FIELD
    for step in range(40, 240):
        feed.accept(reading(step * PERIOD_NS, offset))
    found = filter_.at(240 * PERIOD_NS)
    sigma = math.sqrt(found.covariance[1, 1])
    assert abs(angle_about_axis_y(found.quaternion)) < 2.0 * sigma
    filter_.command(240 * PERIOD_NS, np.zeros(3))
    for step in range(240, 260):
        feed.accept(reading(step * PERIOD_NS, FIELD))
    assert math.sqrt(filter_.at(260 * PERIOD_NS).covariance[1, 1]) < min(0.5 * sigma, 2e-3)


@pytest.mark.parametrize("current", [0.0, 0.05])
def test_an_estimate_that_the_field_with_coils_off_contradicts_is_discarded(current: float) -> None:
    """An estimate is discarded if measurements with coils off contradict it repeatedly.

    Between these measurements, inaccurate measurements with driven coils are accepted.
    """
    feed, filter_ = feed_of()
    for step in range(40):
        feed.accept(reading(step * PERIOD_NS, FIELD))
    turned = attitude_matrix(about_axis_y(2.5)) @ FIELD
    held: list[bool] = []
    step = 40
    while len(held) < 9:
        filter_.command(step * PERIOD_NS, np.array([0.0, current, 0.0]))
        feed.accept(reading((step + 1) * PERIOD_NS, turned))
        filter_.command((step + 2) * PERIOD_NS, np.zeros(3))
        held.append(feed.accept(reading((step + 5) * PERIOD_NS, turned)).holds)
        step += 6
    # If the coils are driven, only every second measurement is made with the coils off.
    assert held.index(True) == (8 if current else 4)
    assert angle_about_axis_y(filter_.at(step * PERIOD_NS).quaternion) == pytest.approx(2.5, abs=0.1)


def navigation(
    uses: bool, *polled: ImuReading, accurate: Any = None, spare: Any = None
) -> tuple[Navigation, Any, Any]:
    """Return the navigation of a body whose IMU returns `polled`, and the mocks of its feed and its facts."""
    unit, estimation, services = Mock(), Mock(), Mock()
    unit.poll.return_value, services.recorder.epoch_ns = polled, 0
    link = Mock(bad_checksum=0, discarded_bytes=0, out_of_range=0, not_finite=0, last_byte_ns=0, upsets=0)
    unit.link.return_value = link
    estimation.uses_readings_without_rate, estimation.is_accurate = uses, accurate
    settings = NavigationSettings(100_000_000, 1_200_000_000, PERIOD_NS)
    return Navigation(unit, estimation, settings, services, spare), estimation.feed, services.facts


def test_a_magnetometer_replaces_a_silent_unit_until_the_unit_answers_again() -> None:
    spare = Mock()
    found, feed, known = navigation(True, spare=spare)
    unit: Any = found._unit
    changed: Any = found._estimation.magnetometer_changed
    unit.poll.side_effect = [[reading(0, FIELD, 0.1)], [], DeviceError("unit", "gone"), [], [], []]
    given: list[ImuReading] = []
    for step in range(5):
        now_ns = step * 50_000_000
        spare.poll.return_value = [reading(now_ns - 1, FIELD)]
        given += found.update(now_ns)
    # After 0.1 s without IMU readings, the readings of the magnetometer are used.
    assert [one.time_ns for one in given] == [0, 149_999_999, 199_999_999]
    assert changed.call_count == 1
    assert [one.has_rate for one in given] == [True, False, False]
    unit.poll.side_effect = [[reading(249_000_000, FIELD, 0.1)]]
    spare.poll.side_effect = DeviceError("magnetometer", "gone")
    assert [one.time_ns for one in found.update(250_000_000)] == [249_000_000]
    assert changed.call_count == 2
    texts = [call.args[3] for call in known.update.call_args_list if call.args[0] is facts.GYRO_LOST]
    assert texts[1] == "the magnetometer replaces the silent inertial unit"
    assert feed.accept.call_count == 4


def test_a_body_that_needs_the_gyro_receives_no_reading_without_a_rate() -> None:
    good, bad = reading(0, FIELD, 0.1), reading(PERIOD_NS, FIELD)
    for uses, expected in ((False, (good,)), (True, (good, bad))):
        found, feed, known = navigation(uses, good, bad)
        assert found.update(PERIOD_NS) == expected
        assert [call.args[0] for call in feed.accept.call_args_list] == list(expected)
        stated = [call.args[1] for call in known.update.call_args_list if call.args[0] is facts.GYRO_LOST]
        assert stated == [False, True]


@pytest.mark.parametrize(
    ("rate", "angle_sigma", "rate_sigma", "allowed"),
    [
        (math.nan, 0.006, 0.019, True),
        (math.nan, 0.007, 0.001, False),
        (math.nan, 0.001, 0.021, False),
        (0.1, 0.03, 0.03, True),
    ],
)
def test_without_a_gyro_the_limits_of_an_arrival_decide_whether_coils_are_driven(
    rate: float, angle_sigma: float, rate_sigma: float, allowed: bool
) -> None:
    modes = replace(CONFIG.modes, arrived_angle=0.02, arrived_rate=0.02)
    estimation = body_module.TestbedEstimation(replace(CONFIG, modes=modes), {})
    found, feed, _ = navigation(True, reading(0, FIELD, rate), accurate=estimation.is_accurate)
    feed.accept.return_value = Mock(holds=True, objection="")
    found.update(0)
    variance = np.zeros(6)
    variance[[1, 4]] = angle_sigma**2, rate_sigma**2
    estimate: Any = Mock(covariance=np.diag(variance))
    assert found.is_measured(estimate, 0) is allowed
    assert not found.is_measured(estimate, 200_000_000), "the reading is too old"
    assert not found.is_measured(None, 0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a flight whose gyro is dead until 18 s, and whose coils disturb the magnetometer."""
    coils = tuple(tuple(5e-4 * float(i == k) for k in range(3)) for i in range(3))
    entry = FaultEntry(fault="imu: gyro-dead", at=0.0, span=18.0)
    section = replace(demo_world(), seed=4, coil_field=coils, faults=(entry,))
    folder: Path = tmp_path_factory.mktemp("gyro-dead")
    return fly(config_for("testbed-demo", camera=True, duration=22.0), folder / "run", section=section)


def test_a_step_is_flown_without_a_gyro_and_with_realistic_uncertainty(flown: Run) -> None:
    names = event_names(flown)
    assert names.count("gyro-lost") == names.count("gyro-recovered") == 1
    assert "task-failed" not in names
    control, truth = flown["control"], flown["truth"]
    angle = 2.0 * np.arctan2(truth["quaternion"][:, 1], truth["quaternion"][:, 3])
    time = control["time_ns"] * 1e-9
    true = np.interp(control["time_ns"], truth["time_ns"], angle)
    settled = (time > 15.0) & (time < 18.0)
    off = np.abs(2.0 * np.arcsin(control["target_q2"]) - true)[settled]
    assert off.max() < math.radians(0.5)
    assert (control["state"][settled] > 0).all(), "the coils are used"
    judged = (time > 2.0) & (time < 18.0)
    nees = ((control["angle"] - true) / control["angle_sigma"])[judged] ** 2
    assert nees.mean() < 1.5
    assert flown["stars"]["accepted"].sum() >= 5
