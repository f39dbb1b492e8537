"""Tests that a bench session with emulated devices identifies each wiring fault, and no fault otherwise.

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

import msgspec
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from flight.app.devices import emulated_bench
from flight.app.run import RunRequest
from flight.app.service import requested_config
from flight.schema import reader
from flight.schema.devices import Gps, coil_fields
from flight.schema.document import config_path, to_yaml
from flight.schema.sections import Config
from ground.bringup import cameras
from ground.bringup.bench import Outcome, Session, StepSkipped
from ground.bringup.session import STEPS

Change = dict[str, Any]
FIELD = 5e-4


@cache
def configuration(name: str) -> tuple[str, Config]:
    return requested_config(RunRequest(config_path(name), Path()))


def windings(**changes: Change) -> Change:
    """Return the coils x, y and z of `step_demo` with changed values."""
    plain = [
        {"axis": axis, "resistance": 23.0, "channels": [2 * k, 2 * k + 1]}
        for k, axis in enumerate(np.eye(3).tolist())
    ]
    return {
        "coils": {"windings": [one | changes.get(name, {}) for name, one in zip("xyz", plain, strict=True)]}
    }


def fault(*names: str) -> Change:
    """Return faults of the emulated devices."""
    return {"simulation": {"faults": [{"fault": name} for name in names]}}


def coil_field(matrix: Any) -> Change:
    """Return a change that multiplies the elements of the coils' field at the magnetometer by factors."""
    return {"simulation": {"coil_field": (FIELD * np.array(matrix)).tolist()}}


def sensed(**matrices: Any) -> Callable[[Any], Any]:
    """Return a fault of the IMU that changes the axes or scales of its sensors."""
    return lambda sample: replace(
        sample, **{name: np.array(matrix) @ getattr(sample, name) for name, matrix in matrices.items()}
    )


@dataclass(frozen=True)
class Case:
    """A wiring fault: changed values, the steps that detect it, and the expected findings ("part kind")."""

    change: Change
    steps: str
    expected: Sequence[str]
    alter: Callable[[Any], Any] | None = None
    says: str = ""
    base: str = "step_demo"
    spoil: Callable[[Session], None] | None = None


def held(sensor: str, axis: int) -> Callable[[Any], Any]:
    """Return a fault of the IMU that freezes one axis of a sensor at its first value."""
    kept: list[float] = []

    def alter(sample: Any) -> Any:
        values = np.array(getattr(sample, sensor))
        kept.append(values[axis])
        values[axis] = kept[0]
        return replace(sample, **{sensor: values})

    return alter


def repeated(sensor: str) -> Callable[[Any], Any]:
    """Return a fault of the IMU that repeats each value of a sensor in the next sample."""
    kept: list[Any] = []

    def alter(sample: Any) -> Any:
        kept.append(getattr(sample, sensor) if len(kept) % 2 == 0 else kept[-1])
        return replace(sample, **{sensor: kept[-1]})

    return alter


def exchanged_strings() -> list[Any]:
    """Return the solar strings of `orbit` with exchanged channels of the first two strings."""
    strings = [msgspec.to_builtins(one) for one in configuration("orbit")[1].solar_strings.strings]  # type: ignore[union-attr]
    strings[0]["channel"], strings[1]["channel"] = strings[1]["channel"], strings[0]["channel"]
    return strings


def sagging(opened: Session) -> None:
    """Reduce the supply voltage in proportion to the supply current, by 20 % at 0.1 A."""
    circuit = opened.hand.hardware.circuit
    measure, currents = circuit.mean_supply, circuit.currents

    def measured(start_ns: int, end_ns: int) -> tuple[float, float]:
        volts, amperes = measure(start_ns, end_ns)
        return volts * (1.0 - 2.0 * amperes), amperes * (1.0 - 2.0 * amperes)

    opened.hand.hardware.monitor._measure = measured
    circuit.currents = lambda: currents() * (1.0 - 2.0 * np.abs(currents()).sum())


def reverse(opened: Session) -> None:
    """Reverse the current through the shunt of the coils' monitor."""
    opened.hand.hardware.monitor.gain = -1.0


def loose_coil(opened: Session) -> None:
    """Interrupt coil y for 0.1 s in every 0.4 s."""
    circuit, clock = opened.hand.hardware.circuit, opened.rig.clock
    currents = circuit.currents
    circuit.currents = lambda: currents() * (1.0, float(clock.now_ns() % 400_000_000 > 100_000_000), 1.0)


def pictured(change: Callable[[Any], Any]) -> Callable[[Session], None]:
    """Return a fault of the star camera that changes the pixels of its frames."""

    def spoil(opened: Session) -> None:
        camera = opened.rig.cameras[0]  # type: ignore[index]
        alter = camera._alter  # type: ignore[union-attr]
        camera._alter = lambda frame: replace(  # type: ignore[union-attr]
            alter(frame), pixels=np.ascontiguousarray(change(alter(frame).pixels))
        )

    return spoil


def without_stars(pixels: Any) -> Any:
    """Return a frame without stars, in which one pixel of a hundred is hot."""
    hot = np.random.default_rng(1).random(pixels.shape) < 0.01
    return np.where(hot, 3000, pixels).astype(pixels.dtype)


def blurred(pixels: Any) -> Any:
    """Return a frame whose stars have Gaussian point spreads of 10 px instead of 1 px."""
    return gaussian_filter(pixels.astype(float), np.sqrt(10.0**2 - 1.0)).round().astype(pixels.dtype)


BOTH = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
X_AND_Y = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
MINUS_X = np.diag([-1.0, 1.0, 1.0])
HALF = np.diag([1.0, 0.5, 1.0])
ABOUT_Z = np.array([[0.866, 0.5, 0.0], [-0.5, 0.866, 0.0], [0.0, 0.0, 1.0]])

COIL_WIRING = {
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
    "coil tilted by 45 deg": Case(
        coil_field([[0.7, 0.0, 0.0], [0.7, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "coils",
        ["coils.windings[0] wrong direction"],
        says="45 deg off the expected direction, along (0.71, 0.71",
    ),
    "coils x and y in parallel on one bridge": Case(
        {
            "simulation": {
                "coil_field": (FIELD * np.array(BOTH)).tolist(),
                "faults": [{"fault": "coil-y: open"}],
            }
        },
        "coils",
        ["coils.windings[0] several coils", "coils.windings[1] open"],
        says="the command of coil x drives coils x and y",
    ),
    "coils x and z in series on one bridge": Case(
        {
            "simulation": {
                "truth": {"resistance": [46.0, 23.0, 23.0]},
                "coil_field": (
                    FIELD * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
                ).tolist(),
                "faults": [{"fault": "coil-z: open"}],
            }
        },
        "coils",
        ["coils.windings[0] several coils", "coils.windings[2] open"],
        says="connected in series",
    ),
    "coils x and y connected": Case(
        coil_field([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        "coils",
        ["coils.windings[0] several coils", "coils.windings[1] several coils"],
    ),
}
COIL_SUPPLY = {
    "bridge leg without signal": Case(
        fault("bridge-y: b-low"), "coils", ["coils.windings[1] half bridge"], says="input B"
    ),
    "bridge leg stuck high": Case(
        fault("bridge-z: a-high"), "coils", ["coils current while off", "coils.windings[2] half bridge"]
    ),
    "loose plug of coil y": Case({}, "coils", ["coils.windings[1] intermittent"], spoil=loose_coil),
    "supply that sags under load": Case(
        {}, "coils", ["coils sagging supply"], says="falls from 5.00 to 3.5", spoil=sagging
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
    "wires at the shunt exchanged": Case(
        {}, "coils", ["power_monitor reversed"], says="swap the two wires", spoil=reverse
    ),
    "monitor stuck": Case(fault("monitor: stuck"), "coils", ["power_monitor no reading"]),
}
SEARCH = {
    "monitor without supply": Case(
        fault("monitor: off"),
        "find",
        ["power_monitor no answer"],
        says="no answer at 0x45; addresses that answer on its bus: 0x40",
    ),
    "PWM chip without supply": Case(
        fault("pwm: off"),
        "find coils",
        ["coils no answer"],
        says="no answer at 0x40; addresses that answer on its bus: 0x45",
    ),
    "I2C bus without pull-ups": Case(
        fault("bus: off"),
        "find",
        ["coils no answer", "power_monitor no answer"],
        says="addresses that answer on its bus: no address",
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
        says="a chip of type ina219 answers at 0x40: swap the addresses: a pca9685",
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
        says="/dev/knightcube-gps is the line of the VN-100",
    ),
    "NMEA receiver at another baud rate": Case(
        {"gps": {"baud_rate": 9600, "driver": "nmea"}},
        "find",
        ["gps wrong baud rate"],
        base="orbit",
        says="set `baud_rate: 9600`",
        spoil=lambda opened: setattr(
            opened, "config", reader.replace(opened.config, gps=Gps(driver="nmea", baud_rate=38400))
        ),
    ),
    "loose plug of the inertial unit": Case(
        fault("imu: intermittent"), "find", ["inertial_unit intermittent"], says="stops for up to 0.2"
    ),
}
REST = {
    "inertial unit too slow": Case(
        fault("imu: slow (n=2)"),
        "rest",
        ["inertial_unit wrong rate"],
        says="20.0 valid samples per second arrive instead of 40",
    ),
    "short interruptions of the inertial unit": Case(
        fault("imu: intermittent (period=3, share=0.1)"), "rest", ["inertial_unit intermittent"], says="0.3"
    ),
    "gyro at half of the rate": Case(
        {}, "rest", ["inertial_unit.gyro wrong rate"], repeated("rate"), says="20 are new per second"
    ),
    "magnetometer at half of the rate": Case(
        {},
        "rest",
        ["inertial_unit.magnetometer wrong rate"],
        repeated("mag"),
        says="50 % of its values repeat",
    ),
    "noise on the line": Case(
        fault("imu: cut (chance=0.1)"), "rest", ["inertial_unit corrupted packets"], says="wrong checksum"
    ),
    "noisy gyro": Case(
        {"simulation": {"imu": {"rate_noise": 0.01}}}, "rest", ["inertial_unit.gyro noisy"], says="0.00027"
    ),
    "unit stuck": Case(
        fault("imu: stuck"), "rest", ["inertial_unit stuck"], says="samples in a row are identical"
    ),
    "magnetometer at its limit": Case(
        fault("magnetometer: saturated"),
        "rest coils",
        ["inertial_unit.magnetometer stuck", "inertial_unit.magnetometer no response"],
    ),
    "magnetometer stuck": Case(
        fault("magnetometer: stuck"),
        "rest coils",
        ["inertial_unit.magnetometer stuck", "inertial_unit.magnetometer no response"],
    ),
}
UNIT_AXES = {
    "gyro with one stuck axis": Case(
        {}, "rest axes", ["inertial_unit.gyro stuck", "inertial_unit.gyro dead"], held("rate", 1), "on y"
    ),
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
    "unit upside down": Case(
        {"inertial_unit": {"mounting": [1.0, 0.0, 0.0, 0.0]}},
        "axes coils",
        ["inertial_unit rotated"],
        says="y shows -y, z shows -z",
    ),
    "gyro with exchanged axes": Case(
        {}, "axes coils", ["inertial_unit.gyro mirrored"], sensed(rate=X_AND_Y), "x shows y, y shows x"
    ),
    "gyro in other units": Case({}, "axes", ["inertial_unit.gyro wrong scale"], sensed(rate=2.0 * np.eye(3))),
    "gyro with a scale of 1.2": Case(
        {}, "axes", ["inertial_unit.gyro wrong scale"], sensed(rate=1.2 * np.eye(3)), "x 1.20, y 1.20"
    ),
}
SENSOR_AXES = {
    "magnetometer with the opposite sign": Case(
        {}, "coils", ["inertial_unit.magnetometer reversed sign"], sensed(mag=-np.eye(3))
    ),
    "accelerometer with a wrong scale of one axis": Case(
        {}, "axes", ["inertial_unit.accelerometer wrong scale"], sensed(accel=HALF), "x 1.00, y 0.50"
    ),
    "magnetometer with a wrong scale of one axis": Case(
        {}, "axes coils", ["inertial_unit.magnetometer wrong scale"], sensed(mag=HALF), "x 1.00, y 0.50"
    ),
    "magnet beside the magnetometer": Case(
        fault("magnetometer: false"),
        "axes",
        ["inertial_unit.magnetometer biased"],
        says="20 uT, the site's 47 uT",
    ),
    "magnetometer with one reversed axis": Case(
        {}, "axes coils", ["inertial_unit.magnetometer mirrored"], sensed(mag=MINUS_X), "x shows -x"
    ),
    "magnetometer rotated by 30 deg": Case(
        {}, "axes coils", ["inertial_unit.magnetometer rotated"], sensed(mag=ABOUT_Z), "rotated by 30 deg"
    ),
    "accelerometer upside down": Case(
        {}, "axes", ["inertial_unit.accelerometer mirrored"], sensed(accel=np.diag([1.0, 1.0, -1.0]))
    ),
}
FRAMES = {
    "lens cap on": Case(fault("camera: black"), "dark light", ["camera lens cap on"]),
    "camera frozen": Case(fault("camera: frozen"), "light", ["camera frozen"], says="frame 1 arrives again"),
    "camera without trigger": Case(
        fault("camera: off"), "light", ["camera no frame"], says="no frame arrives within 12 s of the trigger"
    ),
    "camera with loose contact": Case(
        fault("camera: intermittent (period=7)"), "dark", ["camera intermittent"]
    ),
    "camera with late frames": Case(fault("camera: delayed"), "dark", ["camera late"]),
}
FOCUS = {
    "camera out of focus": Case({"camera": {"psf_sigma": 3.5}}, "focus", ["camera out of focus"]),
    "camera far out of focus": Case(
        {}, "focus", ["camera out of focus"], says="width 10.0", spoil=pictured(blurred)
    ),
}
PIXELS = {
    "camera with hot pixels": Case(
        {}, "dark", ["camera hot pixels"], says="1 % of the pixels", spoil=pictured(without_stars)
    ),
    "camera with half of its rows": Case(
        {},
        "dark",
        ["camera dead lines"],
        spoil=pictured(lambda pixels: pixels * (np.indices(pixels.shape)[0] < 200)),
        says="824 rows and 0 columns",
    ),
    "camera without its lowest bits": Case(
        {}, "dark", ["camera wrong gain"], spoil=pictured(lambda pixels: pixels >> 4)
    ),
    "camera with shifted bits": Case(
        {},
        "dark",
        ["camera wrong pixel format"],
        says="multiples of 16",
        spoil=pictured(lambda pixels: pixels << 4),
    ),
}
GPS = {
    "u-blox receiver at its factory baud rate": Case(
        {"gps": {"baud_rate": 9600}}, "find gps", [], base="orbit"
    ),
    "GPS antenna unplugged": Case(
        fault("gps: no-fix"), "gps", ["gps no fix"], base="orbit", says="with 0 satellites"
    ),
    "GPS receiver stuck": Case(fault("gps: stuck"), "gps", ["gps stuck"], base="orbit"),
    "GPS receiver with a loose plug": Case(
        fault("gps: intermittent (period=8, share=0.5)"), "gps", ["gps intermittent"], base="orbit"
    ),
    "GPS receiver with a wrong time": Case(
        fault("gps: clock"), "gps", ["gps wrong time"], says="180 s", base="orbit"
    ),
    "GPS receiver with late messages": Case(
        fault("gps: delayed"), "gps", ["gps late"], base="orbit", says="a fix arrives 2."
    ),
    "noise on the line of the GPS receiver": Case(
        fault("gps: bits"), "gps", ["gps corrupted messages"], base="orbit"
    ),
}
STRINGS = {
    "plugs of two solar strings exchanged": Case(
        {"solar_strings": {"strings": exchanged_strings()}},
        "strings",
        ["solar_strings.strings[0] exchanged", "solar_strings.strings[1] exchanged"],
        base="orbit",
        says="a current in string 1",
    ),
    "solar string dead": Case(
        fault("strings: dead (string=3)"), "strings", ["solar_strings.strings[2] dead"], base="orbit"
    ),
    "solar converters stuck": Case(fault("strings: stuck"), "strings", ["solar_strings stuck"], base="orbit"),
}


def session(case: Case, folder: Path) -> Session:
    """Return a session whose emulated devices differ from the configuration as the case states."""
    path = folder / "wired.yaml"
    path.write_text(to_yaml({"extends": case.base, **case.change}), encoding="utf-8")
    wired, config = requested_config(RunRequest(path, Path()))
    bench = emulated_bench(path, wired, config)
    bench.hardware.unit.alter = case.alter
    opened = Session(configuration(case.base)[1], bench.rig, ExitStack(), lambda _: None, bench)
    if case.spoil is not None:
        case.spoil(opened)
    return opened


def outcomes(opened: Session, steps: str) -> list[Outcome]:
    """Return the outcomes of some steps, and check that the coils carry no current afterwards."""
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


def check(case: Case, folder: Path) -> None:
    """Check that the steps of a case report its findings and no others."""
    findings = [one for outcome in outcomes(session(case, folder), case.steps) for one in outcome.findings]
    assert [f"{one.part} {one.kind}" for one in findings] == list(case.expected)
    assert case.says in "\n".join(one.line() for one in findings)


@pytest.mark.parametrize("name", COIL_WIRING)
def test_only_the_fault_is_named_in_the_coils_wiring(name: str, tmp_path: Path) -> None:
    check(COIL_WIRING[name], tmp_path)


@pytest.mark.parametrize("name", COIL_SUPPLY)
def test_only_the_fault_is_named_in_the_coils_supply(name: str, tmp_path: Path) -> None:
    check(COIL_SUPPLY[name], tmp_path)


@pytest.mark.parametrize("name", SEARCH)
def test_only_the_fault_is_named_in_the_search_for_devices(name: str, tmp_path: Path) -> None:
    check(SEARCH[name], tmp_path)


@pytest.mark.parametrize("name", REST)
def test_only_the_fault_is_named_in_a_resting_inertial_unit(name: str, tmp_path: Path) -> None:
    check(REST[name], tmp_path)


@pytest.mark.parametrize("name", UNIT_AXES)
def test_only_the_fault_is_named_in_the_axes_of_the_inertial_unit_or_its_gyro(
    name: str, tmp_path: Path
) -> None:
    check(UNIT_AXES[name], tmp_path)


@pytest.mark.parametrize("name", SENSOR_AXES)
def test_only_the_fault_is_named_in_the_axes_of_accelerometer_or_magnetometer(
    name: str, tmp_path: Path
) -> None:
    check(SENSOR_AXES[name], tmp_path)


@pytest.mark.parametrize("name", FRAMES)
def test_only_the_fault_is_named_in_triggers_and_frames(name: str, tmp_path: Path) -> None:
    check(FRAMES[name], tmp_path)


@pytest.mark.parametrize("name", FOCUS)
def test_only_the_fault_is_named_in_the_focus(name: str, tmp_path: Path) -> None:
    check(FOCUS[name], tmp_path)


@pytest.mark.parametrize("name", PIXELS)
def test_only_the_fault_is_named_in_pixel_values(name: str, tmp_path: Path) -> None:
    check(PIXELS[name], tmp_path)


@pytest.mark.parametrize("name", GPS)
def test_only_the_fault_is_named_in_the_gps_receiver(name: str, tmp_path: Path) -> None:
    check(GPS[name], tmp_path)


@pytest.mark.parametrize("name", STRINGS)
def test_only_the_fault_is_named_in_the_solar_strings(name: str, tmp_path: Path) -> None:
    check(STRINGS[name], tmp_path)


def test_a_mirrored_camera_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cameras, "_LENS_FRAMES", 2)
    opened = session(Case({}, "", [], spoil=pictured(lambda pixels: pixels[:, ::-1])), tmp_path)
    (found,) = outcomes(opened, "lens")
    assert [f"{one.part} {one.kind}" for one in found.findings] == ["camera mirrored"]


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


@pytest.mark.parametrize("base", ["step_demo", "orbit"])
def test_each_device_is_found_at_its_place(base: str, tmp_path: Path) -> None:
    (found,) = outcomes(session(Case({}, "", [], base=base), tmp_path), "find")
    answers = {
        "inertial_unit": "/dev/knightcube-imu: answers: VN-100T-CR",
        "coils": "/dev/i2c-1, 0x40: 0x40 answers",
        "power_monitor": "/dev/i2c-1, 0x45: 0x45 answers",
        "camera": "emulated optics: opens",
    }
    if base == "orbit":
        answers |= {"gps": "/dev/knightcube-gps: sends", "solar_strings": "/dev/i2c-1: 0x48, 0x49 answer"}
        answers |= {f"wide_cameras[{number}]": "emulated optics: opens" for number in range(6)}
    assert found.values["answers"] == answers
    assert found.findings == []


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("coils", "address", 0x43), ("power_monitor", "address", 0x44), ("inertial_unit", "baud_rate", 57600)],
)
def test_a_found_address_or_baud_rate_is_a_measured_value(
    section: str, key: str, value: int, tmp_path: Path
) -> None:
    (found,) = outcomes(session(Case({section: {key: value}}, "", []), tmp_path), "find")
    assert found.changes == {section: {key: value}}


def test_a_sound_bench_has_no_finding(tmp_path: Path) -> None:
    found = outcomes(session(Case({}, "", []), tmp_path), "find rest axes coils dark light focus")
    assert [one.line() for outcome in found for one in outcome.findings] == []
    assert [outcome.values for outcome in found if "skipped" in outcome.values] == []


POWER = {"power": {"battery": {"capacity": 2.0}}}


def fitted(change: Change, folder: Path, *, fault_of: str = "") -> Session:
    """Return a session in which `change` applies to `orbit` for the drivers and for the emulated devices."""
    opened = session(Case(change | (fault(fault_of) if fault_of else {}), "", [], base="orbit"), folder)
    opened.config = requested_config(RunRequest(folder / "wired.yaml", Path()))[1]
    return opened


@pytest.mark.parametrize(
    ("fault_of", "expected"),
    [
        ("", []),
        ("battery-monitor: stuck", ["power.battery_monitor stuck"]),
        ("battery-monitor: wrong", ["power.battery_monitor wrong voltage"]),
        ("bus-monitor: stuck", ["power.bus_monitor stuck"]),
        ("battery: cell-lost", ["power.battery_monitor wrong voltage", "power.bus_monitor wrong voltage"]),
    ],
)
def test_faults_of_the_power_system_are_named(fault_of: str, expected: list[str], tmp_path: Path) -> None:
    (found,) = outcomes(fitted(POWER, tmp_path, fault_of=fault_of), "power")
    assert [f"{one.part} {one.kind}" for one in found.findings] == expected


def rail(gain: float) -> Callable[[Session], None]:
    """Return a fault by which the battery monitor multiplies its measured current by `gain`."""

    def spoil(opened: Session) -> None:
        battery = opened.hand.hardware.power.rails[0]
        measure = battery.measure
        battery.monitor._measure = lambda *window: (measure(*window)[0], gain * measure(*window)[1])

    return spoil


@pytest.mark.parametrize(("gain", "kind"), [(-1.0, "reversed"), (0.5, "wrong shunt"), (0.0, "no current")])
def test_a_wrong_shunt_of_the_battery_monitor_is_named(gain: float, kind: str, tmp_path: Path) -> None:
    opened = fitted(POWER, tmp_path)
    rail(gain)(opened)
    (found,) = outcomes(opened, "power")
    assert [f"{one.part} {one.kind}" for one in found.findings] == [f"power.battery_monitor {kind}"]


WIDE = {
    "wide_cameras": [
        {"mounting": mounting, "columns": 128, "rows": 128, "field_of_view_deg": 92.0}
        for mounting in ([0.0, 0.70710678, 0.70710678, 0.0], [0.70710678, 0.0, 0.0, 0.70710678])
    ]
}


@pytest.mark.parametrize(
    ("fault_of", "swapped", "expected"),
    [
        ("", False, []),
        ("wide: black (camera=2)", False, ["wide_cameras[1] lens cap on"]),
        ("wide: garbage (camera=1)", False, ["wide_cameras[0] noisy"]),
        ("wide: frozen (camera=1)", False, ["wide_cameras[0] frozen"]),
        ("wide: off (camera=2)", False, ["wide_cameras[1] no frame"]),
        ("wide: saturated (camera=1)", False, ["wide_cameras[0] too bright"]),
        ("", True, ["wide_cameras[0] exchanged", "wide_cameras[1] exchanged"]),
    ],
)
def test_faults_of_horizon_cameras_are_named(
    fault_of: str, swapped: bool, expected: list[str], tmp_path: Path
) -> None:
    opened = fitted(WIDE, tmp_path, fault_of=fault_of)
    if swapped:
        star, first, second = opened.rig.cameras or ()
        opened.rig = replace(opened.rig, cameras=(star, second, first))
    (found,) = outcomes(opened, "wide")
    assert [f"{one.part} {one.kind}" for one in found.findings] == expected


def test_a_monitor_of_the_power_system_is_not_mistaken_for_the_coil_monitor(tmp_path: Path) -> None:
    (found,) = outcomes(fitted(POWER, tmp_path, fault_of="monitor: off"), "find")
    assert [f"{one.part} {one.kind}" for one in found.findings] == ["power_monitor no answer"]
    assert {"power.battery_monitor", "power.bus_monitor"} <= found.values["answers"].keys()
