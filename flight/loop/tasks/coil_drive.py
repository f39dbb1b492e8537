"""Sends coil commands: excludes failed axes and reallocates the rest to preserve the torque direction.

Written commands are compared with the supply current and the body's motion (`flight.loop.fdir.coils.watch`).
A verdict becomes a fact, the fact an event, and the event's reaction excludes the axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flight.link import events
from flight.loop.fdir import facts
from flight.loop.fdir.coils.stuck_leg import NONE, Axes
from flight.loop.fdir.coils.watch import CoilVerdict, CoilWatch
from flight.loop.services import Services
from flight.schema.sections import Modes
from hal.interfaces.devices import PowerMonitor, TorqueCoils
from hal.interfaces.readings import CoilState, ImuReading
from knightcube.astro.arrays import BoolArray, FloatArray
from knightcube.gnc.control.allocation import allocate

_BROKEN = (facts.COIL_X_BROKEN, facts.COIL_Y_BROKEN, facts.COIL_Z_BROKEN)


@dataclass(frozen=True, slots=True, eq=False)
class CoilDriveSettings:
    """The coils.

    Attributes:
        dipole_per_ampere: n A of each, m^2.
        limits: (3,) A.
        free_axis: (3,) the only axis about which the body can turn; None for a free body.
    """

    dipole_per_ampere: float
    limits: FloatArray
    free_axis: FloatArray | None


class CoilDrive:
    """Commands the coils and watches their response.

    Attributes:
        command: (3,) A, asked of the driver in this cycle.
        available: (3,) bool, the axes in use.
    """

    def __init__(
        self,
        coils: TorqueCoils,
        power: PowerMonitor | None,
        watch: CoilWatch,
        settings: CoilDriveSettings,
        services: Services,
    ) -> None:
        self._coils = coils
        self._power = power
        self._watch = watch
        self._settings = settings
        self._facts = services.facts
        self._events = services.events
        self._verdicts = 0
        self._braked = NONE
        self.available = np.ones(3, dtype=bool)
        self.command: FloatArray = np.zeros(3)

    def state(self) -> CoilState:
        """Return the command on the wire."""
        return self._coils.state()

    def off(self) -> None:
        """Switch all coils off at the driver, at the flight's end."""
        self._coils.off()

    def fault(self) -> str:
        """Return why the PWM chip does not take commands; empty while it does."""
        return self._coils.state().error

    @property
    def suspects(self) -> bool:
        """Whether a coil may carry another current than its command, no verdict being given yet."""
        return self._watch.doubts_currents

    def look(
        self, in_force: CoilState, readings: Sequence[ImuReading], now_ns: int, *, known: bool = True
    ) -> None:
        """Compare the command on the wire with the monitor and the motion, once a cycle.

        Unless the currents since the last cycle are `known`, the evidence until now is discarded.
        """
        watch = self._watch
        if in_force.written_ns >= 0:
            watch.commanded(now_ns, in_force.current, in_force.braked, in_force.written_ns)
        if not known:
            watch.interrupted(now_ns)
        for reading in readings:
            watch.observe_motion(reading.time_ns, reading.rate, reading.field)
        answer = self._power.latest() if self._power is not None and not self._power.error() else None
        if answer is not None:
            watch.measured(answer)
        found = watch.verdicts
        for verdict in found[self._verdicts :]:
            self._state(verdict, now_ns)
        self._verdicts = len(found)
        self._brake(watch.braked)
        self._facts.update(facts.COIL_SUSPECT, bool(watch.suspicion), now_ns, watch.suspicion)
        self._facts.update(facts.POWER_DOUBTED, bool(watch.monitor_doubted), now_ns, watch.monitor_doubted)

    def adopt(self, modes: Modes) -> None:
        """Go on with other bounds of the modes."""
        self._watch.tumble_rate = modes.tumble_rate

    def isolate(self) -> None:
        """Exclude the axes that have a verdict: the reaction to `coil-broken`."""
        self.available = self._watch.available

    def trust(self, now_ns: int) -> None:
        """Use all axes again, by command; a lasting fault will be found again."""
        for axis in range(3):
            self._watch.forget(axis)
        self._verdicts = 0
        self.isolate()
        self._events.report(events.COIL_TRUSTED, now_ns, "all three axes are in use again")

    def send(self, currents: FloatArray, field: Callable[[], FloatArray | None]) -> None:
        """Command currents (3,) A; `field` returns the field (3,) T in body axes, for a reallocation."""
        usable = self.available & ~self._watch.resting
        if not all(usable.tolist()) and currents.any():
            currents = self._reallocated(currents, field(), usable)
        self.command = np.zeros(3) if self._watch.at_rest else currents + self._watch.probe
        self._coils.command(self.command)

    def zero(self) -> None:
        """Command zero current."""
        self.command = np.zeros(3)
        self._coils.command(self.command)

    def _brake(self, axes: Axes) -> None:
        """Brake bridges: a bridge with a leg stuck high drives its coil even at zero command."""
        if axes != self._braked:
            self._coils.brake(axes)
            self._braked = axes

    def _reallocated(self, currents: FloatArray, field: FloatArray | None, usable: BoolArray) -> FloatArray:
        """Return currents of the `usable` axes (3,) that make the torque of `currents`."""
        if field is None:
            return np.where(usable, currents, 0.0)
        dipole, limits = self._settings.dipole_per_ampere, self._settings.limits
        torque = np.cross(dipole * currents, field)
        return allocate(
            torque, field, dipole, limits, usable.astype(float), self._settings.free_axis
        ).currents

    def _state(self, verdict: CoilVerdict, now_ns: int) -> None:
        self._facts.update(_BROKEN[verdict.axis], True, now_ns, verdict.text)
