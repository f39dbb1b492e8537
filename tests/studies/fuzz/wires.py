"""Doors of wires: GPS receiver, I2C parts, streams of frames, messages of workers.

Accepted corruption is a fix or a frame that was never sent, where a checksum reckoned here says so; a reading
beyond its own limits; an object that a worker has no business to make.
"""

from __future__ import annotations

import errno
import mmap
import struct
import types
import zlib
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from flight.link.frames import (
    LONGEST_FRAME,
    SYNC,
    MasterCount,
    PacketAssembler,
    TelecommandHeader,
    TelemetryFramer,
    close_frame,
    open_telemetry,
    telecommand_stream,
    telemetry_stream,
)
from flight.loop.worker import message_length, pack_values, unpack_values
from hal.drivers.ads1115 import AdsSolarStrings, StringWiring
from hal.drivers.ina219 import Ina219
from hal.drivers.pca9685 import Pca9685
from hal.drivers.ublox import NAV_PVT, Pvt, UbxParser, frame, reading_of, unpack_pvt
from hal.interfaces.errors import DeviceError, OutOfRange
from knightcube.errors import FlightError
from knightcube.vision.frame_job import FrameFound
from knightcube.vision.streaks.streak_result import FrameMotion, StreakStatus
from tests.manual_clock import ManualClock
from tests.studies.fuzz.door import Door, DoorTarget, Files
from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.logs import ccitt
from tests.studies.fuzz.mutation import Draw, chance, integer

_SPACECRAFT = 0x1A5
_HEAD = struct.Struct("<QQI")
"""Of a worker's message."""


def gps() -> DoorTarget:
    """Return the door of a GPS receiver; a good frame behind damage is found again."""
    fix = Pvt(
        (2026, 11, 24, 1, 2, 3), -5, 3, 3, 1, 9, 123_456_789, -450_000_000, 515_000_000, 900, 1200,
        (-7_000_000, 2_000_000, 15_000), 200,
    )  # fmt: skip
    good = frame(NAV_PVT, fix.packed(1000))
    examples = [
        {"line": good},
        {"line": good + frame((5, 1), b"\x06\x01") + good},
        {"line": b"$GPGGA,\r\n" + good},
    ]
    payload = good[6:-2]

    def enter(files: Files, whole: bool) -> str:
        data, parser = files["line"], UbxParser()
        found = parser.feed(data[: len(data) // 2]) + parser.feed(data[len(data) // 2 :])
        found += parser.feed(bytes(2 * LONGEST_FRAME)) + parser.feed(good)
        if not found or found[-1][:2] != (NAV_PVT, payload):
            raise Finding("a good frame behind damage was lost")
        counted = parser.discarded_bytes + sum(8 + len(content) for _, content, _ in found)
        if counted != parser.bytes_received:
            raise Finding(f"{parser.bytes_received} bytes came, {counted} are accounted for")
        for kind, content, _ in found:
            if kind == NAV_PVT and len(content) == len(payload):
                _judge_fix(content)
        return "accepted" if whole or len(found) > 1 else "discarded"

    def reseal(_: str, data: bytes) -> bytes:
        return frame(NAV_PVT, data[6:-2].ljust(92, b"\x7f")[:92])

    return DoorTarget(Door(examples, enter, (), reseal))


def _judge_fix(content: bytes) -> None:
    try:
        reading = reading_of(unpack_pvt(content), 10**12, 115_200)
    except OutOfRange:
        return
    numbers = (*reading.position, *reading.velocity)
    if not np.all(np.isfinite(numbers)) or np.linalg.norm(reading.velocity) > 12_001.0:
        raise Finding(f"a fix that cannot be: {numbers}")


class Parts:
    """The target of the I2C bus: its parts answer anything, or not at all."""

    def __init__(self) -> None:
        self._answers: list[object] = []

    def last(self) -> str:
        """Return what the bus answered last."""
        return repr(self._answers)

    def attempt(self, draw: Draw) -> Counter[str]:
        """Run one driver for a second against a bus of nonsense. Raises Finding."""
        self._answers.clear()
        bus, clock = _Nonsense(draw, self._answers), ManualClock()
        kind = integer(draw, 0, 2)
        if kind == 0:
            return Counter(["pwm", _pwm(Pca9685(bus, 0x40, clock))])
        if kind == 1:
            monitor = Ina219(bus, 0x45, clock)
            clock.advance(1_500_000_000)
            power = monitor.latest()
            monitor.close()
            if power is not None and not (0.0 <= power.voltage <= 33.0 and abs(power.current) <= 3.3):
                raise Finding(f"power that the part cannot measure: {power}")
            return Counter(["monitor", "accepted" if power is not None else "refused"])
        strings = AdsSolarStrings(bus, clock, [StringWiring(0x48, channel, 40.0) for channel in range(4)])
        clock.advance(1_500_000_000)
        reading = strings.latest()
        strings.close()
        if reading is not None and np.any(np.abs(reading.currents) > 2.048 / 40.0):
            raise Finding(f"currents beyond the converter: {reading.currents}")
        return Counter(["strings", "accepted" if reading is not None else "refused"])


def _pwm(chip: Pca9685) -> str:
    outcome = "accepted"
    actions: tuple[Callable[[], object], ...] = (chip.configure, chip.is_configured, chip.all_off)
    for action in actions:
        try:
            action()
        except DeviceError as error:
            if not str(error) or "\n" in str(error):
                raise Finding(f"a refusal that is not one line: {error}") from error
            outcome = "refused"
    return outcome


class _Nonsense:
    """A bus whose parts keep some of what is written, answer anything else, or fail."""

    def __init__(self, draw: Draw, answers: list[object]) -> None:
        self._draw, self._answers = draw, answers
        self._kept: dict[tuple[int, int], list[int]] = {}
        self._honest, self._failing = float(draw.random()), 0.3 * float(draw.random()) ** 2

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte without a register."""
        self._fail()

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte."""
        return self.read_i2c_block_data(address, register, 1)[0]

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte."""
        self.write_i2c_block_data(address, register, [value])

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read bytes."""
        self._fail()
        kept = self._kept.get((address, register), [])
        if len(kept) == length and chance(self._draw, self._honest):
            return list(kept)
        answer = [int(byte) for byte in self._draw.bytes(length)]
        if chance(self._draw, 0.3):
            answer = [(0xFF, 0x00)[integer(self._draw, 0, 1)]] * length
        self._answers.append((address, register, answer))
        return answer

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write bytes."""
        self._fail()
        self._kept[address, register] = list(values)

    def close(self) -> None:
        """Close the bus."""

    def _fail(self) -> None:
        if chance(self._draw, self._failing):
            number = (errno.EIO, errno.ENXIO, errno.ETIMEDOUT, errno.EREMOTEIO, errno.EAGAIN)
            raise OSError(number[integer(self._draw, 0, 4)], "no answer")


def uplink() -> DoorTarget:
    """Return the door of a stream of telecommand frames; good ones behind damage are found again."""
    frames = [
        close_frame(TelecommandHeader(_SPACECRAFT, 0, n).pack(7 + size) + bytes(size))
        for n, size in ((0, 20), (1, 200))
    ]
    good = b"".join(SYNC + one for one in frames)

    def enter(files: Files, whole: bool) -> str:
        data, stream = files["line"], telecommand_stream()
        found = stream.add(data[: len(data) // 2]) + stream.add(data[len(data) // 2 :])
        found += stream.add(bytes(LONGEST_FRAME) + good)
        if found[-2:] != frames:
            raise Finding("good frames behind damage were lost")
        if any(ccitt(one) == 0 and one not in frames for one in found) and SYNC not in data:
            raise Finding("a frame that was never sent")
        return "accepted" if whole or len(found) > 2 else "discarded"

    return DoorTarget(Door([{"line": good}, {"line": b"noise" + good}], enter))


def downlink() -> DoorTarget:
    """Return the door of a stream of telemetry frames to the packets in them."""
    framer = TelemetryFramer(_SPACECRAFT, 0, 100, MasterCount(), lambda header, data: header + data)
    packets = [
        bytes((8, number, 0xC0, number, 0, size - 7)) + bytes([number]) * (size - 6)
        for number, size in enumerate((30, 150, 64, 90, 200))
    ]
    made = [one for packet in packets for one in framer.add(packet)] + framer.flush()
    size = len(made[0])
    examples = [{"line": b"".join(SYNC + one for one in made)}]

    def enter(files: Files, whole: bool) -> str:
        stream, assembler, found = telemetry_stream(size), PacketAssembler(), []
        for one in stream.add(files["line"]):
            if ccitt(one) == 0:
                if one not in made:  # one damaged frame in 65,536; the authentication is fuzzed as `link`
                    return "a right CRC by chance"
                header, data, _ = open_telemetry(one, _SPACECRAFT)
                found += assembler.add(header, data)
        if whole and found != packets:
            raise Finding("packets that were sent did not come out")
        if any(packet not in packets for packet in found):
            raise Finding("a packet that was never sent")
        return "accepted" if found else "discarded"

    return DoorTarget(Door(examples, enter))


def workers() -> DoorTarget:
    """Return the door of messages of a worker, whose memory may be damaged."""
    slab = mmap.mmap(-1, 1 << 16)
    values: tuple[object, ...] = (
        {"path": np.linspace(0.0, 1.0, 50), "cost": 1.5},
        [(1, "two", None)],
        (np.float64(2.0), np.arange(6, dtype=np.int16).reshape(2, 3), True),
        ("done", FrameFound(FrameMotion(StreakStatus.BLACK, 1, 0.5), None), "", 7),
    )
    examples = [{"message": pack_values(value, slab)} for value in values]

    def enter(files: Files, whole: bool) -> str:
        message = files["message"]
        length = message_length(message)
        if length is None or length > len(message):
            return "incomplete"
        value = unpack_values(message[:length], slab)
        runs = isinstance(value, types.FunctionType | types.BuiltinFunctionType | types.MethodType)
        if runs and not str(getattr(value, "__module__", "")).startswith("numpy"):
            raise Finding(f"a message that brings something to call: {value!r}")
        return "accepted"

    return DoorTarget(Door(examples, enter, (FlightError,), _with_checksum))


def _with_checksum(_: str, message: bytes) -> bytes:
    """Return a message whose lengths and CRC-32 fit the rest of it."""
    head, body = _HEAD.unpack(message[: _HEAD.size].ljust(_HEAD.size, b"\0"))[0], message[_HEAD.size :]
    head = min(head, len(body))
    return _HEAD.pack(head, len(body) - head, zlib.crc32(body)) + body
