"""The configurations of boards: they name real devices, are refused as `check` refuses, and start."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from flight.app.cli import main
from flight.schema import reader
from flight.schema.orbit import OrbitConfig
from ground.telemetry import read_run
from tests.deploy.scripts import DEPLOY, ROOT, board_dropin, dropin

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
        (ORBIT, {"gps": "none"}, "pointing needs the position"),
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


def test_the_unit_knows_the_writes_that_stop_other_bridges(tmp_path: Path) -> None:
    tree = yaml.safe_load(TESTBED.read_text(encoding="utf-8"))
    tree["coils"] |= {"driver": "drv8830", "address": 0x61}
    path = tmp_path / "flight.yaml"
    path.write_text(yaml.safe_dump(tree), encoding="utf-8")
    words = "0x61 0x00 0x00 0x62 0x00 0x00 0x63 0x00 0x00"
    assert f'Environment=KNIGHTCUBE_I2C=/dev/i2c-1 "KNIGHTCUBE_PWM={words}"\n' in dropin(path)


@pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="no C compiler builds the preload library"
)
def test_the_testbeds_configuration_flies_real_drivers_against_emulated_devices(tmp_path: Path) -> None:
    """I2C bus and serial line are those of the operating system, with emulated devices at their far ends."""
    unit = tmp_path / "imu"
    text = TESTBED.read_text(encoding="utf-8").replace("/dev/knightcube-imu", str(unit))
    text = re.sub(r"device: \{driver: v4l2.*\}", "device: {driver: 'tests.deploy.flat_camera:FLAT'}", text)
    text = text.replace("/run/knightcube/commands", str(tmp_path / "commands"))
    text = text.replace("period: 5.0 ", "period: 1.0 ").replace("  star_tracker: {}", "  #")
    config = tmp_path / "board.yaml"
    config.write_text(text, encoding="utf-8")
    emulate = [sys.executable, "-m", "sim_hal", "emulate"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    program = "\n".join(
        (
            "import json, sys",
            "from flight.__main__ import main",
            f"status = main(['check', {str(config)!r}, '--json'])",
            f"words = ['run', {str(config)!r}, '--duration', '2', '--out', {str(tmp_path / 'run')!r}]",
            "sys.exit(status or main(words))",
        )
    )
    with subprocess.Popen(
        [*emulate, "vn100", "--link", str(unit), "--duration", "90"], env=environment, stdout=subprocess.PIPE
    ) as line:
        assert line.stdout is not None
        assert line.stdout.readline()
        try:
            done = subprocess.run(
                [*emulate, "i2c", "--bus", "1", "--config", str(config), "--", sys.executable, "-c", program],
                env=environment,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=80,
                check=False,
            )
        finally:
            line.terminate()
    assert done.returncode == 0, done.stdout + done.stderr
    checked, _, flown = done.stdout.partition("\n")
    facts = json.loads(checked)
    assert {device["name"] for device in facts["devices"] if device["found"]} == {
        "inertial_unit", "coils", "power_monitor", "camera", "commands.socket",
    }  # fmt: skip
    assert "coils:    at zero" in flown
    run = read_run(tmp_path / "run")
    assert len(run["imu"]) > 40, "the unit is read"
    assert run["housekeeping"]["frames"][-1] >= 1, "the camera is read"
