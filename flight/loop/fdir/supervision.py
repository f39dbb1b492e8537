"""Connects the flight to its external supervisors: the guardian of the coils and the service manager.

The loop calls `beat` at the end of every control cycle without an error, and `feed` while nothing is stalled.
A running loop does not prove that commands reach the coils: heartbeats are passed on only while the coil
driver's job runs. The first heartbeat also reports READY: the devices are open and the loop runs.
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
"""Of the supervision's events: a guardian is replaced at most once per second."""
_UNSERVED_NS = 150_000_000
"""After this time without a run of the coil driver's job (three periods) the guardian should act."""

_EVENTS = {
    GuardianNews.LOST: events.GUARDIAN_LOST,
    GuardianNews.READY: events.GUARDIAN_READY,
    GuardianNews.ACTED: events.GUARDIAN_ACTED,
    GuardianNews.FAILED: events.GUARDIAN_BLIND,
}


def _nothing() -> None:
    """No-op."""


class Supervision:
    """Passes heartbeats on; reports the guardian's state changes as events."""

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
        """Take the supervisors; `status` is shown to people once ready, `coils` is the coil driver's job.

        `settle` is called once, before READY is reported: all parts of the flight exist by then.
        """
        self._guardian = guardian
        self._overseer = overseer
        self._clock = clock
        # A log of its own: events occur before there is a loop, and none of them needs a reaction.
        self._events = EventLog(recorder.event, _THROTTLE_NS)
        self._status = status
        self._coils = coils
        self._settle = settle
        self._ready = False
        self._notes: list[tuple[EventKind, str]] = []

    def note(self, kind: EventKind, text: str) -> None:
        """Keep an event of the start, to be reported once the flight has begun."""
        self._notes.append((kind, text))

    def beat(self) -> None:
        """Pass a heartbeat on, unless the coil driver's job is stalled; never waits."""
        if self._clock.now_ns() - self._coils.served_ns > _UNSERVED_NS:
            return
        self._guardian.beat()
        if not self._ready:
            self._ready = True
            self._settle()
            self._overseer.ready(self._status)

    def close(self) -> None:
        """Write the events that are still held back."""
        self._events.flush(self._clock.now_ns())

    def feed(self) -> None:
        """Feed the watchdog; restart the guardian if needed and report its state changes."""
        self._overseer.feed_watchdog()
        now_ns = self._clock.now_ns()
        notes = self._notes + [(_EVENTS[news], news.value) for news in self._guardian.tend(now_ns)]
        self._notes.clear()
        for kind, text in notes:
            self._events.report(kind, now_ns, text)
