"""Tests of the emulated VN-100's filter registers and commands as VectorNav's SDK 0.99 uses them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hal.drivers.vn100_protocol import build
from sim_hal.emulators.vn100 import Vn100EmulatorSettings
from sim_hal.emulators.vn100_sensors import PROFILES
from tests.hal.vn100.emulated_unit import Bench

NOISELESS = Vn100EmulatorSettings(noise=PROFILES["none"])


def angles(bench: Bench, register: int = 8) -> list[float]:
    """Return yaw, pitch and roll in degrees."""
    (answer,) = bench.exchange(build("RRG", register))
    return [float(text) for text in answer.fields[1:4]]


def command(bench: Bench, *words: object) -> tuple[str, ...]:
    """Send a command; return the fields of the response, with the command first."""
    (answer,) = bench.exchange(build(*map(str, words)))
    return answer.command, *answer.fields


@pytest.mark.parametrize(
    ("register", "default"),
    [
        (36, "4,4,4,5,5,5,5.5,5.5,5.5"),
        (38, "5,5,5,3,3,3,4,4,4"),
        (50, "0,0,0"),
        (51, "1,0.1,0.01"),
        (74, ",".join(["+00.000000"] * 7)),
    ],
)
def test_factory_settings_of_the_filters_registers(register: int, default: str) -> None:
    """Names, lengths and defaults are those of VectorNav UM001 and of the SDK's classes."""
    bench = Bench().quiet()
    assert command(bench, "RRG", register) == ("RRG", str(register), *default.split(","))


@pytest.mark.parametrize("register", [36, 38, 50, 51])
def test_what_is_written_is_echoed_kept_and_saved(register: int) -> None:
    """The commands are those of the SDK: numbers with six decimals, and register numbers with two digits."""
    bench = Bench().quiet()
    length = {36: 9, 38: 9, 50: 3, 51: 3}[register]
    values = [f"{0.5 * k + 0.25:f}" for k in range(length)]
    if register == 51:
        values[0] = "0"
    assert command(bench, "WRG", register, *values) == ("WRG", str(register), *values)
    assert command(bench, "RRG", f"{register:02d}") == ("RRG", str(register), *values)
    assert bench.exchange(build("WNV"), 0.6)[0].command == "WNV"
    bench.exchange(build("RST"), 1.5)
    bench.quiet()
    assert command(bench, "RRG", register)[2:] == tuple(values)


@pytest.mark.parametrize("register", [239, 240])
def test_linear_acceleration_has_its_registers_in_body_and_ned_axes(register: int) -> None:
    """At rest it is zero; as in UM001's example, degrees, m/s^2 and rad/s have 3, 3 and 6 decimals."""
    bench = Bench().quiet()
    (answer,) = bench.exchange(build("RRG", register))
    assert len(answer.fields) == 1 + 9
    assert [len(text) for text in answer.fields[1:]] == [8, 8, 8, 7, 7, 7, 10, 10, 10]
    values = [float(text) for text in answer.fields[1:]]
    assert values[:3] == angles(bench)
    assert values[3:6] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    assert np.linalg.norm(values[6:]) == pytest.approx(0.02, abs=1e-5)


def test_tare_and_initial_heading_turn_the_attitude_about_the_vertical() -> None:
    bench = Bench(NOISELESS).quiet()
    turning = angles(bench)
    assert command(bench, "TAR") == ("TAR",)
    # The body rotates at 0.02 rad/s during two exchanges of 20 ms.
    assert angles(bench) == pytest.approx([0.0, *turning[1:]], abs=0.1)
    assert command(bench, "SIH", "+045.000") == ("SIH", "+045.000")
    assert angles(bench) == pytest.approx([45.0, *turning[1:]], abs=0.1)
    command(bench, "SIH", "-120", "30", "20")
    assert angles(bench, 239) == pytest.approx([-120.0, *turning[1:]], abs=0.1)
    # Quaternion (scalar last) of 60 deg about the vertical; VectorNav's quaternion rotates body into NED.
    command(bench, "SIH", 0, 0, 0.5, 0.866025)
    assert angles(bench, 240) == pytest.approx([60.0, *turning[1:]], abs=0.1)
    bench.exchange(build("RST"), 1.5)
    assert angles(bench.quiet())[0] == pytest.approx(turning[0], abs=3.0), "a reset finds north again"


def test_with_an_absolute_heading_the_magnetometer_wins() -> None:
    bench = Bench(NOISELESS).quiet()
    bench.exchange(build("WRG", 35, 1, 0, 1, 1))
    before = angles(bench)
    assert command(bench, "TAR") == ("TAR",)
    assert command(bench, "SIH", 90) == ("SIH", "90")
    assert angles(bench) == pytest.approx(before, abs=0.1)


def test_biases_are_stored_to_start_from() -> None:
    bias = np.array([1e-3, -2e-3, 3e-3])
    bench = Bench(dataclasses.replace(NOISELESS, gyro_bias=bias)).quiet()
    gyro = ("+00.001000", "-00.002000", "+00.003000")
    bench.exchange(build("WRG", 74, *(0.0,) * 3, *(0.1,) * 4))
    assert command(bench, "SGB") == ("SGB",)
    assert bench.unit.registers.read(43) == gyro
    assert bench.unit.registers.read(74) == (*gyro, *("0.1",) * 4)
    bench.exchange(build("WRG", 43, 0, 0, 0))
    assert command(bench, "SFB") == ("SFB",)
    assert bench.unit.registers.read(43) == gyro
    assert bench.unit.registers.read(74) == (*gyro, *("+00.000000",) * 4)
