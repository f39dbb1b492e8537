"""Steering: computes the coil command from estimate and path, or zero if the estimate is not trusted.

The coil drive excludes failed axes, and reallocates the current among the remaining axes so that the
direction of the torque is preserved. The sent commands are compared with the supply current and the body's
motion (`flight.loop.coil_monitor`). When a coil is diagnosed as broken, a monitored condition becomes active
and reports an event. The reaction to the event `coil-broken` excludes the axis.

All currents in the loop are effective currents. The effective current of a coil is the current with which a
healthy coil would produce the same dipole. The coil drive converts effective currents to actual coil currents
by the signs and gains that the coil monitor has estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flight.link import events
from flight.loop import facts
from flight.loop.body import CoilCommand, FlightBody, Steered, SteeringState, WindowedLaw
from flight.loop.coil_monitor import CoilMonitor
from flight.loop.coil_response import CoilCorrection
from flight.loop.facts import Services
from flight.schema.sections import Modes
from hal.interfaces.devices import NO_AXES, Axes, CoilState, ImuReading, PowerMonitor, TorqueCoils
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.control.coil_map import allocate
from knightcube.gnc.estimation.estimate import Estimate


@dataclass(frozen=True, slots=True, eq=False)
class CoilDriveSettings:
    """Properties of the coils.

    Attributes:
        dipoles: dipole moment of each coil per ampere (3, n), m^2, body axes, one column per coil.
        limits: largest current (n,), A, of each coil.
        free_axis: unit vector (3,) of the only axis about which the body can rotate, or None for a free body.
        resistance: resistance (n,) of each coil, ohm, or None for equal coils.
    """

    dipoles: FloatArray
    limits: FloatArray
    free_axis: FloatArray | None
    resistance: FloatArray | None = None


class CoilDrive:
    """Commands the `available` coils with effective currents (n,), A, and monitors their response."""

    def __init__(
        self,
        coils: TorqueCoils,
        power: PowerMonitor | None,
        watch: CoilMonitor,
        settings: CoilDriveSettings,
        services: Services,
    ) -> None:
        self._coils, self._power, self._watch, self._settings = coils, power, watch, settings
        self._facts, self._events = services.facts, services.events
        self._reported: set[int] = set()  # axes whose diagnosis was reported
        self._braked = NO_AXES
        self._has_rate = True  # without a rate, a self-test of the coils has no result
        self.available, self._all_available = watch.available, bool(watch.available.all())
        self._nothing: FloatArray = np.zeros(len(settings.limits))
        self._limits, self._share = settings.limits, 1.0
        self.command = self._nothing

    def state(self) -> CoilState:
        """Return the command that the PWM chip holds at present."""
        return self._coils.state()

    def effective(self, in_force: CoilState) -> FloatArray:
        """Return the effective currents (n,), A, of the command that the PWM chip holds."""
        return self._watch.correction.effective(in_force.current)

    @property
    def correction(self) -> CoilCorrection:
        """Signs and gains of the coils, as estimated by the coil monitor."""
        return self._watch.correction

    def limit(self, share: float) -> None:
        """Use at most the fraction `share` of the current limits, because the battery is low."""
        self._limits, self._share = share * self._settings.limits, share

    def off(self) -> None:
        """Switch all coils off at the end of the flight."""
        self._coils.off()

    def fault(self) -> str:
        """Return why the PWM chip does not accept commands; empty if it does."""
        return self._coils.state().error

    @property
    def is_suspect(self) -> bool:
        """Whether a coil without a diagnosed fault may carry a current that differs from its command."""
        return self._watch.doubts_currents

    def look(
        self, in_force: CoilState, readings: Sequence[ImuReading], now_ns: int, *, known: bool = True
    ) -> None:
        """Compare the command in force with supply current and motion; called once in each control cycle.

        All earlier evidence is discarded unless the currents since the last cycle are `known`.
        """
        watch = self._watch
        if in_force.written_ns >= 0:
            watch.commanded(now_ns, in_force.current, in_force.braked, in_force.written_ns)
        if not known:
            watch.interrupted(now_ns)
        for reading in readings:
            self._has_rate = reading.has_rate
            if reading.has_rate:
                watch.observe_motion(reading.time_ns, reading.rate, reading.field)
        answer = self._power.latest() if self._power is not None and not self._power.error() else None
        if answer is not None:
            watch.measured(answer)
        if text := watch.tested(now_ns):
            self._events.report(events.COIL_TESTED, now_ns, text)
        for text in watch.news():
            self._events.report(events.COIL_CORRECTED, now_ns, text)
        for verdict in watch.verdicts:
            if verdict.axis not in self._reported:
                self._reported.add(verdict.axis)
                self._facts.update(facts.COILS_BROKEN[verdict.axis], True, now_ns, verdict.text)
        trial = watch.begin_trial(now_ns)
        if trial is not None:
            self._begin_trial(*trial, now_ns)
        self._brake(watch.braked)
        self._facts.update(facts.COIL_SUSPECT, bool(watch.suspicion), now_ns, watch.suspicion)
        self._facts.update(facts.POWER_DOUBTED, bool(watch.monitor_doubted), now_ns, watch.monitor_doubted)

    def adopt(self, modes: Modes) -> None:
        """Replace the limits by the values of a new table of onboard parameters."""
        self._watch.tumble_rate = modes.tumble_rate

    def isolate(self) -> None:
        """Exclude the axes with broken coils, as the reaction to the event `coil-broken`."""
        self.available = self._watch.available
        self._all_available = bool(self.available.all())

    def trust(self, now_ns: int) -> None:
        """Use all axes again, as commanded by the ground. If a fault persists, it will be detected again."""
        for axis in range(len(self._nothing)):
            self._watch.forget(axis)
        self._reported.clear()
        self.isolate()
        self._events.report(events.COIL_TRUSTED, now_ns, "all coils are in use again")

    def _begin_trial(self, axis: int, text: str, now_ns: int) -> None:
        """Use an excluded coil again, because the coil monitor begins a trial of this coil."""
        self._reported.discard(axis)
        self._facts.release(facts.COILS_BROKEN[axis])
        self.isolate()
        self._events.report(events.COIL_TRUSTED, now_ns, text)

    def send(
        self, currents: FloatArray, field: Callable[[], FloatArray | None], *, testable: bool = False
    ) -> None:
        """Command effective currents (n,), A, which a self-test may replace if `testable`.

        Unless all coils are usable and within their limits, the currents are reallocated among the usable
        coils. The allocation preserves the direction of the torque in the magnetic field (3,), T, that
        `field` returns.
        """
        watch, settings = self._watch, self._settings
        sizes = watch.correction.sizes
        # A weak coil reaches its limit at a smaller effective current.
        limited = self._share < 1.0 or min(sizes) < 1.0
        beyond = limited and bool((np.abs(currents) > self._limits * sizes).any())
        if (beyond or watch.rests or not self._all_available) and currents.any():
            usable = self.available & ~watch.resting
            # The usable axes share the torque that was commanded for all axes.
            # While the field is unknown, each usable axis keeps its own current.
            known, limits = field(), self._limits * sizes
            if known is None:
                currents = np.clip(np.where(usable, currents, 0.0), -limits, limits)
            else:
                torque = np.cross(settings.dipoles @ currents, known)
                currents = allocate(
                    torque,
                    known,
                    settings.dipoles,
                    limits,
                    usable.astype(float),
                    settings.free_axis,
                    settings.resistance,
                ).currents
        probe = watch.probe
        if probe is None and testable and self._has_rate:
            probe = watch.test_wave(currents)
        wire = watch.correction.wire(currents) if probe is None else probe
        if watch.at_rest:
            wire = self._nothing
        self.command = watch.correction.effective(wire)
        self._coils.command(wire)

    def zero(self) -> None:
        """Command zero current."""
        self.command = self._nothing
        self._coils.command(self.command)

    def _brake(self, axes: Axes) -> None:
        """Brake the H-bridges of failed coils, because a leg stuck high drives a coil without a command."""
        if axes != self._braked:
            self._coils.brake(axes)
            self._braked = axes


_NO_DIPOLE: FloatArray = np.zeros(3)


class Steering:
    """Steers the body along its path, detumbles it, or keeps the coils at zero.

    Control is lost when no recent reading agrees with the estimate, when the estimate becomes too inaccurate
    without a gyro or, in detumbling, when there is no recent reading. The estimate is propagated by the model
    during a silence of the inertial unit, so that control returns smoothly. The currents become zero within a
    tenth of a second after the last reading. If the planner fails, the body follows its last path and is held
    at the end of the path (event `holding`). If there is no path, the currents are zero.
    """

    def __init__(self, body: FlightBody, drive: CoilDrive, services: Services) -> None:
        self._body, self._drive, self._facts = body, drive, services.facts
        self._has_rate = True  # whether the newest reading or another source gives the body rate

    def run(self, estimate: Estimate | None, now_ns: int, ever_started: bool) -> Steered:
        """Follow the path, or hold the attitude at its end.

        If there is no measured estimate, the coils are set to zero. The loss of control is reported only if
        the filter has had an estimate in this flight (`ever_started`).
        """
        control = self._body.control
        reference = control.paths.sample(now_ns)
        reason = "measurement too old or estimate too inaccurate for control: coils set to zero"
        text = "steering again" if estimate else reason
        self._facts.update(facts.CONTROL_LOST, estimate is None and ever_started, now_ns, text)
        state, dipole, saturated, adrift = SteeringState.OFF, _NO_DIPOLE, False, False
        if estimate is None or reference is None:
            self._release()
        else:
            following = control.paths.is_following(now_ns)
            state = SteeringState.FOLLOWING if following else SteeringState.HOLDING
            wanted: CoilCommand = control.tracker.command(estimate, reference)
            dipole, saturated = wanted.dipole, wanted.saturated
            field = self._body.estimation.field
            self._drive.send(wanted.currents, lambda: field(estimate), testable=True)
            adrift = not following and control.paths.is_adrift(now_ns)
        self._facts.update(
            facts.HOLDING, adrift, now_ns, "no newer path: holding the attitude at the end of the last path"
        )
        return self._steered(state, now_ns, reference, dipole, saturated)

    def begin_detumbling(self, now_ns: int) -> None:
        """Begin the control windows of detumbling."""
        self._body.control.detumbling.begin(now_ns)

    def begin_sun_acquisition(self, now_ns: int) -> None:
        """Begin the control windows of Sun acquisition, if the body has this law."""
        if (acquisition := self._body.control.sun_acquisition) is not None:
            acquisition.begin(now_ns)

    def detumble(self, readings: Sequence[ImuReading], current: bool, now_ns: int) -> Steered:
        """Detumble in this cycle. The flag `current` states whether the newest reading is recent enough."""
        return self._run_law(self._body.control.detumbling, readings, current, now_ns)

    def acquire_sun(self, readings: Sequence[ImuReading], current: bool, now_ns: int) -> Steered:
        """Turn the body to the Sun in this cycle, or keep the coils at zero if the body has no law for it."""
        acquisition = self._body.control.sun_acquisition
        if acquisition is None:
            return self.rest(now_ns)
        return self._run_law(acquisition, readings, current, now_ns, needs_rate=True)

    def _run_law(
        self,
        law: WindowedLaw,
        readings: Sequence[ImuReading],
        current: bool,
        now_ns: int,
        needs_rate: bool = False,
    ) -> Steered:
        """Command the coils by a control law that needs no state estimate, although it may need a rate."""
        for reading in readings:
            known = None if reading.has_rate else self._body.estimation.rate_without_gyro(now_ns)
            self._has_rate = reading.has_rate or known is not None
            law.sample(reading.time_ns, reading.field, reading.rate if known is None else known)
        text = "detumbling again" if current else "readings too old for detumbling: coils set to zero"
        if current and needs_rate and not self._has_rate:
            current, text = False, "neither gyro nor estimate gives the rate: coils set to zero"
        self._facts.update(facts.CONTROL_LOST, not current, now_ns, text)
        if not current:
            steered = self.rest(now_ns)
            law.sent(self._drive.command)
            return steered
        self._body.control.tracker.reset()
        wanted = law.command(now_ns)
        self._drive.send(wanted.currents, lambda: law.field(now_ns))
        law.sent(self._drive.command)
        return self._steered(SteeringState.BRAKING, now_ns, None, wanted.dipole)

    def rest(self, now_ns: int) -> Steered:
        """Keep the coils at zero in this cycle, and return the result."""
        self._release()
        return self._steered(SteeringState.OFF, now_ns, None, _NO_DIPOLE)

    def zero(self) -> None:
        """Command zero current."""
        self._drive.zero()

    def isolate(self) -> None:
        """Exclude the coils that the coil monitor considers broken."""
        self._drive.isolate()

    def _release(self) -> None:
        self._drive.zero()
        self._body.control.tracker.reset()

    def _steered(
        self,
        state: SteeringState,
        now_ns: int,
        reference: Any | None,
        dipole: FloatArray,
        saturated: bool = False,
    ) -> Steered:
        """Check the PWM chip (its fault switches the coils off), and return the result of this cycle."""
        error = self._drive.fault()
        text = error or "the PWM chip accepts commands again"
        self._facts.update(facts.COIL_FAULT, bool(error), now_ns, text)
        return Steered(state, reference, dipole, self._drive.command, saturated)
