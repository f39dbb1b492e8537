"""Tests that the configurations of boards pass the check and fly, with emulated devices.

The flight software uses its drivers of real devices. Serial ports are pseudo-terminals. A preload library
emulates the I2C bus at /dev/i2c-N or at a name made by udev. Emulated cameras perform the ioctls of Video for
Linux and deliver rendered frames. The kernel's virtual cameras `vivid` and `v4l2loopback` are not used,
because they have no control of the exposure time, and the driver refuses a camera without this control.
`tests/hal/cameras/test_v4l2_camera.py` reads frames of `vivid` if the kernel has this module.
"""

from __future__ import annotations

import json
import os
import re
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ground.telemetry import Run
from hal.buses import smbus_byte
from sim_hal.serving.device_link import RemoteI2cBus, open_bus
from tests.deploy.board_flight import (
    WORLDS,
    board_text,
    coil_currents,
    everything_arrived,
    frames_with_rate,
    has_arrived,
    newest,
)
from tests.deploy.scripts import DEPLOY, ROOT, dropin

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not any(map(shutil.which, ("cc", "gcc", "clang"))),
        reason="no C compiler builds the preload library",
    ),
]
PATIENCE_S = 120.0
"""Timeout (s) until every device has been read on a busy machine."""
DEVICES = {
    "board_testbed": {"inertial_unit", "coils", "power_monitor", "camera", "commands.socket"},
    "board_orbit": {
        "inertial_unit", "coils", "power_monitor", "camera", "wide_cameras[0]", "wide_cameras[1]", "gps",
        "solar_strings", "commands.socket",
    },
}  # fmt: skip
"""Devices that `knightcube check` must find."""
GYRO_NOISE = 5e-4
"""Standard deviation (rad/s) of the norm of a gyro reading, rounded up."""


@dataclass(frozen=True)
class Flown:
    """Results of a flight process that was started by the unit's commands and ended by SIGTERM.

    Attributes:
        found: devices that `knightcube check` found before the flight.
        run: packets of the flight.
        driven: whether the coils carried current during the flight.
        currents: currents (A) of the coils after the flight process had ended.
        statuses: exit statuses of the unit's commands before the flight, of the flight and after it.
        said: standard output and standard error of the flight.
    """

    found: set[str]
    run: Run
    driven: bool
    currents: list[float]
    statuses: list[int]
    said: str


def unit_words(config: Path, runs: Path) -> list[str]:
    """Return the launcher's arguments in the unit's ExecStart for a configuration and an archive."""
    unit = (DEPLOY / "knightcube.service").read_text(encoding="utf-8")
    (line,) = re.findall(r"' fly (run .*)$", unit, re.MULTILINE)
    places = {"/etc/knightcube/flight.yaml": str(config), "/var/lib/knightcube/runs": str(runs)}
    return [places.get(word, word) for word in shlex.split(line)]


def unit_environment(config: Path, folder: Path, notifications: socket.socket) -> dict[str, str]:
    """Return the environment that systemd gives the unit with the drop-in of the configuration."""
    named = re.findall("^Environment=(KNIGHTCUBE_I2C.*)$", dropin(config), re.MULTILINE)
    return {
        **os.environ,
        **dict(word.partition("=")[::2] for word in shlex.split(named[0])),
        "NOTIFY_SOCKET": notifications.getsockname(),
        "WATCHDOG_USEC": "2000000",
        "STATE_DIRECTORY": str(folder),
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
    }


@contextmanager
def emulated(config: Path, name: str, folder: Path) -> Iterator[dict[str, Any]]:
    """Emulate the devices of a configuration; yield the JSON object that the emulator prints."""
    words = ["tests.deploy.emulated_board", config, ROOT / "config" / f"{WORLDS[name]}.yaml", folder]
    with subprocess.Popen(
        [sys.executable, "-m", *map(str, words)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.terminate()


def fly(name: str, folder: Path) -> Flown:
    """Start a board's configuration as the unit does, wait for its devices, and end the flight."""
    devices, runs, config = folder / "d", folder / "runs", folder / "flight.yaml"
    devices.mkdir()
    config.write_text(board_text(name, devices), encoding="utf-8")
    coils_off = [shutil.copy(DEPLOY / "coils-off", folder)]
    shutil.copy(str(smbus_byte.__file__), folder)
    with ExitStack() as stack:
        notifications = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notifications.bind(str(folder / "notify"))
        environment = unit_environment(config, folder, notifications)
        facts = stack.enter_context(emulated(config, name, devices))
        environment |= facts["environment"]
        bus = open_bus(facts["socket"])
        stack.callback(bus.close)
        before = subprocess.run(coils_off, env=environment, capture_output=True, check=False)
        words = ["tests.deploy.emulated_video", str(config), facts["socket"], "check", str(config), "--json"]
        flight = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-m", *words, "--", *unit_words(config, runs)],
                cwd=ROOT,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
        )
        stack.callback(flight.kill)
        driven = watch(flight, notifications, bus, runs, name == "board_orbit")
        flight.send_signal(signal.SIGTERM)
        said = flight.communicate(timeout=60.0)[0]
        currents = coil_currents(bus)
        after = subprocess.run(coils_off, env=environment, capture_output=True, check=False)
    checked = json.loads(said.partition("\n")[0])
    found = {device["name"] for device in checked["devices"] if device["found"]}
    statuses = [before.returncode, flight.returncode, after.returncode]
    return Flown(found, newest(runs), driven, currents, statuses, said)


def watch(
    flight: subprocess.Popen[str], notifications: socket.socket, bus: RemoteI2cBus, runs: Path, orbit: bool
) -> bool:
    """Wait until the flight is ready and every device was read; return whether the coils carried current."""
    ready = driven = False
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and flight.poll() is None:
        if select.select([notifications], [], [], 0.5)[0]:
            ready |= "READY=1" in notifications.recv(4096).decode().split("\n")
        driven |= any(coil_currents(bus))
        if ready and driven and has_arrived(runs, orbit):
            break
    return driven


@pytest.fixture(scope="module", params=list(WORLDS))
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(request.param, tmp_path_factory.mktemp("b"))


def test_check_finds_every_device(flown: Flown, request: pytest.FixtureRequest) -> None:
    name = request.node.callspec.params["flown"]
    assert flown.found == DEVICES[name]


def test_the_unit_flies_a_boards_configuration_and_ends_with_the_coils_at_zero(flown: Flown) -> None:
    assert flown.statuses == [0, 0, 0], flown.said
    assert "coils:    at zero" in flown.said
    assert flown.driven
    assert not any(flown.currents)


def test_packets_of_every_device_arrive(flown: Flown) -> None:
    imu, house = flown.run["imu"], flown.run["housekeeping"]
    seconds = (int(imu["time_ns"][-1]) - int(imu["time_ns"][0])) * 1e-9
    assert len(imu) > 20.0 * seconds, "on a busy machine, at least half of 40 readings a second"
    assert not house["imu_bad_checksum"].any()
    assert np.isfinite(house["coil_current"]).any(), "the current monitor is read"
    assert everything_arrived(flown.run, len(flown.run["fix"]) > 0), flown.said


def test_the_rates_of_the_frames_are_those_of_the_gyro(flown: Flown) -> None:
    """The rates in streak packets agree with the gyro within 4 sigma plus 2 %.

    The sign of a rate is not always known.
    """
    imu, frames = flown.run["imu"], frames_with_rate(flown.run)
    middle = frames["exposure_start_ns"] + 0.5e9 * frames["exposure"]
    gyro = np.linalg.norm([np.interp(middle, imu["time_ns"], axis) for axis in imu["rate"].T], axis=0)
    error = np.linalg.norm(frames["rate"], axis=1) - gyro
    sigma = np.sqrt(frames["covariance"][:, :3].sum(axis=1))
    assert (np.abs(error) < 4.0 * np.hypot(sigma, GYRO_NOISE) + 0.02 * gyro).all()
