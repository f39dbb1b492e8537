"""Tests that board configurations name real devices, and that faulty configurations are refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import yaml

from flight.app.cli import main
from flight.schema import reader
from flight.schema.bodies import OrbitConfig
from tests.deploy.scripts import DEPLOY, ROOT, board_dropin, dropin, script

TESTBED, ORBIT = (ROOT / "config" / f"board_{name}.yaml" for name in ("testbed", "orbit"))


@pytest.mark.parametrize("path", [TESTBED, ORBIT], ids=["testbed", "orbit"])
def test_a_boards_configuration_names_every_device_and_estimates_from_streaks(path: Path) -> None:
    assert board_dropin.main([str(path)]) == 0
    config = reader.load(path)
    assert config.simulation is None
    assert config.camera is not None
    assert config.camera.estimator == "likelihood"
    files = {file for file, _ in board_dropin._nodes(config)}
    named = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8")
    for file in files - {"/dev/i2c-1"}:
        assert f'SYMLINK+="{file.removeprefix("/dev/")}"' in named
    assert len(files) == (6 if isinstance(config, OrbitConfig) else 3)
    assert all(f"DeviceAllow={file} rw" in dropin(path) for file in files)


@pytest.mark.parametrize(
    ("name", "words", "complaint"),
    [
        ("board_dropin", [], "usage: board_dropin.py CONFIG [FOLDER]"),
        ("board_dropin", ["a", "b", "c"], "usage: board_dropin.py CONFIG [FOLDER]"),
        ("board_dropin", [str(TESTBED), "/nowhere"], "/nowhere: no such folder"),
        ("sky_index", [], "usage: sky_index.py [--wanted] CONFIG"),
        ("sky_index", ["--wanted"], "usage: sky_index.py [--wanted] CONFIG"),
        ("sky_index", ["--wrong", str(TESTBED)], "usage: sky_index.py [--wanted] CONFIG"),
        ("sky_index", ["/nowhere/flight.yaml"], "/nowhere/flight.yaml: cannot be read"),
    ],
)
def test_wrong_arguments_of_the_installer_s_programs_are_one_line(
    name: str, words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script(name).main(words) == 2
    said = capsys.readouterr().err
    assert (complaint in said, said.count("\n")) == (True, 1)


def test_the_installer_takes_the_testbed_with_streaks_by_default() -> None:
    text = (DEPLOY / "install.sh").read_text(encoding="utf-8")
    assert "flown=${config:-$source/config/board_testbed.yaml}" in text


@pytest.mark.parametrize(
    ("path", "changes", "complaint"),
    [
        (TESTBED, {"body": "nobody"}, "`body` is 'nobody'"),
        (TESTBED, {"camera": {"columns": 640}}, "`camera.device` is missing"),
        (TESTBED, {"coils": {"supply_voltage": 50.0}}, "`coils.supply_voltage` is 50.0: must be"),
        (TESTBED, {"inertial_unit": {"driver": "nobodys:UNIT"}}, "`inertial_unit.driver` is 'nobodys:UNIT'"),
        (ORBIT, {"gps": "none"}, "pointing needs the satellite's position"),
    ],
)
def test_the_installer_refuses_what_check_refuses(
    path: Path, changes: dict[str, object], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    for key, value in changes.items():
        merge = isinstance(value, dict) and key == "coils"
        tree[key] = {**tree[key], **value} if merge else value  # type: ignore[dict-item]
    changed = tmp_path / "flight.yaml"
    changed.write_text(yaml.safe_dump(tree), encoding="utf-8")
    assert board_dropin.main([str(changed)]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert complaint in said.err


_WRONG: list[tuple[Path, tuple[str | int, ...], object]] = [
    (TESTBED, ("plant", "colour"), 3),
    (TESTBED, ("plant", "inertia"), math.nan),
    (TESTBED, ("coils", "current_limit"), math.inf),
    (TESTBED, ("coils", "windings", 1, "channels"), [0, 1]),
    (TESTBED, ("power_monitor", "address"), 0x40),
    (TESTBED, ("camera", "mounting"), [0.0, 0.0, 0.0, 0.0]),
    (TESTBED, ("camera", "device", "pixel_format"), "JPEG"),
    (TESTBED, ("camera",), [1, 2]),
    (TESTBED, ("body",), "os:system"),
    (TESTBED, ("inertial_unit", "max_age"), 0.01),
    (TESTBED, ("steps", 1, "q2"), 1.5),
    (ORBIT, ("craft", "inertia"), [1e-3, 1e-3, 9e-3]),
    (ORBIT, ("solar_strings", "strings", 1, "channel"), 0),
    (ORBIT, ("solar_strings", "strings", 3, "address"), 0x40),
    (ORBIT, ("pointing", "across"), [0.0, 0.0, 1.0]),
    (ORBIT, ("targets", 0, "point"), "mars"),
    (ORBIT, ("commands", "udp"), "0.0.0.0:70000"),
]


@pytest.mark.parametrize(("path", "key", "value"), _WRONG, ids=[str(key[-1]) for _, key, _ in _WRONG])
def test_the_drop_in_and_check_refuse_a_wrong_value_with_the_same_words(
    path: Path,
    key: tuple[str | int, ...],
    value: object,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    part = tree
    for word in key[:-1]:
        part = part[word]
    part[key[-1]] = value
    changed = tmp_path / "flight.yaml"
    changed.write_text(yaml.safe_dump(tree), encoding="utf-8")
    assert board_dropin.main([str(changed)]) == 2
    refused = capsys.readouterr().err.partition(": ")[2]
    assert main(["check", str(changed)]) == 2
    assert capsys.readouterr().err.partition(": ")[2] == refused != ""


def test_the_unit_has_the_writes_that_switch_drv8830_bridges_off(tmp_path: Path) -> None:
    tree = yaml.safe_load(TESTBED.read_text(encoding="utf-8"))
    tree["coils"] |= {"driver": "drv8830", "address": 0x61}
    path = tmp_path / "flight.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    words = "0x61 0x00 0x00 0x62 0x00 0x00 0x63 0x00 0x00"
    assert f'Environment=KNIGHTCUBE_I2C=/dev/i2c-1 "KNIGHTCUBE_PWM={words}"\n' in dropin(path)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("commands", "socket", '/run/a"\nExecStartPre=+/bin/sh'),
        ("commands", "socket", "/run/%n"),
        ("link", "keys", "/keys\nUser=root"),
        ("link", "serial", {"device": "/dev/ttyS0\n"}),
        ("link", "serial", {"device": "/dev/../dev/ttyS0"}),
        ("link", "keys", "keys/satellite"),
        ("commands", "socket", "run/.."),
        ("coils", "bus", "/dev/i2c-1\n"),
        ("inertial_unit", "device", "/dev/imu\nUser=root"),
    ],
)
def test_no_path_of_a_configuration_adds_a_setting_to_a_unit(
    section: str, key: str, value: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tree = yaml.safe_load(TESTBED.read_text(encoding="utf-8"))
    tree["commands"] = {"socket": "/run/knightcube/commands"}
    tree["link"] = {"keys": "/keys", "udp": "127.0.0.1:5000"}
    changed = tmp_path / "flight.yaml"
    changed.write_text(yaml.safe_dump(tree), encoding="utf-8")
    assert board_dropin.main([str(changed), str(tmp_path)]) == 0
    tree[section][key] = value
    changed.write_text(yaml.safe_dump(tree), encoding="utf-8")
    assert board_dropin.main([str(changed), str(tmp_path)]) == 2
    assert "a path on the board must be absolute, without `..`, of letters" in capsys.readouterr().err
