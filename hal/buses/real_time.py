"""Requests real-time scheduling and locked memory from Linux and reports what was obtained.

Both are privileges (RLIMIT_RTPRIO, RLIMIT_MEMLOCK, capabilities) that a machine may refuse; a flight goes on
without them, with more jitter under load. Nothing is raised: each function returns the reason of a refusal,
"" when obtained.
"""

from __future__ import annotations

import os
import resource
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
    """What was obtained, and the reasons of the refusals."""

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
