"""Exceptions of the hardware layer, with device, quantity and values as attributes."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any


class DeviceError(Exception):
    """Raised if a device fails to execute a request."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device
        self.message = message

    def __reduce__(self) -> tuple[Any, ...]:
        """Return pickling data without a call of `__init__`, because `args` lacks its arguments."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class NotResponding(DeviceError):
    """Raised if a device does not answer, for example because a port is closed or a bus hangs."""


class OutputFull(NotResponding):
    """Raised if the output queue of a port remains full; `written` is the number of bytes already queued."""

    def __init__(self, device: str, written: int) -> None:
        super().__init__(device, "writing failed (the output queue is full): is the device still there?")
        self.written = written


class _Answering:
    """Context manager of `answering`; a class, because a generator would be several times as slow."""

    __slots__ = ("_device",)

    def __init__(self, device: str) -> None:
        self._device = device

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, OSError):
            text = f"{error.strerror}; check its power, wiring and address"
            raise NotResponding(self._device, text) from error


def answering(device: str) -> _Answering:
    """Return a context manager that converts an OSError of the bus into NotResponding of the device."""
    return _Answering(device)


class CorruptData(DeviceError):
    """Raised for an answer that the protocol of the device does not allow."""


class Refused(DeviceError):
    """Raised if a device answers with an error, or if a register does not keep a written value."""


class OutOfRange(DeviceError):
    """Raised for a command or reading that exceeds the range of the device or is physically impossible."""

    def __init__(
        self, device: str, quantity: str, value: float, low: float, high: float, unit: str, cure: str = ""
    ) -> None:
        problem = f"{quantity} = {value!r} is outside {low!r} to {high!r} {unit}".rstrip()
        super().__init__(device, f"{problem}: {cure}" if cure else problem)
        self.quantity = quantity
        self.value = value
        self.low = low
        self.high = high
        self.unit = unit


def check_limits(device: str, holder: object, limits: Mapping[str, tuple[float, float, str]]) -> None:
    """Raise OutOfRange for an attribute of `holder` that is NaN or outside its `limits` (low, high, unit)."""
    for name, (low, high, unit) in limits.items():
        value = getattr(holder, name)
        if not low <= value <= high:
            raise OutOfRange(device, name, value, low, high, unit)
