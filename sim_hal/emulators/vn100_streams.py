"""The VN-100's asynchronous outputs by its registers: one ASCII sentence and three binary packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hal.drivers.vn100.protocol import Checksum, build
from sim_hal.emulators.vn100_outputs import FIELD_VALUES, REPORT_BY_TYPE, Instant, Report, report_length
from sim_hal.emulators.vn100_registers import (
    BINARY_OUTPUTS,
    LOW_BAUD,
    BinaryOutput,
    RegisterFile,
    UnitError,
    binary_output,
)
from sim_hal.emulators.vn100_sensors import IMU_RATE_HZ

_OUR_PORT = 1


@dataclass(slots=True)
class Stream:
    """One asynchronous output, sent every `divisor` ticks; `length` in bytes, `sent_ns` in device time."""

    divisor: int
    length: int
    message: Callable[[Instant], bytes]
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
        report = REPORT_BY_TYPE.get(registers.integer(6))
        if report is not None and not self.muted & {6, 7}:
            divisor = IMU_RATE_HZ // registers.integer(7)
            crc_bytes = 2 * (self.checksum() == "crc16")
            length = report_length(report) + len(self._suffix(0)) + crc_bytes
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

    def _sentence(self, report: Report, now: Instant) -> bytes:
        fields = [*report.text(now), *self._suffix(now.status).split(",")[1:]]
        return build(report.header, *fields, checksum=self.checksum())


def packer(output: BinaryOutput) -> Callable[[Instant], bytes]:
    """Return the function that packs a binary output."""
    sources = [FIELD_VALUES[key] for key in output.layout.fields]
    return lambda now: output.layout.pack([value for source in sources for value in source(now)])
