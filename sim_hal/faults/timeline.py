"""Runs actions on the emulated devices at given times of the simulation."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable

from sim_hal.emulators.device import NEVER

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
