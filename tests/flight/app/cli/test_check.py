"""Tests that `knightcube check` reports readiness and each missing device with its remedy."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from smbus2.smbus2 import I2C_FUNCS

from flight.app import devices
from flight.app.cli import run as checking
from flight.app.cli.run import flight_problems
from flight.app.run import RunResult
from flight.link.commands import open_unix
from flight.loop.flight_loop import FlightEnding
from flight.schema import reader
from flight.schema.devices import Sensor, SensorsSection, V4l2Device, WideCamera
from hal.buses.linux_wires import lock_bus
from hal.interfaces.errors import Refused
from tests.ground.commands.in_process import command
from tests.support.orbit_devices import orbit_config
from tests.support.places import DEMO, ROOT

SATELLITE = ROOT / "config" / "orbit.yaml"
TESTBED = ROOT / "config" / "testbed.yaml"
WELL = FlightEnding(10.0, 400, "testbed-demo", coils_at_zero=True, coil_error="")


def write(folder: Path, source: Path, **changes: object) -> Path:
    """Return a configuration with some sections changed."""
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(source.read_text()), **changes}), encoding="utf-8")
    return path


def test_a_sound_simulation_flies_ten_seconds_and_is_ready(tmp_path: Path) -> None:
    done = command("check", write(tmp_path, DEMO, camera="none"), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    facts = json.loads(done.stdout)
    assert (facts["ready"], facts["problems"], facts["simulated"]) == (True, [], True)
    drivers = {"inertial_unit": "vn100", "coils": "pca9685", "power_monitor": "ina219"}
    assert facts["drivers"] == drivers, "the devices are simulated, but their drivers are those of a board"
    assert facts["flight"]["mission_time_s"] == pytest.approx(10.0, abs=0.1)
    assert not Path(facts["flight"]["folder"]).exists(), "nothing is left behind"


def test_a_simulation_is_checked_while_another_flight_uses_its_socket_and_its_state(tmp_path: Path) -> None:
    """A check that used the state would count a boot, and a check that used the socket would be refused."""
    path, state = tmp_path / "commands", tmp_path / "state"
    state.mkdir()
    steps = [{"at": 0.0, "q2": 0.0}]
    mine = write(
        tmp_path, DEMO, camera="none", steps=steps, duration=0.5,
        commands={"socket": str(path), "udp": "127.0.0.1:0"}, state={"folder": str(state)},
    )  # fmt: skip
    flown = command("run", mine, "--out", tmp_path / "run")
    assert flown.returncode == 0, flown.stderr
    kept = {file.name: file.read_bytes() for file in state.iterdir()}
    assert kept, "a flight stores its state"
    with closing(open_unix(path)):
        done = command("check", mine)
    assert (done.returncode, done.stderr) == (0, "")
    assert {file.name: file.read_bytes() for file in state.iterdir()} == kept


def test_a_command_socket_and_a_state_folder_that_a_flight_cannot_use_are_named(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    mine = write(
        tmp_path, DEMO, camera="none", steps=[{"at": 0.0, "q2": 0.0}], duration=0.5,
        commands={"socket": str(tmp_path / "missing/commands")}, state={"folder": str(file / "state")},
    )  # fmt: skip
    facts = json.loads(command("check", mine, "--json").stdout)
    (problem,) = facts["problems"]
    assert problem.startswith(f"commands.socket: cannot be created: {tmp_path / 'missing'}: No such file")
    warned = f"state.folder: the state cannot be stored: {file}: Not a directory"
    assert any(warning.startswith(warned) for warning in facts["warnings"])


def test_a_configuration_that_extends_another_is_checked_and_written_as_one_file(tmp_path: Path) -> None:
    base = write(tmp_path, DEMO, camera="none", duration=0.5, steps=[{"at": 0.0, "q2": 0.0}])
    top, merged, out = tmp_path / "top.yaml", tmp_path / "merged.yaml", tmp_path / "run"
    top.write_text("extends: mine.yaml\nname: top\n", encoding="utf-8")
    done = command("check", top, "--merged", merged)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"configuration: {top}: top, valid\nextends:       {base}\n")
    assert yaml.safe_load(merged.read_text()) == yaml.safe_load(base.read_text()) | {"name": "top"}
    facts = json.loads(command("check", top, "--json").stdout)
    assert facts["extends"] == [str(base)]
    again = command("check", top, "--merged", merged)
    assert again.returncode == 2
    assert "merged.yaml: cannot be written: File exists" in again.stderr
    flown = command("run", top, "--out", out)
    assert flown.returncode == 0, flown.stderr
    assert (out / "config.yaml").read_text() == merged.read_text(), "the run folder does not need the files"
    assert command("report", out).returncode == 0


def test_a_shorter_flight_is_flown_whole_and_the_text_says_ready(tmp_path: Path) -> None:
    path = write(tmp_path, DEMO, camera="none", duration=0.5, steps=[{"at": 0.0, "q2": 0.0}])
    done = command("check", path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"configuration: {path}: step-demo, valid\n")
    assert done.stdout.endswith("noticed:       no faults; no warnings\nverdict:       ready\n")


def test_warnings_of_the_flight_are_in_the_verdict(tmp_path: Path) -> None:
    """No path exists for a body with a thousand times the configured inertia."""
    plant = {**yaml.safe_load(DEMO.read_text())["plant"], "inertia": 1.05}
    done = command("check", write(tmp_path, DEMO, camera="none", plant=plant))
    assert done.returncode == 0, done.stderr
    assert "warnings planner-failed (" in done.stdout
    assert done.stdout.endswith("verdict:       ready, with warnings: see above\n")


def test_a_satellite_without_a_sensor_of_its_attitude_is_ready_with_a_warning(tmp_path: Path) -> None:
    blind: dict[str, Any] = {"camera": "none", "wide_cameras": [], "duration": 0.5}
    path = write(tmp_path, SATELLITE, **blind, solar_strings="none", targets=[{"at": 0.0, "point": "sun"}])
    facts = json.loads(command("check", path, "--json").stdout)
    assert (facts["ready"], facts["problems"]) == (True, [])
    [warning] = facts["warnings"]
    assert warning.endswith("the attitude stays unknown, and the satellite never points to `targets`")
    done = command("check", path)
    assert f"\nwarning:       {warning}\n" in done.stdout
    assert done.stdout.endswith("verdict:       ready, with warnings: see above\n")
    path = write(tmp_path, SATELLITE, **blind, targets=[{"at": 0.0, "point": "sun"}])
    assert json.loads(command("check", path, "--json").stdout)["warnings"] == [], "the solar strings suffice"


SENSOR = """
import struct

class Sensor:
    def __init__(self, i2c, address):
        self.i2c, self.address = i2c, address

    def vector(self, register):
        data = bytearray(12)
        self.i2c.writeto_then_readfrom(self.address, bytes((register,)), data)
        return struct.unpack("<3f", data)

    gyro = property(lambda self: tuple(SCALE * value for value in self.vector(0)))
    magnetic = property(lambda self: tuple(1e6 * value for value in self.vector(1)))

class Chip:
    def __init__(self, measured, sensor):
        self.measured, self.address, self.register = measured, sensor.address, 0

    def answers(self, address):
        return address == self.address

    def write(self, address, data):
        self.register = data[0]

    def read(self, count):
        quantity, noise = (("gyro", 2e-4), ("magnetic", 2e-7))[self.register]
        return struct.pack("<3f", *self.measured.of(quantity, noise))
"""


@pytest.mark.parametrize(
    ("scale", "stated", "problem", "warning"),
    [
        (1.0, 2e-4, "", ""),
        (57.29578, 2e-4, "measures 57.* times the simulated rate: its driver must return rad/s", ""),
        (0.0174533, 2e-4, "measures 0.017. times the simulated rate: its driver must return rad/s", ""),
        (1.0, 0.0115, "", "rate_noise` is 0.0115, and the simulated gyro has 0.00.* rad/s: give rad/s"),
    ],
    ids=["rad/s", "deg/s", "converted twice", "noise in deg/s"],
)
def test_a_gyro_in_degrees_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scale: float, stated: float, problem: str, warning: str
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "degrees", raising=False)
    (tmp_path / "degrees.py").write_text(f"SCALE = {scale}\n{SENSOR}", encoding="utf-8")
    part = {"part": "degrees:Sensor", "emulator": "degrees:Chip", "address": 0x30}
    sensors = [{**part, "measures": {"gyro": list("xyz"), "magnetic": list("xyz")}}]
    unit = {"driver": "sensors", "rate_hz": 40, "angle_noise": 1e-3, "rate_noise": stated, "sensors": sensors}
    path = write(
        tmp_path, SATELLITE, inertial_unit=unit, camera="none", wide_cameras=[], duration=2.0,
        targets=[{"at": 0.0, "point": "sun"}],
    )  # fmt: skip
    done = command("check", path, "--json")
    facts = json.loads(done.stdout)
    assert "problems" in facts, done.stderr
    for found, pattern in ((facts["problems"], problem), (facts["warnings"], warning)):
        named = [text for text in found if "inertial_unit" in text]
        assert len(named) == bool(pattern)
        assert not pattern or re.search(pattern, named[0])


def test_a_simulation_that_does_not_fly_well_is_not_ready(tmp_path: Path) -> None:
    """The check fails if the simulated coils carry a hundredth of the current that is configured."""
    world = {**yaml.safe_load(DEMO.read_text())["simulation"], "truth": {"resistance": [2300.0] * 3}}
    steps = [{"at": 0.0, "q2": 0.0}]
    done = command("check", write(tmp_path, DEMO, camera="none", duration=6.0, steps=steps, simulation=world))
    assert done.returncode == 1, done.stdout
    cause = "coil z open: no current when driven (supply current 1 mA, expected 148 mA)"
    assert f"\nproblem:       alarm: coil-z-broken: {cause}\n" in done.stdout
    assert "\nproblem:       fault noticed: coil-broken (2): coil x faulty, with several " in done.stdout
    assert "\n               coil-suspect: supply current " in done.stdout, "warnings have causes too"
    assert done.stdout.endswith("verdict:       not ready\n")


@pytest.mark.parametrize(
    ("ending", "changes", "problem"),
    [
        (WELL, {}, None),
        (replace(WELL, warnings={"cycle-slip": 1}), {}, None),
        (replace(WELL, alarms=("imu-silent",)), {}, "alarm: imu-silent"),
        (replace(WELL, faults={"blind": 2}), {}, "fault noticed: blind (2)"),
        (
            replace(WELL, alarms=("imu-silent",), causes={"imu-silent": "no packet for 0.3 s"}),
            {},
            "alarm: imu-silent: no packet for 0.3 s",
        ),
        (
            replace(WELL, faults={"blind": 2}, causes={"blind": "no estimate for 60 s"}),
            {},
            "fault noticed: blind (2): no estimate for 60 s",
        ),
        (replace(WELL, alarms=("imu-silent",), faults={"blind": 2}), {"faults": ("imu: silent",)}, None),
        (replace(WELL, coils_at_zero=False), {}, "the coil currents are not zero at the end"),
        (replace(WELL, coils_at_zero=False, coil_error="no answer"), {}, "no answer"),
        (WELL, {"interrupted": True}, "the flight was stopped by SIGINT"),
        (WELL, {"log_error": "the disk is full"}, "the disk is full"),
        (WELL, {"restart": "the loop stood"}, "the loop stood"),
    ],
)
def test_alarms_faults_and_interruptions_are_problems_of_a_flight(
    ending: FlightEnding, changes: dict[str, object], problem: str | None
) -> None:
    result = replace(RunResult(Path(), "stopped by SIGINT", False, "", ending), **changes)  # type: ignore[arg-type]
    assert flight_problems(result) == ([] if problem is None else [problem])


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the device file of an emulated IMU, which a separate process serves."""
    link = tmp_path_factory.mktemp("line") / "unit"
    words = [sys.executable, "-m", "sim_hal", "emulate", "vn100", "--link", str(link), "--duration", "60"]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as server:
        deadline = time.monotonic() + 300.0
        while not link.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        yield link
        server.terminate()


def test_devices_that_are_missing_are_named_with_the_cure_and_one_that_is_there_is_found(
    unit: Path, tmp_path: Path
) -> None:
    tree = yaml.safe_load(TESTBED.read_text())
    changes: dict[str, object] = {
        "inertial_unit": {**tree["inertial_unit"], "device": str(unit)},
        "coils": {**tree["coils"], "bus": str(tmp_path / "no-bus")},
        "camera": {
            "device": {"driver": "v4l2", "path": str(tmp_path / "no-camera")},
            "bits": 8,
            "star_tracker": {"index": "x"},
        },
        "commands": {"socket": str(tmp_path / "nowhere" / "socket")},
    }
    path = write(tmp_path, TESTBED, **changes)
    done = command("check", path, "--json")
    assert done.returncode == 1, done.stderr
    facts = json.loads(done.stdout)
    devices = {item["name"]: item for item in facts["devices"]}
    assert {name for name, item in devices.items() if item["found"]} == {"inertial_unit"}
    assert devices["inertial_unit"]["text"].startswith("answers: VN-100")
    for name, cure in {
        "coils": "no such bus",
        "power_monitor": "no such bus",
        "camera": "no-camera",
        "camera.star_tracker.index": "knightcube index",
        "commands.socket": "no such folder",
    }.items():
        assert cure in devices[name]["text"] + devices[name]["place"], name
        assert f"{name}: missing" in facts["problems"]
    assert facts["flight"] is None, "no real device is flown"
    text = command("check", path).stdout
    assert "MISSING  coils" in text
    assert "found    inertial_unit" in text


def test_all_cameras_are_open_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cameras that can be opened separately may together exceed the bandwidth of their USB bus."""
    running: list[str] = []

    def opened(section: Any, rig: Any, stack: ExitStack) -> None:
        if len(running) == 2:
            raise Refused(section.device.path, "the bandwidth of its USB bus is exhausted")
        running.append(section.device.path)
        stack.callback(running.remove, section.device.path)

    monkeypatch.setattr(checking, "open_camera", opened)
    monkeypatch.setattr(checking, "fitted_devices", lambda _: [])
    cameras = tuple(WideCamera(device=V4l2Device(path=f"/dev/camera{number}")) for number in range(3))
    found = checking.probe(reader.replace(orbit_config(), camera=None, wide_cameras=cameras))
    assert [item.found for item in found if item.name.startswith("wide")] == [True, True, False]
    assert found[2].text == "the bandwidth of its USB bus is exhausted"
    assert running == [], "the check closes the cameras"


def test_separate_sensors_are_not_started_during_a_flight(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A start writes the settings of a sensor, so it would disturb a flight that reads the sensor."""

    def adapter(descriptor: int, request: int, argument: Any = 0) -> int:
        if request == I2C_FUNCS:
            argument.value = (1 << 32) - 1
        return 0

    monkeypatch.setattr("smbus2.smbus2.ioctl", adapter)
    monkeypatch.setattr("hal.buses.linux_wires.ioctl", adapter)
    started: list[str] = []
    monkeypatch.setattr(devices, "_started", lambda _, rig, sensor: started.append(sensor.part))
    sensor = Sensor(part="lis3mdl", bus=str(tmp_path / "sensors"), measures={"magnetic": ("x", "y", "z")})
    unit, node = SensorsSection(driver="sensors", sensors=(sensor,)), tmp_path / "coils"
    node.touch()
    config = reader.replace(orbit_config(), camera=None, wide_cameras=(), inertial_unit=unit)
    config = reader.replace(config, coils=reader.replace(config.coils, bus=str(node)))

    def answer() -> str:
        (item,) = (item for item in checking.probe(config) if item.name == "inertial_unit")
        return item.text

    with node.open(encoding="ascii") as flight:
        lock_bus(flight.fileno())
        assert "another flight drives the coils on this bus" in answer()
    assert started == []
    assert answer() == "lis3mdl: each answers"
    assert started == ["lis3mdl"]


def test_the_devices_of_an_orbit_are_looked_for_too(unit: Path, tmp_path: Path) -> None:
    """The check reads the GPS receiver of an orbit configuration.

    A silent receiver is reported as missing.
    """
    strings = [
        {"normal": normal, "address": address, "channel": channel}
        for normal, address, channel in (
            ([1.0, 0.0, 0.0], 0x48, 0), ([-1.0, 0.0, 0.0], 0x48, 1),
            ([0.0, 1.0, 0.0], 0x49, 0), ([0.0, -1.0, 0.0], 0x49, 1),
        )
    ]  # fmt: skip
    mask = tmp_path / "structure.pgm"
    mask.write_bytes(b"P5 384 384 255\n" + bytes([255] * 384 * 96 + [0] * 384 * 288))
    master, slave = os.openpty()
    try:
        for device, answer in ((unit, True), (Path(os.ttyname(slave)), False)):
            tree = yaml.safe_load((ROOT / "config" / "orbit.yaml").read_text())
            del tree["simulation"]
            path = tmp_path / "orbit.yaml"
            changes = {
                "camera": "none",
                "gps": {"device": str(device)},
                "solar_strings": {"strings": strings},
                "wide_cameras": [
                    {
                        "device": {"driver": "v4l2", "path": str(tmp_path / "none")},
                        "structure_file": str(mask),
                    }
                ],
            }
            path.write_text(yaml.safe_dump({**tree, **changes}), encoding="utf-8")
            done = command("check", path, "--json")
            assert done.returncode == 1, done.stderr
            found = {item["name"]: item for item in json.loads(done.stdout)["devices"]}
            assert found["gps"]["found"] is answer, found["gps"]
            assert {"solar_strings", "wide_cameras[0]"} < set(found)
            assert "no byte arrived" in found["gps"]["text"] or answer
            hidden = found["wide_cameras[0].structure_file"]
            assert hidden["found"] is answer, hidden
            assert ("hides 25 % of the image" if answer else "cannot be read") in hidden["text"]
            mask.unlink(missing_ok=True)
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"body": "nobody"}, "`body` is 'nobody'"),
        ({"duration": -1.0}, "duration"),
        ({"surplus": 1}, "surplus"),
        (
            {"commands": {"timeline": [{"at": 1.0, "clear": "coil-brokn"}]}},
            "`commands.timeline[0].clear` is 'coil-brokn', which is not the name of an event: did you mean "
            "coil-broken?",
        ),
    ],
)
def test_a_configuration_that_is_refused_is_one_line_and_status_2(
    changes: dict[str, object], complaint: str, tmp_path: Path
) -> None:
    done = command("check", write(tmp_path, DEMO, **changes))
    assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, "")
    assert complaint in done.stderr


@pytest.mark.parametrize(
    ("text", "line", "complaint"),
    [
        (
            "craft: {inertia: [1.0e-3, 1.0e-3, 2.1e-3]}",
            2,
            "`craft.inertia` has the principal moments 0.001, 0.001, 0.0021: the largest must not exceed",
        ),
        (
            "craft: {inertia: [[1.0e-3, 2.0e-3, 0.0], [2.0e-3, 1.0e-3, 0.0], [0.0, 0.0, 1.0e-3]]}",
            2,
            "`craft.inertia` has the principal moments -0.001, 0.001, 0.003: all must be positive",
        ),
        (
            "simulation: {free_body: {craft: {size: [0.1, 0.1, 0.1], inertia: [1.0e-3, 1.0e-3, 3.0e-3]}}}",
            2,
            "`simulation.free_body.craft.inertia` has the principal moments 0.001, 0.001, 0.003",
        ),
        (
            "gps: none\nelements: null",
            None,
            "`targets[0].point` is sun: pointing needs the satellite's position: add `gps`",
        ),
        (
            "simulation: {utc: '20.3.2026'}",
            2,
            "`simulation.utc` is '20.3.2026': give a UTC such as 2026-03-20T12:00:00Z",
        ),
        (
            "simulation: {seed: 18446744073709551616}",
            2,
            "`simulation.seed` is 18446744073709551616: must be 0 to",
        ),
        (
            "simulation: {utc: '1999-12-31T00:00:00Z'}",
            2,
            "`simulation.utc` is '1999-12-31T00:00:00Z': give a year from 2001 to 2043",
        ),
        (
            "simulation: {free_body: {craft: {windings: [{axis: [0, 0, 0], resistance: 1},"
            " {axis: [0, 1, 0], resistance: 1}, {axis: [0, 0, 1], resistance: 1}]}}}",
            2,
            "`simulation.free_body.craft.windings[0].axis` is [0.0, 0.0, 0.0]: give the direction",
        ),
        (
            "simulation: {free_body: {craft: {windings: [{axis: [1, 0, 0], resistance: 1},"
            " {axis: [0, 1, 0], resistance: 1}, {axis: [0, 0, 1], resistance: 1}]}}}",
            2,
            "`simulation.free_body.craft.windings[0].dipole_per_ampere` is missing",
        ),
        ("craft: {mass: 4,5}", 2, "`craft.5` is not a key: keys are texts; write decimals with a point"),
        (
            "simulation: {utc: '2027-01-01T00:00:00Z'}",
            None,
            "`elements` do not fit the first revolution of `simulation.free_body.orbit`: largest distance ",
        ),
    ],
)
def test_an_impossible_satellite_is_refused_in_one_line_before_it_is_flown(
    text: str, line: int | None, complaint: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: orbit\n{text}\n", encoding="utf-8")
    done = command("check", path)
    assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, "")
    assert complaint in done.stderr
    assert line is None or f"mine.yaml:{line}: " in done.stderr


def test_a_file_that_is_not_what_was_accepted_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, DEMO, camera="none")
    (tmp_path / "mine.yaml.sha256").write_text("00  mine.yaml\n")
    done = command("check", path)
    assert done.returncode == 2
    assert "differs from the accepted configuration" in done.stderr
