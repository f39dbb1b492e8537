"""An emulated VN-100 on the device end of a serial line.

The unit executes commands and sends its asynchronous outputs (one ASCII sentence and three binary packets)
on the 800 Hz grid of its own clock. Registers that tune its estimation (21 to 26, 32 to 51, 74, 82 to 84)
are stored and echoed without effect, except the heading mode of 35; of register 85 the windows of
magnetometer, accelerometer and gyro have an effect. SYNC lines and the second serial port are not emulated.
The 500 ms of a flash write are VectorNav's; the second of start-up is assumed.

The commands of the attitude filter are those of VectorNav UM001 ch. 8; set initial heading and set filter
bias are as VectorNav's SDK 0.99 sends them and as its units with satellite navigation answer them. Assumed:
in the absolute heading mode the magnetometer sets the heading, so tare and set initial heading change
nothing; gravity sets pitch and roll in every mode, so only the yaw of a given attitude has an effect. The
filter has no gyro bias error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hal.drivers.vn100.protocol import Checksum, Sentence, build, parse
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import IDENTITY, NED_TO_TESTBED, from_rotation_vector, multiply, normalise
from sim_hal.clock import NEVER, SerialEnd
from sim_hal.emulators.vn100_registers import (
    ASYNC_RATES_HZ,
    BINARY_OUTPUTS,
    FILTER_STARTUP_BIAS,
    GYRO_STARTUP_BIAS,
    INVALID_CHECKSUM,
    INVALID_COMMAND,
    INVALID_PARAMETER,
    INVALID_REGISTER,
    LOW_BAUD,
    RECEIVE_OVERFLOW,
    TOO_FEW,
    UNAUTHORIZED,
    BinaryOutput,
    RegisterFile,
    UnitError,
    binary_output,
    expect_count,
)
from sim_hal.emulators.vn100_sensors import (
    FIELD_VALUES,
    IMU_RATE_HZ,
    OUTPUT_BY_REGISTER,
    OUTPUT_BY_TYPE,
    PROFILES,
    AsciiOutput,
    MessageData,
    NoiseProfile,
    Sensors,
    Vn100Sample,
    sentence_length,
)
from sim_hal.worlds.world import BodyMotion

ATTITUDE_COMMANDS = frozenset({"KMD", "KAD", "TAR", "SIH", "SGB", "SFB"})
_DISTURBANCES = {"KMD": 1 << 11, "KAD": 1 << 12}
_VPE_CONTROL, _HEADING_MODE, _ABSOLUTE = 35, 1, 0


class AttitudeCommands:
    """The attitude filter of one unit as far as commands reach it.

    Attributes:
        status: the VPE status word; KMD and KAD set its disturbance bits.
    """

    def __init__(self, registers: RegisterFile, gyro_bias: FloatArray) -> None:
        """`gyro_bias` (3,) rad/s, sensor axes, is the filter's estimate, which SGB and SFB store."""
        self._registers = registers
        self._gyro_bias = gyro_bias
        self._turn: FloatArray | None = None
        self.status = 0

    def reset(self) -> None:
        """Discard the state that commands have set."""
        self._turn = None
        self.status = 0

    def turned(self, measured: Vn100Sample) -> Vn100Sample:
        """Return a sample with the heading that commands have set."""
        if self._turn is None:
            return measured
        return replace(measured, quaternion=multiply(measured.quaternion, self._turn))

    def execute(self, command: str, fields: tuple[str, ...], sample: Callable[[], Vn100Sample]) -> None:
        """Execute one of ATTITUDE_COMMANDS; `sample` measures now. Raises UnitError."""
        if command in _DISTURBANCES:
            bit = _DISTURBANCES[command]
            self.status = self.status | bit if flag(fields) else self.status & ~bit
        elif command == "SIH":
            self._set_heading(_yaw_of(_numbers_of(fields)), sample)
        else:
            expect_count(fields, 0, 0)
            if command == "TAR":
                self._set_heading(0.0, sample)
            else:
                self._store_biases(everything=command == "SFB")

    def _set_heading(self, yaw: float, sample: Callable[[], Vn100Sample]) -> None:
        """Turn the attitude about the vertical so that the yaw is now `yaw`, rad."""
        if self._registers.integer(_VPE_CONTROL, _HEADING_MODE) == _ABSOLUTE:
            return
        change = from_rotation_vector(np.array([0.0, 0.0, yaw - math.radians(sample().yaw_pitch_roll[0])]))
        self._turn = change if self._turn is None else normalise(multiply(self._turn, change))

    def _store_biases(self, everything: bool) -> None:
        gyro = tuple(f"{value:+010.6f}" for value in self._gyro_bias.tolist())
        self._registers.write(GYRO_STARTUP_BIAS, gyro)
        kept = self._registers.read(FILTER_STARTUP_BIAS)[3:]
        self._registers.write(FILTER_STARTUP_BIAS, (*gyro, *(("+00.000000",) * 4 if everything else kept)))


def flag(fields: tuple[str, ...]) -> bool:
    """Return the one field, 0 or 1, of a command. Raises UnitError."""
    expect_count(fields, 1, 1)
    if fields[0] not in {"0", "1"}:
        raise UnitError(INVALID_PARAMETER)
    return fields[0] == "1"


def _numbers_of(fields: tuple[str, ...]) -> list[float]:
    """Return a heading, yaw, pitch and roll, all in degrees, or a quaternion. Raises UnitError."""
    expect_count(fields, 1, 4)
    if len(fields) == 2:
        raise UnitError(TOO_FEW)
    try:
        values = [float(text) for text in fields]
    except ValueError as error:
        raise UnitError(INVALID_PARAMETER) from error
    if not all(map(math.isfinite, values)):
        raise UnitError(INVALID_PARAMETER)
    return values


def _yaw_of(values: list[float]) -> float:
    """Return the yaw in rad of `_numbers_of`; a quaternion needs no unit length. Raises UnitError."""
    if len(values) < 4:
        return math.radians(values[0])
    if not any(values):
        raise UnitError(INVALID_PARAMETER)
    attitude = Vn100Sample(normalise(np.array(values)), np.zeros(3), np.zeros(3), np.zeros(3))
    return math.radians(attitude.yaw_pitch_roll[0])


_OUR_PORT = 1


@dataclass(slots=True)
class Stream:
    """One asynchronous output, sent every `divisor` ticks; `length` in bytes, `sent_ns` in device time."""

    divisor: int
    length: int
    message: Callable[[MessageData], bytes]
    sent_ns: int


class OutputStreams:
    """The streams of one unit.

    Attributes:
        muted: registers whose output is silent until they are written again.
    """

    def __init__(self, registers: RegisterFile) -> None:
        self._registers = registers
        self._streams: dict[int, Stream] = {}
        self.muted: set[int] = set()

    def reset(self) -> None:
        """Remove all streams."""
        self._streams = {}
        self.muted.clear()

    def build(self, device_ns: int) -> None:
        """Rebuild the streams from the registers. Raises UnitError, unchanged, when the line is too slow."""
        registers = self._registers
        streams: dict[int, Stream] = {}
        report = OUTPUT_BY_TYPE.get(registers.integer(6))
        if report is not None and not self.muted & {6, 7}:
            divisor = IMU_RATE_HZ // registers.integer(7)
            crc_bytes = 2 * (self.checksum() == "crc16")
            length = sentence_length(report) + len(self._suffix(0)) + crc_bytes
            streams[6] = Stream(divisor, length, lambda now: self._sentence(report, now), device_ns)
        for number in sorted(set(BINARY_OUTPUTS) - self.muted):
            output = binary_output(registers.read(number))
            if output is not None and output.ports & _OUR_PORT:
                streams[number] = Stream(output.divisor, output.layout.length, packer(output), device_ns)
        # A stream that continues unchanged keeps the time of its last message.
        for number in streams.keys() & self._streams.keys():
            streams[number].sent_ns = self._streams[number].sent_ns
        load = sum(10 * stream.length * IMU_RATE_HZ / stream.divisor for stream in streams.values())
        if load > registers.integer(5):
            raise UnitError(LOW_BAUD)
        self._streams = streams

    def next_tick(self, passed: int) -> int | None:
        """Return the first tick after `passed` on which a stream is due, None without streams."""
        return min(((passed // s.divisor + 1) * s.divisor for s in self._streams.values()), default=None)

    def due(self, tick: int) -> list[Stream]:
        """Return the streams that are due on a tick."""
        return [stream for stream in self._streams.values() if tick % stream.divisor == 0]

    def checksum(self) -> Checksum:
        """Return the checksum that register 30 selects."""
        return "crc16" if self._registers.integer(30, 4) == 3 else "xor8"

    def _suffix(self, status: int) -> str:
        count = ",T0000000000" if self._registers.integer(30, 0) else ""
        return count + (f",S{status:04X}" if self._registers.integer(30, 1) else "")

    def _sentence(self, report: AsciiOutput, now: MessageData) -> bytes:
        fields = [*report.text(now), *self._suffix(now.status).split(",")[1:]]
        return build(report.header, *fields, checksum=self.checksum())


def packer(output: BinaryOutput) -> Callable[[MessageData], bytes]:
    """Return the function that packs a binary output."""
    sources = [FIELD_VALUES[key] for key in output.layout.fields]
    return lambda now: output.layout.pack([value for source in sources for value in source(now)])


_RECEIVE_BUFFER = 256


@dataclass(frozen=True, slots=True)
class UnitActions:
    """The unit's actions that commands call, each with the time in ns.

    Attributes:
        sample: measures at this time.
        build_streams: rebuilds the outputs from the registers; raises UnitError.
        write_flash: saves the registers and calls the function when done.
        restart: resets the unit.
    """

    sample: Callable[[int], MessageData]
    build_streams: Callable[[int], None]
    write_flash: Callable[[int, Callable[[int], None]], None]
    restart: Callable[[int], None]


class CommandInterface:
    """Executes the commands of one unit.

    Attributes:
        paused: whether asynchronous outputs are paused (ASY).
    """

    def __init__(
        self,
        line: SerialEnd,
        registers: RegisterFile,
        streams: OutputStreams,
        actions: UnitActions,
        attitude: AttitudeCommands,
    ) -> None:
        self._line = line
        self._registers = registers
        self._streams = streams
        self._actions = actions
        self._attitude = attitude
        self._received = bytearray()
        self.paused = False

    def reset(self) -> None:
        """Discard received bytes and the state that commands have set."""
        self._received.clear()
        self.paused = False
        self._attitude.reset()

    def receive(self, data: bytes, now_ns: int) -> None:
        """Execute and answer the commands that `data` completes."""
        self._received += data
        while (end := self._received.find(b"\n")) >= 0:
            line = bytes(self._received[: end + 1])
            del self._received[: end + 1]
            start = line.rfind(b"$")
            if start >= 0:
                self._answer_line(line[start:], now_ns)
        if len(self._received) > _RECEIVE_BUFFER:
            self._received.clear()
            self._report_error(RECEIVE_OVERFLOW, self._streams.checksum(), now_ns)

    def _answer_line(self, line: bytes, now_ns: int) -> None:
        sentence = parse(line, allow_none=True)
        if sentence is None:
            wide = len(line.rstrip(b"\r\n").rpartition(b"*")[2]) == 4
            self._report_error(INVALID_CHECKSUM, "crc16" if wide else "xor8", now_ns)
            return
        checksum = self._streams.checksum() if sentence.checksum == "none" else sentence.checksum
        try:
            self._execute(sentence, checksum, now_ns)
        except UnitError as error:
            self._report_error(error.code, checksum, now_ns)

    def _report_error(self, code: int, checksum: Checksum, now_ns: int) -> None:
        mode = self._registers.integer(30, 6)
        if mode:
            self._line.write(build("ERR", f"{code:02X}", checksum=checksum), now_ns)
        if mode == 2:
            self._registers.write(6, ("0",))
            self._actions.build_streams(now_ns)

    def _execute(self, sentence: Sentence, checksum: Checksum, now_ns: int) -> None:
        """Execute a command and answer it. Raises UnitError."""

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
                self.paused = not flag(fields)
                answer(*fields)
            case command if command in ATTITUDE_COMMANDS:
                self._attitude.execute(command, fields, lambda: self._actions.sample(now_ns).measured)
                answer(*fields)
            case "BOM":
                expect_count(fields, 1, 1)
                self._poll_binary(BINARY_OUTPUTS[0] - 1 + _number_of(fields[0]), now_ns)
            case "WNV":
                self._actions.write_flash(now_ns, lambda end_ns: answer(at_ns=end_ns))
            case "RFS" | "RST":
                answer()
                if sentence.command == "RFS":
                    self._registers.restore()
                self._actions.restart(now_ns)
            case _:
                raise UnitError(INVALID_COMMAND)

    def _read(self, number: int, now_ns: int) -> tuple[str, ...]:
        report = OUTPUT_BY_REGISTER.get(number)
        if report is not None:
            return tuple(report.text(self._actions.sample(now_ns)))
        return self._registers.read(number)

    def _write(self, number: int, fields: tuple[str, ...], answer: Callable[..., None], now_ns: int) -> None:
        if number in OUTPUT_BY_REGISTER:
            raise UnitError(UNAUTHORIZED)
        before = self._registers.read(number)
        echo = self._registers.write(number, fields[1:])
        self._streams.muted.discard(number)
        try:
            self._actions.build_streams(now_ns)
        except UnitError:
            self._registers.set_back(number, before)
            raise
        # The answer is sent at the old speed.
        answer(fields[0], *echo)
        self._line.baud_rate = self._registers.integer(5)

    def _poll_binary(self, number: int, now_ns: int) -> None:
        if number not in BINARY_OUTPUTS:
            raise UnitError(INVALID_PARAMETER)
        output = binary_output(self._registers.read(number))
        if output is None:
            raise UnitError(INVALID_PARAMETER)
        self._line.write(packer(output)(self._actions.sample(now_ns)), now_ns)


def _number_of(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise UnitError(INVALID_REGISTER) from error


TICK_NS = 1_000_000_000 // IMU_RATE_HZ
_BILLION = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Vn100EmulatorSettings:
    """The properties of this unit.

    Attributes:
        noise: its noise profile.
        mounting: (4,) sensor axes into body axes.
        reference: (4,) NED into the world's reference frame.
        gyro_bias: (3,) rad/s, sensor axes.
        clock_ppm: how much faster than true its clock runs.
        uptime_ns: its own time when the simulation begins; the remainder of 25 ms is its phase.
        boot_ns: from reset to the first message. flash_ns: to write the flash.
        temperature: degrees C. pressure: kPa.
        free_fall: there is no gravity for its own attitude to stand on.
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
    """The unit; a `sim_hal.clock.EmulatedDevice`.

    Attributes:
        alter: changes each measurement before it is sent, for faults.
    """

    def __init__(
        self,
        sense: Callable[[int], BodyMotion],
        line: SerialEnd,
        rng: np.random.Generator,
        settings: Vn100EmulatorSettings,
        now_ns: int = 0,
    ) -> None:
        """Start at `now_ns`, the unit on for `settings.uptime_ns`; `sense` returns the motion at a time."""
        self.registers = RegisterFile()
        self.alter: Callable[[Vn100Sample], Vn100Sample] | None = None
        self._sense = sense
        self._line = line
        self._settings = settings
        bias = settings.gyro_bias
        self._sensors = Sensors(
            rng, settings.noise, settings.mounting, settings.reference, bias, settings.free_fall
        )
        self._clock_rate = _BILLION + round(settings.clock_ppm * 1000)
        self._then: tuple[int, Callable[[int], None]] | None = None
        self._streams = OutputStreams(self.registers)
        actions = UnitActions(self._instant_now, self._build_streams, self._write_flash, self._restart)
        self._attitude = AttitudeCommands(self.registers, bias)
        self._commands = CommandInterface(line, self.registers, self._streams, actions, self._attitude)
        self._origin_ns = now_ns
        self._uptime_ns = settings.uptime_ns
        self._tick = -1
        self._tick_due = 0
        self._due_ns = NEVER
        self._start(now_ns, settings.uptime_ns)

    def next_event_ns(self) -> int:
        """Return when the unit next receives or sends something."""
        return min(self._line.next_arrival_ns(), self._due_ns)

    def advance(self, now_ns: int) -> None:
        """Receive and send all that is due at or before `now_ns`."""
        while (event_ns := self.next_event_ns()) <= now_ns:
            if self._due_ns <= event_ns:
                self._act(event_ns)
            else:
                data = self._line.read(event_ns)
                if self._then is None:  # A unit that starts, or writes its flash, receives nothing.
                    self._commands.receive(data, event_ns)
            self._schedule(event_ns)

    def set_baud_rate(self, baud_rate: int) -> None:
        """Save this speed in the flash, with the fastest output rate that fits. Raises UnitError."""
        self.registers.write(5, (str(baud_rate),))
        length = sentence_length(OUTPUT_BY_TYPE[14])
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
        """Apply power, or reset: the unit restarts from its flash."""
        self._restart(now_ns)
        self._schedule(now_ns)

    def change_baud_rate(self, baud_rate: int, now_ns: int) -> None:
        """Change the line's speed, as a write of register 5 does."""
        self.registers.write(5, (str(baud_rate),))
        self._line.baud_rate = baud_rate
        self._build_streams(now_ns)

    def upset(self, register: int, bit: int, now_ns: int) -> None:
        """Flip a bit of a register that configures the outputs, as radiation does.

        Assumed: an output whose register is invalid, or asks for more than the line carries, is silent until
        that register is written.
        """
        try:
            self.registers.flip(register, bit)
            self._build_streams(now_ns)
        except UnitError:
            self._streams.muted.add(register)
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
            return
        tick = self._streams.next_tick(max(self._tick, self._device_ns(now_ns) // TICK_NS))
        if self._commands.paused or tick is None:
            self._due_ns = NEVER
        else:
            self._tick_due = tick
            self._due_ns = self._tick_ns(tick)

    def _act(self, now_ns: int) -> None:
        if self._then is not None:
            _, action = self._then
            self._then = None
            action(now_ns)
            return
        self._tick = self._tick_due
        device_ns = self._tick * TICK_NS
        measured = self._measure(now_ns)
        for stream in self._streams.due(self._tick):
            self._line.write(stream.message(self._instant(device_ns, measured, stream.sent_ns)), now_ns)
            stream.sent_ns = device_ns

    # Output.

    def _measure(self, now_ns: int) -> Vn100Sample:
        windows = tuple(self.registers.integer(85, index) for index in range(3))
        measured = self._attitude.turned(self._sensors.measure(self._sense(now_ns), windows))
        return measured if self.alter is None else self.alter(measured)

    def _instant(self, device_ns: int, measured: Vn100Sample, since_ns: int) -> MessageData:
        interval = (device_ns - since_ns) * 1e-9
        settings = self._settings
        return MessageData(
            device_ns, measured, self._attitude.status, interval, settings.temperature, settings.pressure
        )

    def _instant_now(self, now_ns: int) -> MessageData:
        device_ns = self._device_ns(now_ns)
        return self._instant(device_ns, self._measure(now_ns), device_ns - TICK_NS)

    def _build_streams(self, now_ns: int) -> None:
        self._streams.build(self._device_ns(now_ns))

    # Power.

    def _write_flash(self, now_ns: int, done: Callable[[int], None]) -> None:
        self.registers.save()
        self._then = now_ns + self._settings.flash_ns, done

    def _restart(self, now_ns: int) -> None:
        self._then = now_ns + self._settings.boot_ns, lambda end_ns: self._start(end_ns, 0)

    def _start(self, now_ns: int, uptime_ns: int) -> None:
        """Start from the flash, with the unit's clock at `uptime_ns`."""
        self.registers.load()
        self._line.baud_rate = self.registers.integer(5)
        self._sensors.restart()
        self._commands.reset()
        self._streams.reset()
        self._origin_ns = now_ns
        self._uptime_ns = uptime_ns
        self._tick = uptime_ns // TICK_NS
        self._build_streams(now_ns)
        self._schedule(now_ns)
