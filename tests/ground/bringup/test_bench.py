"""Tests of the configuration sections that describe the devices of a bring-up session."""

from __future__ import annotations

from contextlib import ExitStack
from unittest.mock import Mock

import pytest

from flight.schema import reader
from flight.schema.devices import Battery, Power, PowerMonitorSection
from ground.bringup.bench import Session, StepSkipped
from tests.support.orbit_devices import orbit_config


def _session(power: Power | None) -> Session:
    """Return a bring-up session without hardware."""
    config = reader.replace(orbit_config(), power=power)
    return Session(config, Mock(cameras=None), ExitStack(), lambda _: None)


def test_a_monitor_of_the_power_system_has_its_section_if_it_is_configured() -> None:
    monitor = PowerMonitorSection(address=0x45)
    power = Power(battery=Battery(capacity=2.0), battery_monitor=monitor, bus_monitor=None)
    assert _session(power).section("power.battery_monitor") == ("power_monitor", monitor)
    assert _session(power).section("power.bus_monitor") == ("power_monitor", None)
    assert _session(None).section("power.battery_monitor") == ("power_monitor", None)


@pytest.mark.parametrize("key", ["power.battery_monitor", "power.bus_monitor"])
def test_a_step_with_a_monitor_that_is_not_configured_is_skipped(key: str) -> None:
    with pytest.raises(StepSkipped, match=f"the configuration has no {key}"):
        _session(None).device(key)
