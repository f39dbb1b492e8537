"""A clock that stands still until it is moved; jobs run in turn as their time comes."""

from __future__ import annotations

from collections.abc import Callable


class ManualTicker:
    """A job on a ManualClock; a kick runs it on the spot and starts its period again."""

    def __init__(self, clock: ManualClock, period_ns: int, job: Callable[[], None]) -> None:
        self.due_ns = clock.now_ns() + period_ns
        self._clock = clock
        self._period_ns = period_ns
        self._job = job
        self._busy = False

    def kick(self) -> None:
        """Run the job now, unless it is the job itself that asks."""
        self.due_ns = self._clock.now_ns() + self._period_ns
        if not self._busy:
            self._busy = True
            try:
                self._job()
            finally:
                self._busy = False

    def stop(self) -> None:
        """Run no more. Safe to call twice."""
        if self in self._clock.tickers:
            self._clock.tickers.remove(self)


class ManualClock:
    """A hal.interfaces.wires.Clock: sleeping moves it, and so does `advance`."""

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns
        self.tickers: list[ManualTicker] = []

    def now_ns(self) -> int:
        """Return the time."""
        return self._now_ns

    def advance(self, span_ns: int) -> None:
        """Let a span pass, running every job that falls due in it."""
        self.sleep_until_ns(self._now_ns + span_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Move to the deadline, stopping at each job that is due on the way."""
        while due := [ticker for ticker in self.tickers if ticker.due_ns <= deadline_ns]:
            first = min(due, key=lambda ticker: ticker.due_ns)
            self._now_ns = max(self._now_ns, first.due_ns)
            first.kick()
        self._now_ns = max(self._now_ns, deadline_ns)

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> ManualTicker:
        """Run `job` every `period_ns`, the first time one period from now."""
        made = ManualTicker(self, period_ns, job)
        self.tickers.append(made)
        return made

    def utc_ns(self) -> int:
        """Return a label: the clock's own time, counted from 1970."""
        return self._now_ns
