"""Detects stalled rate groups and workers: the watchdog is fed only while none is stalled.

A rate group is stalled when no cycle has completed within its patience; a worker, when a job has been running
for longer than its patience. Jobs on tickers are only reported: a slow disk or a hung bus may delay them,
which a restart would not cure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flight.loop.executive.rate_group import RateGroup
from hal.interfaces.wires import Ticker

_PERIODS = 3
_LEAST_PATIENCE_NS = 2_000_000_000


@dataclass(frozen=True, slots=True)
class WorkerWatch:
    """A worker by name; `busy_since_ns` returns since when a job has been running, None when none is."""

    name: str
    busy_since_ns: Callable[[], int | None]
    patience_ns: int


class _GroupWatch:
    def __init__(self, group: RateGroup) -> None:
        self.group = group
        self.patience_ns = max(_PERIODS * group.period_ns, _LEAST_PATIENCE_NS)
        self._completed = group.completed
        self.since_ns = 0

    def is_stalled(self, now_ns: int) -> bool:
        if self.group.completed != self._completed:
            self._completed, self.since_ns = self.group.completed, now_ns
        return now_ns - self.since_ns > self.patience_ns


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
            if since_ns is not None and now_ns - since_ns > worker.patience_ns:
                names.append(worker.name)
        return names


def failing(tickers: Sequence[Ticker], now_ns: int) -> list[str]:
    """Return a text for each job outside the loop that raises or is stalled."""
    problems = []
    for ticker in tickers:
        stood_ns = now_ns - ticker.served_ns
        if ticker.error:
            problems.append(f"{ticker.name}: {ticker.error}")
        elif stood_ns > max(_PERIODS * ticker.period_ns, _LEAST_PATIENCE_NS):
            problems.append(f"{ticker.name}: stands still for {stood_ns * 1e-9:.1f} s")
    return problems
