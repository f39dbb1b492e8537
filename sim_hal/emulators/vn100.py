"""An emulated VN-100 on the device end of a serial line: registers, commands, outputs and power.

The unit executes commands and sends its asynchronous outputs (one ASCII sentence and three binary packets) on
the 800 Hz grid of its own clock. Register values are stored as the text that the unit prints, with the
contents and defaults of VectorNav UM001 v2.43, chapter 5. The registers that tune the attitude estimation (21
to 26, 32 to 51, 74, 82 to 84) are stored and echoed without effect, except the heading mode in register 35.
In register 85, only the filter windows of magnetometer, accelerometer and gyro have an effect. SYNC lines and
the second serial port are not emulated. VectorNav specifies 500 ms for a flash write, and a start-up time of
1 s is assumed.

The commands of the attitude filter follow VectorNav UM001, chapter 8. The commands "set initial heading" and
"set filter bias" follow VectorNav's SDK 0.99 and the answers of VectorNav units with satellite navigation. In
the absolute heading mode the magnetometer is assumed to set the heading, so that the commands "tare" and "set
initial heading" have no effect. Gravity is assumed to set pitch and roll in every mode, so only the yaw of a
given attitude has an effect. The filter's estimate of the gyro bias has no error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from hal.drivers.vn100_protocol import Checksum, OutputLayout, Sentence, build, layout_of, parse
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import IDENTITY, NED_TO_TESTBED, from_rotation_vector, multiply, normalise
from sim_hal.clock import NEVER
from sim_hal.emulators.serial_line import DeviceEnd
from sim_hal.emulators.vn100_sensors import (
    IMU_RATE_HZ,
    OUTPUT_BY_REGISTER,
    OUTPUT_BY_TYPE,
    PROFILES,
    AsciiOutput,
    MessageData,
    NoiseProfile,
    Reader,
    Sensors,
    Vn100Sample,
    readers,
)
from sim_hal.worlds.world import BodyMotion

Rule = Callable[[str], str]
"""Function from the written text of a field to the stored text. Raises ValueError for an invalid text."""

BAUD_RATES = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
ASYNC_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
ASYNC_TYPES = (0, 1, 2, 8, 9, 10, 11, 12, 13, 14, 16, 17, 19, 30)
BINARY_OUTPUTS = (75, 76, 77)
GYRO_STARTUP_BIAS, FILTER_STARTUP_BIAS = 43, 74

# Bit masks of the binary output fields that a VN-100 has, by group bit.
SUPPORTED_FIELDS: Mapping[int, int] = {0: 0x3F3D, 1: 0x0191, 2: 0x0FFF, 4: 0x01FF}


class UnitError(Exception):
    """Error that the unit reports by the answer `$VNERR` with an error code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"{code:02X}")
        self.code = code


INVALID_CHECKSUM, INVALID_COMMAND, TOO_FEW, TOO_MANY = 0x03, 0x04, 0x05, 0x06
INVALID_PARAMETER, INVALID_REGISTER, UNAUTHORIZED, LOW_BAUD = 0x07, 0x08, 0x09, 0x0C
RECEIVE_OVERFLOW = 0x02


@dataclass(frozen=True, slots=True)
class Register:
    """A register of the unit; each field has a default value and a function that checks written values.

    If `port_option` is set, a write may have the serial port as an additional field.
    """

    rules: tuple[Rule, ...]
    default: tuple[str, ...]
    writable: bool = True
    port_option: bool = False

    def checked(self, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the fields of a write as the unit stores them. Raises UnitError for invalid fields."""
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
    """Raise UnitError if the number of fields is out of range."""
    if len(fields) < least:
        raise UnitError(TOO_FEW)
    if len(fields) > most:
        raise UnitError(TOO_MANY)


def _integer(allowed: Container[int]) -> Rule:
    def rule(text: str) -> str:
        if int(text) not in allowed:
            raise ValueError(text)
        return str(int(text))

    return rule


def _choice(*values: int) -> Rule:
    return _integer(values)


def _unsigned(most: int) -> Rule:
    return _integer(range(most + 1))


def _between(low: float, high: float) -> Rule:
    def rule(text: str) -> str:
        if not (low <= float(text) <= high and math.isfinite(float(text))):
            raise ValueError(text)
        return text

    return rule


_number = _between(-math.inf, math.inf)


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
"""Number of bits of each register field that a fault can address."""
_BASE_10 = 2  # number of decimal fields at the start of registers 75 to 77; later fields are hexadecimal


@dataclass(frozen=True, slots=True)
class BinaryOutput:
    """A binary output of registers 75 to 77, with serial ports, period (800 Hz ticks) and packet layout.

    The functions `readers` return the values of the packet.
    """

    ports: int
    divisor: int
    layout: OutputLayout
    readers: tuple[Reader, ...]

    def pack(self, now: MessageData) -> bytes:
        """Return the binary packet with the data of one sampling time."""
        values: list[float] = []
        for read in self.readers:
            values += read(now)
        return self.layout.pack(values)


def binary_output(fields: tuple[str, ...]) -> BinaryOutput | None:
    """Return the binary output that register fields define, or None if it is off. Raises UnitError."""
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
    layout = layout_of(pairs)
    return BinaryOutput(ports, divisor, layout, readers(layout.fields))


class RegisterFile:
    """Registers of the unit: the fields in use, and their copy in flash memory."""

    def __init__(self) -> None:
        self._defaults = {number: register.default for number, register in REGISTERS.items()}
        self._defaults |= dict.fromkeys(BINARY_OUTPUTS, _OFF)
        self._flash = dict(self._defaults)
        self.values = dict(self._defaults)

    def read(self, number: int) -> tuple[str, ...]:
        """Return the fields of a register. Raises UnitError for an unknown register."""
        if number not in self.values:
            raise UnitError(INVALID_REGISTER)
        return self.values[number]

    def integer(self, number: int, index: int = 0) -> int:
        """Return one field of a register as an integer."""
        return int(self.values[number][index])

    def write(self, number: int, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Store the new fields of a register and return the unit's echo. Raises UnitError."""
        if number in BINARY_OUTPUTS:
            binary_output(fields)
            words = (f"{int(text, 16):04X}" for text in fields[3:])
            kept = (str(int(fields[0])), str(int(fields[1])), f"{int(fields[2], 16):02X}", *words)
            self.values[number] = kept
            return kept
        if number not in REGISTERS:
            raise UnitError(INVALID_REGISTER)
        register = REGISTERS[number]
        kept = register.checked(fields)
        # Only the first serial port, which is connected to the line, is emulated.
        if kept[len(register.rules) :] != ("2",):
            self.values[number] = kept[: len(register.rules)]
        return kept

    def flip(self, number: int, bit: int) -> None:
        """Flip a bit of a register; bits after the last field are ignored.

        Bits are counted from the lowest bit of the first field. The register keeps the new content even if it
        is invalid. Raises UnitError if the unit would reject this content in a write command.
        """
        place, shift = divmod(bit, FIELD_BITS)
        fields = list(self.values[number])
        if place >= len(fields):
            return
        hexadecimal = number in BINARY_OUTPUTS and place >= _BASE_10
        value = int(fields[place], 16 if hexadecimal else 10) ^ 1 << shift
        fields[place] = f"{value:0{len(fields[place])}X}" if hexadecimal else str(value)
        self.values[number] = tuple(fields)
        if number in BINARY_OUTPUTS:
            binary_output(self.values[number])
        else:
            REGISTERS[number].checked(self.values[number])

    def save(self) -> None:
        """Write all registers to flash."""
        self._flash = dict(self.values)

    def restore(self) -> None:
        """Write the factory settings to flash."""
        self._flash = dict(self._defaults)

    def load(self) -> None:
        """Load all registers from flash, as at power-on."""
        self.values = dict(self._flash)


ATTITUDE_COMMANDS = frozenset({"KMD", "KAD", "TAR", "SIH", "SGB", "SFB"})
_DISTURBANCES = {"KMD": 1 << 11, "KAD": 1 << 12}
_VPE_CONTROL, _HEADING_MODE, _ABSOLUTE = 35, 1, 0


class AttitudeCommands:
    """State of the attitude filter (VPE) that commands can change.

    The commands KMD and KAD (known magnetic disturbance, known acceleration disturbance) set bits of the
    status word.
    """

    def __init__(self, registers: RegisterFile, gyro_bias: FloatArray) -> None:
        """Store the filter's estimate `gyro_bias` (3,), rad/s, sensor axes.

        The commands SGB and SFB (set gyro bias, set filter bias) save this estimate in registers.
        """
        self._registers, self._gyro_bias = registers, gyro_bias
        self._turn: FloatArray | None = None
        self.status = 0

    def reset(self) -> None:
        """Discard the heading and the status that commands have set."""
        self._turn = None
        self.status = 0

    def turned(self, sample: Vn100Sample) -> Vn100Sample:
        """Return `sample` rotated to the heading that commands have set."""
        if self._turn is None:
            return sample
        return replace(sample, quaternion=multiply(sample.quaternion, self._turn))

    def execute(self, command: str, fields: tuple[str, ...], sample: Callable[[], Vn100Sample]) -> None:
        """Execute one of `ATTITUDE_COMMANDS`; the function `sample` returns the present sample."""
        if command in _DISTURBANCES:
            bit = _DISTURBANCES[command]
            self.status = self.status | bit if flag(fields) else self.status & ~bit
        elif command == "SIH":
            self._set_heading(_yaw_of(fields), sample)
        else:
            expect_count(fields, 0, 0)
            if command == "TAR":
                self._set_heading(0.0, sample)
            else:
                gyro = tuple(f"{value:+010.6f}" for value in self._gyro_bias.tolist())
                self._registers.write(GYRO_STARTUP_BIAS, gyro)
                kept = self._registers.read(FILTER_STARTUP_BIAS)[3:]
                others = ("+00.000000",) * 4 if command == "SFB" else kept
                self._registers.write(FILTER_STARTUP_BIAS, (*gyro, *others))

    def _set_heading(self, yaw: float, sample: Callable[[], Vn100Sample]) -> None:
        """Rotate the attitude about the vertical so that the present yaw becomes `yaw` (rad)."""
        if self._registers.integer(_VPE_CONTROL, _HEADING_MODE) == _ABSOLUTE:
            return
        change = from_rotation_vector(np.array([0.0, 0.0, yaw - math.radians(sample().yaw_pitch_roll[0])]))
        self._turn = change if self._turn is None else normalise(multiply(self._turn, change))


def flag(fields: tuple[str, ...]) -> bool:
    """Return the only field of a command as a bool.

    Raises UnitError unless the command has one field, which is 0 or 1.
    """
    expect_count(fields, 1, 1)
    if fields[0] not in {"0", "1"}:
        raise UnitError(INVALID_PARAMETER)
    return fields[0] == "1"


def _yaw_of(fields: tuple[str, ...]) -> float:
    """Return the yaw (rad) from the fields: a heading (deg), three angles (deg) or a quaternion.

    Raises UnitError for any other fields.
    """
    expect_count(fields, 1, 4)
    if len(fields) == 2:
        raise UnitError(TOO_FEW)
    try:
        values = [float(text) for text in fields]
    except ValueError as error:
        raise UnitError(INVALID_PARAMETER) from error
    if not all(map(math.isfinite, values)):
        raise UnitError(INVALID_PARAMETER)
    if len(values) < 4:
        return math.radians(values[0])
    if not any(values):
        raise UnitError(INVALID_PARAMETER)
    attitude = Vn100Sample(normalise(np.array(values)), np.zeros(3), np.zeros(3), np.zeros(3))
    return math.radians(attitude.yaw_pitch_roll[0])


@lru_cache(maxsize=16)
def _windows(fields: tuple[str, ...]) -> tuple[int, ...]:
    """Return the filter lengths of magnetometer, accelerometer and gyro, the first fields of register 85."""
    return tuple(map(int, fields[:3]))


_OUR_PORT = 1


@dataclass(slots=True)
class Stream:
    """A periodic output of `length` bytes every `divisor` ticks, last sent at `sent_ns` of device time."""

    divisor: int
    length: int
    message: Callable[[MessageData], bytes]
    sent_ns: int


class OutputStreams:
    """The asynchronous outputs of an emulated unit.

    Attributes:
        muted: registers whose output is silent until the register is written again.
        foreign: packet and rate divisor of an output that another firmware version stored in the flash copy
            of register 75, or None; the output ends when register 75 is written.
    """

    def __init__(self, registers: RegisterFile) -> None:
        self._registers = registers
        self._streams: dict[int, Stream] = {}
        self.muted: set[int] = set()
        self.foreign: tuple[bytes, int] | None = None
        self._sends_foreign = False

    def reset(self) -> None:
        """Remove all output streams, and start the output `foreign` unless it is None."""
        self._streams = {}
        self.muted.clear()
        self._sends_foreign = self.foreign is not None

    def written(self, number: int) -> None:
        """End the injected fault (silent or unrequested output) of a register that has been written."""
        self.muted.discard(number)
        self._sends_foreign = self._sends_foreign and number != BINARY_OUTPUTS[0]

    def build(self, device_ns: int) -> None:
        """Rebuild the output streams from the registers. Raises UnitError if the line is too slow."""
        registers = self._registers
        streams: dict[int, Stream] = {}
        output = OUTPUT_BY_TYPE.get(registers.integer(6))
        if output is not None and not self.muted & {6, 7}:
            divisor = IMU_RATE_HZ // registers.integer(7)
            length = output.length() + len(self._suffix(0)) + 2 * (self.checksum() == "crc16")
            streams[6] = Stream(divisor, length, partial(self._sentence, output), device_ns)
        for number in sorted(set(BINARY_OUTPUTS) - self.muted):
            packet = binary_output(registers.read(number))
            if packet is not None and packet.ports & _OUR_PORT:
                streams[number] = Stream(packet.divisor, packet.layout.length, packet.pack, device_ns)
        if self.foreign is not None and self._sends_foreign:
            packet_, divisor = self.foreign
            streams[BINARY_OUTPUTS[0]] = Stream(divisor, len(packet_), lambda _: packet_, device_ns)
        # An existing stream keeps the time of its last message.
        for number in streams.keys() & self._streams.keys():
            streams[number].sent_ns = self._streams[number].sent_ns
        load = sum(10 * stream.length * IMU_RATE_HZ / stream.divisor for stream in streams.values())
        if load > registers.integer(5):
            raise UnitError(LOW_BAUD)
        self._streams = streams

    def next_tick(self, passed: int) -> int | None:
        """Return the first tick after the tick `passed` on which a stream is due, or None without streams."""
        return min(((passed // s.divisor + 1) * s.divisor for s in self._streams.values()), default=None)

    def due(self, tick: int) -> list[Stream]:
        """Return the output streams that are due on a tick."""
        return [stream for stream in self._streams.values() if tick % stream.divisor == 0]

    def checksum(self) -> Checksum:
        """Return the kind of checksum, 8-bit XOR or CRC-16, that register 30 selects."""
        return "crc16" if self._registers.integer(30, 4) == 3 else "xor8"

    def _suffix(self, status: int) -> str:
        count = ",T0000000000" if self._registers.integer(30, 0) else ""
        return count + (f",S{status:04X}" if self._registers.integer(30, 1) else "")

    def _sentence(self, output: AsciiOutput, now: MessageData) -> bytes:
        fields = [*now.text(output.quantities), *self._suffix(now.status).split(",")[1:]]
        return build(output.header, *fields, checksum=self.checksum())


def _number_of(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise UnitError(INVALID_REGISTER) from error


_RECEIVE_BUFFER = 256
_BILLION = 1_000_000_000
TICK_NS = _BILLION // IMU_RATE_HZ


@dataclass(frozen=True, slots=True)
class Vn100EmulatorSettings:
    """Properties of an emulated unit.

    Attributes:
        noise: noise profile of the sensors.
        mounting: quaternion (4,) from sensor axes to body axes.
        reference: quaternion (4,) from NED axes to the world's reference frame.
        gyro_bias: constant gyro bias (3,), rad/s, sensor axes.
        clock_ppm: rate error of the unit's clock, ppm; positive if the clock is fast.
        uptime_ns: time of the unit's clock at the start of the simulation, ns, which determines the phase of
            the outputs.
        boot_ns: time from reset to the first message, ns.
        flash_ns: duration of a flash write, ns.
        temperature: reported temperature, degrees C.
        pressure: reported pressure, kPa.
        free_fall: whether the body is in free fall, so that the unit's attitude is meaningless.
    """

    noise: NoiseProfile = PROFILES["thesis"]
    mounting: FloatArray = field(default_factory=IDENTITY.copy)
    reference: FloatArray = field(default_factory=NED_TO_TESTBED.copy)
    gyro_bias: FloatArray = field(default_factory=lambda: np.zeros(3))
    clock_ppm: float = 0.0
    uptime_ns: int = 10_000_000_000
    boot_ns: int = 1_000_000_000
    flash_ns: int = 500_000_000
    temperature: float = 20.0
    pressure: float = 101.325
    free_fall: bool = False


class Vn100Emulator:
    """An emulated VN-100 (`sim_hal.clock.EmulatedDevice`); a fault sets `alter`, which alters each sample."""

    def __init__(
        self,
        sense: Callable[[int], BodyMotion],
        line: DeviceEnd,
        rng: np.random.Generator,
        settings: Vn100EmulatorSettings,
        now_ns: int = 0,
    ) -> None:
        """Connect a running unit at `now_ns`; the function `sense` returns the motion at a time."""
        self.registers = RegisterFile()
        self.alter: Callable[[Vn100Sample], Vn100Sample] | None = None
        self._sense, self._line, self._settings = sense, line, settings
        bias = settings.gyro_bias
        self._sensors = Sensors(
            rng, settings.noise, settings.mounting, settings.reference, bias, settings.free_fall
        )
        self._clock_rate = _BILLION + round(settings.clock_ppm * 1000)
        self._then: tuple[int, Callable[[int], None]] | None = None
        self._streams = OutputStreams(self.registers)
        self._attitude = AttitudeCommands(self.registers, bias)
        self._received = bytearray()
        self._paused = False
        self._origin_ns = now_ns
        self._uptime_ns = settings.uptime_ns
        self._tick = -1
        self._tick_due = 0
        self._due_ns = NEVER
        self._start(now_ns, settings.uptime_ns)

    def next_event_ns(self) -> int:
        """Return the time at which the unit next receives or sends data."""
        return min(self._line.next_arrival_ns(), self._due_ns)

    def advance(self, now_ns: int) -> None:
        """Receive and send everything that is due by `now_ns`."""
        while (event_ns := self.next_event_ns()) <= now_ns:
            if self._due_ns <= event_ns:
                self._act(event_ns)
            else:
                data = self._line.read(event_ns)
                if self._then is None:  # the unit does not receive during a start or a flash write
                    self._receive(data, event_ns)
            self._schedule(event_ns)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Save a baud rate in flash, with the highest output rate that the line permits. Raises UnitError."""
        self.registers.write(5, (str(baud_rate),))
        length = OUTPUT_BY_TYPE[14].length()
        fitting = [rate for rate in ASYNC_RATES_HZ if rate <= 40 and 10 * length * rate <= baud_rate]
        self.registers.write(7, (str(fitting[-1]),))
        self._build_streams(self._origin_ns)
        self.registers.save()
        self._line.baud_rate = baud_rate

    def switch_off(self) -> None:
        """Remove the power."""
        self._then = NEVER, lambda _: None
        self._due_ns = NEVER

    def switch_on(self, now_ns: int) -> None:
        """Apply power or reset the unit, which restarts from its flash."""
        self._restart(now_ns)
        self._schedule(now_ns)

    def change_baud_rate(self, baud_rate: int, now_ns: int) -> None:
        """Change the baud rate, as a write of register 5 does."""
        self.registers.write(5, (str(baud_rate),))
        self._line.baud_rate = baud_rate
        self._build_streams(now_ns)

    def save_foreign_output(self, packet: bytes, divisor: int, now_ns: int) -> None:
        """Store in flash an output that only other firmware versions have, and restart the unit from flash.

        The unit sends `packet` every `divisor` ticks of 1/800 s, also after later restarts.
        """
        self._streams.foreign = packet, divisor
        self.switch_on(now_ns)

    def upset(self, register: int, bit: int, now_ns: int) -> None:
        """Flip a bit of a register that configures the outputs, as radiation can do.

        If the register becomes invalid or the line is too slow for the output, the output is assumed to be
        silent until the register is written again.
        """
        try:
            self.registers.flip(register, bit)
            self._build_streams(now_ns)
        except UnitError:
            self._streams.muted.add(register)
            self._build_streams(now_ns)
        self._schedule(now_ns)

    # The following methods count time in ticks of 1/800 s of the unit's own clock.

    def _device_ns(self, now_ns: int) -> int:
        return self._uptime_ns + (now_ns - self._origin_ns) * self._clock_rate // _BILLION

    def _schedule(self, now_ns: int) -> None:
        if self._then is not None:
            self._due_ns = self._then[0]
            return
        tick = self._streams.next_tick(max(self._tick, self._device_ns(now_ns) // TICK_NS))
        if self._paused or tick is None:
            self._due_ns = NEVER
        else:
            self._tick_due = tick
            since_ns = (self._uptime_ns - tick * TICK_NS) * _BILLION // self._clock_rate
            self._due_ns = self._origin_ns - since_ns

    def _act(self, now_ns: int) -> None:
        if self._then is not None:
            _, action = self._then
            self._then = None
            action(now_ns)
            return
        self._tick = self._tick_due
        device_ns = self._tick * TICK_NS
        sample = self._sample(now_ns)
        for stream in self._streams.due(self._tick):
            self._line.write(stream.message(self._data(device_ns, sample, stream.sent_ns)), now_ns)
            stream.sent_ns = device_ns

    # Commands.

    def _receive(self, data: bytes, now_ns: int) -> None:
        """Execute and answer the commands that are complete after `data`."""
        self._received += data
        while (end := self._received.find(b"\n")) >= 0:
            line = bytes(self._received[: end + 1])
            del self._received[: end + 1]
            start = line.rfind(b"$")
            if start >= 0:
                self._answer_line(line[start:], now_ns)
        if len(self._received) > _RECEIVE_BUFFER:
            self._received.clear()
            self._send_error(RECEIVE_OVERFLOW, self._streams.checksum(), now_ns)

    def _answer_line(self, line: bytes, now_ns: int) -> None:
        sentence = parse(line, allow_none=True)
        if sentence is None:
            wide = len(line.rstrip(b"\r\n").rpartition(b"*")[2]) == 4
            self._send_error(INVALID_CHECKSUM, "crc16" if wide else "xor8", now_ns)
            return
        checksum = self._streams.checksum() if sentence.checksum == "none" else sentence.checksum
        try:
            self._execute(sentence, checksum, now_ns)
        except UnitError as error:
            self._send_error(error.code, checksum, now_ns)

    def _send_error(self, code: int, checksum: Checksum, now_ns: int) -> None:
        mode = self.registers.integer(30, 6)
        if mode:
            self._line.write(build("ERR", f"{code:02X}", checksum=checksum), now_ns)
        if mode == 2:
            self.registers.write(6, ("0",))
            self._build_streams(now_ns)

    def _execute(self, sentence: Sentence, checksum: Checksum, now_ns: int) -> None:
        """Execute a command and send the answer. Raises UnitError."""

        def answer(*fields: str, at_ns: int = now_ns) -> None:
            self._line.write(build(sentence.command, *fields, checksum=checksum), at_ns)

        fields = sentence.fields
        match sentence.command:
            case "RRG":
                expect_count(fields, 1, 2)
                number = _number_of(fields[0])
                if number in OUTPUT_BY_REGISTER:
                    answer(fields[0], *self._data_now(now_ns).text(OUTPUT_BY_REGISTER[number].quantities))
                else:
                    answer(fields[0], *self.registers.read(number))
            case "WRG":
                expect_count(fields, 2, 16)
                self._write(_number_of(fields[0]), fields, answer, now_ns)
            case "ASY":
                self._paused = not flag(fields)
                answer(*fields)
            case command if command in ATTITUDE_COMMANDS:
                self._attitude.execute(command, fields, lambda: self._data_now(now_ns).sample)
                answer(*fields)
            case "BOM":
                expect_count(fields, 1, 1)
                number = BINARY_OUTPUTS[0] - 1 + _number_of(fields[0])
                output = binary_output(self.registers.read(number)) if number in BINARY_OUTPUTS else None
                if output is None:
                    raise UnitError(INVALID_PARAMETER)
                self._line.write(output.pack(self._data_now(now_ns)), now_ns)
            case "WNV":
                self.registers.save()
                self._then = now_ns + self._settings.flash_ns, lambda end_ns: answer(at_ns=end_ns)
            case "RFS" | "RST":
                answer()
                if sentence.command == "RFS":
                    self.registers.restore()
                self._restart(now_ns)
            case _:
                raise UnitError(INVALID_COMMAND)

    def _write(self, number: int, fields: tuple[str, ...], answer: Callable[..., None], now_ns: int) -> None:
        if number in OUTPUT_BY_REGISTER:
            raise UnitError(UNAUTHORIZED)
        before = self.registers.read(number)
        echo = self.registers.write(number, fields[1:])
        self._streams.written(number)
        try:
            self._build_streams(now_ns)
        except UnitError:
            self.registers.values[number] = before
            raise
        # The answer is sent at the old baud rate.
        answer(fields[0], *echo)
        self._line.baud_rate = self.registers.integer(5)

    # Output.

    def _sample(self, now_ns: int) -> Vn100Sample:
        windows = _windows(self.registers.values[85])
        sample = self._attitude.turned(self._sensors.measure(self._sense(now_ns), windows))
        return sample if self.alter is None else self.alter(sample)

    def _data(self, device_ns: int, sample: Vn100Sample, since_ns: int) -> MessageData:
        settings, interval = self._settings, (device_ns - since_ns) * 1e-9
        climate = settings.temperature, settings.pressure
        return MessageData(device_ns, sample, self._attitude.status, interval, *climate)

    def _data_now(self, now_ns: int) -> MessageData:
        device_ns = self._device_ns(now_ns)
        return self._data(device_ns, self._sample(now_ns), device_ns - TICK_NS)

    def _build_streams(self, now_ns: int) -> None:
        self._streams.build(self._device_ns(now_ns))

    # Power.

    def _restart(self, now_ns: int) -> None:
        self._then = now_ns + self._settings.boot_ns, lambda end_ns: self._start(end_ns, 0)

    def _start(self, now_ns: int, uptime_ns: int) -> None:
        """Start the unit from its flash, with the unit's clock at `uptime_ns`."""
        self.registers.load()
        self._line.baud_rate = self.registers.integer(5)
        self._sensors.restart()
        self._received.clear()
        self._paused = False
        self._attitude.reset()
        self._streams.reset()
        self._origin_ns = now_ns
        self._uptime_ns = uptime_ns
        self._tick = uptime_ns // TICK_NS
        self._build_streams(now_ns)
        self._schedule(now_ns)
