"""Driver of the INA219 current monitor (TI SBOS448G), which measures the coils' total current and voltage.

The current is computed as shunt voltage divided by shunt resistance. The Calibration register of the chip is
not used, because a brown-out clears the register. Each conversion averages 128 samples within 68 ms. Because
68 ms is not a multiple of the PWM period of 20 ms, a single conversion has an error of up to 18 %, and the
mean of five conversions has an error of up to 7 %. The test of this driver computes these errors. A current
outside the measuring range is reported as the limit of the range and marked as clipped.
"""

from __future__ import annotations

import math
import threading
from collections import deque

from hal.interfaces.devices import PowerReading
from hal.interfaces.errors import DeviceError, NotResponding, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus

CONFIG, SHUNT, BUS, POWER = 0x00, 0x01, 0x02, 0x03

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
    """Return the Config word for the 16 V bus range, the given shunt range and continuous conversions."""
    return range_bits << 11 | AVERAGE_128 << 7 | AVERAGE_128 << 3 | CONTINUOUS


class Ina219:
    """Current monitor that a periodic job reads.

    The job also configures it at the start and after a brown-out.
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
        """Start reading the monitor periodically.

        Args:
            bus: I2C bus of the monitor.
            address: I2C address of the monitor.
            clock: clock that runs the periodic job.
            shunt_ohm: shunt resistance, ohm.
            period_ns: period of reading, ns.
            maximum_current: largest current to be measured, A.
            averaged: number of conversions whose mean is a reading.

        Raises OutOfRange for a shunt or a current outside the range of the chip.
        """
        for quantity, value, unit in (("shunt", shunt_ohm, "ohm"), ("maximum current", maximum_current, "A")):
            if not 0.0 < value < math.inf:
                raise OutOfRange("ina219", quantity, value, 0.0, math.inf, unit)
        if averaged < 1:
            raise OutOfRange("ina219", "averaged conversions", averaged, 1, 100, "")
        self.name = f"ina219 at 0x{address:02x}"
        self._bus = bus
        self._address = address
        self._clock = clock
        self._ohm = shunt_ohm
        self._range_bits = range_for(maximum_current, shunt_ohm)
        self._config = config_for(self._range_bits)
        self._lock = threading.Lock()
        self._conversions: deque[tuple[float, float, bool]] = deque(maxlen=averaged)
        self._latest: PowerReading | None = None
        self._error = ""
        self._set_up_before = False
        self._flag_stays = 0
        self._conversion_ns = clock.now_ns()
        self._ticker = clock.ticker("ina219", period_ns, self._serve)

    def latest(self) -> PowerReading | None:
        """Return the newest reading, or None before the first reading."""
        with self._lock:
            return self._latest

    def error(self) -> str:
        """Return the text of the current failure, or an empty text while readings arrive."""
        with self._lock:
            return self._error

    def close(self) -> None:
        """Stop reading. Calling `close` again has no effect."""
        self._ticker.stop()

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
        if bus & OVERFLOW and not clipped:  # overflow flag, set only if other software has set Calibration
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
        with answering(self.name):
            high, low = self._bus.read_i2c_block_data(self._address, register, 2)
        return high << 8 | low
