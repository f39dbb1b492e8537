"""Who watches the flight from outside: the guardian of the coils and the service manager.

The loop calls `beat` at the end of every control cycle that ran well, and `feed` while everything makes
progress. A loop that turns is no sign that its commands reach the coils: the heartbeat is passed on only
while the coils' own job gets on. READY is said with the first: the devices are open and the loop turns.
"""

from __future__ import annotations

from collections.abc import Callable

from flight.link import events
from flight.link.events import EventKind
from flight.link.telemetry.recorder import Recorder
from flight.loop.fdir.event_log import EventLog
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import Clock, Ticker

_THROTTLE_NS = 1_000_000_000
"""Of its events: as often as a guardian is replaced at most."""
_UNSERVED_NS = 150_000_000
"""Without a run of the coils' job for so long the guardian should act: three of its periods."""

_EVENTS = {
    GuardianNews.LOST: events.GUARDIAN_LOST,
    GuardianNews.READY: events.GUARDIAN_READY,
    GuardianNews.ACTED: events.GUARDIAN_ACTED,
    GuardianNews.FAILED: events.GUARDIAN_BLIND,
}


def _nothing() -> None:
    """Settle nothing."""


class Supervision:
    """Passes the loop's signs of life on; tells what becomes of the guardian as events."""

    def __init__(
        self,
        guardian: CoilGuardian,
        overseer: Overseer,
        clock: Clock,
        recorder: Recorder,
        status: str,
        coils: Ticker,
        settle: Callable[[], None] = _nothing,
    ) -> None:
        """Take who watches; `status` is what people are shown once ready, `coils` serves the coils.

        `settle` is called once, before READY is said: everything that a flight consists of is there by then.
        """
        self._guardian = guardian
        self._overseer = overseer
        self._clock = clock
        # Of its own: it tells things while there is no loop yet, and none of them asks for a reaction.
        self._events = EventLog(recorder.event, _THROTTLE_NS)
        self._status = status
        self._coils = coils
        self._settle = settle
        self._ready = False
        self._notes: list[tuple[EventKind, str]] = []

    def note(self, kind: EventKind, text: str) -> None:
        """Have an event of the start told once the flight has begun."""
        self._notes.append((kind, text))

    def beat(self) -> None:
        """Pass a heartbeat on, if the coils are served; never waits."""
        if self._clock.now_ns() - self._coils.served_ns > _UNSERVED_NS:
            return
        self._guardian.beat()
        if not self._ready:
            self._ready = True
            self._settle()
            self._overseer.ready(self._status)

    def close(self) -> None:
        """Tell what is still held back."""
        self._events.flush(self._clock.now_ns())

    def feed(self) -> None:
        """Feed the watchdog and look after the guardian."""
        self._overseer.feed_watchdog()
        now_ns = self._clock.now_ns()
        notes = self._notes + [(_EVENTS[news], news.value) for news in self._guardian.tend(now_ns)]
        self._notes.clear()
        for kind, text in notes:
            self._events.report(kind, now_ns, text)
