"""One control cycle (40 Hz): readings update the estimate; mode and path determine the coil currents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flight.link.modes import STEERING, Mode
from flight.link.telemetry.definitions import ATTITUDE, COIL_CURRENTS
from flight.loop import horizon_cameras as horizon_task
from flight.loop import imaging as imaging_task
from flight.loop.body import PLANNER, ControlOutput, FlightBody, Steered, Target
from flight.loop.commanding import CommandTask
from flight.loop.executive import Cycle
from flight.loop.facts import Services
from flight.loop.health import HealthWatch, Housekeeping, PerformanceObserver, Shedding
from flight.loop.horizon_cameras import HorizonCameraTask
from flight.loop.imaging import Imaging
from flight.loop.modes import ModeControl
from flight.loop.navigation import CoilKnowledge, CurrentValidity, Navigation, Positioning, SunSensing
from flight.loop.steering import CoilDrive, Steering

if TYPE_CHECKING:  # only flights with a section `power` load this module
    from flight.loop.power import PowerTask
from hal.interfaces.devices import MOST_COILS, CoilState, ImuReading
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.estimate import ATTITUDE as ATTITUDE_ERROR
from knightcube.gnc.estimation.estimate import RATE, Estimate

ATTITUDE_EVERY = 4
"""Number of control cycles from one attitude packet to the next."""
_NAN3 = np.full(3, np.nan)
_NAN4 = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class LoopTasks:
    """The tasks of the loop, in the order in which data flow through them.

    A task is None if the configuration has no device or command channel for it.
    """

    navigation: Navigation
    imaging: Imaging | None
    positioning: Positioning | None
    sun: SunSensing | None
    horizon_cameras: HorizonCameraTask | None
    modes: ModeControl
    steering: Steering
    drive: CoilDrive
    observer: PerformanceObserver
    health: HealthWatch
    housekeeping: Housekeeping
    commanding: CommandTask | None
    power: PowerTask | None
    shedding: Shedding


@dataclass(slots=True, eq=False)
class _CycleRecord:
    """Inputs and results of a control cycle, filled in step by step.

    Attributes:
        coils: coil command that the PWM chip holds at the start of the cycle.
        validity: whether the coil currents are known.
        readings: readings of the inertial unit since the last cycle, oldest first.
        estimate: present state estimate, measured or propagated by the model, or None before the filter
            starts.
        measured: the state estimate if it is recent enough for steering, otherwise None.
    """

    cycle: Cycle
    coils: CoilState
    validity: CurrentValidity
    readings: Sequence[ImuReading]
    estimate: Estimate | None = None
    mode: Mode = Mode.BOOT
    measured: Estimate | None = None

    @property
    def now_ns(self) -> int:
        """Start time (ns) of the cycle."""
        return self.cycle.start_ns


class ControlCycle:
    """The task of the control rate group: sample, estimate, check, decide, steer, publish."""

    def __init__(self, tasks: LoopTasks, body: FlightBody, services: Services) -> None:
        self._tasks = tasks
        self._body = body
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._streams = services.streams
        self._knowledge = CoilKnowledge()
        self._ever_started = False
        self._had_estimate = False
        self._was_measured = False
        self._target: Target | None = None

    def run(self, cycle: Cycle) -> ControlOutput:
        """Run one cycle."""
        record = self._sample(cycle)
        self._estimate(record)
        self._check(record)
        self._decide(record)
        self._accept_results(record)
        steered = self._steer(record)
        return self._publish(record, steered)

    def _sample(self, cycle: Cycle) -> _CycleRecord:
        """Read the inertial unit and the coil command in force, and pass both to navigation."""
        tasks, now_ns = self._tasks, cycle.start_ns
        # The coil driver's thread may have sent the last command late.
        coils = tasks.drive.state()
        validity = self._knowledge.look(coils, now_ns, suspected=tasks.drive.is_suspect)
        tasks.navigation.correct_coils(tasks.drive.correction, tasks.drive.available)
        tasks.navigation.commanded(coils, tasks.drive.effective(coils), validity)
        readings = tasks.navigation.update(now_ns)
        if not coils.error:
            self._streams.note("coils", now_ns)
        return _CycleRecord(cycle, coils, validity, readings)

    def _estimate(self, record: _CycleRecord) -> None:
        """Propagate the state estimate to the present."""
        record.estimate = self._tasks.navigation.estimate(record.now_ns)

    def _check(self, record: _CycleRecord) -> None:
        """Check the coils by supply current and motion, and check the star camera."""
        known = record.validity.since_last_look
        self._tasks.drive.look(record.coils, record.readings, record.now_ns, known=known)
        if self._tasks.imaging is not None:
            self._tasks.imaging.serve(record.now_ns)

    def _decide(self, record: _CycleRecord) -> None:
        """Determine mode and target, and request a path for a new target or a new estimate."""
        tasks, control, now_ns, estimate = self._tasks, self._body.control, record.now_ns, record.estimate
        overdue = None
        if estimate is not None and self._target is not None:
            overdue = control.targets.error_when_due(estimate, self._target, now_ns)
        speed, accurate = tasks.navigation.speed, tasks.navigation.is_accurate(estimate)
        rate = speed if record.readings and math.isfinite(speed) else None
        record.mode = tasks.modes.step(estimate, rate, overdue, not record.coils.error, now_ns, accurate)
        target = tasks.modes.target(now_ns - self._recorder.epoch_ns)
        if target is not self._target:
            self._target = target
            if target is not None:
                self._body.view.announce(target, now_ns)
                control.planner.aim(target, now_ns)
        measured = tasks.navigation.is_measured(estimate, now_ns)
        if estimate is not None and not self._had_estimate:
            control.planner.request(now_ns)
        elif measured and not self._was_measured:
            control.planner.resume(now_ns)
        self._had_estimate = estimate is not None
        self._ever_started = self._ever_started or self._had_estimate
        self._was_measured = measured

    def _accept_results(self, record: _CycleRecord) -> None:
        """Pass the workers' results to their tasks, and update the estimate if cameras changed it."""
        tasks, now_ns = self._tasks, record.now_ns
        for result in self._jobs.collect():
            tasks.observer.job(result, now_ns)
            if result.worker == PLANNER:
                self._body.control.planner.finish(result, now_ns)
                continue
            if result.worker == imaging_task.WORKER and tasks.imaging is not None:
                tasks.imaging.finish(result, now_ns)
            elif result.worker == horizon_task.WORKER and tasks.horizon_cameras is not None:
                tasks.horizon_cameras.finish(result, now_ns)
            self._estimate(record)
        record.measured = record.estimate if self._was_measured else None

    def _steer(self, record: _CycleRecord) -> Steered:
        """Command the coils by the control law of the mode, and return the result."""
        steering, modes, now_ns = self._tasks.steering, self._tasks.modes, record.now_ns
        if record.mode in STEERING:
            return steering.run(record.measured, now_ns, self._ever_started)
        current = self._tasks.navigation.is_current(now_ns)
        if modes.detumbles:
            return steering.detumble(record.readings, current, now_ns)
        if modes.acquires_sun:
            return steering.acquire_sun(record.readings, current, now_ns)
        return steering.rest(now_ns)

    def _publish(self, record: _CycleRecord, steered: Steered) -> ControlOutput:
        """Submit a requested plan to the planner worker, and record the cycle."""
        mode, estimate, target, now_ns = record.mode, record.estimate, self._target, record.now_ns
        output = ControlOutput(record.cycle, mode, estimate, target, steered, self._tasks.drive.state())
        if mode in STEERING and target is not None:
            self._body.control.planner.serve(record.measured, target, now_ns)
        self._body.view.record_cycle(output)
        if record.cycle.slot % ATTITUDE_EVERY:
            return output
        if len(steered.currents) > 3:
            command, written = (_padded(currents) for currents in (steered.currents, output.written.current))
            self._recorder.record(COIL_CURRENTS, now_ns, command=command, written=written)
        reference = steered.reference
        self._recorder.record(
            ATTITUDE,
            now_ns,
            mode=int(mode),
            quaternion=(_NAN4 if estimate is None else estimate.quaternion).tolist(),
            rate=(_NAN3 if estimate is None else estimate.rate).tolist(),
            angle_sigma=_sigmas(estimate, ATTITUDE_ERROR),
            rate_sigma=_sigmas(estimate, RATE),
            wanted=(_NAN4 if reference is None else reference.quaternion).tolist(),
            wanted_rate=(_NAN3 if reference is None else reference.body_rate).tolist(),
            target=(_NAN4 if target is None else target.law.quaternion(now_ns)).tolist(),
            dipole=steered.dipole.tolist(),
        )
        return output


def _padded(currents: FloatArray) -> list[float]:
    """Return the currents (n,), A, of the coils, followed by NaN for coils that are not fitted."""
    return [*currents.tolist(), *[math.nan] * (MOST_COILS - len(currents))]


def _sigmas(estimate: Estimate | None, part: slice) -> list[float]:
    if estimate is None:
        return _NAN3.tolist()
    return [math.sqrt(max(value, 0.0)) for value in estimate.covariance.diagonal()[part].tolist()]
