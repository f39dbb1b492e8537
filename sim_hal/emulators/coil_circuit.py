"""Coil currents through SN754410 bridges or DRV8830 bridges, and the INA219 that measures them.

The circuit with SN754410 bridges on a PWM chip is that of Sease 2013, chapter 5, Table 5.2. Only the mean
current over a PWM period is modelled, because the coil's time constant L/R is 0.1 ms and the PWM period 20 ms
(SN754410 and PCA9685 data sheets). While the two inputs of a bridge differ, the coil carries the current V/R.
Equal inputs of a bridge short-circuit the coil.

A bridge draws the coil current from the supply only while the bridge's inputs differ, so the supply current
is chopped. `ChoppedSupply` integrates the supply current of all bridges exactly over any time window.

The emulated INA219 has the registers and the conversion times of the real chip (TI SBOS448G). A conversion
result is the mean supply current over the conversion window, computed when the bus reads the result. Noise,
gain error and the input filter are not modelled.

The current of a coil on an emulated DRV8830 bridge (TI SLVSAB2) is the output voltage divided by the coil's
resistance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from functools import lru_cache
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from hal.drivers.coils import CLEAR, CONTROL, FAULT, CoilSettings, volts_of
from hal.drivers.pca9685 import COUNTS
from knightcube.astro.arrays import FloatArray
from sim_hal.emulators.i2c_bus import Registers
from sim_hal.emulators.pca9685 import EmulatedPca9685

Pulse = tuple[int, int]
"""Time in a PWM period during which an output is high, as first count and number of counts."""

_HISTORY_NS = 500_000_000
"""Time (ns) over which the supply current is recorded."""


class Bridge(NamedTuple):
    """Pulses on the inputs A and B of an H-bridge, whose outputs are always enabled."""

    a: Pulse
    b: Pulse

    def net_counts(self) -> int:
        """Return the signed number of PWM counts per period in which the coil is driven."""
        return self.a[1] - self.b[1]

    def driven(self) -> tuple[tuple[int, int], ...]:
        """Return the spans [begin, end) of PWM counts in which the coil is driven."""
        return _driven(self)


@lru_cache(maxsize=64)
def _driven(bridge: Bridge) -> tuple[tuple[int, int], ...]:
    """Return the spans of `Bridge.driven`, which are cached because a command lasts for seconds."""
    if bridge.a == bridge.b:
        return ()
    edges = {0, COUNTS}
    for first, length in bridge:
        edges |= {first, (first + length) % COUNTS}
    spans = []
    for begin, end in pairwise(sorted(edges)):
        a, b = ((begin - first) % COUNTS < length for first, length in bridge)
        if a != b:
            spans.append((begin, end))
    return tuple(spans)


class Chopping(NamedTuple):
    """Chopped supply current from a change of the PWM outputs until the next change.

    Attributes:
        since_ns: time at which the PWM outputs changed, ns.
        origin_ns: a time at which the PWM counter was zero, ns.
        period_ns: PWM period.
        drawn: pulses of each bridge, and the current (A) that the bridge draws while it drives the coil.
    """

    since_ns: int
    origin_ns: int
    period_ns: float
    drawn: tuple[tuple[Bridge, float], ...]

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge (A ns) drawn from the supply between two times."""
        whole_0, part_0 = divmod((start_ns - self.origin_ns) / self.period_ns, 1.0)
        whole_1, part_1 = divmod((end_ns - self.origin_ns) / self.period_ns, 1.0)
        total = 0.0
        for bridge, current in self.drawn:
            if not current or bridge.a == bridge.b:
                continue
            for begin, end in bridge.driven():
                at_0 = min(max(part_0 * COUNTS - begin, 0.0), end - begin)
                at_1 = min(max(part_1 * COUNTS - begin, 0.0), end - begin)
                total += current * ((whole_1 - whole_0) * (end - begin) + at_1 - at_0)
        return total * self.period_ns / COUNTS


class ChoppedSupply:
    """Record of the supply current over the last half second."""

    def __init__(self) -> None:
        self._history: deque[Chopping] = deque()

    def note(self, chopping: Chopping) -> None:
        """Record a change of the PWM outputs."""
        self._history.append(chopping)
        while len(self._history) > 1 and self._history[1].since_ns < chopping.since_ns - _HISTORY_NS:
            self._history.popleft()

    def charge(self, start_ns: int, end_ns: int) -> float:
        """Return the charge (A ns) drawn between two times; the charge before the first record is zero."""
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
"""Bound (A) of the uniform random error of a coil current in Sease 2013."""

_LOW, _HIGH = (0, 0), (0, COUNTS)
_OFF = Bridge(_LOW, _LOW)


class CoilCondition(Enum):
    """Condition of a coil or its bridge; if one leg of the bridge is stuck, the other leg still works."""

    SOUND = "sound"
    OPEN = "open"
    SHORTED = "shorted"
    REVERSED = "reversed"
    A_HIGH = "a-high"
    A_LOW = "a-low"
    B_HIGH = "b-high"
    B_LOW = "b-low"


_BLOCK = 256
"""Number of random numbers that are drawn at once."""
_SOUND = CoilCondition.SOUND
_FREE: tuple[Pulse | None, Pulse | None] = (None, None)
_STUCK: dict[CoilCondition, tuple[Pulse | None, Pulse | None]] = {
    CoilCondition.A_HIGH: (_HIGH, None),
    CoilCondition.A_LOW: (_LOW, None),
    CoilCondition.B_HIGH: (None, _HIGH),
    CoilCondition.B_LOW: (None, _LOW),
}
"""Constant outputs of the bridge legs A and B for each fault, or None for a leg that follows its input."""


def _uniform_draws(generator: np.random.Generator) -> Iterator[float]:
    """Yield random numbers from 0 to 1, which are drawn in blocks."""
    while True:
        yield from generator.random(_BLOCK).tolist()


class CoilCircuit:
    """The coils on one PWM chip, updated at every I2C STOP that may have changed an output."""

    def __init__(
        self,
        chip: EmulatedPca9685,
        truth: CoilSettings,
        generator: np.random.Generator,
        now_ns: Callable[[], int],
        uncertainty: float = CURRENT_UNCERTAINTY,
        bus_voltage: float | None = None,
    ) -> None:
        """Create the circuit of coils with the true properties `truth`.

        `uncertainty` (A) is the bound of the uniform random error of a coil current, which is drawn at each
        write of the coil's channels. `bus_voltage` (V) is the voltage that a current monitor measures, by
        default the coils' supply voltage.
        """
        self.chip = chip
        self._coils = tuple(
            (
                (coil.channel_a, coil.channel_b),
                sum(1 << channel for channel in coil.channels),
                coil.sign * truth.supply_voltage / coil.resistance / COUNTS,
                min(truth.current_limit, coil.current_limit, truth.supply_voltage / coil.resistance),
            )
            for coil in truth.coils
        )
        self._draws, self._now_ns, self._uncertainty = _uniform_draws(generator), now_ns, uncertainty
        self._bus_voltage = truth.supply_voltage if bus_voltage is None else bus_voltage
        self._supply_voltage = truth.supply_voltage
        count = len(self._coils)
        self._conditions = [CoilCondition.SOUND] * count
        self._stuck = [_FREE] * count
        self._short_ohm = [1.0] * count
        self._bridges = [_OFF] * count
        self._values = [0.0] * count
        self._drawn = [0.0] * count  # supply current (A) of each bridge while driving its coil
        self._currents: FloatArray = np.zeros(count)
        self._supply = ChoppedSupply()
        chip.on_stop = self.update
        self.update(0)

    def currents(self) -> FloatArray:
        """Return the mean current of each coil (n,), A, at the present PWM outputs."""
        return self._currents

    def become(self, axis: int, condition: CoilCondition, short_ohm: float = 5.0) -> None:
        """Set the condition of a coil; a shorted coil loads its bridge with `short_ohm` ohm."""
        self._conditions[axis] = condition
        self._stuck[axis] = _STUCK.get(condition, _FREE)
        self._short_ohm[axis] = short_ohm
        self.update(self._coils[axis][1])

    def update(self, written: int) -> None:
        """Update the currents after an I2C STOP. The bit mask `written` contains the written PWM channels."""
        count, high = len(self._coils), self.chip.high
        draws = list(islice(self._draws, count)) if written else [0.5] * count
        for axis, ((channel_a, channel_b), channels, step, limit) in enumerate(self._coils):
            stuck_a, stuck_b = self._stuck[axis]
            a, b = stuck_a or high(channel_a), stuck_b or high(channel_b)
            bridge = self._bridges[axis]
            if a != bridge.a or b != bridge.b:
                self._bridges[axis] = bridge = Bridge(a, b)
            elif not written & channels:
                continue
            counts = bridge.net_counts()
            current, drawn = 0.0, abs(step) * COUNTS
            if counts:
                current = counts * step + self._uncertainty * (2.0 * draws[axis] - 1.0)
                current = min(limit, max(-limit, current))
                drawn = abs(current) * COUNTS / abs(counts)
            condition = self._conditions[axis]
            if condition is _SOUND:
                pass
            elif condition is CoilCondition.OPEN:
                current, drawn = 0.0, 0.0
            elif condition is CoilCondition.SHORTED:
                current, drawn = 0.0, self._supply_voltage / self._short_ohm[axis]
            elif condition is CoilCondition.REVERSED:
                current = -current
            self._drawn[axis] = drawn
            self._values[axis] = current
        self._currents = np.array(self._values)
        # If the oscillator is off, the outputs are constant, and the currents do not depend on the period.
        period_ns = 1e9 / (self.chip.frequency or 1.0)
        pulses: tuple[tuple[Bridge, float], ...] = tuple(zip(self._bridges, self._drawn, strict=True))
        self._supply.note(Chopping(self._now_ns(), self.chip.counter_start_ns, period_ns, pulses))

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the mean bus voltage (V) and the mean supply current (A) of all coils over a time window.

        A bridge draws |I| from the supply while its coil is driven. The time window must be within the last
        0.5 s.
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
_RESERVED = 0x4000  # reserved bit of Config, which reads zero
_CALIBRATION_BITS = 0xFFFE
_REMEMBERED_NS = 60_000_000_000

# Conversion times (ns) by ADC code, for 9 to 12 bits and for averages of 2 to 128 samples of 12 bits.
_SINGLE_NS = (84_000, 148_000, 276_000, 532_000)
_AVERAGED_NS = (532_000, 1_060_000, 2_130_000, 4_260_000, 8_510_000, 17_020_000, 34_050_000, 68_100_000)


def conversion_ns(code: int) -> int:
    """Return the duration (ns) of one conversion with a 4-bit ADC code."""
    return _AVERAGED_NS[code & 7] if code & 8 else _SINGLE_NS[code & 3]


class EmulatedIna219:
    """An emulated INA219. The function `measure(start_ns, end_ns)` returns mean voltage (V) and current (A).

    Attributes:
        gain: gain of the current measurement, which a fault sets to a value other than 1.
        frozen: register contents that a fault holds constant.
        lag_ns: age of the reported conversions, ns, which a fault sets to at most a minute.
    """

    def __init__(
        self,
        address: int,
        now_ns: Callable[[], int],
        measure: Callable[[int, int], tuple[float, float]],
        shunt_ohm: float = 0.1,
    ) -> None:
        self.address = address
        self._now_ns, self._measure = now_ns, measure
        self._ohm = shunt_ohm
        self.gain = 1.0
        self.frozen: dict[int, int] = {}
        self.lag_ns = 0
        self._calibration = 0
        # Times, shunt registers and bus registers of past conversions.
        self._past: deque[tuple[int, int, int]] = deque()
        self.brown_out()

    def brown_out(self) -> None:
        """Interrupt the chip's supply, which resets every register to its power-on value."""
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
        """Return the content of a register without the side effects of a bus read."""
        if register in self.frozen:
            return self.frozen[register]
        self._convert()
        shunt, volts = self._shown()
        current = abs(shunt) * self._calibration // 4096
        power = current * volts // 5000
        overflow = current > 0x7FFF or power > 0xFFFF
        current = -current if shunt < 0 else current
        bus = volts << 3 | (_READY if self._ready else 0) | (_OVERFLOW if overflow else 0)
        words = (self._config, shunt, bus, power, current, self._calibration)
        return words[register] & 0xFFFF if register < len(words) else 0

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address."""
        return address == self.address

    def write(self, address: int, data: bytes) -> None:
        """Store a register pointer, and a big-endian word for the register Config or Calibration."""
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
        """Return the big-endian word at the register pointer, and 0xFF for each further byte."""
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
        # The modes power-down and "ADC off" do not change the conversion-ready flag.
        if shunt_wanted or bus_wanted:
            self._ready = False

    def _convert(self) -> None:
        """Compute the newest finished conversion, which measures first the shunt and then the bus voltage."""
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
        """Return the reported shunt and bus registers, which are `lag_ns` old."""
        if not self.lag_ns or not self._past:
            return self._shunt, self._bus
        until_ns = self._now_ns() - self.lag_ns
        old = next((one for one in reversed(self._past) if one[0] <= until_ns), self._past[0])
        return old[1:]


def _digitised(steps: float, code: int, low: int, high: int) -> int:
    """Return the clipped register value of a voltage (12-bit steps), rounded to the ADC's resolution."""
    coarse = 1 if code & 8 else 1 << (3 - (code & 3))
    return min(high, max(low, round(steps / coarse) * coarse))


class EmulatedDrv8830(Registers):
    """One bridge with its registers CONTROL and FAULT; the function `changed` is called after each change."""

    def __init__(self, address: int, changed: Callable[[], None]) -> None:
        super().__init__(address)
        self.registers = [0, 0]
        self._changed = changed

    def store(self, register: int, value: int) -> None:
        """Write CONTROL, or clear the faults."""
        if register == CONTROL:
            self.registers[CONTROL] = value
            self._changed()
        elif register == FAULT and value & CLEAR:
            self.registers[FAULT] = 0

    def load(self, register: int) -> int:
        """Return a register's value."""
        return self.registers[register] if register < len(self.registers) else 0

    def brown_out(self) -> None:
        """Interrupt the supply, which clears the registers."""
        self.registers = [0, 0]
        self._changed()


class BridgeCircuit:
    """Coils on the DRV8830 bridges in `parts`.

    At each write, random errors are added to the coil currents.
    """

    chip = None  # the coils have no PWM chip

    def __init__(
        self, address: int, truth: CoilSettings, generator: np.random.Generator, noise: float, supply: float
    ) -> None:
        """Create one bridge for each coil.

        `noise` (A) is the largest random error of a coil current, and `supply` (V) is the supply voltage.
        """
        self.parts = [EmulatedDrv8830(address + n, self._update) for n in range(len(truth.coils))]
        self._truth, self._generator, self._noise, self._supply = truth, generator, noise, supply
        self._currents: FloatArray = np.zeros(len(truth.coils))

    def currents(self) -> FloatArray:
        """Return the current of each coil (n,), A."""
        return self._currents

    def mean_supply(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Return the supply voltage (V) and the present supply current (A)."""
        return self._supply, float(np.abs(self._currents).sum())

    def _update(self) -> None:
        volts = np.array([volts_of(part.registers[CONTROL]) for part in self.parts])
        noise = self._noise * (2.0 * self._generator.random(len(volts)) - 1.0)
        ohm = np.array([coil.sign * coil.resistance for coil in self._truth.coils])
        self._currents = np.where(volts != 0.0, volts / ohm + noise, 0.0)
