"""Supervisors of a flight in real time: guardian, service manager, priorities of threads, and memory.

The external supervisors are the guardian of the coils and the service manager. The loop calls `beat` at the
end of every control cycle without an error, and `feed` while nothing is stalled. A running loop does not
prove that commands reach the coils, so heartbeats are passed on only while the coil driver's job runs. The
first heartbeat also reports READY, because the devices are open and the loop runs.

When large blocks are freed, glibc raises its mmap threshold (mallopt(3)). Frames are then allocated on the
heap, small blocks fragment the heap, and it grows. Fixed thresholds prevent this; another libc ignores them.
"""

from __future__ import annotations

import ctypes
import gc
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack

from flight.link import events
from flight.link.events import EventKind
from flight.link.telemetry.log import Recorder
from flight.loop.facts import EventLog
from hal.buses import linux_process
from hal.buses.linux_process import ServiceManager
from hal.drivers.coils import DEVICE as COILS
from hal.guardian import GuardianLine
from hal.interfaces.guardian import CoilGuardian, GuardianNews, Overseer
from hal.interfaces.wires import SECOND_NS, Clock, Rig, Ticker

LARGE_BYTES = 256 * 1024
"""Size (bytes) from which a block is mapped separately, and returned to the kernel when freed."""
SPARE_BYTES = 4 * 1024 * 1024
"""Free memory (bytes) kept at the heap's top, so that cycles seldom call the kernel."""

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h


def settle_memory() -> None:
    """Set the heap's thresholds, and replace the automatic garbage collection by a `Collector`.

    Call this once the flight is built. All present objects are exempt from collections, which would otherwise
    take tens of ms of a control cycle to examine modules and tasks.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES)
        mallopt(_M_TRIM_THRESHOLD, SPARE_BYTES)
    gc.collect()
    gc.freeze()
    gc.disable()


class Collector:
    """Collects the garbage since its last call, and exempts the surviving objects from later calls.

    Only a failure makes garbage that needs a collection. Called every few seconds, a collection examines few
    objects and takes at most 2 ms. The first call only exempts the objects of the flight's start.
    """

    def __init__(self) -> None:
        self._begun = False

    def __call__(self) -> None:
        """Collect."""
        if self._begun:
            gc.collect()
        self._begun = True
        gc.freeze()


_THROTTLE_NS = 1_000_000_000
"""Throttle (ns) of the supervision's events; a guardian is replaced at most once per second."""
_UNSERVED_NS = 150_000_000
"""Longest time (ns) without a run of the coil driver's job, three of its periods, before heartbeats stop."""

_EVENTS = {
    GuardianNews.LOST: events.GUARDIAN_LOST,
    GuardianNews.READY: events.GUARDIAN_READY,
    GuardianNews.ACTED: events.GUARDIAN_ACTED,
    GuardianNews.FAILED: events.GUARDIAN_BLIND,
}


class Supervision:
    """Passes heartbeats to the guardian, and reports its state changes as events."""

    def __init__(
        self,
        guardian: CoilGuardian,
        overseer: Overseer,
        clock: Clock,
        recorder: Recorder,
        status: str,
        coils: Ticker,
        settle: Callable[[], None] | None = None,
    ) -> None:
        """Connect the supervisors with the coil driver's job `coils`.

        Once ready, the service manager shows `status`. `settle` is called once, before READY is reported,
        when all parts of the flight exist.
        """
        self._guardian = guardian
        self._overseer = overseer
        self._clock = clock
        # A separate log, because events occur before there is a loop, and none of them needs a reaction.
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
            if self._settle is not None:
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


CONTROL_PRIORITY = 50
"""SCHED_FIFO priority of the control thread and of the coil driver's thread."""
NEXT_PRIORITY = CONTROL_PRIORITY - 10
"""Priority of the other threads of the control process."""
_COLLECT_NS = 2 * SECOND_NS


def start_guardian(rig: Rig, stack: ExitStack) -> GuardianLine | None:
    """Start the guardian before any coil can be energised; close the guardian last, with the coils off."""
    if rig.reach is None:
        return None
    guardian = GuardianLine(rig.reach)
    stack.callback(guardian.close)
    return guardian


def supervise(guardian: GuardianLine, clock: Clock, recorder: Recorder, stack: ExitStack) -> Supervision:
    """Connect the supervisors, and give the control loop and the coil driver priority."""
    overseer = ServiceManager(os.environ, os.getpid())
    stack.callback(overseer.close)
    first = [thread for thread in threading.enumerate() if thread.name == COILS]
    obtained = linux_process.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(linux_process.relinquish)
    stack.callback(overseer.stopping)
    coils = next(ticker for ticker in clock.tickers if ticker.name == COILS)

    stack.callback(gc.enable)
    collector = clock.ticker("garbage", _COLLECT_NS, Collector())
    stack.callback(collector.stop)

    def settle() -> None:
        settle_memory()
        if obtained.priority:
            prioritise_other_threads()

    status = f"flying; {obtained}"
    supervision = Supervision(guardian, overseer, clock, recorder, status, coils, settle)
    stack.callback(supervision.close)
    supervision.note(events.REAL_TIME_REFUSED if obtained.refusals else events.REAL_TIME, str(obtained))
    return supervision


def prioritise_other_threads() -> None:
    """Give the other threads of this process, for log, serial line and disk, the next lower priority.

    A thread that is preempted while it holds the interpreter's lock blocks the control thread too, for a time
    slice or more on a busy machine.
    """
    for thread in threading.enumerate():
        if thread is not threading.main_thread() and thread.name != COILS:
            linux_process.prioritise(thread.native_id or 0, NEXT_PRIORITY)
