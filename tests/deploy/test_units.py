"""Tests of the systemd units, their drop-ins and the device names, without booting a machine."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flight.app.cli.run import REFUSED
from flight.app.flight import fly
from flight.app.run import RunRequest
from flight.schema.document import ConfigError
from hal.interfaces.errors import NotResponding
from tests.deploy.scripts import (
    DEPLOY,
    ROOT,
    TESTBED,
    board_dropin,
    changed_testbed,
    dropin,
    link_dropin,
    safe_dropin,
)
from tests.support.flights import CONFIG

UNITS = ("knightcube.service", "knightcube-safe.service", "knightcube-link.service")
LINK = "{keys: /var/lib/knightcube-link/keys, udp: '192.168.7.2:5000', serial: {device: /dev/null}}"
"""Link section with a UDP address and a serial device."""
CAMERA = "{device: {driver: v4l2, path: /dev/knightcube-camera, pixel_format: Y16}}"

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: install systemd"
)


def put_units(folder: Path, config: Path) -> Path:
    """Copy the units with their drop-ins into a folder, and adapt the paths of commands to this machine."""
    for name, added in zip(UNITS, (dropin(config), safe_dropin(config), link_dropin(config)), strict=True):
        text = (DEPLOY / name).read_text(encoding="utf-8")
        (folder / name).write_text(text + "\n" + added, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the units of a board with persistent device names, a camera and a ground link."""
    folder = tmp_path_factory.mktemp("units")
    config = changed_testbed(
        folder,
        camera=CAMERA,
        coils_bus="/dev/knightcube-i2c",
        commands="{socket: /run/knightcube/commands}",
        link=LINK,
    )
    return put_units(folder, config)


@needs_systemd
def test_systemd_verifies_the_units_without_a_message(units: Path) -> None:
    words = ["systemd-analyze", "verify", *(str(units / name) for name in UNITS)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def exposure(unit: Path) -> float:
    """Return systemd's rating of a unit's sandbox, from 0 (tightest) to 10 (none)."""
    words = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)]
    output = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", output)
    assert found is not None
    return float(found[1])


@needs_systemd
@pytest.mark.parametrize("name", UNITS)
def test_the_sandbox_leaves_an_exposure_of_at_most_1(units: Path, name: str) -> None:
    """The rating of each unit by systemd is 1 or less, also with a radio on a serial line."""
    assert exposure(units / name) <= 1.0


@needs_systemd
def test_the_renewal_is_a_valid_unit_with_a_sandbox_although_it_is_root(tmp_path: Path) -> None:
    for name in ("knightcube-renewal.service", "knightcube-renewal.timer"):
        shutil.copyfile(DEPLOY / name, tmp_path / name)
    words = ["systemd-analyze", "verify", *map(str, sorted(tmp_path.iterdir()))]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert exposure(tmp_path / "knightcube-renewal.service") <= 1.3


@pytest.mark.parametrize("name", ["fly", "renewal.py", "safe_state.py"])
def test_python_runs_isolated_from_environment_and_working_folder(name: str) -> None:
    text = (DEPLOY / name).read_text(encoding="utf-8")
    starts = re.findall(r"^(?:#!.*python.*|.*exec .*venv/bin/python.*|run_python\(\).*)$", text, re.MULTILINE)
    assert starts
    assert all(" -I " in line for line in starts), starts


@pytest.mark.parametrize("name", ["knightcube.service", "knightcube-link.service"])
def test_the_services_import_only_what_root_permits(name: str) -> None:
    assert "KNIGHTCUBE_MODULES=/etc/knightcube/modules" in (DEPLOY / name).read_text(encoding="utf-8")


@needs_systemd
def test_a_pluggable_radio_beside_a_network_has_an_exposure_of_at_most_1_2(tmp_path: Path) -> None:
    link = LINK.replace("/dev/null", "/dev/knightcube-radio")
    config = changed_testbed(tmp_path, commands="{socket: /run/knightcube/commands}", link=link)
    assert exposure(put_units(tmp_path, config) / "knightcube-link.service") <= 1.2


@needs_systemd
@pytest.mark.parametrize("line", ["udp: '192.168.7.2:5000'", "serial: {device: /dev/knightcube-radio}"])
def test_a_link_by_one_line_is_exposed_by_at_most_1(tmp_path: Path, line: str) -> None:
    link = f"{{keys: /var/lib/knightcube-link/keys, {line}}}"
    config = changed_testbed(tmp_path, commands="{socket: /run/knightcube/commands}", link=link)
    assert exposure(put_units(tmp_path, config) / "knightcube-link.service") <= 1.0


@needs_systemd
def test_a_usb3_vision_camera_beside_a_ground_link_has_an_exposure_of_at_most_1(tmp_path: Path) -> None:
    camera = "{device: {driver: aravis, name: Some-1, pixel_format: Mono16}}"
    config = changed_testbed(
        tmp_path, camera=camera, commands="{socket: /run/knightcube/commands}", link=LINK
    )
    assert exposure(put_units(tmp_path, config) / UNITS[0]) <= 1.0


def test_the_safe_state_has_the_command_socket_of_the_flight_and_restarts_the_flight(tmp_path: Path) -> None:
    config = changed_testbed(tmp_path, commands="{socket: /run/knightcube/commands}")
    assert 'Environment="KNIGHTCUBE_COMMANDS=/run/knightcube/commands"\n' in safe_dropin(config)
    assert "KNIGHTCUBE_COMMANDS" not in safe_dropin(TESTBED)
    text = (DEPLOY / "knightcube-safe.service").read_text(encoding="utf-8")
    begun = re.findall("^ExecStart=(.*)$", text, re.MULTILINE)
    assert "' safe_state.py\n" in text
    assert begun[-1].endswith("--no-block start knightcube.service")
    assert f"RestartPreventExitStatus={REFUSED}\n" in (DEPLOY / "knightcube.service").read_text("utf-8")
    shell = subprocess.run(["/bin/sh", str(tmp_path / "no-launcher")], capture_output=True, check=False)
    assert shell.returncode != REFUSED, "a launcher that cannot be read once is started again"


def test_a_satellite_flies_again_after_the_configured_duration_and_a_testbed_ends() -> None:
    assert "Restart=always\n" in dropin(ROOT / "config" / "board_orbit.yaml")
    assert "Restart=" not in dropin(TESTBED)


def test_the_watchdog_timeout_is_at_least_four_feeding_periods() -> None:
    text = (DEPLOY / "knightcube.service").read_text(encoding="utf-8")
    (seconds,) = re.findall(r"^WatchdogSec=(\d+)$", text, re.MULTILINE)
    assert float(seconds) >= 4 * 0.25, "fed four times a second"


def test_the_link_is_watched_restarted_and_does_not_wait_for_the_flight() -> None:
    """A flight that waits at its start is not active.

    If systemd ordered the link after the flight, the link would not start during this wait.
    """
    text = (DEPLOY / "knightcube-link.service").read_text(encoding="utf-8")
    for line in ("Type=notify", "NotifyAccess=main", "Restart=always"):
        assert f"{line}\n" in text
    assert "RestartPreventExitStatus" not in text, "the previous release may accept the configuration"
    (seconds,) = re.findall(r"^WatchdogSec=(\d+)$", text, re.MULTILINE)
    assert float(seconds) >= 20, "fed once a second, or after each frame that a slow disk stores"
    assert "StartLimitIntervalSec=0\n" in text
    assert "After=" not in text


def test_the_dropin_names_the_devices_and_nothing_of_a_network() -> None:
    text = dropin(TESTBED)
    assert "DeviceAllow=/dev/i2c-1 rw\n" in text
    assert "DeviceAllow=/dev/knightcube-imu rw\n" in text
    assert "AF_INET" not in text
    assert "video" not in text


def test_a_configuration_that_extends_another_is_refused_for_a_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.yaml"
    path.write_text("extends: testbed\n", encoding="utf-8")
    assert board_dropin.main([str(path)]) == 2
    words = capsys.readouterr().err
    assert f"install: {path}: `extends` cannot be used on a board" in words
    assert "knightcube check FILE --merged NEW" in words
    assert board_dropin.main([str(TESTBED)]) == 0


@needs_systemd
def test_the_flight_waits_for_the_device_that_udev_names() -> None:
    words = ["systemd-escape", "--path", "--suffix=device", "/dev/knightcube-imu"]
    unit = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    text = dropin(TESTBED)
    assert f"Wants={unit}\nAfter={unit}\n" in text


@needs_systemd
@pytest.mark.parametrize("path", ["/dev/i2c-1", "/dev/knightcube-camera", "/dev/v4l/by-id/a b+c.d:0"])
def test_a_devices_unit_is_named_as_systemd_does_it(path: str) -> None:
    words = ["systemd-escape", "--path", "--suffix=device", path]
    assert (
        board_dropin.device_unit(path)
        == subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    )


def test_the_flight_waits_for_the_units_of_bus_and_camera_too(tmp_path: Path) -> None:
    text = dropin(changed_testbed(tmp_path, camera=CAMERA, coils_bus="/dev/knightcube-i2c"))
    for name in ("i2c", "imu", "camera"):
        unit = rf"dev-knightcube\x2d{name}.device"
        assert f"Wants={unit}\nAfter={unit}\n" in text
    rules = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8").splitlines()
    for subsystem in ("tty", "i2c-dev", "video4linux"):
        tagged = [line for line in rules if line.startswith(f'SUBSYSTEM=="{subsystem}"') and "GROUP=" in line]
        assert tagged
        assert all('TAG+="systemd"' in line for line in tagged)


def test_simulated_devices_need_no_device_of_the_board() -> None:
    assert "Device" not in dropin(CONFIG)


@pytest.mark.parametrize(
    ("lines", "allowed"),
    [
        ("udp: '127.0.0.1:5000'", ["127.0.0.0/8"]),
        ("tcp: 'localhost:5000'", ["127.0.0.0/8"]),
        ("udp: '192.168.7.2:5000'", ["192.168.7.0/24"]),
        ("udp: '0.0.0.0:5000', peers: [192.168.7.9, 10.1.0.0/16]", ["192.168.7.9/32", "10.1.0.0/16"]),
    ],
)
def test_the_network_is_open_only_to_the_link_and_its_peers(
    tmp_path: Path, lines: str, allowed: list[str]
) -> None:
    config = changed_testbed(tmp_path, commands="{socket: /run/x}", link=f"{{keys: /k, {lines}}}")
    assert "AF_INET" not in dropin(config)
    assert "DeviceAllow" not in link_dropin(config)
    text = link_dropin(config)
    assert "RestrictAddressFamilies=AF_INET\n" in text
    assert "PrivateNetwork=no\n" in text
    assert "IPAddressDeny" not in text, "any, as the unit says, stays"
    assert re.findall("IPAddressAllow=(.*)", text) == allowed
    for unit in UNITS:
        assert "IPAddressDeny=any\n" in (DEPLOY / unit).read_text(encoding="utf-8")


def test_unprotected_udp_commands_on_a_bench_permit_loopback_only(tmp_path: Path) -> None:
    text = dropin(changed_testbed(tmp_path, commands="{udp: '127.0.0.1:5000'}"))
    assert re.findall("IPAddressAllow=(.*)", text) == ["127.0.0.0/8"]
    assert link_dropin(TESTBED) == ""


def test_the_coil_bus_may_have_a_persistent_name_in_each_unit(tmp_path: Path) -> None:
    config = changed_testbed(tmp_path, coils_bus="/dev/knightcube-i2c")
    for text in (dropin(config), safe_dropin(config)):
        assert "Environment=KNIGHTCUBE_I2C=/dev/knightcube-i2c KNIGHTCUBE_PWM=0x40\n" in text
        assert "DeviceAllow=/dev/knightcube-i2c rw\n" in text
    assert "knightcube-imu" not in safe_dropin(config)
    rules = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8")
    assert re.search(
        r'^SUBSYSTEM=="i2c-dev", ATTR\{name\}==.*SYMLINK\+="knightcube-i2c"$', rules, re.MULTILINE
    )


@pytest.mark.parametrize("bus", ["-1", "knightcube-i2c", "/dev/a b", "/dev/100%", "true", "1.5", "'1'"])
def test_a_bus_that_is_neither_number_nor_path_is_refused(tmp_path: Path, bus: str) -> None:
    """Blanks and % in a path have special meanings in units and in the file that `coils-off` reads."""
    with pytest.raises(ConfigError, match=r"`coils\.bus`"):
        dropin(changed_testbed(tmp_path, coils_bus=bus))


def test_the_flight_opens_the_bus_by_its_persistent_name(tmp_path: Path) -> None:
    config = changed_testbed(tmp_path, coils_bus="/dev/knightcube-nowhere")
    with pytest.raises(NotResponding, match="/dev/knightcube-nowhere: no such bus"):
        fly(RunRequest(config, tmp_path / "run"))


def board(folder: Path, below: str) -> Path:
    """Return a folder with a /proc and a /sys of a board on which /dev/null appears as a serial device.

    The device has the numbers 1:3 of /dev/null, and its folder is `below` in sys/devices.
    """
    (folder / "proc").mkdir(exist_ok=True)
    (folder / "proc/devices").write_text(
        "Character devices:\n  1 ttyUSB\n  4 tty\n\nBlock devices:\n  1 ramdisk\n", encoding="ascii"
    )
    place = folder / "sys/devices" / below
    place.mkdir(parents=True)
    (folder / "sys/dev/char").mkdir(parents=True, exist_ok=True)
    number = folder / "sys/dev/char/1:3"
    number.unlink(missing_ok=True)
    number.symlink_to(place)
    return folder


def test_a_usb_device_is_permitted_with_any_device_number(tmp_path: Path) -> None:
    """`DeviceAllow` with a file permits only the device number of this file at the start of the unit.

    `DeviceAllow` with a class, such as char-ttyUSB, permits all devices of a driver.
    """
    node = "DeviceAllow=/dev/null rw"
    usb = board(tmp_path, "pci0000:00/0000:00:14.0/usb1/1-3/1-3:1.0/ttyUSB0/tty/ttyUSB0")
    assert board_dropin.allowed("/dev/null", (), usb) == [node, "DeviceAllow=char-ttyUSB rw"]
    fixed = board(tmp_path, "pci0000:00/0000:00:1e.0/tty/ttyS4")
    assert board_dropin.allowed("/dev/null", board_dropin.SERIAL, fixed) == [node]


def test_the_link_sees_only_its_line_unless_the_device_of_the_line_is_pluggable(
    tmp_path: Path,
) -> None:
    config = changed_testbed(tmp_path, commands="{socket: /run/x}", link=LINK)
    usb = board(tmp_path, "pci0000:00/0000:00:14.0/usb1/1-3/1-3:1.0/ttyUSB0/tty/ttyUSB0")
    assert "PrivateDevices" not in link_dropin(config, usb)
    soldered = link_dropin(config, board(tmp_path, "pci0000:00/0000:00:1e.0/tty/ttyS4"))
    assert "DeviceAllow=/dev/null rw\nPrivateDevices=yes\nBindPaths=/dev/null\n" in soldered


def test_a_serial_line_whose_name_has_a_colon_is_not_bound_as_two_paths(tmp_path: Path) -> None:
    line = tmp_path / "pci-0000:00:1e.0"
    line.symlink_to("/dev/null")
    made = changed_testbed(tmp_path, commands="{socket: /run/x}", link=LINK.replace("/dev/null", f"'{line}'"))
    text = link_dropin(made, board(tmp_path, "pci0000:00/0000:00:1e.0/tty/ttyS4"))
    assert f"DeviceAllow={line} rw\n" in text
    assert "BindPaths" not in text
    assert "PrivateDevices" not in text, "a private /dev without the line has no radio"


def test_absent_devices_are_permitted_by_their_possible_classes(tmp_path: Path) -> None:
    text = dropin(changed_testbed(tmp_path, camera=CAMERA))
    for name in ("ttyUSB", "ttyACM", "video4linux"):
        assert f"DeviceAllow=char-{name} rw\n" in text
    assert "char-i2c" not in text, "the memory's and the monitor's buses are none of its business"


@pytest.mark.parametrize(
    ("device", "allowed"),
    [
        ("{driver: v4l2, path: /dev/knightcube-camera, pixel_format: Y16}", "/dev/knightcube-camera"),
        ("{driver: aravis, name: Some-1, pixel_format: Mono16}", "char-usb_device"),
    ],
)
def test_the_dropin_permits_the_configured_camera(tmp_path: Path, device: str, allowed: str) -> None:
    config = changed_testbed(tmp_path, camera=f"{{device: {device}}}")
    assert f"DeviceAllow={allowed} rw\n" in dropin(config)


def test_a_wrong_configuration_is_one_line_and_status_2(tmp_path: Path) -> None:
    config = tmp_path / "flight.yaml"
    config.write_text("name: [", encoding="utf-8")
    words = [sys.executable, str(DEPLOY / "board_dropin.py"), str(config)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2
    assert done.stderr.startswith("install: ")
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is missing")
def test_shellcheck_is_silent() -> None:
    words = ["shellcheck", *(str(DEPLOY / name) for name in ("install.sh", "coils-off", "fly"))]
    assert subprocess.run(words, capture_output=True, text=True, check=False).stdout == ""


def test_every_udev_rule_consists_of_matches_and_assignments() -> None:
    rules = (DEPLOY / "99-knightcube.rules").read_text(encoding="utf-8").splitlines()
    term = re.compile(r'[A-Z_]+(\{[^}]+\})?(==|!=|=|\+=)"[^"]*"')
    lines = [line for line in rules if line and not line.startswith("# ")]
    assert any("ef0500" in line and 'GROUP="video"' in line for line in lines), "USB3 Vision"
    assert {name for line in lines for name in re.findall(r"knightcube-\w+", line)} == {
        "knightcube-imu", "knightcube-i2c", "knightcube-camera", "knightcube-gps", "knightcube-wide"
    }  # fmt: skip
    for line in lines:
        assert all(term.fullmatch(part) for part in line.removeprefix("#").split(", ")), line
