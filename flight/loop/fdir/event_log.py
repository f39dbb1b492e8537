"""Writes events to the flight log, throttled by kind, and triggers their reactions.

The first event of a kind is written at once, then at most one every `THROTTLE_NS`, with the number held back:
a fault at 40 Hz writes one event every few seconds, not forty a second.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from flight.link.events import EVENTS, EventKind, Reaction

THROTTLE_NS = 5_000_000_000

Sink = Callable[[EventKind, int, int, str], None]
"""Writes an event: kind, time in ns, how many of its kind were held back before it, text."""

Reactor = Callable[[EventKind, int, str], None]
"""Carries out the reaction of an event: kind, time in ns, text."""


class EventLog:
    """Passes events to a sink, throttled by kind; `count` and `counts`, by kind, include those held back."""

    def __init__(self, sink: Sink, throttle_ns: int = THROTTLE_NS) -> None:
        self._sink = sink
        self._react: Reactor | None = None
        self._throttle_ns = throttle_ns
        self._last_written: dict[int, int] = {}
        self._held_back: dict[int, int] = {}
        self.count = 0
        self.counts: Counter[EventKind] = Counter()

    def react_by(self, react: Reactor) -> None:
        """Call `react` for every event whose reaction is more than a note, throttled or not."""
        self._react = react

    def report(self, kind: EventKind, time_ns: int, text: str) -> None:
        """Write an event, or count it if one of its kind was written less than a throttle ago; then react."""
        self._write(kind, time_ns, text)
        if self._react is not None and kind.reaction is not Reaction.NOTE:
            self._react(kind, time_ns, text)

    def _write(self, kind: EventKind, time_ns: int, text: str) -> None:
        self.count += 1
        self.counts[kind] += 1
        last_ns = self._last_written.get(kind.code)
        if last_ns is not None and time_ns - last_ns < self._throttle_ns:
            self._held_back[kind.code] = self._held_back.get(kind.code, 0) + 1
            return
        self._last_written[kind.code] = time_ns
        self._sink(kind, time_ns, self._held_back.pop(kind.code, 0), text)

    def flush(self, time_ns: int) -> None:
        """Write the events that are still held back, at the end."""
        by_code = {kind.code: kind for kind in EVENTS}
        for code, held_back in list(self._held_back.items()):
            self._sink(by_code[code], time_ns, held_back - 1, "the last one held back by the throttle")
        self._held_back.clear()
