"""Which coil is broken, and how: commanded currents against the supply current and the body's answer.

For the loop (all calls are cheap, none waits):

    watch = CoilWatch(CoilWatchSettings(full_current=..., ...))
    watch.commanded(time_ns, currents)   # each cycle: what is on the wire (CoilState.current)
    watch.interrupted()                  # in cycles in which the driver does not know what is on the wire
    watch.felt(time_ns, rate, field)     # each sample of the inertial unit: rad/s, T, body axes
    watch.measured(power_reading)        # each look at the monitor; the same reading twice is no matter
    watch.verdicts                       # tuple of CoilVerdict, one an axis at most; they stay until `forget`
    watch.available, watch.neutral       # (3,) bool and (3,) A, for `flight.control.allocation`
    watch.suspicion                      # text while the readings fit no healthy circuit, else empty
    watch.probe                          # (3,) A to be added to the commands: zero, or a wave without a mean
    watch.monitor_doubted                # why the monitor, not a coil, is to be doubted; empty when nothing

The monitor tells the sum of |I| of three bridges, so it cannot see a reversed coil, and sees an open one only
while that axis is commanded: of what is not driven nothing is known, and nothing is claimed. Every reading is
compared with what each hypothesis (healthy; each axis open, shorted, either leg of either input stuck) says
it should be (`flight.health.coil_hypotheses`); one is held while it explains the readings since the trouble
began. A verdict is given when healthy is not held and one axis alone is left; where several are left that are
not driven, a small wave is asked for on each in turn, which tells them apart. A reversed coil is found from
the angular acceleration (`flight.health.coil_response`), which also tells a monitor that lies from a coil
that is broken. The bounds are the thesis's 3.5 mA on each coil's current (Sease 2013 ch. 5), the resistance's
error, and the 7 % that the monitor's windows may miss of the chopped current (`hal.drivers.ina219`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flight.arrays import FloatArray
from flight.health.coil_hypotheses import ELECTRICAL, Bounds, CoilFault, Foretold, fits, foretell
from flight.health.coil_response import CoilResponse, ResponseSettings
from hal.interfaces.readings import PowerReading

__all__ = ["CoilFault", "CoilVerdict", "CoilWatch", "CoilWatchSettings"]

AXES = "xyz"

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CoilVerdict:
    """One broken axis: 0, 1, 2 for x, y, z. `neutral` A is the command that makes the axis carry least."""

    axis: int
    fault: CoilFault
    time_ns: int
    neutral: float
    text: str


@dataclass(frozen=True, slots=True)
class CoilWatchSettings:
    """What is known of the circuit and of the monitor.

    Attributes:
        full_current: A, of a coil that is fully on: supply voltage over resistance.
        current_uncertainty: A, bound on each driven coil's current beside its command.
        gain_error: relative bound: resistance, supply, and the monitor's windows in the chopped current.
        monitor_noise: A, bound, at any current.
        window_ns: how far back a reading reaches. Readings further apart than this begin anew.
        persistence: readings in a row without a healthy explanation until there is a suspicion.
        settle: readings after that until one tells of the time after the fault only.
        evidence: readings that a verdict takes.
        probe_current: A, of the wave by which axes that are not driven are told apart.
        probe_half_ns: half of its period.
        response: how the body answers to the coils; None where it cannot tell.
    """

    full_current: tuple[float, float, float]
    current_uncertainty: float = 3.5e-3
    gain_error: float = 0.2
    monitor_noise: float = 1.5e-3
    window_ns: int = 1_100_000_000
    persistence: int = 3
    settle: int = 5
    evidence: int = 3
    probe_current: float = 0.04
    probe_half_ns: int = 1_300_000_000
    response: ResponseSettings | None = None


# A leg stuck high drives its coil all the time, one way or the other.
_STUCK = {CoilFault.A_HIGH: 1.0, CoilFault.B_HIGH: -1.0}
_LITTLE_FELT = 0.4
_READING_NS = 200_000_000
_MOST_EVIDENCE = 40
_SAMPLES = 45  # of the commands in a window


class CoilWatch:
    """Holds the commands and readings of the last seconds, and the verdicts."""

    def __init__(self, settings: CoilWatchSettings) -> None:
        self._settings = settings
        self._bounds = Bounds(
            settings.full_current, settings.current_uncertainty, settings.gain_error, settings.monitor_noise
        )
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque()
        self._reading_ns = -(1 << 62)
        self._fresh = 0
        self._strange = 0
        self._suspected_ns: int | None = None
        self._judge_ns = 0  # when a verdict may be given in doubt of the kind of fault
        self._evidence: deque[Foretold] = deque(maxlen=_MOST_EVIDENCE)
        self._probing: tuple[int, int] | None = None  # axis, and since when
        self._probed: set[int] = set()
        self._response = None if settings.response is None else CoilResponse(settings.response)
        self._verdicts: dict[int, CoilVerdict] = {}
        self.suspicion = ""
        self.monitor_doubted = ""

    @property
    def verdicts(self) -> tuple[CoilVerdict, ...]:
        """Return the broken axes, in the order in which they were found."""
        return tuple(self._verdicts.values())

    @property
    def available(self) -> BoolArray:
        """Return (3,) which axes may be used."""
        return np.array([axis not in self._verdicts for axis in range(3)])

    @property
    def neutral(self) -> FloatArray:
        """Return (3,) A to be commanded beside what is wanted: of a leg stuck high it brakes the coil."""
        found = self._verdicts
        return np.array([found[axis].neutral if axis in found else 0.0 for axis in range(3)])

    def forget(self, axis: int) -> None:
        """Trust an axis again, by command; a fault that lasts will be found again."""
        self._verdicts.pop(axis, None)
        self.interrupted()

    def commanded(self, time_ns: int, currents: FloatArray) -> None:
        """Tell which currents (3,) A are on the wire from `time_ns` on."""
        values = tuple(currents.tolist())
        self._commands.append((time_ns, values))
        horizon = time_ns - 2 * self._settings.window_ns
        while len(self._commands) > 1 and self._commands[1][0] <= horizon:
            self._commands.popleft()
        if self._response is not None:
            self._response.commanded(time_ns, values)

    def felt(self, time_ns: int, rate: FloatArray, field: FloatArray) -> None:
        """Take a sample of the body rate (3,) rad/s and the magnetic field (3,) T, body axes."""
        if self._response is None or not self._response.felt(time_ns, rate, field):
            return
        for axis in self._response.reversed_axes():
            if axis not in self._verdicts:
                self._give(axis, CoilFault.REVERSED, time_ns, self._response.text(axis))

    def interrupted(self) -> None:
        """Know nothing of the time until now: the driver cannot say what is on the wire."""
        self._fresh = 0
        self._begin_anew()
        if self._response is not None:
            self._response.begin_anew()

    def measured(self, reading: PowerReading) -> None:
        """Take a reading of the monitor."""
        gap_ns = reading.time_ns - self._reading_ns
        if gap_ns <= 0 or not self._commands:
            return
        self._reading_ns = reading.time_ns
        self._fresh = self._fresh + 1 if gap_ns < self._settings.window_ns else 1
        # The driver's mean fills up again after a gap: until it has, it covers less than the window.
        if self._fresh <= self._settings.settle:
            self._begin_anew()
            return
        taken = foretell(reading.current, self._window(reading.time_ns), self._bounds)
        if self._suspected_ns is None:
            self._look_healthy(taken)
        elif reading.time_ns - self._suspected_ns > self._settle_ns:
            self._evidence.append(taken)
            self._judge(reading.time_ns)

    @property
    def probe(self) -> FloatArray:
        """Return (3,) A to be added to the commands now: it makes no mean torque."""
        wave = np.zeros(3)
        if self._probing is not None and self._commands:
            axis, since_ns = self._probing
            half = (self._commands[-1][0] - since_ns) // self._settings.probe_half_ns
            if half < 2:
                wave[axis] = self._settings.probe_current * (1.0 if half == 0 else -1.0)
            else:
                self._probing = None
        return wave

    @property
    def _settle_ns(self) -> int:
        return self._settings.settle * _READING_NS

    @property
    def _known(self) -> dict[int, CoilFault]:
        return {axis: verdict.fault for axis, verdict in self._verdicts.items()}

    def _look_healthy(self, taken: Foretold) -> None:
        if fits([taken], self._bounds, self._known):
            self._strange = 0
            self.monitor_doubted = ""
            return
        self._strange += 1
        if self._strange >= self._settings.persistence:
            self._suspected_ns = self._reading_ns
            self._judge_ns = self._suspected_ns + self._settle_ns + 8 * _READING_NS
            self._evidence.clear()
            asked = float(taken.mean[:, 0].sum())
            self.suspicion = f"supply current {1e3 * taken.current:.0f} mA where {1e3 * asked:.0f} are due"

    def _judge(self, now_ns: int) -> None:
        """Give a verdict if the evidence leaves one axis; give the suspicion up if all is healthy again."""
        evidence = tuple(self._evidence)
        if len(evidence) < self._settings.evidence:
            return
        if fits(evidence[-8:], self._bounds, self._known):
            self._begin_anew()
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
        if self._body_disagrees(axis, fault):
            self.monitor_doubted = f"{self.suspicion}; yet the body feels no change of coil {AXES[axis]}"
        else:
            self._give(axis, fault, now_ns, self.suspicion)
        self._begin_anew()

    def _body_disagrees(self, axis: int, fault: CoilFault) -> bool:
        """Tell whether the body feels a coil's torque as before, so that the monitor is wrong."""
        if self._response is None or self._suspected_ns is None:
            return False
        begun_ns = self._suspected_ns - self._settings.window_ns
        carried = _STUCK.get(fault, 0.0) * self._settings.full_current[axis]
        felt = self._response.felt_of(axis, carried, begun_ns, self._suspected_ns)
        if felt is None:
            return fault not in _STUCK and self._response.is_healthy(axis)
        # Without memory of the time before: a coil that is driven at zero command would be felt by now.
        return fault in _STUCK or self._response.is_healthy(axis) if math.isnan(felt) else felt < _LITTLE_FELT

    def _look_further(self, axes: set[int], now_ns: int) -> None:
        """Have a wave on one of the axes that cannot be told apart; where none explains it, begin anew.

        Nothing that is known explains an intermittent fault, or the monitor's own.
        """
        candidates = sorted(axes - self._probed)
        if not candidates:
            self._evidence.clear()
            self._probed.clear()
            self._judge_ns = now_ns + 8 * _READING_NS
            return
        self._probed.add(candidates[0])
        self._probing = (candidates[0], now_ns)
        self._judge_ns = now_ns + 2 * self._settings.probe_half_ns + _READING_NS

    def _give(self, axis: int, fault: CoilFault, now_ns: int, why: str) -> None:
        full = self._settings.full_current[axis]
        neutral = {CoilFault.A_HIGH: -full, CoilFault.B_HIGH: full}.get(fault, 0.0)
        text = f"coil {AXES[axis]} {fault.value} ({why})"
        self._verdicts[axis] = CoilVerdict(axis, fault, now_ns, neutral, text)

    def _begin_anew(self) -> None:
        self._strange = 0
        self._suspected_ns = None
        self._evidence.clear()
        self._probing = None
        self._probed.clear()
        self.suspicion = ""

    def _window(self, end_ns: int) -> FloatArray:
        """Return the commands (k, 3) that were in force in the window before `end_ns`, at even distances."""
        times = np.array([time_ns for time_ns, _ in self._commands])
        values = np.array([currents for _, currents in self._commands])
        back = np.linspace(self._settings.window_ns, 0, _SAMPLES, endpoint=False).astype(np.int64)
        newest: FloatArray = values[np.maximum(np.searchsorted(times, end_ns - back, side="right") - 1, 0)]
        return newest
