"""One cycle at 40 Hz: bytes to estimate, mode and path to currents, all of it into the log."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flight.bodies.testbed import planning as planning_task
from flight.bodies.testbed.planning import Planning
from flight.bodies.testbed.steering import Steering
from flight.bodies.testbed.targets import KEPT, Target, TargetSequence
from flight.gnc.estimation.estimate import ThreadEstimate
from flight.link import events
from flight.link.modes import Mode
from flight.link.telemetry.definitions import CONTROL, TARGET
from flight.link.telemetry.recorder import Recorder
from flight.loop import imaging as imaging_task
from flight.loop.coil_drive import CoilDrive
from flight.loop.executive.jobs import JobRunner
from flight.loop.executive.rate_group import Cycle
from flight.loop.fdir.coils.knowledge import CoilKnowledge
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.streams import Streams
from flight.loop.imaging import Imaging
from flight.loop.modes.control import ModeControl
from flight.loop.modes.triggers import STEERING
from flight.loop.navigation import Navigation
from flight.loop.performance import PerformanceObserver
from hal.interfaces.devices import TorqueCoils


@dataclass(frozen=True, slots=True)
class Rooms:
    """What a cycle goes through."""

    navigation: Navigation
    modes: ModeControl
    steering: Steering
    planning: Planning
    imaging: Imaging | None
    coils: TorqueCoils
    drive: CoilDrive
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
        streams: Streams,
    ) -> None:
        self._rooms = rooms
        self._targets = targets
        self._recorder = recorder
        self._events = event_log
        self._observer = observer
        self._streams = streams
        self._knowledge = CoilKnowledge()
        self._ever_started = False
        self._blind = True
        self._measured = False
        self.target: Target | None = None
        self.estimate: ThreadEstimate | None = None

    def run(self, cycle: Cycle) -> None:
        """Run one cycle."""
        rooms, now_ns = self._rooms, cycle.start_ns
        # What the last command came to be on the wire, and when: the coils' thread may have needed a moment.
        in_force = rooms.coils.state()
        known = self._knowledge.look(in_force, now_ns)
        rooms.navigation.commanded(in_force, known)
        rooms.navigation.update(now_ns)
        if not in_force.error:
            self._streams.note("coils", now_ns)
        rooms.drive.look(in_force, rooms.navigation.readings, now_ns, known=known.until_now)
        if rooms.imaging is not None:
            rooms.imaging.serve(now_ns)
        self.estimate = rooms.navigation.estimate(now_ns)
        due = None if self.target is None else rooms.planning.due_angle(self.target, now_ns)
        mode = rooms.modes.step(self.estimate, self._measured_rate(), due, not in_force.error, now_ns)
        self._aim(now_ns)
        measured = self._look_out(now_ns)
        self._ever_started = self._ever_started or self.estimate is not None
        self._collect(now_ns)
        steered_by = self.estimate if measured else None
        self._act(mode, steered_by, now_ns)
        written = rooms.coils.state()
        if mode in STEERING and self.target is not None:
            rooms.planning.serve(steered_by, self.target, now_ns)
        self._record(cycle, written.current.tolist(), written.saturated)

    def _measured_rate(self) -> float | None:
        """Return the length of the newest body rate of this cycle, rad/s."""
        readings = self._rooms.navigation.readings
        return math.hypot(*readings[-1].rate.tolist()) if readings else None

    def _look_out(self, now_ns: int) -> bool:
        """Tell whether the estimate is measured; see to a path from where the body is, after it was not."""
        planning, measured = self._rooms.planning, self._rooms.navigation.is_measured(now_ns)
        if self.estimate is not None and self._blind:
            planning.request(now_ns)
        elif measured and not self._measured:
            planning.resume(now_ns)
        self._blind = self.estimate is None
        self._measured = measured
        return measured

    def _act(self, mode: Mode, estimate: ThreadEstimate | None, now_ns: int) -> None:
        """Use the coils as the mode wants, by an estimate that is measured."""
        steering = self._rooms.steering
        if mode in STEERING:
            steering.run(estimate, now_ns, self._ever_started)
        elif mode is Mode.DETUMBLE:
            steering.brake(now_ns)
        else:
            steering.rest(now_ns)

    def _aim(self, now_ns: int) -> None:
        """See which target is in force; want a path to a new one at once, and tell it."""
        modes = self._rooms.modes
        steps = modes.flies_steps
        target = self._targets.at(now_ns - self._recorder.epoch_ns) if steps else modes.wanted
        if target is self.target:
            return
        self.target = target
        if target is None:
            return
        if target.index != KEPT:
            self._recorder.record(TARGET, now_ns, index=target.index, q2=target.q2, rate=target.rate)
            self._events.tell(events.TARGET, now_ns, f"step {target.index}: q2 = {target.q2:+.2f}")
        self._rooms.planning.aim(target, now_ns)

    def _collect(self, now_ns: int) -> None:
        """Take in what the workers have finished."""
        for result in self._rooms.jobs.collect():
            self._observer.job(result, now_ns)
            if result.worker == planning_task.WORKER:
                self._rooms.planning.finish(result, now_ns)
            elif result.worker == imaging_task.WORKER and self._rooms.imaging is not None:
                self._rooms.imaging.finish(result, now_ns)
                self.estimate = self._rooms.navigation.estimate(now_ns)

    def _record(self, cycle: Cycle, written: list[float], saturated: bool) -> None:
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
            target_q2=self.target.q2 if self.target else nan,
            path_q2=math.sin(0.5 * sample.angle) if sample else nan,
            path_rate=sample.rate if sample else nan,
            path_acceleration=sample.acceleration if sample else nan,
            plan=self._rooms.planning.flown,
            current_command=self._rooms.steering.command.tolist(),
            current_written=written,
            saturated=int(saturated or self._rooms.steering.saturated),
        )
