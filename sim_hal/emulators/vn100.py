"""A VN-100 as VectorNav made it, on the device end of a serial line.

It answers every command and register of `vn100_registers`, and says what `vn100_sensors` measure in the words
of `vn100_outputs`, on the 800 Hz grid of its own clock. What tunes its estimation (registers 21 to 26, 32 to
47, 82 to 84) is kept and echoed and changes nothing; of register 85 the windows of magnetometer,
accelerometer and gyro count. Not emulated: tare, SYNC lines, its second serial port. The 500 ms of a flash
write are VectorNav's; the second of start-up is assumed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.frames import NED_TO_TESTBED
from flight.gnc.math.quaternion import IDENTITY
from hal.drivers.vn100.ascii import Checksum, Sentence, build, parse
from sim_hal.emulators.device import NEVER, SerialEnd
from sim_hal.emulators.vn100_outputs import (
    FIELD_VALUES,
    REPORT_BY_REGISTER,
    REPORT_BY_TYPE,
    Instant,
    Report,
    report_length,
)
from sim_hal.emulators.vn100_registers import (
    ASYNC_RATES_HZ,
    BINARY_OUTPUTS,
    INVALID_CHECKSUM,
    INVALID_COMMAND,
    INVALID_PARAMETER,
    INVALID_REGISTER,
    LOW_BAUD,
    RECEIVE_OVERFLOW,
    UNAUTHORIZED,
    BinaryOutput,
    RegisterFile,
    UnitError,
    binary_output,
    expect_count,
)
from sim_hal.emulators.vn100_sensors import IMU_RATE_HZ, PROFILES, Measured, NoiseProfile, Sensors
from sim_hal.worlds.motion import Motion

TICK_NS = 1_000_000_000 // IMU_RATE_HZ
_BILLION = 1_000_000_000
_RECEIVE_BUFFER = 256
_OUR_PORT = 1
_KNOWN_MAGNETIC, _KNOWN_ACCELERATION = 1 << 11, 1 << 12


@dataclass(frozen=True, slots=True)
class Vn100EmulatorSettings:
    """What this unit is like.

    Attributes:
        noise: its noise profile.
        mounting: (4,) sensor axes into body axes.
        reference: (4,) NED into the world's reference frame.
        gyro_bias: (3,) rad/s, sensor axes.
        clock_ppm: how much faster than true its clock runs.
        uptime_ns: its own time when the simulation begins; what is beyond a whole 25 ms is its phase.
        boot_ns: from reset to the first word. flash_ns: to write the flash.
        temperature: degrees C. pressure: kPa.
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


@dataclass(slots=True)
class _Stream:
    """One asynchronous output: every `divisor` ticks; `length` in bytes."""

    divisor: int
    length: int
    say: Callable[[Instant], bytes]
    said_ns: int


class Vn100Emulator:
    """The unit; a `sim_hal.emulators.device.EmulatedDevice`.

    Attributes:
        spoil: what becomes of a measurement before it is told: for faults.
    """

    def __init__(
        self,
        sense: Callable[[int], Motion],
        line: SerialEnd,
        rng: np.random.Generator,
        settings: Vn100EmulatorSettings,
        now_ns: int = 0,
    ) -> None:
        """Find the unit on since `settings.uptime_ns` at `now_ns`; `sense` gives the motion at a time."""
        self.registers = RegisterFile()
        self.spoil: Callable[[Measured], Measured] | None = None
        self._sense = sense
        self._line = line
        self._settings = settings
        bias = settings.gyro_bias
        self._sensors = Sensors(rng, settings.noise, settings.mounting, settings.reference, bias)
        self._clock_rate = _BILLION + round(settings.clock_ppm * 1000)
        self._received = bytearray()
        self._then: tuple[int, Callable[[int], None]] | None = None
        self._streams: dict[int, _Stream] = {}
        self._mute: set[int] = set()
        self._paused = False
        self._status = 0
        self._origin_ns = now_ns
        self._uptime_ns = settings.uptime_ns
        self._tick = -1
        self._tick_due = 0
        self._due_ns = NEVER
        self._start(now_ns, settings.uptime_ns)

    def next_event_ns(self) -> int:
        """Return when the unit next hears or says something."""
        return min(self._line.next_arrival_ns(), self._due_ns)

    def advance(self, now_ns: int) -> None:
        """Hear and say all that is due at or before `now_ns`."""
        while (event_ns := self.next_event_ns()) <= now_ns:
            if self._due_ns <= event_ns:
                self._act(event_ns)
            else:
                self._hear(self._line.read(event_ns), event_ns)
            self._schedule(event_ns)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Be a unit that was saved at this speed, its output slowed to what fits. Raises UnitError."""
        self.registers.write(5, (str(baud_rate),))
        length = report_length(REPORT_BY_TYPE[14])
        fitting = [rate for rate in ASYNC_RATES_HZ if rate <= 40 and 10 * length * rate <= baud_rate]
        self.registers.write(7, (str(fitting[-1]),))
        self._build_streams(self._origin_ns)
        self.registers.save()
        self._line.baud_rate = baud_rate

    def switch_off(self) -> None:
        """Take the power away."""
        self._then = NEVER, lambda _: None
        self._due_ns = NEVER

    def switch_on(self, now_ns: int) -> None:
        """Give power, or reset: the unit starts anew from its flash."""
        self._then = now_ns + self._settings.boot_ns, lambda end_ns: self._start(end_ns, 0)
        self._schedule(now_ns)

    def change_baud_rate(self, baud_rate: int, now_ns: int) -> None:
        """Speak at another speed from now on, as if somebody had written register 5."""
        self.registers.write(5, (str(baud_rate),))
        self._line.baud_rate = baud_rate
        self._build_streams(now_ns)

    def upset(self, register: int, bit: int, now_ns: int) -> None:
        """Let radiation flip a bit of a register that its outputs are made of.

        Assumed: an output whose register makes no sense, or asks for more than the line carries, is silent
        until that register is written.
        """
        try:
            self.registers.flip(register, bit)
            self._build_streams(now_ns)
        except UnitError:
            self._mute.add(register)
            self._build_streams(now_ns)
        self._schedule(now_ns)

    # Time: ticks of 1/800 s of the unit's own clock.

    def _device_ns(self, now_ns: int) -> int:
        return self._uptime_ns + (now_ns - self._origin_ns) * self._clock_rate // _BILLION

    def _tick_ns(self, tick: int) -> int:
        return self._origin_ns - (self._uptime_ns - tick * TICK_NS) * _BILLION // self._clock_rate

    def _schedule(self, now_ns: int) -> None:
        if self._then is not None:
            self._due_ns = self._then[0]
        elif self._paused or not self._streams:
            self._due_ns = NEVER
        else:
            passed = max(self._tick, self._device_ns(now_ns) // TICK_NS)
            self._tick_due = min((passed // s.divisor + 1) * s.divisor for s in self._streams.values())
            self._due_ns = self._tick_ns(self._tick_due)

    def _act(self, now_ns: int) -> None:
        if self._then is not None:
            _, action = self._then
            self._then = None
            action(now_ns)
            return
        self._tick = self._tick_due
        device_ns = self._tick * TICK_NS
        measured = self._measure(now_ns)
        for stream in self._streams.values():
            if self._tick % stream.divisor == 0:
                self._line.write(stream.say(self._instant(device_ns, measured, stream.said_ns)), now_ns)
                stream.said_ns = device_ns

    # What it says.

    def _measure(self, now_ns: int) -> Measured:
        windows = tuple(self.registers.integer(85, index) for index in range(3))
        measured = self._sensors.measure(self._sense(now_ns), windows)
        return measured if self.spoil is None else self.spoil(measured)

    def _instant(self, device_ns: int, measured: Measured, since_ns: int) -> Instant:
        interval = (device_ns - since_ns) * 1e-9
        settings = self._settings
        return Instant(device_ns, measured, self._status, interval, settings.temperature, settings.pressure)

    def _instant_now(self, now_ns: int) -> Instant:
        device_ns = self._device_ns(now_ns)
        return self._instant(device_ns, self._measure(now_ns), device_ns - TICK_NS)

    def _build_streams(self, now_ns: int) -> None:
        device_ns = self._device_ns(now_ns)
        streams: dict[int, _Stream] = {}
        report = REPORT_BY_TYPE.get(self.registers.integer(6))
        if report is not None and not self._mute & {6, 7}:
            divisor = IMU_RATE_HZ // self.registers.integer(7)
            length = report_length(report) + len(self._suffix()) + 2 * (self._checksum() == "crc16")
            streams[6] = _Stream(divisor, length, lambda now: self._sentence(report, now), device_ns)
        for number in sorted(set(BINARY_OUTPUTS) - self._mute):
            output = binary_output(self.registers.read(number))
            if output is not None and output.ports & _OUR_PORT:
                streams[number] = _Stream(output.divisor, output.layout.length, _packer(output), device_ns)
        # A stream that goes on as it was keeps the time of its last word.
        for number in streams.keys() & self._streams.keys():
            streams[number].said_ns = self._streams[number].said_ns
        load = sum(10 * stream.length * IMU_RATE_HZ / stream.divisor for stream in streams.values())
        if load > self.registers.integer(5):
            raise UnitError(LOW_BAUD)
        self._streams = streams

    def _checksum(self) -> Checksum:
        return "crc16" if self.registers.integer(30, 4) == 3 else "xor8"

    def _suffix(self) -> str:
        count = ",T0000000000" if self.registers.integer(30, 0) else ""
        return count + (f",S{self._status:04X}" if self.registers.integer(30, 1) else "")

    def _sentence(self, report: Report, now: Instant) -> bytes:
        fields = [*report.text(now), *self._suffix().split(",")[1:]]
        return build(report.header, *fields, checksum=self._checksum())

    # What it hears.

    def _hear(self, data: bytes, now_ns: int) -> None:
        if self._then is not None:
            return  # starting, or writing its flash: deaf
        self._received += data
        while (end := self._received.find(b"\n")) >= 0:
            line = bytes(self._received[: end + 1])
            del self._received[: end + 1]
            start = line.rfind(b"$")
            if start >= 0:
                self._obey(line[start:], now_ns)
        if len(self._received) > _RECEIVE_BUFFER:
            self._received.clear()
            self._complain(RECEIVE_OVERFLOW, self._checksum(), now_ns)

    def _obey(self, line: bytes, now_ns: int) -> None:
        sentence = parse(line, allow_none=True)
        if sentence is None:
            wide = len(line.rstrip(b"\r\n").rpartition(b"*")[2]) == 4
            self._complain(INVALID_CHECKSUM, "crc16" if wide else "xor8", now_ns)
            return
        checksum = self._checksum() if sentence.checksum == "none" else sentence.checksum
        try:
            self._execute(sentence, checksum, now_ns)
        except UnitError as error:
            self._complain(error.code, checksum, now_ns)

    def _complain(self, code: int, checksum: Checksum, now_ns: int) -> None:
        mode = self.registers.integer(30, 6)
        if mode:
            self._line.write(build("ERR", f"{code:02X}", checksum=checksum), now_ns)
        if mode == 2:
            self.registers.write(6, ("0",))
            self._build_streams(now_ns)

    def _execute(self, sentence: Sentence, checksum: Checksum, now_ns: int) -> None:
        """Do what a command asks and answer it. Raises UnitError."""

        def answer(*fields: str, at_ns: int = now_ns) -> None:
            self._line.write(build(sentence.command, *fields, checksum=checksum), at_ns)

        fields = sentence.fields
        match sentence.command:
            case "RRG":
                expect_count(fields, 1, 2)
                answer(fields[0], *self._read(_number_of(fields[0]), now_ns))
            case "WRG":
                expect_count(fields, 2, 16)
                self._write(_number_of(fields[0]), fields, answer, now_ns)
            case "ASY":
                self._paused = not _flag(fields)
                answer(*fields)
            case "KMD" | "KAD":
                bit = _KNOWN_MAGNETIC if sentence.command == "KMD" else _KNOWN_ACCELERATION
                self._status = self._status | bit if _flag(fields) else self._status & ~bit
                answer(*fields)
            case "BOM":
                expect_count(fields, 1, 1)
                self._poll_binary(BINARY_OUTPUTS[0] - 1 + _number_of(fields[0]), now_ns)
            case "WNV":
                self.registers.save()
                self._then = now_ns + self._settings.flash_ns, lambda end_ns: answer(at_ns=end_ns)
            case "SGB":
                bias = self._settings.gyro_bias.tolist()
                self.registers.write(43, tuple(f"{value:+010.6f}" for value in bias))
                answer()
            case "RFS" | "RST":
                answer()
                if sentence.command == "RFS":
                    self.registers.restore()
                self._then = now_ns + self._settings.boot_ns, lambda end_ns: self._start(end_ns, 0)
            case _:
                raise UnitError(INVALID_COMMAND)

    def _read(self, number: int, now_ns: int) -> tuple[str, ...]:
        report = REPORT_BY_REGISTER.get(number)
        if report is not None:
            return tuple(report.text(self._instant_now(now_ns)))
        return self.registers.read(number)

    def _write(self, number: int, fields: tuple[str, ...], answer: Callable[..., None], now_ns: int) -> None:
        if number in REPORT_BY_REGISTER:
            raise UnitError(UNAUTHORIZED)
        before = self.registers.read(number)
        echo = self.registers.write(number, fields[1:])
        self._mute.discard(number)
        try:
            self._build_streams(now_ns)
        except UnitError:
            self.registers.set_back(number, before)
            raise
        # The answer still goes out at the old speed.
        answer(fields[0], *echo)
        self._line.baud_rate = self.registers.integer(5)

    def _poll_binary(self, number: int, now_ns: int) -> None:
        if number not in BINARY_OUTPUTS:
            raise UnitError(INVALID_PARAMETER)
        output = binary_output(self.registers.read(number))
        if output is None:
            raise UnitError(INVALID_PARAMETER)
        self._line.write(_packer(output)(self._instant_now(now_ns)), now_ns)

    def _start(self, now_ns: int, uptime_ns: int) -> None:
        """Begin anew from the flash, with the unit's clock at `uptime_ns`."""
        self.registers.load()
        self._line.baud_rate = self.registers.integer(5)
        self._sensors.restart()
        self._received.clear()
        self._streams = {}
        self._mute.clear()
        self._paused = False
        self._status = 0
        self._origin_ns = now_ns
        self._uptime_ns = uptime_ns
        self._tick = uptime_ns // TICK_NS
        self._build_streams(now_ns)
        self._schedule(now_ns)


def _packer(output: BinaryOutput) -> Callable[[Instant], bytes]:
    sources = [FIELD_VALUES[key] for key in output.layout.fields]
    return lambda now: output.layout.pack([value for source in sources for value in source(now)])


def _number_of(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise UnitError(INVALID_REGISTER) from error


def _flag(fields: tuple[str, ...]) -> bool:
    expect_count(fields, 1, 1)
    if fields[0] not in {"0", "1"}:
        raise UnitError(INVALID_PARAMETER)
    return fields[0] == "1"
