"""Coil currents from the PWM chip's outputs through SN754410 bridges (Sease 2013 ch. 5, Table 5.2).

The mean of a period counts: coil L/R is 0.1 ms, the period 20 ms. While the two inputs differ, V/R is driven
in one direction; equal inputs brake, an enable input that is low lets the coil coast; neither makes current.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum

import numpy as np

from flight.gnc.math.arrays import FloatArray
from hal.drivers.coil_settings import CoilSettings
from hal.drivers.pca9685 import COUNTS
from sim_hal.emulators.pca9685 import EmulatedPca9685

CURRENT_UNCERTAINTY = 3.5e-3
"""A; the thesis's bound on the error of a coil's current."""

_HISTORY_NS = 500_000_000
_LOW, _HIGH = (0, 0), (0, COUNTS)


class Condition(Enum):
    """The condition of a coil or its bridge; beside a stuck leg the other leg still follows its input."""

    SOUND = "sound"
    OPEN = "open"
    SHORTED = "shorted"
    REVERSED = "reversed"
    A_HIGH = "A stuck high"
    A_LOW = "A stuck low"
    B_HIGH = "B stuck high"
    B_LOW = "B stuck low"


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
        self._conditions = [Condition.SOUND] * 3
        self._short_ohm = [1.0, 1.0, 1.0]
        self._counts = [0, 0, 0]
        self._values = [0.0, 0.0, 0.0]
        self._drawn = [0.0, 0.0, 0.0]  # from the supply, by each bridge
        self._currents: FloatArray = np.zeros(3)
        # (time, charge in A ns that the supply has given by then, current since then), oldest first.
        self._history: deque[tuple[int, float, float]] = deque([(now_ns(), 0.0, 0.0)])
        chip.on_stop = self.update
        self.update(0)

    def currents(self) -> FloatArray:
        """Return the mean currents (3,) in A of the present PWM setting."""
        return self._currents

    def become(self, axis: int, condition: Condition, short_ohm: float = 5.0) -> None:
        """Set the condition of a coil; a shorted coil loads its bridge with `short_ohm`."""
        self._conditions[axis] = condition
        self._short_ohm[axis] = short_ohm
        self.update(self._coils[axis][1])

    def update(self, written: int) -> None:
        """Update the currents after a STOP; `written` is the mask of the channels that were written."""
        draws = self._generator.random(3).tolist() if written else (0.5, 0.5, 0.5)
        for axis, (coil, channels, step, limit) in enumerate(self._coils):
            condition = self._conditions[axis]
            counts = self._driven(coil.channel_a, coil.channel_b, coil.enable_channel, condition)
            if counts == self._counts[axis] and not written & channels:
                continue
            self._counts[axis] = counts
            current = 0.0
            if counts and condition is not Condition.OPEN:
                current = counts * step + self._uncertainty * (2.0 * draws[axis] - 1.0)
                current = min(limit, max(-limit, current))
            self._drawn[axis] = abs(current)
            if condition is Condition.SHORTED:
                self._drawn[axis] = abs(counts) / COUNTS * self._supply_voltage / self._short_ohm[axis]
                current = 0.0
            self._values[axis] = -current if condition is Condition.REVERSED else current
        self._currents = np.array(self._values)
        self._remember()

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the mean bus voltage (V) and mean current of all coils together (A) over a recent window.

        A bridge takes |I| from the supply whichever way its coil is driven. The history spans 0.5 s.
        """
        charge = self._charge(end_ns) - self._charge(start_ns)
        return self._bus_voltage, charge / (end_ns - start_ns)

    def _driven(self, channel_a: int, channel_b: int, enable: int | None, condition: Condition) -> int:
        """Return for how many counts of a period, signed, the coil is driven."""
        high = self._chip.high
        a, b = high(channel_a), high(channel_b)
        match condition:
            case Condition.A_HIGH | Condition.A_LOW:
                a = _HIGH if condition is Condition.A_HIGH else _LOW
            case Condition.B_HIGH | Condition.B_LOW:
                b = _HIGH if condition is Condition.B_HIGH else _LOW
            case _:
                pass
        if enable is None:
            # While both legs are high the coil is shorted, which brakes and does not drive.
            return a[1] - b[1]
        gate = high(enable)
        return common_counts(a, gate) - common_counts(b, gate)

    def _remember(self) -> None:
        now = self._now_ns()
        last_ns, charge, current = self._history[-1]
        self._history.append((now, charge + current * (now - last_ns), sum(self._drawn)))
        while len(self._history) > 1 and self._history[1][0] < now - _HISTORY_NS:
            self._history.popleft()

    def _charge(self, time_ns: int) -> float:
        for begin_ns, charge, current in reversed(self._history):
            if begin_ns <= time_ns:
                return charge + current * (time_ns - begin_ns)
        return self._history[0][1]


def common_counts(a: tuple[int, int], b: tuple[int, int]) -> int:
    """Return for how many counts of a period two pulses, (first count, length) each, are high together."""
    lag = (b[0] - a[0]) % COUNTS
    # b's pulse as a sees it starts at lag, and what runs over the period's end comes back at its beginning.
    first = min(a[1], lag + b[1]) - lag
    wrapped = min(a[1], lag + b[1] - COUNTS)
    return max(0, first) + max(0, wrapped)
