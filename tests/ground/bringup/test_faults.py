"""Tests that a bench session with emulated devices names each wiring fault, and none in a correct set-up.

The drivers are configured by `step_demo`. The emulated devices differ from `step_demo` by one wiring fault.
The devices send and receive the bytes of their real protocols.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.app.devices import emulated_bench
from flight.app.run import RunRequest
from flight.app.service import requested_config
from flight.schema.devices import coil_fields
from flight.schema.document import config_path, to_yaml
from flight.schema.sections import Config
from ground.bringup.diagnosis import UNRECOGNISED
from ground.bringup.session import STEPS, Outcome, Session, StepSkipped

Change = dict[str, Any]
FIELD = 5e-4


def windings(**changes: Change) -> Change:
    """Return the coils x, y and z of step_demo with other values."""
    plain = [
        {"axis": axis, "resistance": 23.0, "channels": [2 * k, 2 * k + 1]}
        for k, axis in enumerate(np.eye(3).tolist())
    ]
    return {
        "coils": {"windings": [one | changes.get(name, {}) for name, one in zip("xyz", plain, strict=True)]}
    }


def fault(*names: str) -> Change:
    """Return the faults of the emulated devices."""
    return {"simulation": {"faults": [{"fault": name} for name in names]}}


def coil_field(matrix: Any) -> Change:
    """Return the field of the coils at the magnetometer, in multiples of the usual field."""
    return {"simulation": {"coil_field": (FIELD * np.array(matrix)).tolist()}}


def sensed(**matrices: Any) -> Callable[[Any], Any]:
    """Return a fault of the IMU that changes the axes or scales of sensors."""
    return lambda sample: replace(
        sample, **{name: np.array(matrix) @ getattr(sample, name) for name, matrix in matrices.items()}
    )


@dataclass(frozen=True)
class Case:
    """A wiring fault: changed values, steps that detect it, and expected findings as "part kind"."""

    change: Change
    steps: str
    expected: Sequence[str]
    alter: Callable[[Any], Any] | None = None
    says: str = ""
    base: str = "step_demo"


X_AND_Y = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
MINUS_X = np.diag([-1.0, 1.0, 1.0])
HALF = np.diag([1.0, 0.5, 1.0])
ABOUT_Z = np.array([[0.866, 0.5, 0.0], [-0.5, 0.866, 0.0], [0.0, 0.0, 1.0]])

CASES = {
    "coils x and y exchanged": Case(
        windings(x={"channels": [2, 3]}, y={"channels": [0, 1]}),
        "coils",
        ["coils.windings[0] exchanged", "coils.windings[1] exchanged"],
        says="the command of coil x drives coil y",
    ),
    "three coils exchanged": Case(
        windings(x={"channels": [2, 3]}, y={"channels": [4, 5]}, z={"channels": [0, 1]}),
        "coils",
        [f"coils.windings[{k}] exchanged" for k in range(3)],
        says="the command of coil z drives coil y",
    ),
    "coil y reversed": Case(windings(y={"sign": -1}), "coils", ["coils.windings[1] reversed"]),
    "coils exchanged and one reversed": Case(
        windings(y={"channels": [4, 5], "sign": -1}, z={"channels": [2, 3]}),
        "coils",
        ["coils.windings[1] exchanged", "coils.windings[2] exchanged"],
        says="drives coil y, reversed",
    ),
    "coil z open": Case(fault("coil-z: open"), "coils", ["coils.windings[2] open"]),
    "coil x shorted": Case(fault("coil-x: shorted (ohm=8)"), "coils", ["coils.windings[0] short"]),
    "coil y with half the field": Case(
        coil_field(HALF), "coils", ["coils.windings[1] wrong strength"], says="field 0.50 times"
    ),
    "coil x with twice the resistance": Case(
        {"simulation": {"truth": {"resistance": [46.0, 23.0, 23.0]}}},
        "coils",
        ["coils.windings[0] wrong resistance"],
        says="multiply `resistance` by 2.0",
    ),
    "bridge leg without signal": Case(
        fault("bridge-y: b-low"), "coils", ["coils.windings[1] half bridge"], says="input B"
    ),
    "bridge leg stuck high": Case(
        fault("bridge-z: a-high"), "coils", ["coils current while off", "coils.windings[2] half bridge"]
    ),
    "coil mounted askew": Case(
        coil_field([[1.0, 0.0, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "coils",
        ["coils.windings[0] wrong direction"],
        says=UNRECOGNISED,
    ),
    "magnetometer with the opposite sign": Case(
        {}, "coils", ["inertial_unit.magnetometer reversed sign"], sensed(mag=-np.eye(3))
    ),
    "magnetometer stuck": Case(
        fault("magnetometer: stuck"),
        "rest coils",
        ["inertial_unit.magnetometer stuck", "inertial_unit.magnetometer no response"],
    ),
    "shunt ten times as large": Case(
        {"power_monitor": {"shunt": 1.0}}, "coils", ["power_monitor wrong shunt"], says="at least"
    ),
    "shunt ten times as small": Case(
        {"power_monitor": {"shunt": 0.01}}, "coils", ["power_monitor wrong shunt"], says="0.099"
    ),
    "supply voltage too low": Case(
        {"simulation": {"truth": {"supply_voltage": 2.2}}}, "coils", ["power_monitor wrong current"]
    ),
    "monitor without supply": Case(fault("monitor: off"), "find", ["power_monitor no answer"]),
    "monitor stuck": Case(fault("monitor: stuck"), "coils", ["power_monitor no reading"]),
    "PWM chip without supply": Case(fault("pwm: off"), "find coils", ["coils no answer"]),
    "I2C bus without pull-ups": Case(
        fault("bus: off"), "find", ["coils no answer", "power_monitor no answer"]
    ),
    "PWM chip at another address": Case(
        {"coils": {"address": 0x43}}, "find", ["coils wrong address"], says="set `address: 0x43`"
    ),
    "monitor at another address": Case(
        {"power_monitor": {"address": 0x44}}, "find", ["power_monitor wrong address"], says="0x44"
    ),
    "addresses of PWM chip and monitor exchanged": Case(
        {"coils": {"address": 0x45}, "power_monitor": {"address": 0x40}},
        "find",
        ["coils exchanged", "power_monitor exchanged"],
    ),
    "inertial unit without power": Case(fault("imu: off"), "find axes", ["inertial_unit no answer"]),
    "inertial unit at another baud rate": Case(
        {"inertial_unit": {"baud_rate": 57600}},
        "find",
        ["inertial_unit wrong baud rate"],
        says="set `baud_rate: 57600`",
    ),
    "lines of unit and GPS exchanged": Case(
        {"inertial_unit": {"device": "/dev/knightcube-gps"}, "gps": {"device": "/dev/knightcube-imu"}},
        "find",
        ["inertial_unit exchanged", "gps exchanged"],
        base="orbit",
    ),
    "inertial unit too slow": Case(fault("imu: slow (n=2)"), "rest", ["inertial_unit wrong rate"]),
    "noise on the line": Case(
        fault("imu: cut (chance=0.1)"), "rest", ["inertial_unit corrupted packets"], says="wrong checksum"
    ),
    "noisy gyro": Case(
        {"simulation": {"imu": {"rate_noise": 0.01}}}, "rest", ["inertial_unit.gyro noisy"], says="0.00027"
    ),
    "unit stuck": Case(fault("imu: stuck"), "rest", ["inertial_unit stuck"]),
    "gyro dead": Case(fault("imu: gyro-dead"), "rest axes", ["inertial_unit.gyro dead"] * 2),
    "unit rotated by 90 deg": Case(
        {"inertial_unit": {"mounting": [0.0, 0.0, 0.70710678, 0.70710678]}},
        "axes coils",
        ["inertial_unit rotated"],
        says="x shows -y, y shows x",
    ),
    "unit rotated by 40 deg": Case(
        {"inertial_unit": {"mounting": [0.34202014, 0.0, 0.0, 0.93969262]}},
        "axes coils",
        ["inertial_unit rotated"],
        says="rotated by 40 deg about (1.00",
    ),
    "gyro with exchanged axes": Case(
        {}, "axes coils", ["inertial_unit.gyro mirrored"], sensed(rate=X_AND_Y), "x shows y, y shows x"
    ),
    "gyro in other units": Case({}, "axes", ["inertial_unit.gyro wrong scale"], sensed(rate=2.0 * np.eye(3))),
    "magnetometer with one reversed axis": Case(
        {}, "axes coils", ["inertial_unit.magnetometer mirrored"], sensed(mag=MINUS_X), "x shows -x"
    ),
    "magnetometer rotated by 30 deg": Case(
        {}, "axes coils", ["inertial_unit.magnetometer rotated"], sensed(mag=ABOUT_Z), "rotated by 30 deg"
    ),
    "accelerometer upside down": Case(
        {}, "axes", ["inertial_unit.accelerometer mirrored"], sensed(accel=np.diag([1.0, 1.0, -1.0]))
    ),
    "lens cap on": Case(fault("camera: black"), "dark light", ["camera lens cap on"]),
    "camera frozen": Case(fault("camera: frozen"), "light", ["camera frozen"]),
    "camera without trigger": Case(fault("camera: off"), "light", ["camera no frame"]),
    "camera out of focus": Case({"camera": {"psf_sigma": 3.5}}, "focus", ["camera out of focus"]),
}


@cache
def configuration(name: str) -> tuple[str, Config]:
    return requested_config(RunRequest(config_path(name), Path()))


def session(case: Case, folder: Path) -> Session:
    """Return a session whose emulated devices differ from the configuration by the change of a case."""
    path = folder / "wired.yaml"
    path.write_text(to_yaml({"extends": case.base, **case.change}), encoding="utf-8")
    wired, config = requested_config(RunRequest(path, Path()))
    bench = emulated_bench(path, wired, config)
    bench.hardware.unit.alter = case.alter
    return Session(configuration(case.base)[1], bench.rig, ExitStack(), lambda _: None, bench)


def outcomes(opened: Session, steps: str) -> list[Outcome]:
    """Return the outcomes of steps, after which the coils must carry no current."""
    found = []
    for name in steps.split():
        try:
            found.append(STEPS[name](opened))
        except StepSkipped as reason:
            found.append(Outcome([reason.finding] if reason.finding else [], {"skipped": str(reason)}))
        opened.known[name] = found[-1]
    opened.close()
    assert not opened.hand.hardware.circuit.currents().any()
    return found


@pytest.mark.parametrize("name", CASES)
def test_a_wiring_fault_is_named_and_no_other(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    findings = [one for outcome in outcomes(session(case, tmp_path), case.steps) for one in outcome.findings]
    assert [f"{one.part} {one.kind}" for one in findings] == list(case.expected)
    assert case.says in "\n".join(one.line() for one in findings)


PLACES = {"x": [0.03, 0.02, -0.01], "y": [0.02, 0.05, 0.03], "z": [-0.02, 0.03, 0.06]}


@pytest.mark.parametrize(
    ("change", "truth", "expected"),
    [
        ({}, {}, []),
        ({"z": {"sign": -1}}, {}, ["coils.windings[2] reversed"]),
        ({}, {"supply_voltage": 2.2}, ["coils wrong supply voltage"]),
    ],
)
def test_the_positions_of_the_coils_give_their_fields(
    change: dict[str, Change], truth: Change, expected: list[str], tmp_path: Path
) -> None:
    placed = {name: {"position": place} for name, place in PLACES.items()}
    wired = windings(**{name: one | change.get(name, {}) for name, one in placed.items()})
    opened = session(Case(wired | {"simulation": {"truth": truth}}, "", []), tmp_path)
    (tmp_path / "config.yaml").write_text(to_yaml({"extends": "step_demo", **windings(**placed)}))
    opened.coil_field = coil_fields(requested_config(RunRequest(tmp_path / "config.yaml", Path()))[1])
    (found,) = outcomes(opened, "coils")
    assert [f"{one.part} {one.kind}" for one in found.findings] == expected


def test_a_sound_bench_has_no_finding(tmp_path: Path) -> None:
    found = outcomes(session(Case({}, "", []), tmp_path), "find rest axes coils dark light focus")
    assert [one.line() for outcome in found for one in outcome.findings] == []
    assert [outcome.values for outcome in found if "skipped" in outcome.values] == []


def test_a_monitor_of_the_power_system_is_not_mistaken_for_the_coil_monitor(tmp_path: Path) -> None:
    power = {"power": {"battery": {"capacity": 2.0}}}
    opened = session(Case(power | fault("monitor: off"), "", [], base="orbit"), tmp_path)
    opened.config = requested_config(RunRequest(tmp_path / "wired.yaml", Path()))[1]
    (found,) = outcomes(opened, "find")
    assert [f"{one.part} {one.kind}" for one in found.findings] == ["power_monitor no answer"]
    assert {"power.battery_monitor", "power.bus_monitor"} <= found.values["answers"].keys()
