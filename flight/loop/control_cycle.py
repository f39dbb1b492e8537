"""One cycle at 40 Hz: from bytes to estimate, and by mode and path to currents; recorded in the log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flight.link.modes import STEERING, Mode
from flight.link.telemetry.definitions import ATTITUDE
from flight.loop import horizon_cameras as horizon_task
from flight.loop import imaging as imaging_task
from flight.loop.body import PLANNER, ControlOutput, FlightBody, Steered, Target
from flight.loop.coil_monitor import CoilKnowledge, CurrentValidity
from flight.loop.commanding import CommandTask
from flight.loop.executive import Cycle
from flight.loop.facts import Services
from flight.loop.health import HealthWatch, Housekeeping, PerformanceObserver
from flight.loop.horizon_cameras import HorizonCameraTask
from flight.loop.imaging import Imaging
from flight.loop.modes import ModeControl
from flight.loop.navigation import Navigation, Positioning, SunSensing
from flight.loop.steering import CoilDrive, Steering
from hal.interfaces.devices import CoilState, ImuReading
from knightcube.gnc.estimation.estimate import ATTITUDE as ATTITUDE_ERROR
from knightcube.gnc.estimation.estimate import RATE, Estimate

ATTITUDE_EVERY = 4
"""Control cycles from one attitude packet to the next."""
_NAN3 = np.full(3, np.nan)
_NAN4 = np.full(4, np.nan)


@dataclass(frozen=True, slots=True)
class LoopTasks:
    """The tasks of the loop, in the order of the data flow.

    A task is None if the configuration has no device or command channel for it.
    """

    navigation: Navigation
    imaging: Imaging | None
    positioning: Positioning | None
    sun: SunSensing | None
    wide: HorizonCameraTask | None
    modes: ModeControl
    steering: Steering
    drive: CoilDrive
    observer: PerformanceObserver
    health: HealthWatch
    housekeeping: Housekeeping
    commanding: CommandTask | None


@dataclass(frozen=True, slots=True)
class _Samples:
    """The inputs of one cycle: coil command on the wire, its validity, and readings of the inertial unit."""

    coils: CoilState
    validity: CurrentValidity
    readings: Sequence[ImuReading]


class ControlCycle:
    """The task of the control rate group: sample, check, estimate, decide, steer, publish."""

    def __init__(self, tasks: LoopTasks, body: FlightBody, services: Services) -> None:
        self._tasks = tasks
        self._body = body
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._streams = services.streams
        self._knowledge = CoilKnowledge()
        self._ever_started = False
        self._had_estimate = False
        self._measured = False
        self._target: Target | None = None

    def run(self, cycle: Cycle) -> ControlOutput:
        """Run one cycle."""
        now_ns = cycle.start_ns
        samples = self._sample(now_ns)
        self._check(samples, now_ns)
        estimate = self._tasks.navigation.estimate(now_ns)
        mode = self._decide(estimate, samples, now_ns)
        if self._accept_results(now_ns):
            estimate = self._tasks.navigation.estimate(now_ns)
        measured = estimate if self._measured else None
        steered = self._steer(mode, measured, samples.readings, now_ns)
        output = ControlOutput(cycle, mode, estimate, self._target, steered, self._tasks.drive.state())
        self._publish(output, measured)
        return output

    def _sample(self, now_ns: int) -> _Samples:
        """Return the coil command on the wire and the readings, and apply both to the estimate."""
        tasks = self._tasks
        # The last command may have reached the wire late: the coils' thread sends it.
        coils = tasks.drive.state()
        validity = self._knowledge.look(coils, now_ns, suspected=tasks.drive.is_suspect)
        tasks.navigation.commanded(coils, validity)
        readings = tasks.navigation.update(now_ns)
        if not coils.error:
            self._streams.note("coils", now_ns)
        return _Samples(coils, validity, readings)

    def _check(self, samples: _Samples, now_ns: int) -> None:
        """Check the coils against supply current and motion, and the camera."""
        tasks = self._tasks
        known = samples.validity.since_last_look
        tasks.drive.look(samples.coils, samples.readings, now_ns, known=known)
        if tasks.imaging is not None:
            tasks.imaging.serve(now_ns)

    def _decide(self, estimate: Estimate | None, samples: _Samples, now_ns: int) -> Mode:
        """Return the mode to act in; set the target, and request a path if there is an estimate again."""
        overdue = None
        if estimate is not None and self._target is not None:
            overdue = self._body.control.targets.error_when_due(estimate, self._target, now_ns)
        rate = _newest_rate(samples.readings)
        mode = self._tasks.modes.step(estimate, rate, overdue, not samples.coils.error, now_ns)
        self._aim(now_ns)
        planner, measured = self._body.control.planner, self._tasks.navigation.is_measured(now_ns)
        if estimate is not None and not self._had_estimate:
            planner.request(now_ns)
        elif measured and not self._measured:
            planner.resume(now_ns)
        self._had_estimate = estimate is not None
        self._ever_started = self._ever_started or self._had_estimate
        self._measured = measured
        return mode

    def _aim(self, now_ns: int) -> None:
        """Set the target in force; announce a new target and request a path at once."""
        target = self._tasks.modes.target(now_ns - self._recorder.epoch_ns)
        if target is self._target:
            return
        self._target = target
        if target is not None:
            self._body.view.announce(target, now_ns)
            self._body.control.planner.aim(target, now_ns)

    def _accept_results(self, now_ns: int) -> bool:
        """Accept the workers' results; return whether a frame was among them."""
        tasks, framed = self._tasks, False
        for result in self._jobs.collect():
            tasks.observer.job(result, now_ns)
            if result.worker == PLANNER:
                self._body.control.planner.finish(result, now_ns)
            elif result.worker == imaging_task.WORKER and tasks.imaging is not None:
                tasks.imaging.finish(result, now_ns)
                framed = True
            elif result.worker == horizon_task.WORKER and tasks.wide is not None:
                tasks.wide.finish(result, now_ns)
                framed = True
        return framed

    def _steer(
        self, mode: Mode, estimate: Estimate | None, readings: Sequence[ImuReading], now_ns: int
    ) -> Steered:
        """Use the coils as the mode requires; `estimate` is None unless measured."""
        steering, modes = self._tasks.steering, self._tasks.modes
        if mode in STEERING:
            return steering.run(estimate, now_ns, self._ever_started)
        if modes.detumbles:
            return steering.detumble(readings, self._tasks.navigation.is_current(now_ns), now_ns)
        if modes.acquires_sun:
            return steering.acquire_sun(readings, self._tasks.navigation.is_current(now_ns), now_ns)
        return steering.rest(now_ns)

    def _publish(self, output: ControlOutput, measured: Estimate | None) -> None:
        """Submit the requested plan, and record the cycle; `measured` is the measured estimate or None."""
        cycle = output.cycle
        if output.mode in STEERING and output.target is not None:
            self._body.control.planner.serve(measured, output.target, cycle.start_ns)
        self._body.view.record_cycle(output)
        if cycle.slot % ATTITUDE_EVERY == 0:
            self._record(output)

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
            angle_sigma=_sigmas(estimate, ATTITUDE_ERROR),
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
