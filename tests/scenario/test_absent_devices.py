"""Tests that a board waits in BOOT with zero coil current until all its devices are present."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from flight.app.devices import open_devices
from flight.link.events import Mode
from hal.interfaces.errors import NotResponding
from sim_hal.emulators.serial_line import SOUND, LineFaults
from sim_hal.rig import LockStep, opened_lockstep
from tests.support.flights import Rigged, demo_config, demo_world, event_names, fly

DEVICES = ("imu", "pwm")
EVENTS = {"imu": "imu-silent", "pwm": "coil-fault"}


def take_away(lock: LockStep, device: str) -> None:
    if device == "imu":
        lock.line.to_host.faults = LineFaults(silent=True)
    else:
        lock.hardware.bus.nack(demo_config(1.0).coils.address, times=None)


def give_back(lock: LockStep, device: str) -> None:
    if device == "imu":
        lock.line.to_host.faults = SOUND
    else:
        lock.hardware.bus.clear_faults()


@pytest.mark.parametrize("device", DEVICES)
def test_an_absent_device_is_awaited_in_boot_and_used_when_it_appears(tmp_path: Path, device: str) -> None:
    def prepare(rigged: Rigged) -> None:
        rigged.at(4.0, lambda: give_back(rigged.lock, device))

    config = demo_config(12.0, camera=False)
    run = fly(config, tmp_path, prepare, absent=lambda lock: take_away(lock, device))
    assert EVENTS[device] in event_names(run)
    modes, times = run["mode"]["mode"].tolist(), run["mode"]["time_ns"] * 1e-9
    assert modes == [Mode.BOOT, Mode.TESTBED_DEMO]
    assert 4.0 <= times[1] <= 6.0, "within two seconds"
    truth = run["truth"]
    current = np.abs(truth["current"]).max(axis=1)
    assert not current[truth["time_ns"] < 4_000_000_000].any()
    assert current.any()


@pytest.mark.parametrize("device", DEVICES)
def test_an_absent_device_is_an_error_at_once_on_a_bench(tmp_path: Path, device: str) -> None:
    config = demo_config(1.0, camera=False)
    with ExitStack() as stack, opened_lockstep(config, demo_world(), tmp_path) as lock:
        take_away(lock, device)
        rig = lock.rig()
        with pytest.raises(NotResponding):
            open_devices(config, rig, stack, patient=False)
