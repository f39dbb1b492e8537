"""The INA219: current of all coils together, bus voltage and power (TI SBOS448G).

The current is shunt voltage over shunt resistance; the chip's Calibration register, which a brown-out clears,
is not used. Each conversion averages 128 samples in 68 ms, not a whole number of the 20 ms PWM periods, so it
may be 18 % off; the mean of five may be 7 % off (a test computes both). A current beyond the range is
reported as the end of the range and marked as clipped.
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

_SHUNT_RANGES_V = (0.04, 0.08, 0.16, 0.32)  # in the order of the PG bits
_SILENCE_NS = 1_000_000_000
_SURE_STUCK = 3
"""Number of reads in a row after which a ready flag that stays set counts as stuck."""
_REACH_NS = 300_000_000
"""Largest age (ns) of the beginning of a conversion: 136 ms + 10 %, and as long again until it is read."""


def range_for(maximum_current: float, shunt_ohm: float) -> int:
    """Return the PG bits of the narrowest shunt range that holds a current in A.

    Raises OutOfRange when none does.
    """
    for bits, full_scale in enumerate(_SHUNT_RANGES_V):
        # 0.8 A in 0.1 ohm is 80 mV, despite rounding.
        if maximum_current * shunt_ohm <= full_scale * (1.0 + 1e-12):
            return bits
    raise OutOfRange("ina219", "maximum current", maximum_current, 0.0, _SHUNT_RANGES_V[-1] / shunt_ohm, "A")


def config_for(range_bits: int) -> int:
    """Return the Config word: 16 V bus range, the shunt range, 128 samples for both, continuous."""
    return range_bits << 11 | AVERAGE_128 << 7 | AVERAGE_128 << 3 | CONTINUOUS


class Ina219:
    """One monitor, read by a job of the clock, which also sets it up, again after a brown-out."""

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
        """Start reading every `period_ns`; a reading is the mean of the last `averaged` conversions.

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
        """Return the newest reading, None before the first."""
        with self._lock:
            return self._latest

    def error(self) -> str:
        """Return the last failure while it lasts, empty when readings arrive."""
        with self._lock:
            return self._error

    def close(self) -> None:
        """Stop reading. Safe to call twice."""
        self._ticker.stop()

    def _serve(self) -> None:
        try:
            conversion = self._convert()
        except DeviceError as error:
            # A mean must not bridge a gap: the current may have changed meanwhile.
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
            # A failure is reported until the mean is complete again, for readers that read once per second.
            if count == self._conversions.maxlen:
                self._error = ""

    def _convert(self) -> tuple[float, float, bool] | None:
        """Return bus voltage V and current A of a new conversion, and whether it is clipped; None without."""
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
        self._read(POWER)  # clears "ready", so that no conversion is counted twice
        self._flag_stays = self._flag_stays + 1 if self._read(BUS) & CONVERSION_READY else 0
        if self._flag_stays >= _SURE_STUCK:
            raise NotResponding(self.name, "its registers are stuck: a conversion that was read stays new")
        self._conversion_ns = self._clock.now_ns()
        signed = shunt - 0x10000 if shunt & 0x8000 else shunt
        full_scale = _SHUNT_RANGES_V[self._range_bits]
        current, clipped = signed * SHUNT_STEP_V / self._ohm, abs(signed) >= round(full_scale / SHUNT_STEP_V)
        if bus & OVERFLOW and not clipped:  # of Current and Power: another has written Calibration
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
                f"Config reads 0x{found:04x} after 0x{self._config:04x} was written: is another part at this"
                " address?",
            )
        self._conversion_ns = self._clock.now_ns()
        lost, self._set_up_before = self._set_up_before, True
        if lost:
            raise NotResponding(self.name, "had lost its set-up (brown-out?); set up again")

    def _read(self, register: int) -> int:
        with answering(self.name):
            high, low = self._bus.read_i2c_block_data(self._address, register, 2)
        return high << 8 | low
