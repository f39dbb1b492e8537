"""Tests of simulated flights with other devices than in the thesis, by drivers of emulated chips.

In the first flight, CircuitPython's own drivers (extra `circuitpython`) read the sensors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flight.app.flight import fly
from flight.app.run import RunRequest
from ground.telemetry import Run, read_run

TESTBED = """
extends: step_demo
inertial_unit:
  driver: sensors
  angle_noise: 1.5e-3
  rate_noise: 1.2e-3
  sensors:
    - part: icm20948
      measures: {gyro: [y, -x, z], acceleration: [y, -x, z]}
      set: {gyro_dlpf_cutoff: 5, gyro_data_rate: 100}
    - {part: lis3mdl, measures: {magnetic: [-y, x, z]}, set: {range: 2, data_rate: 1}}
coils: {driver: drv8830, address: 0x60}
power_monitor: none
camera: none
steps: [{at: 0.0, q2: -0.1}]
duration: 13.0
"""
ORBIT = """
extends: orbit
inertial_unit:
  driver: sensors
  rate_noise: 9.0e-4
  sensors:
    - part: adis16470
      spi: /dev/spidev0.0
      measures: {gyro: [z, x, y], acceleration: [z, x, y]}
      set: {decimation: 49}
    - {part: lis3mdl, bus: 2, address: 0x1e, measures: {magnetic: [-y, x, z]}, set: {data_rate: 1}}
gps: {driver: nmea, baud_rate: 9600}
camera: none
wide_cameras: []
solar_strings: none
duration: 6.0
targets: [{at: 0.0, point: nadir}]
"""

MAGNETOMETER = """
extends: {name}
magnetometer:
  sensors: [{{part: lis3mdl, address: 0x1e, measures: {{magnetic: [-y, x, z]}}, set: {{data_rate: 1}}}}]
camera: none
wide_cameras: []
solar_strings: none
duration: {duration}
"""


def flown(text: str, folder: Path, *expected: str, fault: str = "") -> Run:
    """Return the logs of a flight in lock-step. No fault events except `expected` may occur."""
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    result = fly(RunRequest(path, folder / "run", faults=(fault,) if fault else ()))
    assert set(result.ending.faults) == set(expected)
    assert result.ending.coils_at_zero
    return read_run(folder / "run")


def test_a_testbed_flies_on_circuitpython_drivers_and_bridges_with_an_i2c_interface(tmp_path: Path) -> None:
    """The step reaches its target within 10 s. The angle is computed from gravity and the magnetic field."""
    pytest.importorskip("adafruit_icm20x")
    pytest.importorskip("adafruit_lis3mdl")
    run = flown(TESTBED, tmp_path)
    truth = run["truth"]
    late = truth["quaternion"][-80:, 1]
    assert np.abs(late + 0.1).max() < 0.01, "q2 of the last 2 s"
    assert len(run["imu"]) == pytest.approx(13 * 40, abs=2)
    # Each reading agrees with the truth at its time, so axes, scales and time stamps are correct.
    times = run["imu"]["sample_time_ns"] * 1e-9
    for field, axis, bound in (("rate", 1, 0.008), ("quaternion", 1, 0.006)):
        true = np.interp(times, truth["time_ns"] * 1e-9, truth[field][:, axis])
        assert np.abs(run["imu"][field][:, axis] - true)[4:].max() < bound, field


def test_a_satellite_flies_with_a_sensor_on_spi_and_a_receiver_with_nmea_sentences(tmp_path: Path) -> None:
    pytest.importorskip("adafruit_lis3mdl")
    run = flown(ORBIT, tmp_path)
    truth = run["truth"]
    times = run["imu"]["sample_time_ns"] * 1e-9
    for axis in range(3):
        true = np.interp(times, truth["time_ns"] * 1e-9, truth["rate"][:, axis])
        assert np.abs(run["imu"]["rate"][:, axis] - true)[4:].max() < 0.006, "gyro on SPI, 5 sigma"
    fixes, link = run["fix"], run["gps_link"][-1]
    assert len(fixes) >= 1
    assert (link["frames"], link["bad_checksum"], link["out_of_range"]) == (0, 0, 0)
    assert link["sentences"] >= 2


def test_a_separate_magnetometer_controls_the_testbed_while_the_inertial_unit_is_off(
    tmp_path: Path,
) -> None:
    """A separate magnetometer controls the testbed while the IMU is off.

    Without a camera, the coils pause at intervals so that the magnetometer is undisturbed.
    """
    pytest.importorskip("adafruit_lis3mdl")
    text = MAGNETOMETER.format(name="step_demo", duration=13.0)
    text = text.replace("wide_cameras: []\nsolar_strings: none\n", "steps: [{at: 0.0, q2: -0.1}]\n")
    run = flown(text, tmp_path, "control-lost", "gyro-lost", "imu-silent", fault="imu: off @ 2")
    times, dead = run["imu"]["sample_time_ns"] * 1e-9, np.isnan(run["imu"]["rate"][:, 0])
    assert not dead[times < 2.0].any()
    assert dead[times > 2.1].all()
    assert np.diff(times).max() < 0.2
    assert np.abs(run["truth"]["quaternion"][-80:, 1] + 0.1).max() < 0.01, "q2 of the last 2 s"


def test_a_satellite_without_an_inertial_unit_brakes_by_its_magnetometer(tmp_path: Path) -> None:
    pytest.importorskip("adafruit_lis3mdl")
    text = MAGNETOMETER.format(name="orbit\ninertial_unit: none", duration=15.0)
    run = flown(text, tmp_path)
    assert np.isnan(run["imu"]["rate"]).all()
    spin, truth = run["spin"], run["truth"]
    known = spin["known"] == 1
    assert known[3 * len(known) // 4 :].all()
    assert np.abs(spin["dipole"][known]).max() > 0.0
    true = np.column_stack([np.interp(spin["time_ns"], truth["time_ns"], one) for one in truth["rate"].T])
    along = spin["field"][known] / np.linalg.norm(spin["field"][known], axis=1)[:, None]
    off = spin["rate"][known] - true[known]
    off -= along * np.sum(along * off, axis=1)[:, None]
    assert np.linalg.norm(off, axis=1).max() < 0.05
