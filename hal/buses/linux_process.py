"""Services that Linux and systemd offer to this process: real-time priority, locked memory, notifications.

Priority and locked memory are privileges (RLIMIT_RTPRIO, RLIMIT_MEMLOCK, capabilities) that a machine may
refuse. A flight continues without them, with more jitter under load. `prioritise` and `lock_memory` raise
nothing: they return the reason of a refusal, or "" on success.

`ServiceManager` notifies systemd over its socket (sd_notify(3)). Without NOTIFY_SOCKET in the environment,
notifications are dropped, as are those that cannot be delivered: a notification must never delay or end a
flight. Only READY is repeated until it is delivered, because without it the service manager ends the
process.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
from collections.abc import Mapping
from dataclasses import dataclass

# sys/mman.h
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_MCL_ONFAULT = 4


def prioritise(thread_id: int, priority: int) -> str:
    """Run a thread (0: this one) under SCHED_FIFO; threads and processes started by it do not inherit it."""
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(thread_id, policy, os.sched_param(priority))
    except OSError as error:
        return f"SCHED_FIFO {priority} refused ({error.strerror}): allow it with LimitRTPRIO"
    return ""


def relinquish() -> None:
    """Return this thread to ordinary scheduling, which is always permitted."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def worker_cores() -> frozenset[int]:
    """Return the cores for worker processes: all but the last, which stays free for the control process.

    Empty where there is only one. The control process itself may use every core.
    """
    return frozenset(sorted(os.sched_getaffinity(0))[:-1])


def lock_memory() -> str:
    """Keep every page that this process touches in memory.

    Pages are locked only when touched (MCL_ONFAULT), otherwise whole thread stacks and the workers' shared
    memory would become resident. Under a limit only present mappings are locked: later ones would count
    against the limit and might fail.
    """
    import ctypes  # noqa: PLC0415 - the guardian requests its priority before this slow import

    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    future = _MCL_FUTURE if unlimited or os.geteuid() == 0 else 0
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | future | _MCL_ONFAULT) != 0:
        return f"locked memory refused ({os.strerror(ctypes.get_errno())}): allow it with LimitMEMLOCK"
    return ""


@dataclass(frozen=True, slots=True)
class Obtained:
    """Obtained priority and locked memory, and the reasons of refusals."""

    priority: int
    locked: bool
    refusals: tuple[str, ...]

    def __str__(self) -> str:
        scheduling = f"SCHED_FIFO {self.priority}" if self.priority else "ordinary scheduling"
        memory = "memory locked" if self.locked else "memory not locked"
        return "; ".join((f"{scheduling}, {memory}", *self.refusals))


def obtain(thread_ids: list[int], priority: int) -> Obtained:
    """Prioritise threads and lock the memory; return the result."""
    refused = next(filter(None, [prioritise(thread_id, priority) for thread_id in thread_ids]), "")
    unlocked = lock_memory()
    return Obtained(0 if refused else priority, not unlocked, tuple(filter(None, (refused, unlocked))))


class ServiceManager:
    """The service manager that started this process, if one did."""

    def __init__(self, environment: Mapping[str, str], process_id: int) -> None:
        """Read the socket and watchdog from `environment`; WATCHDOG_PID must be `process_id` if given."""
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
        """The watchdog's time-out; 0 without a watchdog."""

    def ready(self, status: str) -> None:
        """Report that the start is complete; repeated with the watchdog until it is delivered."""
        self._undelivered_ready = f"READY=1\nSTATUS={status}"
        self._repeat_ready()

    def status(self, status: str) -> None:
        """Report a status line for people."""
        self._notify(f"STATUS={status}")

    def feed_watchdog(self) -> None:
        """Report that every task makes progress."""
        self._repeat_ready()
        if self.watchdog_ns:
            self._notify("WATCHDOG=1")

    def extend_start(self, seconds: float) -> None:
        """Ask for more time before the start counts as failed."""
        self._notify(f"EXTEND_TIMEOUT_USEC={round(seconds * 1e6)}")

    def stopping(self) -> None:
        """Report that the process is stopping."""
        self._undelivered_ready = ""
        self._notify("STOPPING=1")

    def close(self) -> None:
        """Close the line. Safe to call twice."""
        line, self._line = self._line, None
        if line is not None:
            line.close()

    def _repeat_ready(self) -> None:
        if self._undelivered_ready and self._notify(self._undelivered_ready):
            self._undelivered_ready = ""

    def _notify(self, message: str) -> bool:
        """Send a notification; return whether it was delivered."""
        if self._line is not None:
            with contextlib.suppress(OSError):
                self._line.sendto(message.encode(), self._address)
                return True
        return False
