"""The units, the installer and `coils-off`, as far as they can be tried without booting."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hal.drivers.pca9685 import ALL_LED_OFF_H, FULL
from hal.guardian.client import CoilReach
from tests.scenario.flights import CONFIG

ROOT = CONFIG.parents[1]
DEPLOY = ROOT / "deploy"
UNITS = ("knightcube.service", "knightcube-safe.service")
TESTBED = ROOT / "config" / "testbed.yaml"

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: install systemd"
)


def dropin(config: Path) -> str:
    words = [sys.executable, str(DEPLOY / "board_dropin.py"), str(config)]
    return subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT).stdout


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the units, the commands in them where they are now, the drop-in at their end."""
    folder = tmp_path_factory.mktemp("units")
    added = dropin(TESTBED)
    for name in UNITS:
        text = (DEPLOY / name).read_text(encoding="utf-8")
        text = text.replace("/opt/knightcube/venv/bin/python", sys.executable)
        text = text.replace("/opt/knightcube/bin/coils-off", str(DEPLOY / "coils-off"))
        (folder / name).write_text(text + "\n" + added, encoding="utf-8")
    return folder


@needs_systemd
def test_systemd_finds_nothing_to_complain_of(units: Path) -> None:
    words = ["systemd-analyze", "verify", *(str(units / name) for name in UNITS)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@needs_systemd
@pytest.mark.parametrize("name", UNITS)
def test_the_sandbox_leaves_an_exposure_of_at_most_1_5(units: Path, name: str) -> None:
    words = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(units / name)]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", told)
    assert found is not None
    assert float(found[1]) <= 1.5


def test_the_watchdog_leaves_room_for_four_meals() -> None:
    text = (DEPLOY / "knightcube.service").read_text(encoding="utf-8")
    (seconds,) = re.findall(r"^WatchdogSec=(\d+)$", text, re.MULTILINE)
    assert float(seconds) >= 4 * 0.25, "fed four times a second"


def test_the_dropin_names_the_devices_and_nothing_of_a_network() -> None:
    text = dropin(TESTBED)
    assert "DeviceAllow=/dev/i2c-1 rw\n" in text
    assert "DeviceAllow=/dev/knightcube-imu rw\n" in text
    assert "AF_INET" not in text
    assert "video" not in text


@needs_systemd
def test_the_flight_waits_for_the_device_that_udev_names() -> None:
    words = ["systemd-escape", "--path", "--suffix=device", "/dev/knightcube-imu"]
    unit = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    text = dropin(TESTBED)
    assert f"Wants={unit}\nAfter={unit}\n" in text
    rules = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8").splitlines()
    assert all('TAG+="systemd"' in line for line in rules if "knightcube-imu" in line)


def test_simulated_devices_ask_for_none_of_the_boards() -> None:
    assert "Device" not in dropin(CONFIG)


def test_the_dropin_opens_the_network_only_for_a_command_link(tmp_path: Path) -> None:
    config = tmp_path / "flight.yaml"
    linked = TESTBED.read_text(encoding="utf-8") + "\ncommands: {udp: '127.0.0.1:5000'}\n"
    config.write_text(linked, encoding="utf-8")
    text = dropin(config)
    assert "RestrictAddressFamilies=AF_INET\n" in text
    assert "PrivateNetwork=no\n" in text


@pytest.mark.parametrize(
    ("device", "allowed"),
    [
        ("{kind: v4l2, path: /dev/knightcube-camera, pixel_format: Y16}", "/dev/knightcube-camera"),
        ("{kind: aravis, name: Some-1, pixel_format: Mono16}", "char-usb_device"),
    ],
)
def test_the_dropin_lets_the_configured_camera_through(tmp_path: Path, device: str, allowed: str) -> None:
    config = tmp_path / "flight.yaml"
    text = TESTBED.read_text(encoding="utf-8")
    given = re.sub(r"^camera: none.*$", f"camera: {{device: {device}}}", text, flags=re.MULTILINE)
    config.write_text(given, encoding="utf-8")
    assert f"DeviceAllow={allowed} rw\n" in dropin(config)


def test_a_wrong_configuration_is_one_line_and_status_2(tmp_path: Path) -> None:
    config = tmp_path / "flight.yaml"
    config.write_text("name: [", encoding="utf-8")
    words = [sys.executable, str(DEPLOY / "board_dropin.py"), str(config)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2
    assert done.stderr.startswith("install: ")
    assert "Traceback" not in done.stderr


class Tools:
    """Stand-ins for i2cset and python3, which note how they were called, and whether they succeed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "bin").mkdir()
        shutil.copy(DEPLOY / "coils-off", folder)

    def put(self, name: str, status: int) -> None:
        tool = self.folder / "bin" / name
        tool.write_text(
            f'#!/bin/sh\necho "{name} $*" >>"{self.folder}/calls"\nexit {status}\n', encoding="utf-8"
        )
        tool.chmod(0o755)

    def run(self, **environment: str) -> tuple[int, list[str], str]:
        done = subprocess.run(
            [str(self.folder / "coils-off")],
            env={
                "PATH": f"{self.folder}/bin:{os.environ['PATH']}",
                "STATE_DIRECTORY": str(self.folder),
                **environment,
            },
            capture_output=True,
            text=True,
            check=False,
        )
        calls = (self.folder / "calls").read_text(encoding="utf-8").splitlines()
        return done.returncode, calls, done.stderr


@pytest.fixture
def tools(tmp_path: Path) -> Tools:
    return Tools(tmp_path)


def test_the_coils_are_zeroed_by_i2cset_first(tools: Tools) -> None:
    tools.put("i2cset", 0)
    tools.put("python3", 0)
    assert tools.run() == (0, [f"i2cset -y 1 0x40 0x{ALL_LED_OFF_H:02x} 0x{FULL:02x} b"], "")


def test_where_i2cset_fails_any_python_does_it(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 0)
    status, calls, _ = tools.run()
    assert status == 0
    assert calls[1] == f"python3 -I -S {tools.folder}/smbus_byte.py /dev/i2c-1 0x40 0xfd 0x10"


def test_it_tries_again_and_says_so_when_all_is_in_vain(tools: Tools) -> None:
    tools.put("i2cset", 1)
    tools.put("python3", 1)
    status, calls, told = tools.run()
    assert status == 1
    assert len(calls) == 10, "five times each"
    assert "the coils may be driven" in told


def test_the_bus_and_address_last_flown_count_more_than_the_units(tools: Tools) -> None:
    tools.put("i2cset", 0)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3", KNIGHTCUBE_PWM="0x41")[1][-1].startswith(
        "i2cset -y 3 0x41 "
    )
    CoilReach("hal.buses.smbus_byte:open_bus", "/dev/i2c-7", 0x42).note(tools.folder)
    assert tools.run(KNIGHTCUBE_I2C="/dev/i2c-3")[1][-1].startswith("i2cset -y 7 0x42 ")


def test_a_stable_name_of_the_bus_is_followed_to_its_number(tools: Tools, tmp_path: Path) -> None:
    tools.put("i2cset", 0)
    (tmp_path / "knightcube-i2c").symlink_to("/dev/i2c-5")
    status, calls, _ = tools.run(KNIGHTCUBE_I2C=str(tmp_path / "knightcube-i2c"))
    assert status == 0
    assert calls[-1].startswith("i2cset -y 5 0x40 ")


@needs_systemd
def test_a_dry_run_tells_every_step_and_touches_nothing() -> None:
    before = sorted(Path("/etc/systemd/system").iterdir())
    words = ["sh", str(DEPLOY / "install.sh"), "--dry-run", "--config", str(TESTBED)]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    for step in (
        "useradd",
        "venv",
        "pip install",
        "coils-off",
        "flight.yaml",
        "knightcube.service",
        "99-knight",
    ):
        assert step in told
    assert sorted(Path("/etc/systemd/system").iterdir()) == before
    assert not Path("/opt/knightcube").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--frobnicate"], "unknown option"),
        (["--config"], "wants a value"),
        (["--dry-run", "--config", "/no"], "/no"),
    ],
)
def test_wrong_use_of_the_installer_is_one_line_and_status_2(words: list[str], told: str) -> None:
    done = subprocess.run(
        ["sh", str(DEPLOY / "install.sh"), *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert told in done.stderr


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is missing")
def test_shellcheck_is_silent() -> None:
    words = ["shellcheck", str(DEPLOY / "install.sh"), str(DEPLOY / "coils-off")]
    assert subprocess.run(words, capture_output=True, text=True, check=False).stdout == ""


def test_every_udev_rule_is_of_matches_and_assignments() -> None:
    rules = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8").splitlines()
    term = re.compile(r'[A-Z_]+(\{[^}]+\})?(==|!=|=|\+=)"[^"]*"')
    lines = [line for line in rules if line and not line.startswith("# ")]
    assert {name for line in lines for name in re.findall(r"knightcube-\w+", line)} == {
        "knightcube-imu", "knightcube-i2c", "knightcube-camera"
    }  # fmt: skip
    for line in lines:
        assert all(term.fullmatch(part) for part in line.removeprefix("#").split(", ")), line
