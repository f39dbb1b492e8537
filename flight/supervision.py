"""Who watches the flight from outside: the guardian of the coils and the service manager.

The loop calls `beat` at the end of every control cycle that ran well, and `feed` while everything makes
progress. READY is said after the first such cycle: the devices are open and the loop turns.
"""

from __future__ import annotations

from flight import events
from flight.events import EventKind
from flight.telemetry.recorder import Recorder
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import Clock

_EVENTS = {
    GuardianNews.LOST: events.GUARDIAN_LOST,
    GuardianNews.READY: events.GUARDIAN_READY,
    GuardianNews.ACTED: events.GUARDIAN_ACTED,
    GuardianNews.FAILED: events.GUARDIAN_BLIND,
}


class Supervision:
    """Passes the loop's signs of life on; tells what becomes of the guardian as events."""

    def __init__(
        self,
        guardian: CoilGuardian,
        overseer: Overseer,
        clock: Clock,
        recorder: Recorder,
        status: str,
    ) -> None:
        """Take who watches; `status` is what people are shown once the flight is ready."""
        self._guardian = guardian
        self._overseer = overseer
        self._clock = clock
        self._recorder = recorder
        self._status = status
        self._ready = False
        self._notes: list[tuple[EventKind, str]] = []

    def note(self, kind: EventKind, text: str) -> None:
        """Have an event of the start told once the flight has begun."""
        self._notes.append((kind, text))

    def beat(self) -> None:
        """Pass a heartbeat on; never waits."""
        self._guardian.beat()
        if not self._ready:
            self._ready = True
            self._overseer.ready(self._status)

    def feed(self) -> None:
        """Feed the watchdog and look after the guardian."""
        self._overseer.feed_watchdog()
        now_ns = self._clock.now_ns()
        notes = self._notes + [(_EVENTS[news], news.value) for news in self._guardian.tend(now_ns)]
        self._notes.clear()
        for kind, text in notes:
            self._recorder.event(kind, now_ns, 0, text)
