"""Services of Linux and systemd for the flight process: clock, priority, locked memory, notifications.

The clock sleeps until absolute monotonic deadlines, and runs each periodic job in a separate thread.

Real-time priority and locked memory are privileges (RLIMIT_RTPRIO, RLIMIT_MEMLOCK, capabilities) that the
operating system may refuse. Without real-time priority and locked memory the flight process continues with
more jitter under load. The functions `prioritise` and `lock_memory` never raise; they return the reason for a
refusal, or an empty text on success.

`ServiceManager` sends notifications to systemd over a socket (sd_notify(3)). Notifications are dropped if the
environment variable NOTIFY_SOCKET is missing or the delivery fails, because a notification must never delay
or end the flight process. Only the notification READY is repeated until it is delivered, because systemd ends
a process that does not report READY.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # hal.interfaces.wires imports numpy, which the guardian must not load
    from hal.interfaces.wires import Ticker


class ContainedJob:
    """Job whose exceptions are stored as text, with the attributes of `hal.interfaces.wires.Ticker`."""

    def __init__(self, name: str, job: Callable[[], None], now_ns: Callable[[], int]) -> None:
        self.name = name
        self.error = ""
        self.served_ns = now_ns()
        self._job, self._now_ns = job, now_ns

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
    """Clock based on CLOCK_MONOTONIC of the operating system, with the list `tickers` of running jobs."""

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


# sys/mman.h
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_MCL_ONFAULT = 4


def prioritise(thread_id: int, priority: int) -> str:
    """Give a thread real-time priority (SCHED_FIFO), which its child threads and processes do not inherit.

    The thread identifier 0 stands for the calling thread. Returns the reason for a refusal, or an empty text
    on success.
    """
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(thread_id, policy, os.sched_param(priority))
    except OSError as error:
        return f"SCHED_FIFO {priority} refused ({error.strerror}): allow it with LimitRTPRIO"
    return ""


def relinquish() -> None:
    """Return the calling thread to ordinary scheduling, which is always permitted."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def worker_cores() -> frozenset[int]:
    """Return the processor cores for the worker processes: all available cores except the last core.

    The last core stays free for the control process, which may use all cores. The result is empty if only one
    core is available.
    """
    return frozenset(sorted(os.sched_getaffinity(0))[:-1])


def lock_memory() -> str:
    """Lock the memory pages of this process in RAM.

    Returns the reason for a refusal, or an empty text on success. A page is locked when it is first accessed
    (MCL_ONFAULT), because otherwise whole thread stacks and the shared memory of the workers would become
    resident. If RLIMIT_MEMLOCK is limited, only existing mappings are locked, because later mappings would
    count against the limit and might fail.
    """
    import ctypes  # noqa: PLC0415 - the slow import, done after the guardian has requested its priority

    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    future = _MCL_FUTURE if unlimited or os.geteuid() == 0 else 0
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | future | _MCL_ONFAULT) != 0:
        return f"locked memory refused ({os.strerror(ctypes.get_errno())}): allow it with LimitMEMLOCK"
    return ""


@dataclass(frozen=True, slots=True)
class Obtained:
    """Result of requesting privileges: real-time priority, locked memory, and reasons for refusals."""

    priority: int
    locked: bool
    refusals: tuple[str, ...]

    def __str__(self) -> str:
        scheduling = f"SCHED_FIFO {self.priority}" if self.priority else "ordinary scheduling"
        memory = "memory locked" if self.locked else "memory not locked"
        return "; ".join((f"{scheduling}, {memory}", *self.refusals))


def obtain(thread_ids: list[int], priority: int) -> Obtained:
    """Request real-time priority for threads and lock the memory, and return the result."""
    refused = next(filter(None, [prioritise(thread_id, priority) for thread_id in thread_ids]), "")
    unlocked = lock_memory()
    return Obtained(0 if refused else priority, not unlocked, tuple(filter(None, (refused, unlocked))))


class ServiceManager:
    """Connection to the service manager (systemd), if it started this process."""

    def __init__(self, environment: Mapping[str, str], process_id: int) -> None:
        """Read the socket and the watchdog timeout from environment variables.

        The watchdog is used only if WATCHDOG_PID is missing or equals `process_id`.
        """
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._line: socket.socket | None = None
        self._undelivered_ready = ""
        if self._address:
            self._line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._line.setblocking(False)
        meant = environment.get("WATCHDOG_PID", str(process_id)) == str(process_id)
        period = environment.get("WATCHDOG_USEC", "")
        self.watchdog_ns = int(period) * 1000 if meant and period.isdecimal() else 0
        """Timeout of the watchdog (ns), or 0 if systemd does not monitor this process."""

    def ready(self, status: str) -> None:
        """Report that the start is complete. The method `feed_watchdog` repeats the report until delivery."""
        self._undelivered_ready = f"READY=1\nSTATUS={status}"
        self._repeat_ready()

    def status(self, status: str) -> None:
        """Report a status text, which `systemctl status` shows."""
        self._notify(f"STATUS={status}")

    def feed_watchdog(self) -> None:
        """Report that all tasks make progress."""
        self._repeat_ready()
        if self.watchdog_ns:
            self._notify("WATCHDOG=1")

    def extend_start(self, seconds: float) -> None:
        """Request more time (s) before the service manager considers the start as failed."""
        self._notify(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._undelivered_ready = ""
        self._notify("STOPPING=1")

    def close(self) -> None:
        """Close the socket to the service manager. Calling `close` again has no effect."""
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _repeat_ready(self) -> None:
        if self._undelivered_ready and self._notify(self._undelivered_ready):
            self._undelivered_ready = ""

    def _notify(self, message: str) -> bool:
        """Send a notification and return whether it was delivered."""
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendto(message.encode(), self._address)
                return True
        return False
