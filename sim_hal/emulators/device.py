"""The interface of emulated devices: each acts at its own event times."""

from __future__ import annotations

from typing import Protocol

NEVER = 1 << 62
"""Later than any instant of any run (146 years), in ns."""


class EmulatedDevice(Protocol):
    """A device on the simulation's time line."""

    def next_event_ns(self) -> int:
        """Return the time of its next event; NEVER without one."""

    def advance(self, now_ns: int) -> None:
        """Process all events due at or before `now_ns`, in order, each at its own time."""


class SerialEnd(Protocol):
    """The device's end of a serial line."""

    baud_rate: int

    def write(self, data: bytes, now_ns: int) -> None:
        """Send bytes from `now_ns` on, after any that wait."""

    def read(self, now_ns: int) -> bytes:
        """Return unread bytes from the host that have arrived by `now_ns`."""

    def next_arrival_ns(self) -> int:
        """Return when bytes from the host next arrive; NEVER if none are under way."""
