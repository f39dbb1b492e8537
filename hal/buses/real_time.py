"""Real-time scheduling and locked memory of Linux: asked for, and reported as obtained.

Both are privileges (RLIMIT_RTPRIO, RLIMIT_MEMLOCK, capabilities) that a machine may refuse; a flight goes on
without them, later under load. Nothing is raised here: each function returns why not, "" when obtained.
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
    """Run a thread (0: this one) under SCHED_FIFO; threads and processes it starts do not inherit it."""
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(thread_id, policy, os.sched_param(priority))
    except OSError as error:
        return f"SCHED_FIFO {priority} refused ({error.strerror}): allow it with LimitRTPRIO"
    return ""


def relinquish() -> None:
    """Put this thread back among all others. A thread may always do that."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def lock_memory() -> str:
    """Keep every page that this process touches in memory.

    Pages are locked when they are touched and not before (MCL_ONFAULT): whole thread stacks and the workers'
    shared memory would otherwise be made resident. Under a limit only what is mapped already is locked: what
    is mapped later would count against the limit and might fail.
    """
    import ctypes  # noqa: PLC0415 - the guardian asks for its priority before it pays for this import

    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    future = _MCL_FUTURE if unlimited or os.geteuid() == 0 else 0
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | future | _MCL_ONFAULT) != 0:
        return f"locked memory refused ({os.strerror(ctypes.get_errno())}): allow it with LimitMEMLOCK"
    return ""


@dataclass(frozen=True, slots=True)
class Obtained:
    """What was granted, and why the rest was not."""

    priority: int
    locked: bool
    refusals: tuple[str, ...]

    def __str__(self) -> str:
        scheduling = f"SCHED_FIFO {self.priority}" if self.priority else "ordinary scheduling"
        memory = "memory locked" if self.locked else "memory not locked"
        return "; ".join((f"{scheduling}, {memory}", *self.refusals))


def obtain(thread_ids: list[int], priority: int) -> Obtained:
    """Prioritise threads and lock the memory; return what was obtained."""
    refused = next(filter(None, [prioritise(thread_id, priority) for thread_id in thread_ids]), "")
    unlocked = lock_memory()
    return Obtained(0 if refused else priority, not unlocked, tuple(filter(None, (refused, unlocked))))
