"""Detects stalled rate groups and workers, and connects the flight to its external supervisors.

A rate group is stalled when no cycle has completed within its time limit; a worker, when a job has been
running for longer than its time limit. The watchdog is fed only while none is stalled. Jobs on tickers are
only reported: a slow disk or a hung bus may delay them, which a restart would not cure.

The external supervisors are the guardian of the coils and the service manager. The loop calls `beat` at the
end of every control cycle without an error, and `feed` while nothing is stalled. A running loop does not
prove that commands reach the coils: heartbeats are passed on only while the coil driver's job runs. The first
heartbeat also reports READY: the devices are open and the loop runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flight.link import events
from flight.link.events import EventKind
from flight.link.telemetry.log import Recorder
from flight.loop.executive.executive import RateGroup
from flight.loop.fdir.facts import EventLog
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import Clock, Ticker

_PERIODS = 3
_SHORTEST_LIMIT_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class WorkerWatch:
    """A worker by name; `busy_since_ns` returns since when a job has been running, None when none is."""

    name: str
    busy_since_ns: Callable[[], int | None]
    limit_ns: int


class _GroupWatch:
    def __init__(self, group: RateGroup) -> None:
        self.group = group
        self.limit_ns = max(_PERIODS * group.period_ns, _SHORTEST_LIMIT_NS)
        self._completed = group.completed
        self.since_ns = 0

    def is_stalled(self, now_ns: int) -> bool:
        if self.group.completed != self._completed:
            self._completed, self.since_ns = self.group.completed, now_ns
        return now_ns - self.since_ns > self.limit_ns


class GroupsAndWorkers:
    """Watches rate groups and workers."""

    def __init__(self, groups: list[RateGroup], workers: list[WorkerWatch]) -> None:
        self._groups = [_GroupWatch(group) for group in groups]
        self._workers = workers

    def begin(self, time_ns: int) -> None:
        """Count from here."""
        for watch in self._groups:
            watch.since_ns = time_ns

    def stalled(self, now_ns: int) -> list[str]:
        """Return the names of the stalled groups and workers."""
        names = [watch.group.name for watch in self._groups if watch.is_stalled(now_ns)]
        for worker in self._workers:
            since_ns = worker.busy_since_ns()
            if since_ns is not None and now_ns - since_ns > worker.limit_ns:
                names.append(worker.name)
        return names


def failing(tickers: Sequence[Ticker], now_ns: int) -> list[str]:
    """Return a text for each job outside the loop that raises or is stalled."""
    problems = []
    for ticker in tickers:
        stood_ns = now_ns - ticker.served_ns
        if ticker.error:
            problems.append(f"{ticker.name}: {ticker.error}")
        elif stood_ns > max(_PERIODS * ticker.period_ns, _SHORTEST_LIMIT_NS):
            problems.append(f"{ticker.name}: stands still for {stood_ns * 1e-9:.1f} s")
    return problems


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
