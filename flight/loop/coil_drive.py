"""The last hand before the coils: axes that are broken are left out, the others keep the torque's direction.

What is on the wire is compared with what the supply and the body say (`flight.loop.fdir.coils.watch`). A
verdict becomes a fact, the fact an event, and the event's reaction takes the axis out of use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flight.gnc.control.allocation import allocate
from flight.gnc.math.arrays import FloatArray
from flight.link import events
from flight.loop.fdir import facts
from flight.loop.fdir.coils.stuck_leg import NONE, Axes
from flight.loop.fdir.coils.watch import CoilVerdict, CoilWatch
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import Facts
from hal.interfaces.devices import PowerMonitor, TorqueCoils
from hal.interfaces.readings import CoilState, ImuReading

_BROKEN = (facts.COIL_X_BROKEN, facts.COIL_Y_BROKEN, facts.COIL_Z_BROKEN)


class CoilDrive:
    """Commands the coils, and watches what becomes of it.

    Attributes:
        command: (3,) A, asked of the driver in this cycle.
        available: (3,) bool, the axes in use.
    """

    def __init__(
        self,
        coils: TorqueCoils,
        watch: CoilWatch,
        dipole_per_ampere: float,
        limits: FloatArray,
        facts_: Facts,
        event_log: EventLog,
        power: PowerMonitor | None = None,
    ) -> None:
        """Take the coils, n A of each in m^2, and their limits (3,) in A. The body turns about y alone."""
        self._coils = coils
        self._watch = watch
        self._dipole = dipole_per_ampere
        self._limits = limits
        self._facts = facts_
        self._events = event_log
        self._power = power
        self._verdicts = 0
        self._braked = NONE
        self.available = np.ones(3, dtype=bool)
        self.command: FloatArray = np.zeros(3)

    def look(
        self, in_force: CoilState, readings: Sequence[ImuReading], now_ns: int, *, known: bool = True
    ) -> None:
        """Compare what is on the wire with what the monitor and the body answer, once a cycle.

        Nothing is made of the time until now where it is not `known` what the coils carried.
        """
        watch = self._watch
        if in_force.written_ns >= 0:
            watch.commanded(now_ns, in_force.current, in_force.braked, in_force.written_ns)
        if not known:
            watch.interrupted(now_ns)
        for reading in readings:
            watch.felt(reading.time_ns, reading.rate, reading.field)
        answer = self._power.latest() if self._power is not None and not self._power.error() else None
        if answer is not None:
            watch.measured(answer)
        found = watch.verdicts
        for verdict in found[self._verdicts :]:
            self._state(verdict, now_ns)
        self._verdicts = len(found)
        self._brake(watch.braked)
        self._facts.state(facts.COIL_SUSPECT, bool(watch.suspicion), now_ns, watch.suspicion)
        self._facts.state(facts.POWER_DOUBTED, bool(watch.monitor_doubted), now_ns, watch.monitor_doubted)

    def isolate(self) -> None:
        """Leave out the axes that have a verdict: the reaction to `coil-broken`."""
        self.available = self._watch.available

    def trust(self, now_ns: int) -> None:
        """Use all axes again, by command; what is still broken will be found again."""
        for axis in range(3):
            self._watch.forget(axis)
        self._verdicts = 0
        self.isolate()
        self._events.tell(events.COIL_TRUSTED, now_ns, "all three axes are in use again")

    def send(self, currents: FloatArray, field: Callable[[], FloatArray | None]) -> None:
        """Command currents (3,) A; `field` tells the field (3,) T in body axes where they are reallocated."""
        if not self.available.all() and currents.any():
            currents = self._reallocated(currents, field())
        self.command = np.zeros(3) if self._watch.at_rest else currents + self._watch.probe
        self._coils.command(self.command)

    def zero(self) -> None:
        """Command nothing at all."""
        self.command = np.zeros(3)
        self._coils.command(self.command)

    def _brake(self, axes: Axes) -> None:
        """Have bridges braked: one with a leg stuck high drives its coil at zero command."""
        if axes != self._braked:
            self._coils.brake(axes)
            self._braked = axes

    def _reallocated(self, currents: FloatArray, field: FloatArray | None) -> FloatArray:
        """Return the currents of the axes in use that make the torque that `currents` would have made."""
        if field is None:
            return np.where(self.available, currents, 0.0)
        torque = np.cross(self._dipole * currents, field)
        about_thread = np.array([0.0, 1.0, 0.0])
        shared = allocate(
            torque, field, self._dipole, self._limits, self.available.astype(float), about_thread
        )
        return shared.currents

    def _state(self, verdict: CoilVerdict, now_ns: int) -> None:
        self._facts.state(_BROKEN[verdict.axis], True, now_ns, verdict.text)
