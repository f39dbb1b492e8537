"""Tests that a satellite detumbles by the magnetometer, ends detumbling, and then detumbles again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import OrbitConfig
from flight.schema.document import ConfigError
from flight.schema.sections import Commands, CommandStep
from ground.report import format_report, summarise
from ground.telemetry import Run
from knightcube.errors import UsageError
from sim_hal.faults.schedule import check
from sim_hal.settings import FaultEntry
from tests.scenario.mode_flights import currents, entered, modes_of
from tests.scenario.orbit_flights import ORBIT, orbit_config, speed, world
from tests.support.flights import event_names, fly

SPEED, SLOW = 0.1745, 0.1
"""Body rates (rad/s) at the release and at the end of detumbling."""
SILENT, MUTE = 20.0, 1.0
"""Start and duration (s) of the interval in which the IMU is silent."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a flight that begins with a tumble of 10 deg/s, and whose IMU is silent during detumbling.

    Detumbling ends at a rate above the configured tumble rate, so the flight soon detumbles again.
    """
    config = orbit_config(70.0, tumble_rate=0.01)
    section = configuration.replace(config.detumble, low_rate=SLOW, low_for=3.0)
    timeline = (CommandStep(at=1.0, mode="hold"), CommandStep(at=2.0, slew=0.1))
    config = configuration.replace(config, detumble=section, commands=Commands(timeline=timeline))
    silence = FaultEntry(fault="imu: silent", at=SILENT, span=MUTE)
    return fly(config, tmp_path_factory.mktemp("orbit"), section=world(SPEED, silence))


def test_the_satellite_detumbles_rests_and_detumbles_again_if_it_rotates_too_fast(flown: Run) -> None:
    assert modes_of(flown)[:4] == [Mode.BOOT, Mode.DETUMBLE, Mode.ACQUIRE, Mode.DETUMBLE]
    assert speed(flown)[0] == pytest.approx(SPEED, rel=0.05)
    rested = flown["mode"]["time_ns"][2] * 1e-9
    time = flown["truth"]["time_ns"] * 1e-9
    assert speed(flown)[time >= rested][0] < SLOW + 1e-3
    again = flown["mode"]["time_ns"][3] * 1e-9
    assert again > rested
    assert not currents(flown, rested + 0.05, again).any()


def test_the_errors_of_the_rate_from_the_magnetometer_agree_with_its_sigma(flown: Run) -> None:
    spin = flown["spin"][flown["spin"]["known"] == 1]
    spin = spin[spin["time_ns"] > 5e9]
    times = spin["time_ns"] * 1e-9
    true = np.column_stack(
        [np.interp(times, flown["truth"]["time_ns"] * 1e-9, flown["truth"]["rate"][:, k]) for k in range(3)]
    )
    error = np.linalg.norm(spin["rate"] - true, axis=1)
    assert len(spin) > 60
    assert np.median(error) < np.radians(0.3)
    assert np.mean(error > 3.0 * spin["rate_sigma"]) < 0.05


def test_the_coils_are_at_zero_while_the_unit_is_silent(flown: Run) -> None:
    assert currents(flown, SILENT - 3.0, SILENT).any()
    assert not currents(flown, SILENT + 0.2, SILENT + MUTE).any()
    assert currents(flown, SILENT + MUTE + 2.0, SILENT + MUTE + 6.0).any()
    assert {"control-lost", "control-regained", "imu-silent"} <= set(event_names(flown))


def test_the_coils_pause_while_the_magnetometer_measures(flown: Run) -> None:
    """The coils pause while the magnetometer measures.

    The magnetometer is read in the last 0.1 s of each pause of 0.2 s, after the decay of the currents.
    """
    time = flown["truth"]["time_ns"] * 1e-9
    began = entered(flown, Mode.DETUMBLE, 0)
    phase = (time - began) % 4.0
    measuring = (time > began + 2.0) & (time < SILENT) & (phase > 0.1) & (phase < 0.2)
    assert np.abs(flown["truth"]["current"][measuring]).max() < 1e-3


def test_modes_that_need_an_attitude_are_refused(flown: Run) -> None:
    answers = [to_text(text) for text in flown["command"]["text"]]
    assert ["cannot be commanded of this body" in text for text in answers] == [True, True]
    assert entered(flown, Mode.DETUMBLE) > 2.0


def test_the_report_shows_the_detumbling_and_no_steps(flown: Run) -> None:
    summary = summarise(flown)
    first = summary["detumbling"]["periods"][0]
    assert first["slowed"]
    assert first["first_rate_rad_s"] == pytest.approx(SPEED, rel=0.05)
    text = format_report(summary)
    assert "Detumbling, rates from the truth" in text
    assert "thesis" not in text


def test_an_initial_mode_that_the_body_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"modes\.initial.*hold.*this body has detumble, safe"):
        fly(orbit_config(1.0, initial="hold"), tmp_path, section=world(0.01))


def test_tools_of_the_testbed_refuse_an_orbit_with_file_and_line() -> None:
    with pytest.raises(ConfigError, match=r"orbit\.yaml:\d+: `body` is orbit: .* of the testbed"):
        configuration.load_testbed(ORBIT)


def test_a_fault_of_the_planner_is_refused_only_where_no_path_is_planned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config, fault = orbit_config(5.0), (FaultEntry(fault="planner: nan"),)
    check(fault, config, realtime=False)
    monkeypatch.setattr(OrbitConfig, "replan_period", lambda _: None)
    with pytest.raises(UsageError, match="this flight has no planner: the body plans no paths"):
        check(fault, config, realtime=False)
