"""Coil currents from the PWM chip's outputs through SN754410 bridges (Sease 2013 ch. 5, Table 5.2).

The body moves by the mean of a period: coil L/R is 0.1 ms, the period 20 ms. While the two inputs differ, V/R
is driven in one direction; equal inputs brake, an enable input that is low lets the coil coast; neither makes
current. The supply's current is chopped (`sim_hal.worlds.chopped_supply`).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

import numpy as np

from hal.drivers.h_bridge import CoilSettings, CoilWiring
from hal.drivers.pca9685 import COUNTS
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.pca9685 import EmulatedPca9685
from sim_hal.worlds.chopped_supply import Bridge, ChoppedSupply, Chopping, Pulse

CURRENT_UNCERTAINTY = 3.5e-3
"""A; the thesis's bound on the error of a coil's current."""

_LOW, _HIGH = (0, 0), (0, COUNTS)
_OFF = Bridge(_LOW, _LOW, _HIGH)


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


_FREE: tuple[Pulse | None, Pulse | None] = (None, None)
_STUCK: dict[Condition, tuple[Pulse | None, Pulse | None]] = {
    Condition.A_HIGH: (_HIGH, None),
    Condition.A_LOW: (_LOW, None),
    Condition.B_HIGH: (None, _HIGH),
    Condition.B_LOW: (None, _LOW),
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
        self._conditions = [Condition.SOUND] * 3
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

    def become(self, axis: int, condition: Condition, short_ohm: float = 5.0) -> None:
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
                case Condition.SOUND:
                    pass
                case Condition.OPEN:
                    current, drawn = 0.0, 0.0
                case Condition.SHORTED:
                    current, drawn = 0.0, self._supply_voltage / self._short_ohm[axis]
                case Condition.REVERSED:
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
        high, enable = self._chip.high, coil.enable_channel
        return Bridge(
            stuck_a or high(coil.channel_a),
            stuck_b or high(coil.channel_b),
            _HIGH if enable is None else high(enable),
        )

    def _remember(self) -> None:
        # Without a clock the outputs are constant, and any frequency is right.
        period_ns = 1e9 / (self._chip.frequency or 1.0)
        pulses: tuple[tuple[Bridge, float], ...] = tuple(zip(self._bridges, self._drawn, strict=True))
        self._supply.note(Chopping(self._now_ns(), self._chip.counter_start_ns, period_ns, pulses))
