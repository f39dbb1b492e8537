"""An emulated PCA9685 PWM chip, whose registers determine the outputs as in the NXP data sheet.

Accesses that the data sheet forbids or does not define have as little effect as possible and are recorded in
`violations`. The oscillator's tolerance and the phase of the counter are not modelled. A register change
takes effect at the STOP of the I2C transaction.
"""

from __future__ import annotations

from collections.abc import Callable

from hal.drivers.pca9685 import (
    ALL_LED_OFF_H,
    AUTO_INCREMENT,
    CHANNELS,
    COUNTS,
    EXTERNAL_CLOCK,
    FULL,
    GENERAL_CALL,
    LED0_ON_L,
    MODE1,
    MODE2,
    OSCILLATOR_HZ,
    OSCILLATOR_START_NS,
    PRE_SCALE,
    RESTART,
    SLEEP,
    SOFTWARE_RESET,
)

_ALL_LED_ON_L = 0xFA
_TEST_MODE = 0xFF
_LED_END = LED0_ON_L + 4 * CHANNELS
_ALL_CALL = 0x01
_INVERT = 0x10
_UPDATE_ON_ACK = 0x08
_ALL_CHANNELS = (1 << CHANNELS) - 1
# Registers SUBADR1 to SUBADR3 and ALLCALLADR, each with the MODE1 bit that enables its address.
_EXTRA_ADDRESSES = ((0x02, 0x08), (0x03, 0x04), (0x04, 0x02), (0x05, _ALL_CALL))


_WRITABLE = bytearray(256)
"""Writable bits of each register; reserved bits read zero."""
_WRITABLE[MODE1] = 0x7F
_WRITABLE[MODE2] = 0x1F
_WRITABLE[0x02:0x06] = b"\xfe" * 4
_WRITABLE[LED0_ON_L:_LED_END] = b"\xff\x1f\xff\x1f" * CHANNELS
_WRITABLE[PRE_SCALE] = 0xFF
_WITHOUT_PULSES = SLEEP | EXTERNAL_CLOCK
"""Bits of MODE1, each of which stops the PWM outputs."""

_POWER_ON = bytearray(256)
"""Content of each register after power-on."""
_POWER_ON[MODE1] = SLEEP | _ALL_CALL
_POWER_ON[MODE2] = 0x04
_POWER_ON[0x02:0x06] = b"\xe2\xe4\xe8\xe0"
_POWER_ON[LED0_ON_L:_LED_END] = b"\x00\x00\x00\x10" * CHANNELS
_POWER_ON[PRE_SCALE] = 0x1E


class EmulatedPca9685:
    """One emulated PCA9685.

    Attributes:
        on_stop: function that is called after each write that may have changed outputs, with the bit mask of
            the written channels (0 if only the modes changed).
        output_enable: whether the OE pin is active; if it is inactive, every output is low (OUTNE = 00).
        violations: accesses by the bus master that the data sheet forbids.
    """

    def __init__(self, address: int, now_ns: Callable[[], int]) -> None:
        self.address = address
        self.on_stop: Callable[[int], None] | None = None
        self.output_enable = True
        self.violations: set[str] = set()
        self._now_ns = now_ns
        self._registers = bytearray()
        self._addresses: set[int] = set()
        self._high: dict[int, tuple[int, int]] = {}  # cached results of `high` for the present registers
        self._halted = 0  # bit mask of channels that sleep mode has stopped until RESTART or a new write
        self._power_on()

    def brown_out(self) -> None:
        """Interrupt the chip's supply, which resets every register to its power-on value."""
        self._power_on()
        self._stop(_ALL_CHANNELS)

    def upset(self, register: int, value: int) -> None:
        """Overwrite a register in any mode of the chip, as radiation can do."""
        self._registers[register] = value
        self._high.clear()
        self._find_addresses()
        self._stop(_ALL_CHANNELS)

    def flip(self, register: int, bit: int) -> None:
        """Flip a bit of a register, as radiation can do; unused bits stay zero."""
        self.upset(register, self._registers[register] ^ 1 << bit & _WRITABLE[register])

    def register(self, register: int) -> int:
        """Return the content of a register as a read over the bus returns it."""
        restart = RESTART if register == MODE1 and self._restart else 0
        return self._registers[register] | restart

    @property
    def frequency(self) -> float:
        """PWM frequency (Hz), or 0 while the oscillator is off."""
        # No external clock is wired to the EXTCLK pin.
        if self._registers[MODE1] & _WITHOUT_PULSES:
            return 0.0
        return OSCILLATOR_HZ / (COUNTS * (self._registers[PRE_SCALE] + 1))

    @property
    def counter_start_ns(self) -> int:
        """Time at which the PWM counter last started from zero."""
        return self._awake_ns

    def high(self, channel: int) -> tuple[int, int]:
        """Return the part of a PWM period in which an output is high: first count and number of counts."""
        if not self.output_enable:
            return 0, 0
        found = self._high.get(channel)
        if found is None:
            start, length = found = self._pulse(channel)
            if self._registers[MODE2] & _INVERT:
                found = (start + length) % COUNTS, COUNTS - length
            self._high[channel] = found
        return found

    def duty(self, channel: int) -> float:
        """Return the duty cycle of an output, from 0 to 1."""
        return self.high(channel)[1] / COUNTS

    def answers(self, address: int) -> bool:
        """Return whether the chip acknowledges an address: its own, the general call or an enabled group."""
        return address in self._addresses

    def write(self, address: int, data: bytes) -> None:
        """Process the bytes of one write over the bus."""
        if address == GENERAL_CALL:
            if data == bytes((SOFTWARE_RESET,)):
                self._power_on()
                self._stop(_ALL_CHANNELS)
            return
        self._pointer = pointer = data[0]
        count = len(data) - 1
        if count == 0:
            return
        if self._registers[MODE1] & AUTO_INCREMENT and pointer >= LED0_ON_L and pointer + count <= _LED_END:
            written = self._store_run(pointer, data[1:])
        else:
            written = 0
            self._high.clear()
            for value in data[1:]:
                written |= self._store(self._pointer, value)
                self._advance()
        # A write to a channel acts like RESTART; if the OCH bit is set, only a write of all four registers
        # does.
        if written and (count >= 4 or not self._registers[MODE2] & _UPDATE_ON_ACK):
            if self._halted:
                self._halted &= ~written
                self._high.clear()
            self._restart = False
        self._stop(written)

    def read(self, count: int) -> bytes:
        """Return `count` bytes, beginning at the register pointer."""
        given = bytearray()
        for _ in range(count):
            given.append(self.register(self._pointer))
            self._advance()
        return bytes(given)

    def _power_on(self) -> None:
        self._registers = bytearray(_POWER_ON)
        self._high.clear()
        self._pointer = 0
        self._restart = False
        self._halted = 0
        self._awake_ns = self._now_ns()
        self._find_addresses()

    def _pulse(self, channel: int) -> tuple[int, int]:
        registers = self._registers
        base = LED0_ON_L + 4 * channel
        off_high = registers[base + 3]
        if off_high & FULL or registers[MODE1] & _WITHOUT_PULSES or self._halted >> channel & 1:
            return 0, 0
        on_high = registers[base + 1]
        if on_high & FULL:
            return 0, COUNTS
        on = on_high << 8 | registers[base]
        length = ((off_high << 8 | registers[base + 2]) - on) % COUNTS
        if length == 0:
            self.violations.add(f"LED{channel}: ON count = OFF count = {on}")
        return on, length

    def _store_run(self, pointer: int, values: bytes) -> int:
        end = pointer + len(values)
        # All bytes are masked at once as one long integer, which is faster than a loop.
        writable = int.from_bytes(_WRITABLE[pointer:end], "big")
        kept = (int.from_bytes(values, "big") & writable).to_bytes(len(values), "big")
        if self._registers[pointer:end] != kept:
            self._registers[pointer:end] = kept
            self._high.clear()
        self._pointer = end if end < _LED_END else 0
        first, last = (pointer - LED0_ON_L) >> 2, (end - 1 - LED0_ON_L) >> 2
        return (1 << last + 1) - (1 << first)

    def _store(self, register: int, value: int) -> int:
        """Write one register and return the bit mask of the affected channels."""
        if LED0_ON_L <= register < _LED_END:
            self._registers[register] = value & _WRITABLE[register]
            return 1 << ((register - LED0_ON_L) >> 2)
        if _ALL_LED_ON_L <= register <= ALL_LED_OFF_H:
            offset = register - _ALL_LED_ON_L + LED0_ON_L
            self._registers[offset:_LED_END:4] = bytes((value & _WRITABLE[offset],)) * CHANNELS
            return _ALL_CHANNELS
        if register == MODE1:
            self._store_mode1(value)
        elif register == PRE_SCALE:
            if self._registers[MODE1] & SLEEP:
                self._registers[PRE_SCALE] = max(3, value)
            else:
                self.violations.add("PRE_SCALE written while awake")
        elif register == _TEST_MODE:
            self.violations.add("TestMode written")
        else:
            self._registers[register] = value & _WRITABLE[register]
        self._find_addresses()
        return 0

    def _store_mode1(self, value: int) -> None:
        before = self._registers[MODE1]
        # EXTCLK can be set only while the chip sleeps, and only a reset clears EXTCLK.
        external = before & EXTERNAL_CLOCK or value & before << 2 & EXTERNAL_CLOCK
        self._registers[MODE1] = value & ~(RESTART | EXTERNAL_CLOCK) | external
        if value & SLEEP and not before & SLEEP:
            running = sum(
                1 << channel
                for channel in range(CHANNELS)
                if not self._registers[LED0_ON_L + 4 * channel + 3] & FULL
            )
            self._halted |= running
            self._restart = self._restart or running != 0
        elif before & SLEEP and not value & SLEEP:
            self._awake_ns = self._now_ns()
        if value & RESTART and self._restart and not value & SLEEP:
            if before & SLEEP or self._now_ns() - self._awake_ns < OSCILLATOR_START_NS:
                self.violations.add("RESTART within 500 us of waking")
            else:
                self._restart = False
                self._halted = 0

    def _advance(self) -> None:
        if self._registers[MODE1] & AUTO_INCREMENT:
            following = self._pointer + 1
            self._pointer = 0 if following in {_LED_END, _TEST_MODE} else following & 0xFF

    def _find_addresses(self) -> None:
        self._addresses = {GENERAL_CALL, self.address} | {
            self._registers[register] >> 1
            for register, enabled in _EXTRA_ADDRESSES
            if self._registers[MODE1] & enabled
        }

    def _stop(self, written: int) -> None:
        if self.on_stop is not None:
            self.on_stop(written)
