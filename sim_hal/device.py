"""The interface of emulated devices, which act at their own event times; and a queue of timed actions."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
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


Action = Callable[[], None]


class FaultTimeline:
    """The queue of such actions, as an emulated device."""

    def __init__(self) -> None:
        self._order = itertools.count()
        self._actions: list[tuple[int, int, Action]] = []

    def at(self, time_ns: int, action: Action) -> None:
        """Run `action` at `time_ns` of the simulation."""
        heapq.heappush(self._actions, (time_ns, next(self._order), action))

    def next_event_ns(self) -> int:
        """Return when the next action is due."""
        return self._actions[0][0] if self._actions else NEVER

    def advance(self, now_ns: int) -> None:
        """Run the actions that are due."""
        while self._actions and self._actions[0][0] <= now_ns:
            heapq.heappop(self._actions)[2]()
