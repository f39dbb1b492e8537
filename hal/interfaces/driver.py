"""The registration of a device driver, by which the flight application finds everything about a device.

A configuration names a registration by the key `driver` of the device's section, either by a built-in name
(`flight.schema.drivers`) or as `module:object` of a package outside this repository.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from hal.interfaces.wires import Rig


def nothing(_: Any) -> tuple[()]:
    """Return an empty tuple, for any section."""
    return ()


def later(named: str) -> Callable[..., Any]:
    """Return a function that imports the function `module:function` at its first call, and calls it.

    An emulator is registered in this way, so that a board does not load the simulator.
    """
    module, _, function = named.partition(":")

    def call(*arguments: Any) -> Any:
        return getattr(importlib.import_module(module), function)(*arguments)

    return call


@dataclass(frozen=True, slots=True)
class Driver:
    """Registration of a device driver.

    Attributes:
        kind: section of the configuration, such as `inertial_unit`; `camera` also serves `wide_cameras`.
        section: type of the section, which adds the driver's own keys to those of the kind's base section.
        open: function that takes the rig and the section, and returns the driver (`hal.interfaces.devices`).
            The driver of the coils must be passive until its method `start` is called.
        probe: function that takes a rig and the section, asks the device for a sign of life without changing
            its state, and returns the answer as text. It raises DeviceError without an answer.
        emulate: function that takes a `sim_hal.emulation.Emulation` and the section, connects an emulated
            device to the emulated wires, and returns the device. A camera needs none, because the simulator
            emulates the cameras of all drivers. Without an emulator, another device flies on hardware only.
        files: function that returns the device files that the section names.
        check: function that raises OutOfRange for a section that the driver does not accept.
        off: for coils, function that returns the I2C writes (address, register, value) that switch all coils
            off in any state of the chips. The guardian executes them if the flight process fails.
    """

    kind: str
    section: type[Any]
    open: Callable[[Rig, Any], Any]
    probe: Callable[[Rig, Any], str]
    emulate: Callable[[Any, Any], Any] | None = None
    files: Callable[[Any], Sequence[str]] = nothing
    check: Callable[[Any], object] = nothing
    off: Callable[[Any], Sequence[tuple[int, int, int]]] = nothing
