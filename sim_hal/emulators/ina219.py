"""An emulated INA219: registers, and conversions at its own pace (TI SBOS448G).

Each conversion is the mean of the circuit's supply over the conversion window, computed when the bus asks for
its result. Not modelled: noise, gain error, the input filter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

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
    """Return how long one conversion with a 4-bit ADC code takes."""
    return _AVERAGED_NS[code & 7] if code & 8 else _SINGLE_NS[code & 3]


class EmulatedIna219:
    """One monitor; `measure(start_ns, end_ns)` gives mean bus voltage (V) and current (A) of a window.

    Attributes:
        gain: of its current measurement; 1 is sound.
        frozen: words that it gives whatever it measures, none when sound.
        lag_ns: how old the conversions are that it gives, up to a minute; 0 is sound.
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
        self._power_on()

    def brown_out(self) -> None:
        """Interrupt the supply: every register returns to its power-on value."""
        self._power_on()

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

    def _power_on(self) -> None:
        self._pointer = 0
        self._calibration = 0
        self._shunt = 0
        self._bus = 0
        self._ready = False
        self._past.clear()
        self._configure(POWER_ON_CONFIG)

    def _configure(self, word: int) -> None:
        if word & _RESET:
            self._power_on()
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
        """Accept the newest finished conversion: first the shunt, then the bus."""
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
        """Return the shunt's and the bus's conversion that the registers give: the newest, or an old one."""
        if not self.lag_ns or not self._past:
            return self._shunt, self._bus
        until_ns = self._now_ns() - self.lag_ns
        old = next((one for one in reversed(self._past) if one[0] <= until_ns), self._past[0])
        return old[1:]

    def _products(self) -> tuple[int, int, bool]:
        """Return Current, Power and whether either is beyond its register."""
        shunt, volts = self._shown()
        current = abs(shunt) * self._calibration // 4096
        power = current * volts // 5000
        overflow = current > 0x7FFF or power > 0xFFFF
        return (-current if shunt < 0 else current), power, overflow


def _digitised(steps: float, code: int, low: int, high: int) -> int:
    """Return a voltage, given in 12-bit steps, as its register value: coarser for fewer bits, clipped."""
    coarse = 1 if code & 8 else 1 << (3 - (code & 3))
    return min(high, max(low, round(steps / coarse) * coarse))
