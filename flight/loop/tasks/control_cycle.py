"""One cycle at 40 Hz: from bytes to estimate, and by mode and path to currents; recorded in the log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flight.link.modes import STEERING, Mode
from flight.link.telemetry.definitions import ATTITUDE
from flight.loop.body import PLANNER, Body, ControlOutput, Steered, Target
from flight.loop.executive.executive import Cycle
from flight.loop.executive.jobs import JobResult
from flight.loop.fdir.coil_watch import CoilKnowledge
from flight.loop.services import Services
from flight.loop.tasks import imaging as imaging_task
from flight.loop.tasks import wide_imaging as wide_task
from flight.loop.tasks.health import PerformanceObserver
from flight.loop.tasks.imaging import Imaging
from flight.loop.tasks.mode_control import ModeControl
from flight.loop.tasks.navigation import Navigation
from flight.loop.tasks.steering import CoilDrive, Steering
from flight.loop.tasks.wide_imaging import WideImaging
from hal.interfaces.readings import ImuReading
from knightcube.gnc.estimation.estimate import RATE, TURN, Estimate

ATTITUDE_EVERY = 4
"""Control cycles from one attitude packet to the next."""
_NAN3 = np.full(3, np.nan)
_NAN4 = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class CycleTasks:
    """The tasks that a cycle runs, in the order of the data."""

    navigation: Navigation
    modes: ModeControl
    steering: Steering
    drive: CoilDrive
    imaging: Imaging | None
    wide: WideImaging | None


class ControlCycle:
    """The task of the control rate group."""

    def __init__(
        self, tasks: CycleTasks, body: Body, observer: PerformanceObserver, services: Services
    ) -> None:
        self._tasks = tasks
        self._body = body
        self._observer = observer
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._streams = services.streams
        self._knowledge = CoilKnowledge()
        self._ever_started = False
        self._blind = True
        self._measured = False
        self._target: Target | None = None

    def run(self, cycle: Cycle) -> ControlOutput:
        """Run one cycle."""
        tasks, body, now_ns = self._tasks, self._body, cycle.start_ns
        # The last command may have reached the wire late: the coils' thread sends it.
        in_force = tasks.drive.state()
        known = self._knowledge.look(in_force, now_ns, suspected=tasks.drive.suspects)
        tasks.navigation.commanded(in_force, known)
        readings = tasks.navigation.update(now_ns)
        if not in_force.error:
            self._streams.note("coils", now_ns)
        tasks.drive.look(in_force, readings, now_ns, known=known.since_last_look)
        if tasks.imaging is not None:
            tasks.imaging.serve(now_ns)
        estimate = tasks.navigation.estimate(now_ns)
        overdue = self._overdue(estimate, now_ns)
        mode = tasks.modes.step(estimate, _newest_rate(readings), overdue, not in_force.error, now_ns)
        self._aim(now_ns)
        measured = self._replan_if_regained(estimate, now_ns)
        self._ever_started = self._ever_started or estimate is not None
        if self._collect(now_ns):
            estimate = tasks.navigation.estimate(now_ns)
        trusted = estimate if measured else None
        steered = self._act(mode, trusted, readings, now_ns)
        output = ControlOutput(cycle, mode, estimate, self._target, steered, tasks.drive.state())
        if mode in STEERING and self._target is not None:
            body.planner.serve(trusted, self._target, now_ns)
        body.view.record_cycle(output)
        if cycle.slot % ATTITUDE_EVERY == 0:
            self._record(output)
        return output

    def coils_off(self) -> None:
        """Switch all coils off: the flight is over."""
        self._tasks.drive.off()

    def _overdue(self, estimate: Estimate | None, now_ns: int) -> float | None:
        if estimate is None or self._target is None:
            return None
        return self._body.targets.error_when_due(estimate, self._target, now_ns)

    def _replan_if_regained(self, estimate: Estimate | None, now_ns: int) -> bool:
        """Return whether the estimate is measured; request a path when measured again."""
        planner, measured = self._body.planner, self._tasks.navigation.is_measured(now_ns)
        if estimate is not None and self._blind:
            planner.request(now_ns)
        elif measured and not self._measured:
            planner.resume(now_ns)
        self._blind = estimate is None
        self._measured = measured
        return measured

    def _act(
        self, mode: Mode, estimate: Estimate | None, readings: Sequence[ImuReading], now_ns: int
    ) -> Steered:
        """Use the coils as the mode requires; `estimate` is None unless measured."""
        steering = self._tasks.steering
        if mode in STEERING:
            return steering.run(estimate, now_ns, self._ever_started)
        if self._tasks.modes.brakes:
            return steering.brake(readings, self._tasks.navigation.is_heard(now_ns), now_ns)
        if self._tasks.modes.seeks:
            return steering.seek(readings, self._tasks.navigation.is_heard(now_ns), now_ns)
        return steering.rest(now_ns)

    def _aim(self, now_ns: int) -> None:
        """Set the target in force; announce a new target and request a path at once."""
        modes = self._tasks.modes
        mission_ns = now_ns - self._recorder.epoch_ns
        target = modes.target(mission_ns)
        if target is self._target:
            return
        self._target = target
        if target is None:
            return
        self._body.view.announce(target, now_ns)
        self._body.planner.aim(target, now_ns)

    def _collect(self, now_ns: int) -> bool:
        """Accept the workers' results; return whether a frame was among them."""
        framed = False
        for result in self._jobs.collect():
            framed |= self._accept(result, now_ns)
        return framed

    def _accept(self, result: JobResult, now_ns: int) -> bool:
        self._observer.job(result, now_ns)
        if result.worker == PLANNER:
            self._body.planner.finish(result, now_ns)
        elif result.worker == imaging_task.WORKER and self._tasks.imaging is not None:
            self._tasks.imaging.finish(result, now_ns)
            return True
        elif result.worker == wide_task.WORKER and self._tasks.wide is not None:
            self._tasks.wide.finish(result, now_ns)
            return True
        return False

    def _record(self, output: ControlOutput) -> None:
        """Record the attitude packet, the same for every body."""
        estimate, reference, target = output.estimate, output.steered.reference, output.target
        now_ns = output.cycle.start_ns
        self._recorder.record(
            ATTITUDE,
            now_ns,
            mode=int(output.mode),
            quaternion=(_NAN4 if estimate is None else estimate.quaternion).tolist(),
            rate=(_NAN3 if estimate is None else estimate.rate).tolist(),
            angle_sigma=_sigmas(estimate, TURN),
            rate_sigma=_sigmas(estimate, RATE),
            wanted=(_NAN4 if reference is None else reference.quaternion).tolist(),
            wanted_rate=(_NAN3 if reference is None else reference.body_rate).tolist(),
            target=(_NAN4 if target is None else target.law.quaternion(now_ns)).tolist(),
            dipole=output.steered.dipole.tolist(),
        )


def _newest_rate(readings: Sequence[ImuReading]) -> float | None:
    """Return the magnitude of the newest body rate of this cycle, rad/s."""
    return math.hypot(*readings[-1].rate.tolist()) if readings else None


def _sigmas(estimate: Estimate | None, part: slice) -> list[float]:
    if estimate is None:
        return _NAN3.tolist()
    return [math.sqrt(max(value, 0.0)) for value in estimate.covariance.diagonal()[part].tolist()]
