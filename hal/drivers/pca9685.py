"""The PCA9685: sixteen PWM outputs of 12 bits on I2C (NXP data sheet).

Uses neither numpy nor threads: the guardian process imports this module to switch the coils off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hal.interfaces.errors import NotResponding, OutOfRange, Refused, answering

if TYPE_CHECKING:  # at run time the Protocols would import numpy, with the readings' types
    from hal.interfaces.wires import Clock, I2cBus

MODE1 = 0x00
MODE2 = 0x01
LED0_ON_L = 0x06
ALL_LED_OFF_H = 0xFD
PRE_SCALE = 0xFE

RESTART = 0x80
AUTO_INCREMENT = 0x20
EXTERNAL_CLOCK = 0x40  # sticky: only a reset clears it
SLEEP = 0x10
TOTEM_POLE = 0x04
FULL = 0x10  # bit 4 of an ON_H or OFF_H register: the whole period

GENERAL_CALL = 0x00
"""Address of all chips on a bus."""
SOFTWARE_RESET = 0x06
"""Byte to the general call that returns all chips to their power-on state (NXP data sheet, 7.6)."""

CHANNELS = 16
COUNTS = 4096
BLOCK_CHANNELS = 8  # fit into the 32 bytes of one SMBus block
OSCILLATOR_HZ = 25e6
FREQUENCY_HZ = 50.0
"""Frequency of the PWM period."""
OSCILLATOR_START_NS = 500_000

PwmCounts = tuple[int, int]
"""Counts (on, off) at which an output rises and falls, 0 .. 4095; 4096 is the full bit, full OFF wins."""

FULL_ON: PwmCounts = (COUNTS, 0)
FULL_OFF: PwmCounts = (0, COUNTS)


def switch_off(bus: I2cBus, address: int, tries: int = 3) -> None:
    """Switch every output of the chip off, whatever its state.

    Writes one byte to ALL_LED_OFF_H, which needs no set-up and works with or without auto-increment. Raises
    NotResponding after `tries` failures in a row.
    """
    for left in reversed(range(tries)):
        try:
            bus.write_byte_data(address, ALL_LED_OFF_H, FULL)
            return
        except OSError as error:
            if left == 0:
                raise NotResponding(_name(address), f"could not be switched off: {error.strerror}") from error


def prescale_for(frequency_hz: float) -> int:
    """Return the PRE_SCALE value of a PWM frequency: round(25 MHz / (4096 f)) - 1; 50 Hz gives 121.

    Raises OutOfRange outside 24 .. 1526 Hz, the range of the chip.
    """
    low, high = OSCILLATOR_HZ / (COUNTS * 256), OSCILLATOR_HZ / (COUNTS * 4)
    # Written so that NaN is rejected too.
    if not low <= frequency_hz <= high:
        raise OutOfRange("pca9685", "PWM frequency", frequency_hz, low, high, "Hz")
    return round(OSCILLATOR_HZ / (COUNTS * frequency_hz)) - 1


class Pca9685:
    """One chip on a bus. Nothing is retried here; the caller handles failures."""

    def __init__(self, bus: I2cBus, address: int, clock: Clock) -> None:
        self._bus = bus
        self._address = address
        self._clock = clock
        self._prescale = prescale_for(FREQUENCY_HZ)
        self.name = _name(address)

    def configure(self) -> None:
        """Set the chip up with every output off, and read the set-up back.

        All outputs go off first, in case a dead process left the chip running. A chip that an upset has
        switched to an external clock is reset, and with it each chip of the bus that obeys the general call:
        an ADS1115 loses its conversion. Raises NotResponding, or Refused if a register does not keep its
        value.
        """
        self.all_off()
        mode = self._read(MODE1)
        if mode & EXTERNAL_CLOCK:
            with answering(self.name):
                self._bus.write_byte(GENERAL_CALL, SOFTWARE_RESET)
            mode = self._read(MODE1)
        asleep = mode & ~RESTART | SLEEP
        self._write(MODE1, asleep)
        self._write(PRE_SCALE, self._prescale)  # writable only while the chip sleeps
        self._write(MODE1, AUTO_INCREMENT)
        self._clock.sleep_until_ns(self._clock.now_ns() + OSCILLATOR_START_NS)
        self._write(MODE2, TOTEM_POLE)
        for name, wanted, found in self._set_up():
            if found != wanted:
                raise Refused(
                    self.name,
                    f"{name} reads 0x{found:02x} after 0x{wanted:02x} was written: is another part at this"
                    " address, or does the chip need a power cycle?",
                )

    def is_configured(self) -> bool:
        """Return whether the chip still holds its set-up, lost in a brown-out. Raises NotResponding."""
        return all(found == wanted for _, wanted, found in self._set_up())

    def holds(self, first: int, counts: Sequence[PwmCounts]) -> bool:
        """Return whether up to 8 neighbouring channels hold these counts. Raises NotResponding."""
        wanted = _values(counts)
        with answering(self.name):
            return self._bus.read_i2c_block_data(self._address, LED0_ON_L + 4 * first, len(wanted)) == wanted

    def write_channels(self, first: int, counts: Sequence[PwmCounts]) -> None:
        """Write up to 8 neighbouring channels in one block; their outputs change together, at its end.

        Raises OutOfRange for counts that the chip does not define (equal ones among them), NotResponding.
        """
        if not (1 <= len(counts) <= BLOCK_CHANNELS and 0 <= first <= CHANNELS - len(counts)):
            raise OutOfRange(self.name, "last channel", first + len(counts) - 1, 0, CHANNELS - 1, "")
        for on, off in counts:
            if on == off or not (0 <= on <= COUNTS and 0 <= off <= COUNTS):
                quantity = f"OFF count with ON count {on} (never equal)"
                raise OutOfRange(self.name, quantity, off, 0, COUNTS, "counts")
        with answering(self.name):
            self._bus.write_i2c_block_data(self._address, LED0_ON_L + 4 * first, _values(counts))

    def all_off(self) -> None:
        """Switch every output off. Raises NotResponding."""
        switch_off(self._bus, self._address, tries=1)

    def _set_up(self) -> list[tuple[str, int, int]]:
        # RESTART only records that the chip slept with channels running; it changes no output.
        return [
            ("MODE1", AUTO_INCREMENT, self._read(MODE1) & ~RESTART),
            ("MODE2", TOTEM_POLE, self._read(MODE2)),
            ("PRE_SCALE", self._prescale, self._read(PRE_SCALE)),
        ]

    def _read(self, register: int) -> int:
        with answering(self.name):
            return self._bus.read_byte_data(self._address, register)

    def _write(self, register: int, value: int) -> None:
        with answering(self.name):
            self._bus.write_byte_data(self._address, register, value)


def _values(counts: Sequence[PwmCounts]) -> list[int]:
    """Return the values of the four registers of each channel."""
    return [byte for on, off in counts for byte in (on & 0xFF, on >> 8, off & 0xFF, off >> 8)]


def _name(address: int) -> str:
    return f"pca9685 at 0x{address:02x}"
