"""Tests of the table of faults: defaults, bounds, durations, and combinations."""

from __future__ import annotations

import math

import pytest

from sim_hal.faults.catalogue import CATALOGUE, Where

AXES = "xyz456"
CHANCE, TURNS = "chance 0.5 1e-06..1", "period 0.5 0.05..3600 s; share 0.5 0.01..0.99"
PARAMETERS = {
    "imu: wrong": "angle 0.2 -3.14159..3.14159 rad; rate 0.05 -10..10 rad/s",
    "imu: slow": "n 8 2..1000 whole",
    "imu: delayed": "delay 0.2 0.001..60 s",
    "imu: intermittent": TURNS,
    "imu: bits": "chance 0.001 1e-06..1",
    "imu: cut": "chance 0.3 1e-06..1",
    "imu: baud": "rate 230400 9600..921600 baud",
    "imu: upset": "register drawn 6..75; bit drawn 0..175 whole",
    "magnetometer: false": "field 2e-05 1e-08..0.001 T",
    "pwm: bits": "chance 0.005 1e-06..1",
    "pwm: slow": CHANCE,
    "pwm: intermittent": TURNS,
    "pwm: delayed": "delay 0.2 0.001..60 s",
    "pwm: upset": "register drawn 0..254; bit drawn 0..7 whole",
    "monitor: bits": "chance 0.005 1e-06..1",
    "monitor: slow": CHANCE,
    "monitor: intermittent": TURNS,
    "monitor: delayed": "delay 2 0.001..60 s",
    "monitor: wrong": "gain 2 0..10",
    "monitor: upset": "register drawn 0..5; bit drawn 0..15 whole",
    "bus: nack": CHANCE,
    "bus: intermittent": TURNS,
    **{f"coil-{axis}: shorted": "ohm 5 0.1..1000 ohm" for axis in AXES},
    "camera: slow": "n 3 2..1000 whole",
    "camera: delayed": "delay 3 0.001..60 s",
    "camera: intermittent": "period 6 0.05..3600 s; share 0.5 0.01..0.99",
    "gps: false": "distance 20000 1..2e+07 m",
    "gps: clock": "seconds 180 -86400..86400 s",
    "gps: bits": "chance 0.001 1e-06..1",
    "gps: delayed": "delay 2 0.001..60 s",
    "gps: intermittent": TURNS,
    "battery-monitor: wrong": "gain 0.5 0..10",
    "bus-monitor: wrong": "gain 0.5 0..10",
    "battery: weak": "factor 4 1..100",
    "panels: lost": "panel 1 0..32 whole",
    "strings: dead": "string 1 0..4 whole",
    "strings: wrong": "gain 0.5 0..10",
    **{
        f"wide: {kind}": "camera 0 0..6 whole"
        for kind in ("off", "black", "saturated", "blinded", "frozen", "garbage", "wrong")
    },
    "wide: delayed": "camera 0 0..6 whole; delay 3 0.001..60 s",
    "wide: intermittent": "camera 0 0..6 whole; period 6 0.05..3600 s; share 0.5 0.01..0.99",
    "planner: slow": "delay 1.5 0.001..60 s",
    "vision: slow": "delay 1.5 0.001..60 s",
    "clock: stepped": "by 3600 -3.2e+08..3.2e+08 s",
    "config: corrupted": "bytes 3 1..10000 whole",
}
PLAIN = """
imu: off, imu: silent, imu: unplugged, imu: stuck, imu: gyro-dead, imu: garbage, imu: reset,
magnetometer: stuck, magnetometer: saturated, pwm: off, pwm: nack, pwm: garbage, pwm: brown-out, pwm: stuck,
pwm: wrong,
monitor: off, monitor: nack, monitor: garbage, monitor: brown-out, monitor: stuck, bus: off,
bus: arbitration, bus: hang, camera: off, camera: black, camera: saturated, camera: blinded, camera: frozen,
camera: torn, camera: garbage, camera: wrong, gps: off, gps: silent, gps: no-fix, gps: stuck, gps: garbage,
battery-monitor: off, battery-monitor: stuck, bus-monitor: off, bus-monitor: stuck, battery: cell-lost,
strings: off, strings: stuck, strings: garbage, planner: nan, planner: exception, planner: endless,
planner: killed, vision: nan, vision: exception, vision: endless, vision: killed, process: killed,
process: stopped, disk: full, disk: failing
"""
MOMENTARY = {
    "imu: reset", "imu: baud", "imu: upset", "pwm: brown-out", "pwm: wrong", "pwm: upset",
    "monitor: brown-out", "monitor: upset", "process: killed", "config: corrupted",
}  # fmt: skip
TOGETHER = {
    "imu": "silent garbage slow delayed intermittent bits cut upset",
    "pwm": "nack slow intermittent brown-out wrong upset",
    "monitor": "nack slow intermittent brown-out upset",
    "bus": "off nack arbitration hang intermittent",
    "gps": "silent clock garbage bits delayed intermittent",
}
"""Kinds of fault that may be present together with other faults of their device."""


def test_the_faults_are_those_of_the_table() -> None:
    coils = {f"coil-{axis}: {kind}" for axis in AXES for kind in ("open", "shorted", "reversed")}
    bridges = {f"bridge-{axis}: {leg}-{level}" for axis in AXES for leg in "ab" for level in ("high", "low")}
    plain = {" ".join(name.split()) for name in PLAIN.split(",")}
    assert set(CATALOGUE) == plain | set(PARAMETERS) | coils | bridges


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_fault_has_the_parameters_of_the_table(name: str) -> None:
    rows = []
    for key, parameter in CATALOGUE[name].parameters.items():
        default = "drawn" if parameter.default is None else f"{parameter.default:g}"
        words = [key, default, f"{parameter.low:g}..{parameter.high:g}", parameter.unit]
        rows.append(" ".join([word for word in words if word] + ["whole"] * parameter.whole))
    assert "; ".join(rows) == PARAMETERS.get(name, "")


def test_the_faults_without_a_duration_are_those_of_the_table() -> None:
    assert {name for name, kind in CATALOGUE.items() if kind.momentary} == MOMENTARY


def test_the_faults_that_may_come_together_are_those_of_the_table() -> None:
    expected = {f"{device}: {kind}" for device, kinds in TOGETHER.items() for kind in kinds.split()}
    assert {name for name, kind in CATALOGUE.items() if kind.adds} == expected


def test_some_faults_need_a_process_or_a_command_line() -> None:
    assert {name: kind.where for name, kind in CATALOGUE.items() if kind.where is not Where.BOTH} == {
        "process: killed": Where.REALTIME,
        "process: stopped": Where.REALTIME,
        "config: corrupted": Where.COMMAND_LINE,
    }


def test_the_choices_are_registers_and_speeds_that_exist() -> None:
    assert list(CATALOGUE["imu: upset"].parameters["register"].choices) == [6, 7, 75]
    assert list(CATALOGUE["monitor: upset"].parameters["register"].choices) == [0, 5]
    # PCA9685: MODE1, MODE2, four registers of each of 16 channels from 0x06, PRE_SCALE.
    assert list(CATALOGUE["pwm: upset"].parameters["register"].choices) == [0, 1, *range(6, 70), 254]
    speeds = [9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600]
    assert list(CATALOGUE["imu: baud"].parameters["rate"].choices) == speeds


def test_the_largest_angle_is_half_a_turn() -> None:
    assert CATALOGUE["imu: wrong"].parameters["angle"].high == math.pi
