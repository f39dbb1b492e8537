"""The exceptions of the hardware layer; each carries its facts as attributes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager


class DeviceError(Exception):
    """A device failed to do what was requested."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message


class NotResponding(DeviceError):
    """No answer: no acknowledge, no bytes, a closed port, a bus that hangs."""


@contextmanager
def answering(device: str) -> Iterator[None]:
    """Raise NotResponding of a device for an OSError of its bus."""
    try:
        yield
    except OSError as error:
        raise NotResponding(device, f"{error.strerror}; check its power, wiring and address") from error


class CorruptData(DeviceError):
    """An answer that the protocol does not allow."""


class Refused(DeviceError):
    """The device refused: an error answer, or a register that does not keep the value."""


class OutOfRange(DeviceError):
    """A command or a reading is outside the range of the device or of physics."""

    def __init__(self, device: str, quantity: str, value: float, low: float, high: float, unit: str) -> None:
        super().__init__(device, f"{quantity} = {value!r} {unit} is outside {low!r} .. {high!r} {unit}")
        self.quantity = quantity
        self.value = value
        self.low = low
        self.high = high
        self.unit = unit


def check_limits(device: str, holder: object, limits: Mapping[str, tuple[float, float, str]]) -> None:
    """Raise OutOfRange for an attribute of `holder` that is not within its (low, high, unit); NaN is not."""
    for name, (low, high, unit) in limits.items():
        value = getattr(holder, name)
        if not low <= value <= high:
            raise OutOfRange(device, name, value, low, high, unit)
