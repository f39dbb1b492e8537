"""Fixtures of one rig with two buses: an emulated bus in memory, and smbus2 with replaced ioctls."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hal.buses.linux_wires import LinuxI2cBus
from tests.hal.coils.ioctl_wire import IoctlWire
from tests.hal.coils.rig import THESIS, Rig, Wire
from tests.manual_clock import ManualClock


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> IoctlWire:
    """Replace the kernel's I2C interface by an emulated bus.

    With this replacement, every file that can be opened acts as an I2C adapter.
    """
    wire = Wire(ManualClock(), THESIS, uncertainty=0.0)
    return _replace_ioctl(monkeypatch, wire)


@pytest.fixture(params=["emulated", "smbus2"])
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    """Return a rig on each of the two buses. The coils are not started."""
    if request.param == "emulated":
        yield Rig()
        return
    clock = ManualClock()
    wire = Wire(clock, THESIS, uncertainty=0.0)
    _replace_ioctl(monkeypatch, wire)
    bus = LinuxI2cBus("/dev/null")
    yield Rig(wire=wire, clock=clock, bus=bus)
    bus.close()


def _replace_ioctl(monkeypatch: pytest.MonkeyPatch, wire: Wire) -> IoctlWire:
    kernel = IoctlWire(wire.bus)
    monkeypatch.setattr("smbus2.smbus2.ioctl", kernel)
    monkeypatch.setattr("hal.buses.linux_wires.ioctl", kernel)
    return kernel
