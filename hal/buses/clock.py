"""System clock: absolute monotonic deadlines, and periodic jobs that each run in a separate thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # hal.interfaces.wires imports numpy, which the guardian must not load
    from hal.interfaces.wires import Ticker


class ContainedJob:
    """Job whose exceptions are stored as text instead of being raised.

    Attributes:
        name: name of the job.
        error: exception of the last run as text, or an empty text if the run completed.
        served_ns: time (ns) at which a run last succeeded, initially the time of creation.
    """

    def __init__(self, name: str, job: Callable[[], None], now_ns: Callable[[], int]) -> None:
        self.name = name
        self.error = ""
        self.served_ns = now_ns()
        self._job = job
        self._now_ns = now_ns

    def run(self) -> None:
        """Run the job once. Never raises."""
        try:
            self._job()
        except Exception as error:  # noqa: BLE001 - containment boundary: the ticker
            self.error = f"{type(error).__name__}: {error}"
        else:
            self.error = ""
            self.served_ns = self._now_ns()


class SystemClock:
    """Clock based on CLOCK_MONOTONIC of the operating system.

    Attributes:
        tickers: running tickers in the order of their creation.
    """

    def __init__(self) -> None:
        self.tickers: list[Ticker] = []

    def now_ns(self) -> int:
        """Return the monotonic time, ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until an absolute deadline, ns.

        CPython resumes a sleep that was interrupted by a signal. The conversion to seconds (float) can end
        the sleep a few ns early, so the sleep is repeated until the deadline has passed.
        """
        while (left := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns` in a new daemon thread."""
        made = ThreadTicker(self, name, period_ns, job)
        self.tickers.append(made)
        return made

    def utc_ns(self) -> int:
        """Return UTC in ns since 1970."""
        return time.time_ns()


class ThreadTicker(ContainedJob):
    """Daemon thread that runs a job once per period and at each call of `kick`, also after failed runs."""

    def __init__(self, clock: SystemClock, name: str, period_ns: int, job: Callable[[], None]) -> None:
        super().__init__(name, job, clock.now_ns)
        self.period_ns = period_ns
        self._clock = clock
        self._wake = threading.Event()
        self._stopped = False
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def kick(self) -> None:
        """Run the job as soon as possible."""
        self._wake.set()

    def stop(self) -> None:
        """Wait until the current run has finished, and end the thread."""
        self._stopped = True
        self._wake.set()
        if self in self._clock.tickers:
            self._clock.tickers.remove(self)
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2.0)

    def _serve(self) -> None:
        due_ns = self._clock.now_ns() + self.period_ns
        while not self._stopped:
            kicked = self._wake.wait(max(0, due_ns - self._clock.now_ns()) * 1e-9)
            self._wake.clear()
            # Periods are counted from the start of a run, so that the job's duration does not lower the rate.
            now_ns = self._clock.now_ns()
            due_ns = now_ns + self.period_ns if kicked else max(now_ns, due_ns + self.period_ns)
            if not self._stopped:
                self.run()
