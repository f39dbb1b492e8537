"""Tests that loads are shed when a small battery is low, and restored after sunrise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from flight.schema import reader as configuration
from flight.schema.devices import Battery, LowBattery, Power
from ground.telemetry import Run
from sim_hal.settings import PowerTruth, SolarPanel
from tests.scenario.orbit_flights import orbit_config, world
from tests.support.flights import demo_config, demo_world, event_names, fly

FACES = [tuple(sign * float(k == axis) for k in range(3)) for axis in range(3) for sign in (1.0, -1.0)]
ANOMALY_DEG = 242.0
"""True anomaly at the start, about 14 s before the sunrise."""
CAMERA_PERIOD = 3.0


@pytest.fixture(scope="module")
def orbit(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a flight that detumbles at its coils' limits, from an eclipse into sunlight."""
    section = world(0.1745)
    assert section.free_body is not None
    start = configuration.replace(section.free_body.orbit, true_anomaly_deg=ANOMALY_DEG)
    panels = tuple(SolarPanel(normal=(x, y, z), peak=9.0) for x, y, z in FACES)
    body = configuration.replace(section.free_body, orbit=start)
    truth = PowerTruth(charge=0.41, load=4.0, panels=panels)
    section = configuration.replace(section, free_body=body, power=truth)
    power = Power(battery=Battery(capacity=0.006, resistance=0.15))
    config = configuration.replace(orbit_config(30.0), camera=None, gps=None, elements=None, power=power)
    return fly(config, tmp_path_factory.mktemp("power"), section=section)


def test_the_loads_are_shed_in_order_and_the_flight_goes_on_after_sunrise(orbit: Run) -> None:
    assert [name for name in event_names(orbit) if name.startswith("battery")] == [
        "battery-low", "battery-very-low", "battery-critical",
        "battery-charged", "battery-recovered", "battery-recovered",
    ]  # fmt: skip
    modes = [(int(row["mode"]), to_text(row["reason"])) for row in orbit["mode"]]
    assert modes[1:4] == [
        (Mode.DETUMBLE, ""), (Mode.SAFE, "battery-critical"), (Mode.ACQUIRE, "battery-charged")
    ]  # fmt: skip
    assert modes[4][0] == Mode.DETUMBLE, "the satellite still rotates, so it is detumbled first"
    dark, packets = orbit["orbit_truth"]["sunlit"] < 0.5, orbit["power"]
    assert dark[0]
    assert not dark[-1]
    assert packets["shed"][-1] == 0
    true = orbit["true_power"]
    at = np.interp(packets["time_ns"], true["time_ns"], true["charge"])
    assert np.abs(packets["charge"] - at).max() < 0.1


def test_the_coils_carry_at_most_their_reduced_limit_while_the_battery_is_low(orbit: Run) -> None:
    times, power = orbit["truth"]["time_ns"], orbit["power"]
    shed = power["shed"][np.searchsorted(power["time_ns"], times, side="right") - 1]
    largest = np.abs(orbit["truth"]["current"]).max(axis=1)
    begun = np.flatnonzero(shed >= 1)[0]
    assert largest[:begun].max() > 0.14
    assert largest[begun + 8 :][shed[begun + 8 :] >= 1].max() < 0.3 * 0.148 + 0.004


def test_a_testbed_takes_fewer_frames_and_then_rests_with_a_reason(tmp_path: Path) -> None:
    limits = LowBattery(camera_period=CAMERA_PERIOD)
    config = demo_config(13.0)
    assert config.camera is not None
    camera = configuration.replace(config.camera, period=1.0, exposure=0.1, columns=256, rows=256)
    power = Power(battery=Battery(capacity=0.002), low_battery=limits)
    config = configuration.replace(config, camera=camera, power=power)
    section = configuration.replace(demo_world(), power=PowerTruth(charge=0.36, load=2.0))
    run = fly(config, tmp_path, section=section)
    shed, times = run["power"]["shed"], run["power"]["time_ns"] * 1e-9
    slower, safe = times[shed == 2][0], times[shed == 3][0]
    frames = run["streak"]["exposure_start_ns"] * 1e-9
    assert np.diff(frames[frames < slower]).max() < 1.5
    assert np.diff(frames[frames > slower]).min() > CAMERA_PERIOD - 1.0
    assert "camera-lost" not in event_names(run)
    assert to_text(run["mode"][-1]["reason"]) == "battery-critical"
    assert not run["truth"]["current"][run["truth"]["time_ns"] * 1e-9 > safe + 1.0].any()
