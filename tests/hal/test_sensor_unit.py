"""Tests of IMUs that consist of separate sensors: starts, failures, attitude, and Linux's SPI device."""

from __future__ import annotations

import errno
import os
import struct
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.schema.devices import axis_matrix
from hal.buses.linux_wires import LinuxSpiDevice, LinuxWires
from hal.buses.system import SystemClock
from hal.drivers.sensor_unit import (
    DEC_RATE,
    PROD_ID,
    PRODUCT,
    Adis16470,
    CheckedUnit,
    SensorPart,
    SensorUnit,
    UnitSettings,
    level_attitude,
    quaternion_of,
)
from hal.interfaces.devices import ImuLink, ImuReading
from hal.interfaces.errors import NotResponding, Refused
from knightcube.astro import quaternion
from sim_hal.clock import SimClock
from sim_hal.emulators.sensors import EmulatedAdis16470, Measurements
from sim_hal.worlds.world import BodyMotion, about_thread

SETTINGS = UnitSettings(
    mounting=np.eye(3),
    gyro_matrix=np.eye(3),
    field_matrix=np.eye(3),
    field_bias=np.array([1e-5, 0.0, 0.0]),
    rate_hz=50,
    field_range=6e-4,
)
AXES = axis_matrix(("-y", "z", "x"))


class Sensor:
    """A sensor that counts its readings, and fails while `failing` is true."""

    def __init__(self) -> None:
        self.readings = 0
        self.failing = False
        self.field = (0.0, 0.0, -450.0)

    @property
    def gyro(self) -> tuple[float, float, float]:
        if self.failing:
            raise OSError(errno.EREMOTEIO, "no acknowledge")
        self.readings += 1
        return (0.1, 0.2, 0.3 + 1e-6 * self.readings)

    @property
    def magnetic(self) -> tuple[float, float, float]:
        return self.field


class Bench:
    """An IMU with one sensor; `starts` counts the starts of this sensor."""

    def __init__(self) -> None:
        self.clock, self.sensor, self.starts = SimClock(), Sensor(), 0
        part = SensorPart("one", self._make, {"gyro": AXES, "magnetic": np.eye(3)})
        self.unit = SensorUnit(self.clock, [part], SETTINGS)

    def _make(self) -> Sensor:
        self.starts += 1
        if self.sensor.failing:
            raise RuntimeError("Failed to find the sensor - check your wiring!")
        return self.sensor

    def wait(self, seconds: float) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * 1e9))


def test_readings_come_at_the_rate_in_body_axes_with_the_bias_removed() -> None:
    bench = Bench()
    bench.unit.configure()
    bench.wait(1.0)
    readings = bench.unit.poll()
    assert len(readings) == 50
    assert bench.unit.poll() == []
    np.testing.assert_allclose(readings[-1].rate, [-0.2, 0.3, 0.1], atol=1e-3)
    np.testing.assert_allclose(readings[-1].field, [-1e-5, 0.0, -450e-6])
    assert readings[-1].quaternion.tolist() == [0.0, 0.0, 0.0, 1.0], "no accelerometer, no attitude"
    assert bench.unit.link().packets == 50


def test_a_sensor_that_fails_is_reported_started_again_and_read_again() -> None:
    bench = Bench()
    bench.unit.configure()
    bench.wait(0.1)
    assert bench.unit.poll()
    bench.sensor.failing = True
    bench.wait(0.1)
    with pytest.raises(NotResponding, match="check your wiring"):
        bench.unit.poll()
    bench.sensor.failing = False
    bench.wait(0.1)
    assert bench.unit.poll()
    assert bench.starts > 2, "the settings are written again"


def test_a_sensor_that_is_missing_at_the_start_is_named() -> None:
    bench = Bench()
    bench.sensor.failing = True
    with pytest.raises(NotResponding, match="one: Failed to find the sensor"):
        bench.unit.configure()


@pytest.mark.parametrize(
    ("field", "counter"), [((0.0, np.nan, 0.0), "not_finite"), ((700.0, 0.0, 0.0), "out_of_range")]
)
def test_implausible_samples_are_counted_and_not_returned(
    field: tuple[float, float, float], counter: str
) -> None:
    bench = Bench()
    bench.unit.configure()
    bench.sensor.field = field
    bench.wait(0.2)
    assert bench.unit.poll() == []
    assert getattr(bench.unit.link(), counter) == 10
    assert "magnetic" in bench.unit.link().rejection


class SleepyChip:
    """A sensor that answers with zero after a brown-out, until it is started again."""

    def __init__(self) -> None:
        self.asleep, self.sleeping, self.readings = set[str](), set[str](), 0

    def make(self) -> SleepyChip:
        self.asleep = set(self.sleeping)
        return self

    def _value(self, quantity: str) -> tuple[float, float, float]:
        self.readings += 1
        return (0.0, 0.0, 0.0 if quantity in self.asleep else 1.0 + 1e-6 * self.readings)

    gyro = property(lambda self: self._value("gyro"))
    magnetic = property(lambda self: self._value("magnetic"))


def sleepy_unit() -> tuple[SleepyChip, SensorUnit, SimClock]:
    chip, clock = SleepyChip(), SimClock()
    part = SensorPart("chip", chip.make, {"gyro": np.eye(3), "magnetic": np.eye(3)})
    unit = SensorUnit(clock, [part], SETTINGS)
    unit.configure()
    clock.sleep_until_ns(1_000_000_000)
    assert len(unit.poll()) == 50
    return chip, unit, clock


@pytest.mark.parametrize("asleep", [{"gyro"}, {"magnetic"}, {"gyro", "magnetic"}])
def test_a_sensor_that_sleeps_after_a_brown_out_is_started_again(asleep: set[str]) -> None:
    chip, unit, clock = sleepy_unit()
    chip.asleep = asleep
    clock.sleep_until_ns(5_000_000_000)
    unit.poll()
    clock.sleep_until_ns(6_000_000_000)
    readings = unit.poll()
    assert len(readings) == 50
    assert all(reading.rate[2] > 0.9 and reading.field[2] > 0.9e-6 for reading in readings)


def test_a_gyro_that_stays_stuck_gives_no_rate_and_is_seldom_started() -> None:
    chip, unit, clock = sleepy_unit()
    chip.asleep = chip.sleeping = {"gyro"}
    clock.sleep_until_ns(2_000_000_000)
    unit.poll()
    clock.sleep_until_ns(60_000_000_000)
    readings = unit.poll()
    assert len(readings) == 58 * 50
    assert not any(reading.has_rate for reading in readings)
    assert "rates in a row are identical" in unit.link().rejection


class ForeignUnit:
    """An inertial unit that returns given readings."""

    def __init__(self, *changes: dict[str, Any]) -> None:
        good = ImuReading(1, 2, 3, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), np.zeros(3))
        self._readings = [good._replace(**change) for change in changes]
        self.closed = self.configured = False

    def configure(self) -> None:
        self.configured = True

    def poll(self) -> list[ImuReading]:
        readings, self._readings = self._readings, []
        return readings

    def link(self) -> ImuLink:
        return ImuLink(60, 5, 0, 0, 1, 2, 9, "of the driver")

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("change", "counted", "says"),
    [
        ({"field": np.array([0.0, np.nan, 0.0])}, (1, 3), "field = [0.0, nan, 0.0]"),
        ({"acceleration": np.array([np.inf, 0.0, 0.0])}, (1, 3), "acceleration = [inf"),
        ({"field": np.zeros(4)}, (2, 2), "field of shape (4,)"),
        ({"field": np.array([0.0, 45.0, 0.0])}, (2, 2), "field [0.0, 45.0, 0.0] T, beyond 0.0006 T"),
        ({"quaternion": np.array([0.0, 0.0, 0.0, 2.0])}, (2, 2), "quaternion of norm 2, not 1"),
        ({"time_ns": 1_800_000_000 * 10**9}, (2, 2), "time_ns 1.8e+09 s ahead of the clock"),
        ({"time_ns": 10**8 + 1}, (2, 2), "time_ns 0.1 s ahead of the clock"),
        ({"time_ns": np.nan}, (2, 2), "time_ns nan s ahead of the clock"),
    ],
)
def test_implausible_readings_of_a_foreign_driver_are_counted_and_omitted(
    change: dict[str, Any], counted: tuple[int, int], says: str
) -> None:
    unit = CheckedUnit(ForeignUnit({}, change, {"field": [1e-5, 0.0, 0.0]}), 6e-4, SimClock())
    assert unit.link() == ImuLink(60, 5, 0, 0, 1, 2, 9, "of the driver")
    first, last = unit.poll()
    assert first.has_rate
    assert last.field.tolist() == [1e-5, 0.0, 0.0]
    link = unit.link()
    assert (link.out_of_range, link.not_finite) == counted
    assert link.rejection.startswith(says)


def test_a_rate_in_sensor_counts_is_out_of_range_and_not_used() -> None:
    foreign = ForeignUnit({"rate": np.array([310, -2, 7])}, {"rate": [1.0, np.nan, 0.0]}, {"rate": [1, 2, 3]})
    unit = CheckedUnit(foreign, 6e-4, SimClock())
    unit.configure()
    in_counts, invalid, fast = unit.poll()
    assert foreign.configured
    assert not in_counts.has_rate
    assert not invalid.has_rate
    assert fast.rate.tolist() == [1.0, 2.0, 3.0]
    assert unit.link().out_of_range == 2
    assert unit.link().rejection == "rate [310.0, -2.0, 7.0] rad/s, beyond 34.9 rad/s"
    unit.close()
    assert foreign.closed


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 0.7, 2.5])
def test_the_attitude_on_the_thread_follows_from_gravity_and_field(angle: float) -> None:
    motion = about_thread(0, angle, 0.0, 4.5e-4)
    measured = level_attitude(motion.field_body, motion.specific_force_body)
    assert abs(measured @ motion.quaternion) == pytest.approx(1.0)


def test_the_quaternion_of_a_matrix_is_that_of_the_library() -> None:
    for vector in np.random.default_rng(3).uniform(-3.1, 3.1, (40, 3)):
        q = quaternion.from_rotation_vector(vector)
        assert abs(quaternion_of(quaternion.attitude_matrix(q)) @ q) == pytest.approx(1.0)


def test_an_adis16470_measures_negative_rates_and_averages() -> None:
    motion = BodyMotion(0, np.zeros(4), np.array([-0.3, 0.002, 2.0]), np.zeros(3), np.array([0.0, -9.8, 3.0]))
    clock, axes = SimClock(), {"gyro": np.eye(3)}
    part = EmulatedAdis16470(0, Measurements(lambda _: motion, axes, np.random.default_rng(1), clock.now_ns))
    sensor = Adis16470(part)
    assert sensor.decimation == 24
    sensor.decimation = 1999
    clock.sleep_until_ns(2_000_000_000)
    np.testing.assert_allclose(sensor.gyro, motion.rate, atol=5e-4)
    np.testing.assert_allclose(sensor.acceleration, motion.specific_force_body, atol=5e-3)
    part._held[DEC_RATE] = 0  # as after a brown-out, with five times the noise
    with pytest.raises(NotResponding, match="DEC_RATE is 0 instead of 1999"):
        _ = sensor.acceleration


def test_an_adis16470_never_mixes_the_axes_of_two_samples() -> None:
    """If the sample counter changes in every try, NotResponding is raised."""

    class Part:
        counter = 0

        def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
            self.counter += 1
            requested = [b"\0\0", *frames[:-1]]
            known = {PROD_ID: PRODUCT, DEC_RATE: 24}
            words = [known.get(frame[0], 16 * self.counter + index) for index, frame in enumerate(requested)]
            return [word.to_bytes(2, "big") for word in words]

    sensor = Adis16470(Part())
    with pytest.raises(NotResponding, match="the sample changed"):
        _ = sensor.gyro


@pytest.mark.parametrize(("answer", "error"), [(b"\xff\xff", NotResponding), (b"\x12\x34", Refused)])
def test_another_or_no_part_on_the_spi_bus_is_refused(answer: bytes, error: type[Exception]) -> None:
    class Part:
        def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
            return [answer for _ in frames]

    with pytest.raises(error):
        Adis16470(Part())


def test_the_spi_device_makes_the_calls_of_the_kernels_interface(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    """The ioctl numbers and the 32 bytes of struct spi_ioc_transfer agree with linux/spi/spidev.h."""
    device = tmp_path / "spidev0.0"
    device.touch()
    calls: list[tuple[int, bytes]] = []

    def record(_: int, request: int, data: bytes) -> int:
        calls.append((request, bytes(data)))
        return 0

    monkeypatch.setattr("hal.buses.linux_wires.ioctl", record)
    opened = LinuxSpiDevice(str(device), 1_000_000, 3)
    assert opened.transfer([b"\x72\x00", b"\x00\x00"]) == [b"\0\0"] * 2
    opened.close()
    assert calls[:2] == [(0x40016B01, b"\x03"), (0x40046B04, struct.pack("=I", 1_000_000))]
    request, data = calls[2]
    assert (request, len(data)) == (0x40406B00, 64)
    for offset, reselected in ((0, 1), (32, 0)):
        sent, received, length, speed, gap, bits, change = struct.unpack_from("=QQIIHBB", data, offset)
        assert (length, speed, bits, change) == (2, 1_000_000, 8, reselected)
        assert gap >= 16
        assert 0 not in {sent, received}


@pytest.mark.parametrize("works", [True, False])
def test_a_sensor_that_is_started_again_and_again_opens_its_spi_device_once(
    works: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    device = tmp_path / "spidev0.0"
    device.touch()

    def ioctl(*_: object) -> int:
        if not works:
            raise OSError(errno.EINVAL, "Invalid argument")
        return 0

    monkeypatch.setattr("hal.buses.linux_wires.ioctl", ioctl)
    with ExitStack() as stack:
        wires, before = LinuxWires(SystemClock(), stack, 1), len(os.listdir("/proc/self/fd"))
        for _ in range(10):
            with suppress(NotResponding):
                wires.spi(str(device), 1_000_000, 3)
        assert len(os.listdir("/proc/self/fd")) == before + works


def test_an_spi_device_that_is_missing_is_named_with_the_cure() -> None:
    with pytest.raises(NotResponding, match="is the SPI bus enabled"):
        LinuxSpiDevice("/nowhere/spidev9.9", 1_000_000, 0)


def test_the_duration_of_a_job_does_not_lower_its_rate() -> None:
    """A job of 10 ms that is due every 20 ms starts every 20 ms, so a slow job does not lower its rate."""
    clock, begun = SystemClock(), []

    def job() -> None:
        begun.append(clock.now_ns())
        time.sleep(0.01)

    ticker = clock.ticker("slow", 20_000_000, job)
    clock.sleep_until_ns(clock.now_ns() + 400_000_000)
    ticker.stop()
    # If the job delayed the next period, no interval would be shorter than 30 ms, the sum of period and job.
    assert np.diff(begun).min() < 26_000_000
