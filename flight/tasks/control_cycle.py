"""One cycle at 40 Hz: bytes to estimate, estimate and path to currents, all of it into the log."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flight import events
from flight.estimation.estimate import ThreadEstimate
from flight.events import EventLog
from flight.executive.jobs import JobRunner
from flight.executive.rate_group import Cycle
from flight.tasks import imaging as imaging_task
from flight.tasks import planning as planning_task
from flight.tasks.imaging import Imaging
from flight.tasks.navigation import Navigation
from flight.tasks.performance import PerformanceObserver
from flight.tasks.planning import Planning
from flight.tasks.steering import Steering
from flight.tasks.targets import Target, TargetSequence
from flight.telemetry.definitions import CONTROL, TARGET
from flight.telemetry.recorder import Recorder
from hal.interfaces.devices import TorqueCoils


@dataclass(frozen=True, slots=True)
class Rooms:
    """What a cycle goes through."""

    navigation: Navigation
    steering: Steering
    planning: Planning
    imaging: Imaging | None
    coils: TorqueCoils
    jobs: JobRunner


class ControlCycle:
    """The task of the control rate group."""

    def __init__(
        self,
        rooms: Rooms,
        targets: TargetSequence,
        recorder: Recorder,
        event_log: EventLog,
        observer: PerformanceObserver,
    ) -> None:
        self._rooms = rooms
        self._targets = targets
        self._recorder = recorder
        self._events = event_log
        self._observer = observer
        self._ever_started = False
        self._blind = True
        self.target: Target | None = None
        self.estimate: ThreadEstimate | None = None

    def run(self, cycle: Cycle) -> None:
        """Run one cycle."""
        rooms, now_ns = self._rooms, cycle.start_ns
        target = self._command_target(now_ns)
        # What the last command came to be on the wire, and when: the coils' thread may have needed a moment.
        in_force = rooms.coils.state()
        rooms.navigation.commanded(in_force.written_ns, in_force.current)
        rooms.navigation.update(now_ns)
        if rooms.imaging is not None:
            rooms.imaging.serve(now_ns)
        self.estimate = rooms.navigation.estimate(now_ns)
        if self.estimate is not None and self._blind:
            rooms.planning.request(now_ns)  # from where the body is by now, not from an old path
        self._blind = self.estimate is None
        self._ever_started = self._ever_started or self.estimate is not None
        self._collect(now_ns)
        rooms.steering.run(self.estimate, now_ns, self._ever_started)
        written = rooms.coils.state()
        rooms.planning.serve(self.estimate, target, now_ns)
        self._record(cycle, target, written.current.tolist(), written.saturated)

    def _command_target(self, now_ns: int) -> Target:
        """Return the target in force; tell a new one and want a path to it at once."""
        target = self._targets.at(now_ns - self._recorder.epoch_ns)
        if target is not self.target:
            self.target = target
            self._recorder.record(TARGET, now_ns, index=target.index, q2=target.q2, rate=target.rate)
            self._events.tell(events.TARGET, now_ns, f"step {target.index}: q2 = {target.q2:+.2f}")
            self._rooms.planning.aim(target, now_ns)
        return target

    def _collect(self, now_ns: int) -> None:
        """Take in what the workers have finished."""
        for result in self._rooms.jobs.collect():
            self._observer.job(result, now_ns)
            if result.worker == planning_task.WORKER:
                self._rooms.planning.finish(result, now_ns)
            elif result.worker == imaging_task.WORKER and self._rooms.imaging is not None:
                self._rooms.imaging.finish(result, now_ns)
                self.estimate = self._rooms.navigation.estimate(now_ns)

    def _record(self, cycle: Cycle, target: Target, written: list[float], saturated: bool) -> None:
        estimate, sample = self.estimate, self._rooms.steering.sample
        nan = math.nan
        self._recorder.record(
            CONTROL,
            cycle.start_ns,
            cycle=cycle.slot,
            state=int(self._rooms.steering.state),
            estimate_age=(cycle.start_ns - estimate.measured_ns) * 1e-9 if estimate else nan,
            angle=estimate.angle if estimate else nan,
            q2=estimate.q2 if estimate else nan,
            rate=estimate.rate if estimate else nan,
            angle_sigma=math.sqrt(estimate.covariance[0, 0]) if estimate else nan,
            rate_sigma=math.sqrt(estimate.covariance[1, 1]) if estimate else nan,
            target_q2=target.q2,
            path_q2=math.sin(0.5 * sample.angle) if sample else nan,
            path_rate=sample.rate if sample else nan,
            path_acceleration=sample.acceleration if sample else nan,
            plan=self._rooms.planning.flown,
            current_command=self._rooms.steering.command.tolist(),
            current_written=written,
            saturated=int(saturated or self._rooms.steering.saturated),
        )
