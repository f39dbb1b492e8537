"""Coil currents from the PWM chip's outputs through SN754410 bridges, and the INA219 that measures them.

The circuit is that of Sease 2013 ch. 5, Table 5.2.

The mean current over a PWM period moves the body: coil L/R is 0.1 ms, the period 20 ms (SN754410 and PCA9685
data sheets). While the two inputs of a bridge differ, V/R drives the coil in one direction. Equal inputs
brake the coil.

The supply's current is chopped: a bridge draws its coil's current only while its inputs differ.
`ChoppedSupply` integrates the current of three bridges exactly over any window.

The emulated INA219 has registers and converts at its own pace (TI SBOS448G). Each conversion is the mean of
the supply over the conversion window, computed when the bus reads its result. Noise, gain error and the input
filter are not modelled.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hal.drivers.coils import CoilSettings
from hal.drivers.pca9685 import COUNTS
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.pca9685 import EmulatedPca9685

Pulse = tuple[int, int]
"""The high time of an output in a period: (first count, number of counts)."""

_HISTORY_NS = 500_000_000
"""Time over which the supply's current is recorded."""


class Bridge(NamedTuple):
    """The pulses on inputs A and B of a bridge, whose enable input is tied high."""

    a: Pulse
    b: Pulse

    def net_counts(self) -> int:
        """Return the signed number of counts of a period in which the coil is driven."""
        return self.a[1] - self.b[1]

    def driven(self) -> list[tuple[int, int]]:
        """Return the spans of counts [begin, end) in which the coil is driven."""
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
        since_ns: time of the change of the outputs.
        origin_ns: a time at which the PWM counter was zero.
        period_ns: PWM period.
        drawn: pulses of each bridge, and its current (A) while driven.
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
        """Record a change of the outputs."""
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
"""Bound of the error of a coil's current (A) in the thesis."""

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
"""Constant pulses of the legs A and B of each condition; None for a leg that follows its input."""


class CoilCircuit:
    """Three coils on one PWM chip, updated at every I2C STOP that may have changed outputs."""

    def __init__(
        self,
        chip: EmulatedPca9685,
        truth: CoilSettings,
        generator: np.random.Generator,
        now_ns: Callable[[], int],
        uncertainty: float = CURRENT_UNCERTAINTY,
        bus_voltage: float | None = None,
    ) -> None:
        """Connect the coils with their true properties.

        `uncertainty` (A) bounds a uniform error that is drawn at each write of a coil's channels.
        `bus_voltage` (V) is the voltage at a monitor in the supply, by default the coils' supply voltage.
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
            stuck_a, stuck_b = self._stuck[axis]
            pulse_a = stuck_a or self._chip.high(coil.channel_a)
            bridge = Bridge(pulse_a, stuck_b or self._chip.high(coil.channel_b))
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
                case CoilCondition.OPEN:
                    current, drawn = 0.0, 0.0
                case CoilCondition.SHORTED:
                    current, drawn = 0.0, self._supply_voltage / self._short_ohm[axis]
                case CoilCondition.REVERSED:
                    current = -current
            self._drawn[axis] = drawn
            self._values[axis] = current
        self._currents = np.array(self._values)
        # Without a clock the outputs are constant, and any period is right.
        period_ns = 1e9 / (self._chip.frequency or 1.0)
        pulses: tuple[tuple[Bridge, float], ...] = tuple(zip(self._bridges, self._drawn, strict=True))
        self._supply.note(Chopping(self._now_ns(), self._chip.counter_start_ns, period_ns, pulses))

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the mean bus voltage (V) and mean current of all coils together (A) over a recent window.

        A bridge draws |I| from the supply while its coil is driven. The window must be within the last 0.5 s.
        """
        return self._bus_voltage, self._supply.charge(start_ns, end_ns) / (end_ns - start_ns)


CONFIG = 0x00
POWER = 0x03
CALIBRATION = 0x05

POWER_ON_CONFIG = 0x399F
_RESET = 0x8000
_BUS_32V = 0x2000
_SHUNT_STEP_V = 10e-6
_BUS_STEP_V = 4e-3
_READY, _OVERFLOW = 0b10, 0b01
_RESERVED = 0x4000  # of Config; reads zero
_CALIBRATION_BITS = 0xFFFE
_REMEMBERED_NS = 60_000_000_000

# Nanoseconds by ADC code: 9 to 12 bits, then 12 bits averaged 2 to 128 times.
_SINGLE_NS = (84_000, 148_000, 276_000, 532_000)
_AVERAGED_NS = (532_000, 1_060_000, 2_130_000, 4_260_000, 8_510_000, 17_020_000, 34_050_000, 68_100_000)


def conversion_ns(code: int) -> int:
    """Return the time of one conversion with a 4-bit ADC code."""
    return _AVERAGED_NS[code & 7] if code & 8 else _SINGLE_NS[code & 3]


class EmulatedIna219:
    """One monitor; `measure(start_ns, end_ns)` returns mean bus voltage (V) and current (A) of a window.

    Attributes:
        gain: gain error of its current measurement, for faults; 1 is sound.
        frozen: constant content of registers, for faults.
        lag_ns: age of the conversions that it reports, up to a minute, for faults.
    """

    def __init__(
        self,
        address: int,
        now_ns: Callable[[], int],
        measure: Callable[[int, int], tuple[float, float]],
        shunt_ohm: float = 0.1,
    ) -> None:
        self.address = address
        self._now_ns = now_ns
        self._measure = measure
        self._ohm = shunt_ohm
        self.gain = 1.0
        self.frozen: dict[int, int] = {}
        self.lag_ns = 0
        self._calibration = 0
        self._past: deque[tuple[int, int, int]] = deque()  # (time, shunt, bus) of conversions, oldest first
        self.brown_out()

    def brown_out(self) -> None:
        """Interrupt the supply: every register returns to its power-on value."""
        self._pointer = 0
        self._calibration = 0
        self._shunt = 0
        self._bus = 0
        self._ready = False
        self._past.clear()
        self._configure(POWER_ON_CONFIG)

    def upset(self, register: int, bit: int) -> None:
        """Flip a bit of Config or Calibration, as radiation does; unused bits stay zero."""
        if register == CONFIG:
            self._convert()
            self._configure((self._config ^ 1 << bit) & 0xFFFF)
        elif register == CALIBRATION:
            self._calibration = (self._calibration ^ 1 << bit) & _CALIBRATION_BITS

    def register(self, register: int) -> int:
        """Return a register's word without the side effects of a bus read."""
        if register in self.frozen:
            return self.frozen[register]
        self._convert()
        current, power, overflow = self._products()
        shunt, volts = self._shown()
        bus = volts << 3 | (_READY if self._ready else 0) | (_OVERFLOW if overflow else 0)
        words = (self._config, shunt, bus, power, current, self._calibration)
        return words[register] & 0xFFFF if register < len(words) else 0

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges this address."""
        return address == self.address

    def write(self, address: int, data: bytes) -> None:
        """Accept a register pointer, and a word (big-endian) for Config or Calibration."""
        self._pointer = data[0]
        if len(data) < 3:
            return
        word = data[1] << 8 | data[2]
        if self._pointer == CONFIG:
            self._convert()
            self._configure(word)
        elif self._pointer == CALIBRATION:
            self._calibration = word & _CALIBRATION_BITS

    def read(self, count: int) -> bytes:
        """Return the word at the register pointer, big-endian; bytes beyond it read 0xFF."""
        word = self.register(self._pointer)
        if self._pointer == POWER:
            self._ready = False
        return word.to_bytes(2, "big")[:count] + b"\xff" * (count - 2)

    def _configure(self, word: int) -> None:
        if word & _RESET:
            self.brown_out()
            return
        self._config = word & ~_RESERVED
        mode = word & 0b111
        shunt_wanted, bus_wanted = mode & 0b001, mode & 0b010
        self._continuous = bool(mode & 0b100)
        self._shunt_ns = conversion_ns(word >> 3 & 0xF) if shunt_wanted else 0
        self._bus_ns = conversion_ns(word >> 7 & 0xF) if bus_wanted else 0
        self._begin_ns = self._now_ns()
        self._done = 0
        # Power-down and "ADC off" leave the flag as it is.
        if shunt_wanted or bus_wanted:
            self._ready = False

    def _convert(self) -> None:
        """Take the newest finished conversion: first the shunt, then the bus."""
        cycle_ns = self._shunt_ns + self._bus_ns
        if cycle_ns == 0:
            return
        ended = (self._now_ns() - self._begin_ns) // cycle_ns
        if not self._continuous:
            ended = min(ended, 1)
        if ended <= self._done:
            return
        self._done = ended
        self._ready = True
        start = self._begin_ns + (ended - 1) * cycle_ns
        middle = start + self._shunt_ns
        if self._shunt_ns:
            _, amps = self._measure(start, middle)
            gain = 1 << (self._config >> 11 & 0b11)
            code = self._config >> 3 & 0xF
            self._shunt = _digitised(
                amps * self.gain * self._ohm / _SHUNT_STEP_V, code, -4000 * gain, 4000 * gain
            )
        if self._bus_ns:
            volts, _ = self._measure(middle, middle + self._bus_ns)
            top = 8000 if self._config & _BUS_32V else 4000
            self._bus = _digitised(volts / _BUS_STEP_V, self._config >> 7 & 0xF, 0, top)
        now_ns = self._now_ns()
        self._past.append((now_ns, self._shunt, self._bus))
        while self._past[0][0] < now_ns - _REMEMBERED_NS:
            self._past.popleft()

    def _shown(self) -> tuple[int, int]:
        """Return the reported conversions of shunt and bus: the newest, or with `lag_ns` older ones."""
        if not self.lag_ns or not self._past:
            return self._shunt, self._bus
        until_ns = self._now_ns() - self.lag_ns
        old = next((one for one in reversed(self._past) if one[0] <= until_ns), self._past[0])
        return old[1:]

    def _products(self) -> tuple[int, int, bool]:
        """Return Current, Power, and whether either exceeds its register."""
        shunt, volts = self._shown()
        current = abs(shunt) * self._calibration // 4096
        power = current * volts // 5000
        overflow = current > 0x7FFF or power > 0xFFFF
        return (-current if shunt < 0 else current), power, overflow


def _digitised(steps: float, code: int, low: int, high: int) -> int:
    """Return the register value of a voltage in 12-bit steps, at the resolution of the ADC code, clipped."""
    coarse = 1 if code & 8 else 1 << (3 - (code & 3))
    return min(high, max(low, round(steps / coarse) * coarse))
