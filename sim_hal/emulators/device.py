"""What every emulated device has in common: it acts at instants of its own, and on time only."""

from __future__ import annotations

from typing import Protocol

NEVER = 1 << 62
"""Later than any instant of any run (146 years), in ns."""


class EmulatedDevice(Protocol):
    """A device on the simulation's time line."""

    def next_event_ns(self) -> int:
        """Return when it next does something by itself; NEVER if nothing is to come."""

    def advance(self, now_ns: int) -> None:
        """Do all that is due at or before `now_ns`, in order, each thing at its own time."""


class SerialEnd(Protocol):
    """The device's end of a serial line."""

    baud_rate: int

    def write(self, data: bytes, now_ns: int) -> None:
        """Start to send bytes at `now_ns`, or when those before them have gone."""

    def read(self, now_ns: int) -> bytes:
        """Return what has crossed from the host by `now_ns` and was not read yet."""

    def next_arrival_ns(self) -> int:
        """Return when bytes from the host will next be there; NEVER if none are on their way."""
