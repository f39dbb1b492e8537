"""Driver of the PCA9685, an I2C chip with sixteen 12-bit PWM outputs (NXP data sheet)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from hal.interfaces.errors import NotResponding, OutOfRange, Refused, answering
from hal.interfaces.wires import Clock, I2cBus

MODE1 = 0x00
MODE2 = 0x01
LED0_ON_L = 0x06
ALL_LED_OFF_H = 0xFD
PRE_SCALE = 0xFE

RESTART = 0x80
AUTO_INCREMENT = 0x20
EXTERNAL_CLOCK = 0x40  # bit for an external clock, which only a reset clears
SLEEP = 0x10
TOTEM_POLE = 0x04
FULL = 0x10  # bit 4 of an ON_H or OFF_H register: output on or off for the whole period

GENERAL_CALL = 0x00
"""General call address, to which all chips on a bus respond."""
SOFTWARE_RESET = 0x06
"""Byte that resets all chips if it is sent to the general call address (NXP data sheet, section 7.6)."""

CHANNELS = 16
COUNTS = 4096
BLOCK_CHANNELS = 8  # maximum number of channels in one SMBus block of 32 bytes
OSCILLATOR_HZ = 25e6
FREQUENCY_HZ = 50.0
"""PWM frequency, Hz."""
OSCILLATOR_START_NS = 500_000

PwmCounts = tuple[int, int]
"""Counts (on, off) within the PWM period at which an output is switched on and off, 0 to 4095.

The value 4096 means on or off for the whole period. If both counts are 4096, the output is off.
"""

FULL_ON: PwmCounts = (COUNTS, 0)
FULL_OFF: PwmCounts = (0, COUNTS)


def prescale_for(frequency_hz: float) -> int:
    """Return the PRE_SCALE value of a PWM frequency f: round(25 MHz / (4096 f)) - 1.

    Raises OutOfRange outside the frequency range of the chip, 24 Hz to 1526 Hz.
    """
    low, high = OSCILLATOR_HZ / (COUNTS * 256), OSCILLATOR_HZ / (COUNTS * 4)
    # The negated comparison also rejects NaN.
    if not low <= frequency_hz <= high:
        raise OutOfRange("pca9685", "PWM frequency", frequency_hz, low, high, "Hz")
    return round(OSCILLATOR_HZ / (COUNTS * frequency_hz)) - 1


class Pca9685:
    """PCA9685 chip on an I2C bus.

    Failed transactions are not retried, because the caller handles failures.
    """

    def __init__(self, bus: I2cBus, address: int, clock: Clock) -> None:
        self._bus, self._address, self._clock = bus, address, clock
        self._prescale = prescale_for(FREQUENCY_HZ)
        self.name = f"pca9685 at 0x{address:02x}"

    def configure(self) -> None:
        """Configure the chip with all outputs off, and read the configuration back.

        All outputs are switched off first, because a process that died may have left them on. If the chip has
        switched to an external clock because of a bit flip, it is reset by a general call. The general call
        also resets other chips on the bus, for example an ADS1115, which loses its conversion. Raises
        NotResponding if the chip does not answer, and Refused if a register does not keep its value.
        """
        self.all_off()
        mode = self._read(MODE1)
        if mode & EXTERNAL_CLOCK:
            with answering(self.name):
                self._bus.write_byte(GENERAL_CALL, SOFTWARE_RESET)
            mode = self._read(MODE1)
        asleep = mode & ~RESTART | SLEEP
        self._write(MODE1, asleep)
        self._write(PRE_SCALE, self._prescale)  # the prescaler is writable only in sleep mode
        self._write(MODE1, AUTO_INCREMENT)
        self._clock.sleep_until_ns(self._clock.now_ns() + OSCILLATOR_START_NS)
        self._write(MODE2, TOTEM_POLE)
        for name, wanted, found in self._set_up():
            if found != wanted:
                raise Refused(
                    self.name,
                    f"{name} reads 0x{found:02x} after 0x{wanted:02x} was written: is another chip at "
                    "this address, or does the chip need a power cycle?",
                )

    def is_configured(self) -> bool:
        """Return whether the chip still has its configuration, which a brown-out erases.

        Raises NotResponding.
        """
        return all(found == wanted for _, wanted, found in self._set_up())

    def holds(self, first: int, counts: Sequence[PwmCounts]) -> bool:
        """Return whether at most 8 consecutive channels have the given counts. Raises NotResponding."""
        wanted = _values(counts)
        with answering(self.name):
            return self._bus.read_i2c_block_data(self._address, LED0_ON_L + 4 * first, len(wanted)) == wanted

    def write_channels(self, first: int, counts: Sequence[PwmCounts]) -> None:
        """Write the counts of consecutive channels, at most 8, in one block.

        All written outputs change simultaneously at the end of the block transfer. Raises OutOfRange for
        counts without a defined effect, such as equal on and off counts, and NotResponding if the chip does
        not answer.
        """
        values = _checked_values(self.name, first, tuple(counts))
        with answering(self.name):
            self._bus.write_i2c_block_data(self._address, LED0_ON_L + 4 * first, values)

    def all_off(self) -> None:
        """Switch all outputs off, in any state of the chip. Raises NotResponding if the chip does not answer.

        One byte is written to the register ALL_LED_OFF_H, which works without any configuration of the chip.
        """
        try:
            self._bus.write_byte_data(self._address, ALL_LED_OFF_H, FULL)
        except OSError as error:
            raise NotResponding(self.name, f"could not be switched off: {error.strerror}") from error

    def _set_up(self) -> list[tuple[str, int, int]]:
        # The RESTART bit only records that the chip was put to sleep with active channels, so it is ignored.
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


@lru_cache(maxsize=8)
def _checked_values(name: str, first: int, counts: tuple[PwmCounts, ...]) -> tuple[int, ...]:
    """Return the register values of `counts` for the channels from `first` on.

    Raises OutOfRange, with the `name` of the chip, for counts without a defined effect. The values of the
    newest blocks are cached, because most cycles write the same block.
    """
    if not (1 <= len(counts) <= BLOCK_CHANNELS and 0 <= first <= CHANNELS - len(counts)):
        raise OutOfRange(name, "last channel", first + len(counts) - 1, 0, CHANNELS - 1, "")
    for on, off in counts:
        if on == off or not (0 <= on <= COUNTS and 0 <= off <= COUNTS):
            quantity = f"OFF count (must differ from ON count {on})"
            raise OutOfRange(name, quantity, off, 0, COUNTS, "counts")
    return tuple(_values(counts))


def _values(counts: Sequence[PwmCounts]) -> list[int]:
    """Return the values of the four registers of each channel for the given counts."""
    return [byte for on, off in counts for byte in (on & 0xFF, on >> 8, off & 0xFF, off >> 8)]
