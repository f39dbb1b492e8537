"""Tests that opened devices are closed after a check, and that wrong values of devices are refused."""

from __future__ import annotations

from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from flight.app import devices
from flight.schema.devices import Gps, Sensor, SensorsSection
from flight.schema.document import ConfigError
from hal.interfaces.errors import NotResponding, OutOfRange
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock


@pytest.mark.parametrize("answers", [True, False])
def test_sensors_that_were_opened_to_be_checked_are_closed(
    answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the check did not close the sensors, the driver's thread would continue to read them."""
    unit = Mock()
    unit.configure.side_effect = None if answers else NotResponding("lis3mdl", "no acknowledge")
    monkeypatch.setattr(devices, "open_sensors", lambda *_: unit)
    section = cast(Any, SimpleNamespace(sensors=[SimpleNamespace(part="lis3mdl")]))
    if answers:
        assert "lis3mdl" in devices.probe_sensors(Mock(), section)
    else:
        with pytest.raises(NotResponding):
            devices.probe_sensors(Mock(), section)
    unit.close.assert_called_once_with()


def test_a_device_that_lacks_a_method_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A start that waits for its devices opens them again every few seconds, so the device must be closed."""
    device = Mock(spec=["close"])
    monkeypatch.setattr(devices, "driver_of", lambda *_: SimpleNamespace(open=lambda *_: device))
    config = cast(Any, SimpleNamespace(gps=SimpleNamespace(driver="other:GPS")))
    with ExitStack() as stack, pytest.raises(NotResponding, match="has no method"):
        devices.opened("gps", config, Mock(), stack)
    device.close.assert_called_once_with()


@pytest.mark.parametrize(("period", "arrival"), [(1.0, 2.4), (5.0, 5.4)])
def test_a_receiver_that_sends_once_per_period_is_found(period: float, arrival: float) -> None:
    """A receiver keeps the period that the last flight has set until it loses its supply."""
    clock = SimClock()
    heard = Mock(receive=lambda: [(0, b"x")] if clock.now_ns() >= arrival * SECOND_NS else [])
    rig: Any = SimpleNamespace(clock=clock, wires=Mock(serial=lambda *_: heard))
    assert devices.probe_ublox(rig, Gps(period=period)) == "sends"
    silent: Any = SimpleNamespace(clock=clock, wires=Mock(serial=lambda *_: Mock(receive=list)))
    with pytest.raises(NotResponding, match=f"no byte arrived in {max(2.5, period + 0.5):g} s"):
        devices.probe_ublox(silent, Gps(period=period))


@pytest.mark.parametrize(
    ("data", "found"), [(b"$GNTXT,01,01,02,u-blox*12\r\n", True), (b"\x80\xf8" * 99, False)]
)
def test_a_receiver_with_another_baud_rate_is_found_only_by_a_driver_that_changes_it(
    data: bytes, found: bool
) -> None:
    clock = SimClock()
    port = Mock(receive=lambda: [(clock.now_ns(), data)], baud_rate=9600)
    rig: Any = SimpleNamespace(clock=clock, wires=Mock(serial=lambda *_: port), earliest_utc_ns=0)
    assert devices.probe_ublox(rig, Gps()) == "sends"
    if found:
        assert devices.probe_nmea(rig, Gps(driver="nmea")) == "sends"
    else:
        with pytest.raises(NotResponding, match=r"no NMEA sentence at 9600 baud arrived in 2\.5 s"):
            devices.probe_nmea(rig, Gps(driver="nmea", baud_rate=9600))


@pytest.mark.parametrize(
    ("quantity", "names", "problem"),
    [
        ("magnetic", ("x", "y", "y"), r"is \[x, y, y\]: name each of the sensor's axes x, y and z once"),
        ("gyro", ("x", "-x", "z"), "name each of the sensor's axes"),
        ("gyro", ("x", "y", "-z"), "these axes are left-handed"),
        ("acceleration", ("y", "x", "z"), "these axes are left-handed"),
        ("magnetic", ("x", "y", "-z"), ""),
        ("gyro", ("-y", "x", "z"), ""),
    ],
)
def test_axes_that_no_sensor_has_are_refused(quantity: str, names: tuple[str, ...], problem: str) -> None:
    measures = cast(Any, {"magnetic": ("x", "y", "z")} | {quantity: names})
    section = SensorsSection(sensors=(Sensor(part="icm20948", measures=measures),))
    if not problem:
        devices.open_sensors(Mock(), section)
        return
    with pytest.raises(ConfigError, match=problem) as caught:
        devices.open_sensors(Mock(), section)
    assert caught.value.where == f"inertial_unit.sensors[0].measures.{quantity}"


def test_a_voltage_that_no_drv8830_has_is_refused() -> None:
    """The highest output voltage of the chip is 5.06 V (TI SLVSAB2, table 1)."""
    section = {
        "channels": [(0, 1)],
        "resistance": [23.0],
        "signs": [1],
        "limits": [0.2],
        "stale_after": 0.25,
        "supply_voltage": 5.0,
    }
    assert devices.check_drv8830(cast(Any, SimpleNamespace(**section))).supply_voltage == 5.0
    with pytest.raises(OutOfRange, match="supply voltage of DRV8830 bridges"):
        devices.check_drv8830(cast(Any, SimpleNamespace(**section | {"supply_voltage": 6.0})))


@pytest.mark.parametrize(("driver", "error"), [("mine:UNIT", NotResponding), ("vn100", AttributeError)])
def test_a_mistake_in_the_configuration_of_a_foreign_unit_is_named(
    driver: str, error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def configure() -> None:
        raise AttributeError("'Rig' object has no attribute 'wire'")

    found: dict[str, Any] = {"coils": Mock(), "inertial_unit": SimpleNamespace(configure=configure)}
    monkeypatch.setattr(devices, "opened", lambda kind, *_: found.get(kind))
    sections = {name: SimpleNamespace(driver="pca9685") for name in ("coils", "magnetometer")}
    config = SimpleNamespace(
        **sections, inertial_unit=SimpleNamespace(driver=driver), camera=None, power=None, wide_cameras=()
    )
    with pytest.raises(error, match=r"no attribute 'wire'") as caught:
        devices.open_devices(cast(Any, config), Mock(), Mock(), patient=False)
    if error is NotResponding:
        assert "'mine:UNIT', whose function `configure` failed" in str(caught.value)
        devices.open_devices(cast(Any, config), Mock(cameras=[None]), Mock(), patient=True)
    found["coils"].start.assert_any_call(False)


def test_a_mistake_in_a_foreign_camera_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    device = Mock()
    device.open.side_effect = ImportError("no module `sdk`")
    monkeypatch.setattr(devices, "driver_of", lambda *_: Mock(open=lambda *_: device))
    camera = SimpleNamespace(device=SimpleNamespace(driver="mine:CAMERA"))
    with pytest.raises(NotResponding, match=r"'mine:CAMERA'.*no module `sdk`"):
        devices.open_camera(cast(Any, camera), Mock(), Mock())
