"""Starts the flight's external supervisors, and sets the scheduling priorities of its threads."""

from __future__ import annotations

import gc
import os
import threading
from contextlib import ExitStack

from flight.link import events
from flight.link.telemetry.recorder import Recorder
from flight.loop.executive import memory
from flight.loop.fdir.supervision import Supervision
from hal.buses import real_time
from hal.buses.service_manager import ServiceManager
from hal.drivers.coil_settings import DEVICE as COILS
from hal.guardian.client import GuardianLine
from hal.interfaces.rig import Rig
from hal.interfaces.wires import SECOND_NS, Clock

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
    obtained = real_time.obtain([0, *(thread.native_id or 0 for thread in first)], CONTROL_PRIORITY)
    stack.callback(real_time.relinquish)
    stack.callback(overseer.stopping)
    coils = next(ticker for ticker in clock.tickers if ticker.name == COILS)

    stack.callback(gc.enable)
    collector = clock.ticker("garbage", _COLLECT_NS, memory.Collector())
    stack.callback(collector.stop)

    def settle() -> None:
        memory.settle()
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
            real_time.prioritise(thread.native_id or 0, NEXT_PRIORITY)
