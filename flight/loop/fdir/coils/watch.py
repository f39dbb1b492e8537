"""Which coil is broken, and how: commanded currents against the supply current and the body's answer.

For the loop (all calls are cheap, none waits):

    watch = CoilWatch(CoilWatchSettings(full_current=..., ...))
    watch.commanded(time_ns, currents, braked, written_ns)  # each cycle: what is on the wire (CoilState)
    watch.interrupted(time_ns)           # in cycles before which nobody knows what the coils carried
    watch.observe_motion(time_ns, rate, field)     # each sample of the inertial unit: rad/s, T, body axes
    watch.measured(power_reading)        # each look at the monitor; the same reading twice is no matter
    watch.verdicts                       # tuple of CoilVerdict, one an axis at most; they stay until `forget`
    watch.available                      # (3,) bool, for `flight.gnc.control.allocation`
    watch.braked                         # which bridges are to be braked now (TorqueCoils.brake)
    watch.at_rest                        # whether nothing is to be commanded now, for half a second
    watch.suspicion                      # text while the readings fit no healthy circuit, else empty
    watch.probe                          # (3,) A to be added to the commands: zero, or a wave without a mean
    watch.monitor_doubted                # why the monitor, not a coil, is to be doubted; empty when nothing

The monitor tells the sum of |I| of three bridges, so it cannot see a reversed coil, and sees an open one only
while that axis is commanded: of what is not driven nothing is known, and nothing is claimed. Every reading is
compared with what each hypothesis (healthy; each axis open, shorted, either leg of either input stuck) says
it should be (`flight.loop.fdir.coils.hypotheses`); one is held while it explains the readings since the
trouble began. A verdict is given when healthy is not held and one axis alone is left; where several are left
that are
not driven, a small wave is asked for on each in turn, which tells them apart. A reversed coil is found from
the angular acceleration (`flight.loop.fdir.coils.response`), which also tells a monitor that lies from a coil
that is broken. Current that nobody asked for is told sooner: `flight.loop.fdir.coils.stuck_leg` brakes what
is at rest, in every mode; while it is at work no other verdict is given. The bounds are the thesis's 3.5 mA
on each
coil's current (Sease 2013 ch. 5), the resistance's error, and the 18 % by which a single conversion may miss
the chopped current (`hal.drivers.ina219`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from flight.gnc.math.arrays import FloatArray
from flight.loop.fdir.coils.brake_proof import BrakeProof
from flight.loop.fdir.coils.commands import CoilCommands
from flight.loop.fdir.coils.hypotheses import (
    ELECTRICAL,
    MEAN,
    NEWEST,
    Bounds,
    CoilFault,
    Predicted,
    Sampling,
    fits,
    predict,
)
from flight.loop.fdir.coils.motion_witness import MotionWitness
from flight.loop.fdir.coils.probe import Probe
from flight.loop.fdir.coils.response import CoilResponse
from flight.loop.fdir.coils.stuck_leg import NONE, Axes, StuckLeg
from flight.loop.fdir.coils.verdict import CoilVerdict, CoilWatchSettings
from hal.interfaces.readings import PowerReading

__all__ = ["CoilFault", "CoilVerdict", "CoilWatch", "CoilWatchSettings"]

AXES = "xyz"

BoolArray = npt.NDArray[np.bool_]


_BRAKED = {CoilFault.A_HIGH, CoilFault.B_HIGH, CoilFault.HIGH}
_STUCK_EXCESS = 0.3
"""Of the current of a coil that is fully on: a leg stuck high draws more without doubt."""
_LEAST_SHORT = 0.02
"""A; a smaller excess is below what the body's motion could confirm."""
_READING_NS = 200_000_000
_MOST_EVIDENCE = 40
_IN_DOUBT = 5
"""Readings until a verdict may leave open what is wrong with the axis."""


class CoilWatch:
    """Holds the commands and readings of the last seconds, and the verdicts."""

    def __init__(self, settings: CoilWatchSettings) -> None:
        self._settings = settings
        self._bounds = Bounds(
            settings.full_current,
            settings.current_uncertainty,
            settings.gain_error,
            settings.monitor_noise,
        )
        self._commands = CoilCommands(2 * settings.window_ns)
        self._reading_ns = -(1 << 62)
        self._fresh = 0
        self._strange = 0
        self._suspected_ns: int | None = None
        self._judge_ns = 0  # when a verdict may be given in doubt of the kind of fault
        self._sound_ns = 0  # when a coil that was driven last drew what it should
        self._unmixed_ns = 0  # from when on a reading's mean tells of one state of the circuit
        self._evidence: deque[Predicted] = deque(maxlen=_MOST_EVIDENCE)
        self._probe = Probe(settings.probe_current, settings.probe_half_ns)
        self._response = None if settings.response is None else CoilResponse(settings.response)
        self._verdicts: dict[int, CoilVerdict] = {}
        self._looked_ns = 0
        self._leg = StuckLeg(_STUCK_EXCESS * min(settings.full_current))
        self._proof = BrakeProof()
        self._witness = MotionWitness(self._response, settings.full_current)
        self._strangeness = ""

    @property
    def verdicts(self) -> tuple[CoilVerdict, ...]:
        """Return the broken axes, in the order in which they were found."""
        return tuple(self._verdicts.values())

    @property
    def available(self) -> BoolArray:
        """Return (3,) which axes may be used."""
        return np.array([axis not in self._verdicts for axis in range(3)])

    @property
    def suspicion(self) -> str:
        """Return why a coil is suspected, empty while none is."""
        return self._leg.suspicion or self._strangeness

    @property
    def braked(self) -> Axes:
        """Return which bridges are to be braked: those with a leg stuck high, or to find out which has."""
        x, y, z = (
            asked or (axis in self._verdicts and self._verdicts[axis].fault in _BRAKED)
            for axis, asked in enumerate(self._leg.brake)
        )
        return x, y, z

    @property
    def at_rest(self) -> bool:
        """Tell whether nothing is to be commanded now, so that a leg stuck high shows."""
        return self._leg.rest

    def forget(self, axis: int) -> None:
        """Trust an axis again, by command; a fault that lasts will be found again."""
        self._verdicts.pop(axis, None)
        self._proof.discard(axis)
        self.interrupted(self._commands.newest_ns if self._commands else 0)

    def commanded(
        self, time_ns: int, currents: FloatArray, braked: Axes = NONE, written_ns: int | None = None
    ) -> None:
        """Tell which currents (3,) A are on the wire at `time_ns`, and which bridges are braked.

        They have been since `written_ns`, by default since now.
        """
        values = tuple(currents.tolist())
        self._commands.note(time_ns, values, braked)
        # Without readings nobody would end a rest or a brake.
        if self._leg.is_at_work and time_ns - self._looked_ns > self._settings.window_ns:
            self._leg.reset()
        if self._response is not None:
            self._response.commanded(time_ns if written_ns is None else written_ns, values)

    def observe_motion(self, time_ns: int, rate: FloatArray, field: FloatArray) -> None:
        """Take a sample of the body rate (3,) rad/s and the magnetic field (3,) T, body axes."""
        if self._response is None or not self._response.observe_motion(time_ns, rate, field):
            return
        for axis in self._response.reversed_axes():
            # A current that nobody asked for turns the body too.
            if axis not in self._verdicts and not self.suspicion:
                self._give(axis, CoilFault.REVERSED, time_ns, self._response.text(axis))

    def interrupted(self, now_ns: int) -> None:
        """Know nothing of the time until now: the driver, or nobody, can say what was on the wire."""
        self._fresh = 0
        self._leg.reset()
        self._reset()
        if self._response is not None:
            self._response.interrupted(now_ns)

    def measured(self, reading: PowerReading) -> None:
        """Take a reading of the monitor."""
        gap_ns = reading.time_ns - self._reading_ns
        if gap_ns <= 0 or not self._commands:
            return
        self._reading_ns = reading.time_ns
        self._look_at_legs(reading)
        if self._leg.is_at_work:
            self._unmixed_ns = reading.time_ns
            if self._suspected_ns is None and self._leg.suspicion:
                self._suspect(self._leg.suspicion)
            return
        self._fresh = self._fresh + 1 if gap_ns < self._settings.window_ns else 1
        if self._fresh <= self._settings.settle:
            self._reset()
            self._unmixed_ns = reading.time_ns
            return
        taken = self._taken(reading)
        if self._suspected_ns is None:
            self._look_healthy(taken, reading)
        elif reading.time_ns - self._suspected_ns > self._settle_ns:
            self._evidence.extend(taken)
            self._judge(reading.time_ns)

    @property
    def probe(self) -> FloatArray:
        """Return (3,) A to be added to the commands now: it makes no mean torque."""
        return self._probe.wave(self._commands.newest_ns) if self._commands else np.zeros(3)

    @property
    def monitor_doubted(self) -> str:
        """Return why the monitor, not a coil, is doubted; empty while it is believed."""
        return self._witness.doubt

    @property
    def _settle_ns(self) -> int:
        return self._settings.settle * _READING_NS

    @property
    def _known(self) -> dict[int, CoilFault]:
        """Return what the circuit does of each broken axis: one that is braked takes nothing."""
        return {
            axis: CoilFault.OPEN if verdict.fault in _BRAKED else verdict.fault
            for axis, verdict in self._verdicts.items()
        }

    def _look_at_legs(self, reading: PowerReading) -> None:
        """Look whether a leg is stuck high, where this conversion was made under the present brakes."""
        commands = self._commands
        if commands.braked != self.braked or not commands.is_known_since(reading.newest_since_ns):
            return
        self._looked_ns = reading.time_ns
        seen = commands.supplied(reading, self._bounds, self._known)
        if self._proof:
            for axis in self._proof.ingest(self._leg.exceeds(seen)):  # back to both inputs low
                self._verdicts[axis] = replace(self._verdicts[axis], fault=CoilFault.UNCERTAIN)
            return
        found = self._leg.look(seen)
        if found is not None:
            text = f"{1e3 * reading.newest:.0f} mA without a command"
            self._give(found, CoilFault.HIGH, reading.time_ns, text)
            self.interrupted(reading.time_ns)

    def _taken(self, reading: PowerReading) -> list[Predicted]:
        """Return what a reading says: its newest conversion, and its mean where nothing is mixed in it."""
        windows: list[tuple[float, int, Sampling]] = [(reading.newest, reading.newest_since_ns, NEWEST)]
        begin_ns = reading.time_ns - self._settings.window_ns
        if begin_ns >= self._unmixed_ns:
            windows.append((reading.current, begin_ns, MEAN))
        return [
            predict(current, self._commands.window(since_ns, reading.time_ns), self._bounds, sampling)
            for current, since_ns, sampling in windows
        ]

    def _look_healthy(self, taken: list[Predicted], reading: PowerReading) -> None:
        asked = float(taken[0].mean[:, 0].sum())
        if all(fits([one], self._bounds, self._known) for one in taken):
            self._strange = 0
            self._witness.believe()
            if asked > self._bounds.uncertainty:
                self._sound_ns = reading.newest_since_ns
            return
        self._strange += 1
        if self._strange >= self._settings.persistence:
            why = f"supply current {1e3 * reading.newest:.0f} mA where {1e3 * asked:.0f} are due"
            self._suspect(why)
            if reading.newest > asked > 0.0:
                self._leg.ask_for_rest(why)

    def _suspect(self, why: str) -> None:
        self._suspected_ns = self._unmixed_ns = self._reading_ns
        self._judge_ns = self._reading_ns + self._settle_ns + _IN_DOUBT * _READING_NS
        self._evidence.clear()
        self._strangeness = why

    def _judge(self, now_ns: int) -> None:
        """Give a verdict if the evidence leaves one axis; give the suspicion up if all is healthy again."""
        evidence = tuple(self._evidence)
        if len(evidence) < self._settings.evidence:
            return
        if fits(evidence[-8:], self._bounds, self._known):
            self._reset()
            return
        sound = [axis for axis in range(3) if axis not in self._verdicts]
        left = [
            (axis, fault)
            for axis in sound
            for fault in ELECTRICAL
            if fits(evidence, self._bounds, self._known, axis, fault)
        ]
        axes = {axis for axis, _ in left}
        waited = now_ns >= self._judge_ns
        if len(axes) == 1 and (len(left) == 1 or waited):
            axis, fault = left[0]
            self._conclude(axis, fault if len(left) == 1 else CoilFault.UNCERTAIN, now_ns)
        elif waited:
            self._look_further(axes, now_ns)

    def _conclude(self, axis: int, fault: CoilFault, now_ns: int) -> None:
        excess = max(one.current - float(one.mean[:, 0].sum()) for one in self._evidence)
        if fault is CoilFault.SHORTED and excess < _LEAST_SHORT:
            self._reset()  # too little for the body to bear it out: it may be the monitor
            return
        if self._is_contradicted(axis, fault):
            why = f"{self._strangeness}; yet the body feels no change of coil {AXES[axis]}"
            self._witness.doubt_monitor(why, now_ns)
        else:
            self._give(axis, fault, now_ns, self._strangeness)
            if fault in _BRAKED:
                self._proof.add(axis)
                self._fresh = 0
        self._reset()

    def _is_contradicted(self, axis: int, fault: CoilFault) -> bool:
        if self._suspected_ns is None:
            return False
        begun_ns = min(self._sound_ns, self._suspected_ns - self._settings.window_ns)
        return self._witness.contradicts(axis, fault, begun_ns, self._suspected_ns, self._reading_ns)

    def _look_further(self, axes: set[int], now_ns: int) -> None:
        """Put a wave on one of the axes that cannot be told apart; when all were tried, collect new evidence.

        No hypothesis explains an intermittent fault, or a fault of the monitor.
        """
        ends_ns = self._probe.begin(axes, now_ns)
        if ends_ns is None:
            self._evidence.clear()
            self._judge_ns = now_ns + _IN_DOUBT * _READING_NS
        else:
            self._judge_ns = ends_ns + _READING_NS

    def _give(self, axis: int, fault: CoilFault, now_ns: int, why: str) -> None:
        text = f"coil {AXES[axis]} {fault.value} ({why})"
        self._verdicts[axis] = CoilVerdict(axis, fault, now_ns, text)

    def _reset(self) -> None:
        self._strange = 0
        self._suspected_ns = None
        self._evidence.clear()
        self._probe.stop()
        self._strangeness = ""
