"""Tests that a satellite with a known attitude points to its target, with pauses for the magnetometer."""

from __future__ import annotations

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.bodies import TargetStep
from flight.schema.sections import Commands, CommandStep
from ground.telemetry import Run
from knightcube.astro.quaternion import angle_between
from tests.scenario.mode_flights import entered, modes_of
from tests.scenario.orbit_flights import navigating, skyward
from tests.support.flights import event_names, fly

DURATION, SUNWARD = 52.0, 47.0
"""Duration (s) of the flight, and time (s) of the command of the mode SUN."""
SPEED = 0.001
"""Largest initial body rate (rad/s), equal to the orbital rate."""
WITHIN = 12.0
"""Largest pointing error (deg) at the end of the run."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a flight that starts near rest. The target is the inertial attitude at the release."""
    section = skyward()
    assert section.free_body is not None
    attitude = section.free_body.release.attitude
    release = configuration.replace(section.free_body.release, speed=SPEED)
    section = configuration.replace(
        section, free_body=configuration.replace(section.free_body, release=release), faults=()
    )
    config = configuration.replace(
        navigating(),
        duration=DURATION,
        targets=(TargetStep(at=0.0, point="inertial", quaternion=attitude),),
        commands=Commands(timeline=(CommandStep(at=SUNWARD, mode="sun"),)),
    )
    return fly(config, tmp_path_factory.mktemp("pointing"), section=section)


def test_the_satellite_points_as_soon_as_its_attitude_is_known(flown: Run) -> None:
    assert modes_of(flown) == [Mode.BOOT, Mode.DETUMBLE, Mode.ACQUIRE, Mode.POINT, Mode.SUN]
    assert entered(flown, Mode.POINT, 0) < 30.0
    assert not {"planner-failed", "control-lost", "tumbling"} & set(event_names(flown))
    targets = [to_text(e["text"]) for e in flown["event"] if to_text(e["name"]) == "target"]
    assert targets[0].startswith("inertial")
    assert targets[1] == "sun, roll free"


def test_the_satellite_stays_near_its_target(flown: Run) -> None:
    packets = flown["attitude"]
    pointing = packets[(packets["mode"] == Mode.POINT) & np.isfinite(packets["target"][:, 0])]
    assert len(pointing) > 50
    off = np.degrees(angle_between(pointing["quaternion"], pointing["target"]))
    assert off.max() < WITHIN


def test_the_coils_act_and_pause_for_the_magnetometer(flown: Run) -> None:
    """The coils are driven, and are off for a tenth of the time in pauses for the magnetometer."""
    truth = flown["truth"]
    time = truth["time_ns"] * 1e-9
    inside = (time > entered(flown, Mode.POINT, 0) + 4.0) & (time < DURATION)
    currents = np.abs(truth["current"][inside]).max(axis=1)
    assert np.mean(currents < 1e-3) == pytest.approx(0.1, abs=0.06)


def test_no_coil_switches_during_an_exposure_while_the_satellite_points(flown: Run) -> None:
    packets = flown["attitude"]
    times, dipoles = packets["time_ns"].astype(np.int64), packets["dipole"]
    changed = np.abs(np.diff(dipoles, axis=0)).max(axis=1) > 0.0
    after = times[1:][changed]  # first packets after changes of the commanded dipole, 0.1 s apart
    frames = flown["streak"][flown["streak"]["exposure_start_ns"] > entered(flown, Mode.POINT, 0) * 1e9]
    assert len(frames) >= 3
    assert len(after) > 30
    for frame in frames:
        begin = int(frame["exposure_start_ns"])
        end = begin + round(float(frame["exposure"]) * 1e9)
        assert not ((after - 100_000_000 >= begin) & (after <= end)).any()
