"""The commands of an emulated VN-100: reads sentences from the line, executes and answers them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hal.drivers.vn100.protocol import Checksum, Sentence, build, parse
from sim_hal.emulators.device import SerialEnd
from sim_hal.emulators.vn100_attitude import ATTITUDE_COMMANDS, AttitudeCommands, flag
from sim_hal.emulators.vn100_outputs import REPORT_BY_REGISTER, Instant
from sim_hal.emulators.vn100_registers import (
    BINARY_OUTPUTS,
    INVALID_CHECKSUM,
    INVALID_COMMAND,
    INVALID_PARAMETER,
    INVALID_REGISTER,
    RECEIVE_OVERFLOW,
    UNAUTHORIZED,
    RegisterFile,
    UnitError,
    binary_output,
    expect_count,
)
from sim_hal.emulators.vn100_streams import OutputStreams, packer

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

    sample: Callable[[int], Instant]
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
        report = REPORT_BY_REGISTER.get(number)
        if report is not None:
            return tuple(report.text(self._actions.sample(now_ns)))
        return self._registers.read(number)

    def _write(self, number: int, fields: tuple[str, ...], answer: Callable[..., None], now_ns: int) -> None:
        if number in REPORT_BY_REGISTER:
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
