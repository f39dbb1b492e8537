"""The registers of the VN-100: contents, accepted values, and the unit's error codes.

Values are kept as the text that the unit prints. Contents and defaults: VectorNav UM001 v2.43 ch. 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from hal.drivers.vn100.protocol import OutputLayout, layout_of

Rule = Callable[[str], str]
"""Returns the text as the unit stores it; raises ValueError for an invalid text."""

BAUD_RATES = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
ASYNC_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
ASYNC_TYPES = (0, 1, 2, 8, 9, 10, 11, 12, 13, 14, 16, 17, 19, 30)
BINARY_OUTPUTS = (75, 76, 77)
GYRO_STARTUP_BIAS, FILTER_STARTUP_BIAS = 43, 74

# The fields that a VN-100 has, by group bit; all others need satellite navigation or later units.
SUPPORTED_FIELDS: Mapping[int, int] = {0: 0x3F3D, 1: 0x0191, 2: 0x0FFF, 4: 0x01FF}


class UnitError(Exception):
    """The unit answers `$VNERR` with this code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:02X}")
        self.code = code


INVALID_CHECKSUM, INVALID_COMMAND, TOO_FEW, TOO_MANY = 0x03, 0x04, 0x05, 0x06
INVALID_PARAMETER, INVALID_REGISTER, UNAUTHORIZED, LOW_BAUD = 0x07, 0x08, 0x09, 0x0C
RECEIVE_OVERFLOW = 0x02


@dataclass(frozen=True, slots=True)
class Register:
    """One register: a rule for each field, and the defaults.

    `port_option`: a further field, the serial port, may follow in a write.
    """

    rules: tuple[Rule, ...]
    default: tuple[str, ...]
    writable: bool = True
    port_option: bool = False

    def checked(self, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the fields as the unit stores them. Raises UnitError."""
        if not self.writable:
            raise UnitError(UNAUTHORIZED)
        expect_count(fields, len(self.rules), len(self.rules) + self.port_option)
        try:
            kept = tuple(rule(text) for rule, text in zip(self.rules, fields, strict=False))
            extra = tuple(_choice(1, 2)(text) for text in fields[len(self.rules) :])
        except ValueError as error:
            raise UnitError(INVALID_PARAMETER) from error
        return kept + extra


def expect_count(fields: tuple[str, ...], least: int, most: int) -> None:
    """Raise UnitError when the number of fields is out of range."""
    if len(fields) < least:
        raise UnitError(TOO_FEW)
    if len(fields) > most:
        raise UnitError(TOO_MANY)


def _choice(*values: int) -> Rule:
    def rule(text: str) -> str:
        if int(text) not in values:
            raise ValueError(text)
        return str(int(text))

    return rule


def _unsigned(most: int) -> Rule:
    def rule(text: str) -> str:
        if not 0 <= int(text) <= most:
            raise ValueError(text)
        return str(int(text))

    return rule


def _number(text: str) -> str:
    if not math.isfinite(float(text)):
        raise ValueError(text)
    return text


def _between(low: float, high: float) -> Rule:
    def rule(text: str) -> str:
        if not low <= float(text) <= high:
            raise ValueError(text)
        return text

    return rule


def _tag(text: str) -> str:
    if len(text) > 20:
        raise ValueError(text)
    return text


def _fixed(text: str) -> Register:
    return Register((_tag,), (text,), writable=False)


def _numbers(*default: str) -> Register:
    return Register((_number,) * len(default), default)


_ON_OFF = _choice(0, 1)
_WINDOW = _unsigned(25)
_IDENTITY = ("1", "0", "0", "0", "1", "0", "0", "0", "1")
_CALIBRATION = (*_IDENTITY, "0", "0", "0")

REGISTERS: Mapping[int, Register] = {
    0: Register((_tag,), ("",)),
    1: _fixed("VN-100T-CR"),
    2: _fixed("5"),
    3: _fixed("0100012345"),
    4: _fixed("2.1.0.0"),
    5: Register((_choice(*BAUD_RATES),), ("115200",), port_option=True),
    6: Register((_choice(*ASYNC_TYPES),), ("14",), port_option=True),
    7: Register((_choice(*ASYNC_RATES_HZ),), ("40",), port_option=True),
    21: _numbers("1", "0", "1.8", "0", "0", "-9.79375"),
    23: _numbers(*_CALIBRATION),
    25: _numbers(*_CALIBRATION),
    26: _numbers(*_IDENTITY),
    30: Register(
        (*(_unsigned(4), _unsigned(2)) * 2, _choice(1, 3), _choice(0, 1, 3), _unsigned(2)),
        ("0", "0", "0", "0", "1", "0", "1"),
    ),
    32: Register(
        (_unsigned(6), _ON_OFF, _ON_OFF, _unsigned(65535), _unsigned(6), _ON_OFF, _unsigned(65535))
        + (_unsigned(4294967295),) * 2,
        ("3", "0", "0", "0", "6", "1", "0", "100000000", "0"),
    ),
    33: Register((_unsigned(4294967295),) * 3, ("0", "0", "0")),
    35: Register((_ON_OFF, _unsigned(2), _ON_OFF, _ON_OFF), ("1", "1", "1", "1")),
    36: Register((_between(0.0, 10.0),) * 9, ("4",) * 3 + ("5",) * 3 + ("5.5",) * 3),
    38: Register((_between(0.0, 10.0),) * 9, ("5",) * 3 + ("3",) * 3 + ("4",) * 3),
    GYRO_STARTUP_BIAS: _numbers(*("+00.000000",) * 3),
    44: Register((_unsigned(2), _choice(1, 3), _choice(1, 2, 3, 4, 5)), ("1", "3", "5")),
    47: Register((_number,) * 12, _CALIBRATION, writable=False),
    50: _numbers("0", "0", "0"),
    51: Register((_ON_OFF, _number, _number), ("1", "0.1", "0.01")),
    FILTER_STARTUP_BIAS: _numbers(*("+00.000000",) * 7),
    82: Register((_ON_OFF, _unsigned(2), _ON_OFF, _ON_OFF, _ON_OFF), ("0", "0", "0", "0", "0")),
    83: _numbers("0", "0", "0", "0", "1000", "0.000", "+00.00000000", "+000.00000000", "+00000.000"),
    84: _numbers(*_CALIBRATION),
    85: Register((_WINDOW,) * 5 + (_unsigned(3),) * 5, ("0", "4", "4", "4", "0", "0", "3", "3", "3", "0")),
}

_OFF = ("0", "0", "00")

FIELD_BITS = 16
"""Width of each field of the registers in which bits are flipped."""
_BASE_10 = 2  # fields of a binary output; the others are hexadecimal


@dataclass(frozen=True, slots=True)
class BinaryOutput:
    """An output set of registers 75 to 77: serial ports, period in 800 Hz ticks, and packet."""

    ports: int
    divisor: int
    layout: OutputLayout


def binary_output(fields: tuple[str, ...]) -> BinaryOutput | None:
    """Return the output set that the fields of a register 75 to 77 ask for; None for one without groups.

    Raises UnitError.
    """
    expect_count(fields, 3, 3 + 8)
    try:
        ports, divisor, groups = int(fields[0]), int(fields[1]), int(fields[2], 16)
        words = [int(text, 16) for text in fields[3:]]
    except ValueError as error:
        raise UnitError(INVALID_PARAMETER) from error
    if not (0 <= ports <= 3 and 0 <= divisor <= 65535 and 0 <= groups <= 0xFF):
        raise UnitError(INVALID_PARAMETER)
    bits = [bit for bit in range(8) if groups >> bit & 1]
    expect_count(fields[3:], len(bits), len(bits))
    if not bits and ports == 0:
        return None
    pairs = dict(zip(bits, words, strict=True))
    known = all(word and not word & ~SUPPORTED_FIELDS.get(bit, 0) for bit, word in pairs.items())
    if divisor == 0 or not bits or not known:
        raise UnitError(INVALID_PARAMETER)
    return BinaryOutput(ports, divisor, layout_of(pairs))


class RegisterFile:
    """The registers in use, and those in flash."""

    def __init__(self) -> None:
        self._defaults = {number: register.default for number, register in REGISTERS.items()}
        self._defaults |= dict.fromkeys(BINARY_OUTPUTS, _OFF)
        self._flash = dict(self._defaults)
        self._values = dict(self._defaults)

    def read(self, number: int) -> tuple[str, ...]:
        """Return a register's fields. Raises UnitError."""
        if number not in self._values:
            raise UnitError(INVALID_REGISTER)
        return self._values[number]

    def integer(self, number: int, index: int = 0) -> int:
        """Return one field as an integer."""
        return int(self._values[number][index])

    def write(self, number: int, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Store a register's new fields; return the unit's echo. Raises UnitError."""
        if number in BINARY_OUTPUTS:
            binary_output(fields)
            words = (f"{int(text, 16):04X}" for text in fields[3:])
            kept = (str(int(fields[0])), str(int(fields[1])), f"{int(fields[2], 16):02X}", *words)
            self._values[number] = kept
            return kept
        if number not in REGISTERS:
            raise UnitError(INVALID_REGISTER)
        register = REGISTERS[number]
        kept = register.checked(fields)
        # Only the port that the line is on, the first, is emulated.
        if kept[len(register.rules) :] != ("2",):
            self._values[number] = kept[: len(register.rules)]
        return kept

    def flip(self, number: int, bit: int) -> None:
        """Flip a bit, counted from the lowest of the first field on; one beyond the last is none.

        The register keeps what it holds then, and this raises UnitError where no write would have put it
        there.
        """
        place, shift = divmod(bit, FIELD_BITS)
        fields = list(self._values[number])
        if place >= len(fields):
            return
        hexadecimal = number in BINARY_OUTPUTS and place >= _BASE_10
        value = int(fields[place], 16 if hexadecimal else 10) ^ 1 << shift
        fields[place] = f"{value:0{len(fields[place])}X}" if hexadecimal else str(value)
        self._values[number] = tuple(fields)
        if number in BINARY_OUTPUTS:
            binary_output(self._values[number])
        else:
            REGISTERS[number].checked(self._values[number])

    def set_back(self, number: int, fields: tuple[str, ...]) -> None:
        """Restore a register's earlier fields."""
        self._values[number] = fields

    def save(self) -> None:
        """Write all to flash."""
        self._flash = dict(self._values)

    def restore(self) -> None:
        """Write the factory settings to flash."""
        self._flash = dict(self._defaults)

    def load(self) -> None:
        """Load all from flash, as at power-on."""
        self._values = dict(self._flash)
