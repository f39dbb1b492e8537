"""The exceptions of the hardware layer; each carries its facts as attributes."""

from __future__ import annotations


class DeviceError(Exception):
    """A device could not do what was asked of it."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message


class NotResponding(DeviceError):
    """Nothing came back: no acknowledge, no bytes, a closed port, a bus that hangs."""


class CorruptData(DeviceError):
    """Something came back, but not what the protocol allows."""


class Refused(DeviceError):
    """The device understood and said no (an error answer, a register that will not take the value)."""


class OutOfRange(DeviceError):
    """A command or a reading lies outside what the device can do or the world allows."""

    def __init__(self, device: str, quantity: str, value: float, low: float, high: float, unit: str) -> None:
        super().__init__(device, f"{quantity} = {value!r} {unit} is outside {low!r} .. {high!r} {unit}")
        self.quantity = quantity
        self.value = value
        self.low = low
        self.high = high
        self.unit = unit
