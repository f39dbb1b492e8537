"""Drivers of current monitors: INA219 for the coils' supply, and ADS1115 for the solar cell strings.

The INA219 (TI SBOS448G) measures the coils' total current and voltage. The current is computed as shunt
voltage divided by shunt resistance. The Calibration register of the chip is not used, because a brown-out
clears the register. Each conversion averages 128 samples within 68 ms. Because 68 ms is not a multiple of the
PWM period of 20 ms, a single conversion has an error of up to 18 %, and the mean of five conversions has an
error of up to 7 %. The driver's test computes the errors of single conversions and of means. A current
outside the measuring range is reported as the limit of the range and marked as clipped.

An A/D converter ADS1115 (TI SBAS444) has four inputs. The current of a string flows through a shunt, whose
voltage is amplified; the output voltage per current is `volt_per_ampere`. A periodic job reads the completed
conversion of one channel and starts the conversion of the next channel, on all converters at once. No call
waits for a conversion, because a conversion takes 7.8 ms and the job runs at intervals of at least 10 ms. A
current outside the measuring range is reported as the limit of the range, and the text `error` names the
affected string.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from hal.interfaces.devices import PowerReading, StringReading
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus, Ticker

_Reading = TypeVar("_Reading")


class PolledMonitor(Generic[_Reading]):
    """Monitor on an I2C bus, read by a periodic job of a subclass; the lock protects reading and error."""

    _ticker: Ticker

    def __init__(self, bus: I2cBus, clock: Clock) -> None:
        self._bus, self._clock = bus, clock
        self._lock = threading.Lock()
        self._latest: _Reading | None = None
        self._error = ""

    def latest(self) -> _Reading | None:
        """Return the newest reading, or None before the first reading."""
        with self._lock:
            return self._latest

    def error(self) -> str:
        """Return the text of the current failure, or an empty text."""
        with self._lock:
            return self._error

    def close(self) -> None:
        """Stop reading. Calling `close` again has no effect."""
        self._ticker.stop()

    def _word(self, name: str, address: int, register: int) -> int:
        """Return the big-endian word in a register of the chip `name`. Raises NotResponding."""
        with answering(name):
            high, low = self._bus.read_i2c_block_data(address, register, 2)
        return high << 8 | low


CONFIG, SHUNT, BUS, POWER = 0x00, 0x01, 0x02, 0x03

BUS_32_V = 1 << 13
AVERAGE_128 = 0b1111
CONTINUOUS = 0b111
SHUNT_STEP_V = 10e-6
BUS_STEP_V = 4e-3
CONVERSION_READY = 0b10
OVERFLOW = 0b01

_SHUNT_RANGES_V = (0.04, 0.08, 0.16, 0.32)  # full-scale shunt voltage for each value of the PG bits
_SILENCE_NS = 1_000_000_000
_SURE_STUCK = 3
"""Number of consecutive reads with a set ready flag after which the flag is considered stuck."""
_REACH_NS = 300_000_000
"""Longest time (ns) from the start of a conversion to the reading of its result.

A conversion of both voltages takes up to 150 ms (136 ms + 10 %), and its result is read within another 150
ms.
"""


def range_for(maximum_current: float, shunt_ohm: float) -> int:
    """Return the PG bits of the smallest shunt voltage range that covers `maximum_current` (A).

    Raises OutOfRange if no range covers the current.
    """
    for bits, full_scale in enumerate(_SHUNT_RANGES_V):
        # Rounding must not exclude an exact limit, such as 0.8 A at 0.1 ohm in the 80 mV range.
        if maximum_current * shunt_ohm <= full_scale * (1.0 + 1e-12):
            return bits
    raise OutOfRange("ina219", "maximum current", maximum_current, 0.0, _SHUNT_RANGES_V[-1] / shunt_ohm, "A")


def config_for(range_bits: int) -> int:
    """Return the Config word for the 32 V bus range, the given shunt range and continuous conversions.

    The bus voltage has steps of 4 mV in both ranges of the chip, 16 V and 32 V.
    """
    return BUS_32_V | range_bits << 11 | AVERAGE_128 << 7 | AVERAGE_128 << 3 | CONTINUOUS


class Ina219(PolledMonitor[PowerReading]):
    """Current monitor that a periodic job reads.

    The job also configures the monitor at the start and after a brown-out.
    """

    def __init__(
        self,
        bus: I2cBus,
        address: int,
        clock: Clock,
        shunt_ohm: float = 0.1,
        period_ns: int = 200_000_000,
        maximum_current: float = 0.8,
        averaged: int = 5,
    ) -> None:
        """Start reading the monitor every `period_ns`.

        The largest current to be measured is `maximum_current` (A), and a reading is the mean of `averaged`
        conversions. Raises OutOfRange for a shunt or a current outside the range of the chip.
        """
        for quantity, value, unit in (("shunt", shunt_ohm, "ohm"), ("maximum current", maximum_current, "A")):
            if not 0.0 < value < math.inf:
                raise OutOfRange("ina219", quantity, value, 0.0, math.inf, unit)
        if averaged < 1:
            raise OutOfRange("ina219", "averaged conversions", averaged, 1, 100, "")
        super().__init__(bus, clock)
        self.name = f"ina219 at 0x{address:02x}"
        self._address = address
        self._ohm = shunt_ohm
        self._range_bits = range_for(maximum_current, shunt_ohm)
        self._config = config_for(self._range_bits)
        self._conversions: deque[tuple[float, float, bool]] = deque(maxlen=averaged)
        self._set_up_before = False
        self._flag_stays = 0
        self._conversion_ns = clock.now_ns()
        self._ticker = clock.ticker("ina219", period_ns, self._serve)

    def _serve(self) -> None:
        try:
            conversion = self._convert()
        except DeviceError as error:
            # A mean must not include conversions before a gap, because the current may have changed.
            self._conversions.clear()
            with self._lock:
                self._error = str(error)
            return
        if conversion is None:
            return
        self._conversions.append(conversion)
        count = len(self._conversions)
        volts, amps, clipped = zip(*self._conversions, strict=True)
        voltage, current = math.fsum(volts) / count, math.fsum(amps) / count
        now_ns = self._clock.now_ns()
        newest, since_ns = conversion[1], now_ns - _REACH_NS
        with self._lock:
            self._latest = PowerReading(
                now_ns, voltage, current, voltage * current, newest, since_ns, any(clipped)
            )
            # A failure is reported until a mean is complete, because some callers check only once a second.
            if count == self._conversions.maxlen:
                self._error = ""

    def _convert(self) -> tuple[float, float, bool] | None:
        """Return voltage (V), current (A) and clipping flag of a new conversion, or None if none is new."""
        if self._read(CONFIG) != self._config:
            self._set_up()
            return None
        self._set_up_before = True
        bus = self._read(BUS)
        if not bus & CONVERSION_READY:
            silence = self._clock.now_ns() - self._conversion_ns
            if silence > _SILENCE_NS:
                raise NotResponding(self.name, f"no conversion for {silence * 1e-9:.1f} s; check its supply")
            return None
        shunt = self._read(SHUNT)
        self._read(POWER)  # this read clears the ready flag, so that no conversion is counted twice
        self._flag_stays = self._flag_stays + 1 if self._read(BUS) & CONVERSION_READY else 0
        if self._flag_stays >= _SURE_STUCK:
            raise NotResponding(self.name, "its registers are stuck: the ready flag stays set after reading")
        self._conversion_ns = self._clock.now_ns()
        signed = shunt - 0x10000 if shunt & 0x8000 else shunt
        full_scale = _SHUNT_RANGES_V[self._range_bits]
        current, clipped = signed * SHUNT_STEP_V / self._ohm, abs(signed) >= round(full_scale / SHUNT_STEP_V)
        if bus & OVERFLOW and not clipped:  # set only if other software has written Calibration
            bound = full_scale / self._ohm
            raise OutOfRange(self.name, "overflow: coil current", current, -bound, bound, "A")
        return (bus >> 3) * BUS_STEP_V, current, clipped

    def _set_up(self) -> None:
        with answering(self.name):
            word = [self._config >> 8, self._config & 0xFF]
            self._bus.write_i2c_block_data(self._address, CONFIG, word)
        found = self._read(CONFIG)
        if found != self._config:
            raise Refused(
                self.name,
                f"Config reads 0x{found:04x} after 0x{self._config:04x} was written: is another chip "
                "at this address?",
            )
        self._conversion_ns = self._clock.now_ns()
        lost, self._set_up_before = self._set_up_before, True
        if lost:
            raise NotResponding(self.name, "had lost its set-up (brown-out?); set up again")

    def _read(self, register: int) -> int:
        return self._word(self.name, self._address, register)


ADS1115_CONVERSION, ADS1115_CONFIG = 0x00, 0x01
START = 0x8000
"""Bit of the Config register: writing 1 starts a conversion, and reading 1 means that none is running."""
_SINGLE_ENDED, _MUX_BIT = 0b100, 12
_RANGE_2_048 = 0b010 << 9
_SINGLE_SHOT = 1 << 8
_RATE_128 = 0b100 << 5
_NO_COMPARATOR = 0b11
FULL_SCALE = 2.048
STEP = FULL_SCALE / 32_768
"""Voltage (V) of one ADC count."""
CHANNELS = 4
_SHORTEST_NS = 10_000_000


def conversion_of(channel: int) -> int:
    """Return the Config word that starts a conversion of one channel.

    The input is measured against ground in the range +-2.048 V, at 128 conversions per second.
    """
    mux = (_SINGLE_ENDED | channel) << _MUX_BIT
    return START | mux | _RANGE_2_048 | _SINGLE_SHOT | _RATE_128 | _NO_COMPARATOR


@dataclass(frozen=True, slots=True)
class StringWiring:
    """I2C address and input (0 to 3) of a string's A/D converter, and the amplifier's gain (V/A)."""

    address: int
    channel: int
    volt_per_ampere: float


class AdsSolarStrings(PolledMonitor[StringReading]):
    """Monitor of the solar cell strings, which implements `hal.interfaces.devices.SolarStrings`."""

    def __init__(
        self, bus: I2cBus, clock: Clock, wirings: Sequence[StringWiring], period_ns: int = 500_000_000
    ) -> None:
        """Measure all strings once per `period_ns`. Raises OutOfRange for an invalid period or wiring."""
        super().__init__(bus, clock)
        self.name = "solar strings"
        self._wirings = tuple(wirings)
        self._parts = sorted({wiring.address for wiring in wirings})
        self._counts = dict.fromkeys(((w.address, w.channel) for w in wirings), 0)
        if len(self._counts) != len(self._wirings) or not wirings:
            raise OutOfRange(self.name, "number of different channels", len(self._counts), 1, 16, "")
        for wiring in wirings:
            if not 0 <= wiring.channel < CHANNELS:
                raise OutOfRange(self.name, "channel", wiring.channel, 0, CHANNELS - 1, "")
            if not 0.0 < wiring.volt_per_ampere < 1e6:
                raise OutOfRange(self.name, "volt per ampere", wiring.volt_per_ampere, 0.0, 1e6, "V/A")
        self._channels = sorted({wiring.channel for wiring in wirings})
        step_ns = period_ns // len(self._channels)
        if step_ns < _SHORTEST_NS:
            shortest = _SHORTEST_NS * len(self._channels)
            raise OutOfRange(self.name, "period", period_ns * 1e-9, shortest * 1e-9, 60.0, "s")
        self._step = -1
        self._ticker = clock.ticker("solar strings", step_ns, self._serve)

    def _serve(self) -> None:
        try:
            for address in self._parts if self._step >= 0 else ():
                self._collect(address, self._channels[self._step])
            self._step += 1
            if self._step == len(self._channels):
                self._step = 0
                self._publish()
            word = conversion_of(self._channels[self._step])
            for address in self._parts:
                with answering(f"ads1115 at 0x{address:02x}"):
                    self._bus.write_i2c_block_data(address, ADS1115_CONFIG, [word >> 8, word & 0xFF])
        except DeviceError as error:
            # A reading contains all strings, so a failed measurement is repeated from the first channel.
            self._step = -1
            with self._lock:
                self._error = str(error)

    def _collect(self, address: int, channel: int) -> None:
        name = f"ads1115 at 0x{address:02x}"
        config = self._word(name, address, ADS1115_CONFIG)
        if config != conversion_of(channel):
            busy = config == conversion_of(channel) & ~START
            cause = "the conversion does not end" if busy else f"Config reads 0x{config:04x} (brown-out?)"
            raise Refused(name, cause)
        word = self._word(name, address, ADS1115_CONVERSION)
        if (address, channel) in self._counts:
            self._counts[address, channel] = word - 0x10000 if word & 0x8000 else word

    def _publish(self) -> None:
        currents, error = np.empty(len(self._wirings)), ""
        for index, wiring in enumerate(self._wirings):
            counts = self._counts[wiring.address, wiring.channel]
            current = counts * STEP / wiring.volt_per_ampere
            if abs(counts) >= 0x7FFF:
                bound, name = FULL_SCALE / wiring.volt_per_ampere, f"current of string {index + 1}"
                error = str(OutOfRange(self.name, name, current, -bound, bound, "A"))
            currents[index] = current
        with self._lock:
            self._latest = StringReading(self._clock.now_ns(), currents)
            self._error = error
