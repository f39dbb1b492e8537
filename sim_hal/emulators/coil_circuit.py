"""Coil currents from the PWM chip's outputs through SN754410 bridges (Sease 2013 ch. 5, Table 5.2).

The mean current over a PWM period moves the body: coil L/R is 0.1 ms, the period 20 ms (SN754410 and PCA9685
data sheets). While the two inputs of a bridge differ, V/R drives the coil in one direction. Equal inputs
brake the coil.

The supply's current is chopped: a bridge draws its coil's current only while its inputs differ.
`ChoppedSupply` integrates the current of three bridges exactly over any window.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hal.drivers.coils import CoilSettings, CoilWiring
from hal.drivers.pca9685 import COUNTS
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.pca9685 import EmulatedPca9685

Pulse = tuple[int, int]
"""When in a period an output is high: (first count, how many counts)."""

_HISTORY_NS = 500_000_000


class Bridge(NamedTuple):
    """The pulses on inputs A and B of a bridge, whose enable input is tied high."""

    a: Pulse
    b: Pulse

    def net_counts(self) -> int:
        """Return for how many counts of a period, signed, the coil is driven; both inputs high brake."""
        return self.a[1] - self.b[1]

    def driven(self) -> list[tuple[int, int]]:
        """Return the spans of counts [begin, end) in which the coil is driven either way."""
        if self.a == self.b:
            return []
        edges = {0, COUNTS}
        for first, length in self:
            edges |= {first, (first + length) % COUNTS}
        ordered = sorted(edges)
        spans = []
        for begin, end in pairwise(ordered):
            a, b = ((begin - first) % COUNTS < length for first, length in self)
            if a != b:
                spans.append((begin, end))
        return spans


class Chopping(NamedTuple):
    """The supply's current from `since_ns` on.

    Attributes:
        since_ns: when these outputs began.
        origin_ns: when the PWM counter was zero.
        period_ns: of the PWM.
        drawn: of each bridge the pulses, and the current in A while it is driven.
    """

    since_ns: int
    origin_ns: int
    period_ns: float
    drawn: tuple[tuple[Bridge, float], ...]

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge drawn between two times, in A ns."""
        periods = [divmod((time_ns - self.origin_ns) / self.period_ns, 1.0) for time_ns in (start_ns, end_ns)]
        (whole_0, part_0), (whole_1, part_1) = periods
        total = 0.0
        for bridge, current in self.drawn:
            for begin, end in bridge.driven() if current else ():
                at_0, at_1 = (min(max(part * COUNTS - begin, 0.0), end - begin) for part in (part_0, part_1))
                total += current * ((whole_1 - whole_0) * (end - begin) + at_1 - at_0)
        return total * self.period_ns / COUNTS


class ChoppedSupply:
    """The supply's current over the last half second."""

    def __init__(self) -> None:
        self._history: deque[Chopping] = deque()

    def note(self, chopping: Chopping) -> None:
        """Note that the outputs changed."""
        self._history.append(chopping)
        while len(self._history) > 1 and self._history[1].since_ns < chopping.since_ns - _HISTORY_NS:
            self._history.popleft()

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge drawn between two times, in A ns; none before the history begins."""
        total, until_ns = 0.0, end_ns
        for chopping in reversed(self._history):
            begin_ns = max(chopping.since_ns, start_ns)
            if begin_ns < until_ns:
                total += chopping.charge(begin_ns, until_ns)
                until_ns = begin_ns
            if chopping.since_ns <= start_ns:
                break
        return total


CURRENT_UNCERTAINTY = 3.5e-3
"""A; the thesis's bound on the error of a coil's current."""

_LOW, _HIGH = (0, 0), (0, COUNTS)
_OFF = Bridge(_LOW, _LOW)


class CoilCondition(Enum):
    """The condition of a coil or its bridge; beside a stuck leg the other leg still follows its input."""

    SOUND = "sound"
    OPEN = "open"
    SHORTED = "shorted"
    REVERSED = "reversed"
    A_HIGH = "a-high"
    A_LOW = "a-low"
    B_HIGH = "b-high"
    B_LOW = "b-low"


_FREE: tuple[Pulse | None, Pulse | None] = (None, None)
_STUCK: dict[CoilCondition, tuple[Pulse | None, Pulse | None]] = {
    CoilCondition.A_HIGH: (_HIGH, None),
    CoilCondition.A_LOW: (_LOW, None),
    CoilCondition.B_HIGH: (None, _HIGH),
    CoilCondition.B_LOW: (None, _LOW),
}
"""The pulses of the legs A and B that do not follow their inputs."""


class CoilCircuit:
    """Three coils on one chip; updates at every I2C STOP that may have changed outputs."""

    def __init__(
        self,
        chip: EmulatedPca9685,
        truth: CoilSettings,
        generator: np.random.Generator,
        now_ns: Callable[[], int],
        uncertainty: float = CURRENT_UNCERTAINTY,
        bus_voltage: float | None = None,
    ) -> None:
        """Connect the coils by their true wiring, which may differ from the driver's.

        `uncertainty` bounds a uniform error in A, drawn at each write of a coil's channels, none at zero;
        `bus_voltage` is the voltage at a monitor in the supply, V, by default the coils' supply voltage.
        """
        self._chip = chip
        self._coils = tuple(
            (
                coil,
                sum(1 << channel for channel in coil.channels),
                coil.sign * truth.supply_voltage / coil.resistance / COUNTS,
                min(truth.current_limit, truth.supply_voltage / coil.resistance),
            )
            for coil in truth.coils
        )
        self._generator = generator
        self._now_ns = now_ns
        self._uncertainty = uncertainty
        self._bus_voltage = truth.supply_voltage if bus_voltage is None else bus_voltage
        self._supply_voltage = truth.supply_voltage
        self._conditions = [CoilCondition.SOUND] * 3
        self._stuck = [_FREE] * 3
        self._short_ohm = [1.0, 1.0, 1.0]
        self._bridges = [_OFF] * 3
        self._values = [0.0, 0.0, 0.0]
        self._drawn = [0.0, 0.0, 0.0]  # from the supply while driven, by each bridge
        self._currents: FloatArray = np.zeros(3)
        self._supply = ChoppedSupply()
        chip.on_stop = self.update
        self.update(0)

    def currents(self) -> FloatArray:
        """Return the mean currents (3,) in A of the present PWM setting."""
        return self._currents

    def become(self, axis: int, condition: CoilCondition, short_ohm: float = 5.0) -> None:
        """Set the condition of a coil; a shorted coil loads its bridge with `short_ohm`."""
        self._conditions[axis] = condition
        self._stuck[axis] = _STUCK.get(condition, _FREE)
        self._short_ohm[axis] = short_ohm
        self.update(self._coils[axis][1])

    def update(self, written: int) -> None:
        """Update the currents after a STOP; `written` is the mask of the channels that were written."""
        draws = self._generator.random(3).tolist() if written else (0.5, 0.5, 0.5)
        for axis, (coil, channels, step, limit) in enumerate(self._coils):
            bridge = self._bridge(coil, *self._stuck[axis])
            if bridge == self._bridges[axis] and not written & channels:
                continue
            self._bridges[axis] = bridge
            counts = bridge.net_counts()
            current, drawn = 0.0, abs(step) * COUNTS
            if counts:
                current = counts * step + self._uncertainty * (2.0 * draws[axis] - 1.0)
                current = min(limit, max(-limit, current))
                drawn = abs(current) * COUNTS / abs(counts)
            match self._conditions[axis]:
                case CoilCondition.SOUND:
                    pass
                case CoilCondition.OPEN:
                    current, drawn = 0.0, 0.0
                case CoilCondition.SHORTED:
                    current, drawn = 0.0, self._supply_voltage / self._short_ohm[axis]
                case CoilCondition.REVERSED:
                    current = -current
                case _:
                    pass
            self._drawn[axis] = drawn
            self._values[axis] = current
        self._currents = np.array(self._values)
        self._remember()

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the mean bus voltage (V) and mean current of all coils together (A) over a recent window.

        A bridge takes |I| from the supply while its coil is driven, whichever way. The history spans 0.5 s.
        """
        return self._bus_voltage, self._supply.charge(start_ns, end_ns) / (end_ns - start_ns)

    def _bridge(self, coil: CoilWiring, stuck_a: Pulse | None, stuck_b: Pulse | None) -> Bridge:
        """Return the pulses that a bridge's legs follow: their inputs', or those at which they are stuck."""
        return Bridge(stuck_a or self._chip.high(coil.channel_a), stuck_b or self._chip.high(coil.channel_b))

    def _remember(self) -> None:
        # Without a clock the outputs are constant, and any frequency is right.
        period_ns = 1e9 / (self._chip.frequency or 1.0)
        pulses: tuple[tuple[Bridge, float], ...] = tuple(zip(self._bridges, self._drawn, strict=True))
        self._supply.note(Chopping(self._now_ns(), self._chip.counter_start_ns, period_ns, pulses))
