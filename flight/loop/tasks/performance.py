"""The performance record: times and execution times of cycles, in a log of its own.

Also the executive's observer: slips and failures become events, and a failed control cycle zeroes the coils.
"""

from __future__ import annotations

import traceback

from flight.link import events
from flight.link.telemetry.definitions import CYCLE_TIMING, JOB_TIMING, RATE_GROUP
from flight.loop.executive.jobs import JobResult
from flight.loop.executive.rate_group import Cycle, RateGroup
from flight.loop.services import Services
from hal.interfaces.devices import TorqueCoils

CONTROL = "control"


class PerformanceObserver:
    """Records every cycle, slip and failure that the executive reports."""

    def __init__(self, coils: TorqueCoils, services: Services) -> None:
        self._coils = coils
        self._clock = services.clock
        self._recorder = services.recorder
        self._events = services.events

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Record a control cycle's lateness and execution time."""
        if group.name == CONTROL:
            self._recorder.time(
                CYCLE_TIMING,
                cycle.start_ns,
                cycle=cycle.slot,
                lateness=(cycle.start_ns - cycle.due_ns) * 1e-9,
                execution=execution_ns * 1e-9,
            )

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Report skipped slots of the control group: no other group can slip without it."""
        if group.name != CONTROL:
            return
        text = f"{group.name}: {slots} slots skipped, {group.slips} since start"
        self._events.report(events.CYCLE_SLIP, self._clock.now_ns(), text)

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Switch the coils off when the control task failed, and report the error's place."""
        if group.name == CONTROL:
            self._coils.off()
        last = traceback.extract_tb(error.__traceback__)[-1]
        text = f"{group.name}: {type(error).__name__}: {error} ({last.name}, line {last.lineno})"
        self._events.report(events.TASK_FAILED, self._clock.now_ns(), text)

    def group(self, group: RateGroup, now_ns: int) -> None:
        """Record the statistics of a rate group."""
        self._recorder.time(
            RATE_GROUP,
            now_ns,
            name=group.name,
            period=group.period_ns * 1e-9,
            cycles=group.cycles,
            slips=group.slips,
            overruns=group.overruns,
            mean=group.mean_execution_ns * 1e-9,
            max=group.max_execution_ns * 1e-9,
        )

    def job(self, result: JobResult, now_ns: int) -> None:
        """Record the execution time of a job."""
        self._recorder.time(
            JOB_TIMING,
            now_ns,
            name=result.worker,
            execution=result.execution_ns * 1e-9,
            outcome=result.outcome,
        )
