"""The VN-100 driver: sets the unit up over its own protocol, reads its output, recovers a lost unit.

Attitude: the unit sends (q0, q1, q2, q3), scalar last, a Hamilton quaternion that rotates body into NED. In
this project's convention the same four numbers rotate NED into the sensor frame. Two constant linear maps of
the settings convert it to the mission's reference frame and the body's axes
(`knightcube.astro.quaternion.attitude_map`). Readings that are not finite or physically impossible are
rejected and counted.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hal.drivers.vn100.protocol import AsciiLine, BinaryPacket, Layout, StreamParser, measurement
from hal.drivers.vn100.setup import (
    DEVICE,
    IMU_RATE_HZ,
    OUTPUT_SET,
    PASSING_ERRORS,
    Question,
    Recovery,
    Vn100Settings,
    check,
    set_up,
)
from hal.interfaces.devices import ImuLink, ImuReading
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, Refused
from hal.interfaces.wires import Clock, SerialPort

TESLA_PER_GAUSS = 1e-4
_UNIT_NORM_TOLERANCE = 1e-2
_CERTAIN = 4  # intervals, or polls with lines, in a row that do not match the settings

# Where a packet may carry each quantity, in order of preference.
_SOURCES = (
    ("common.quaternion", "attitude.quaternion"),
    ("common.angular_rate", "imu.angular_rate"),
    ("imu.mag", "common.mag_pres", "imu.uncomp_mag"),
    ("common.accel", "imu.accel"),
)
_TIMES = ("common.time_startup", "time.time_startup")

# Device time in ns, quaternion, rate, magnetic field in gauss, acceleration.
_Sample = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]


class ReadingConverter:
    """Converts packets and lines into readings; detects a unit that does not run on our settings.

    Attributes:
        resets: how often the device's time went backwards, because the unit restarted.
        out_of_range: samples rejected as impossible, repeated values among them.
        not_finite: samples rejected because a value is not finite.
    """

    def __init__(self, settings: Vn100Settings, byte_ns: float, on_reset: Callable[[], None]) -> None:
        """Convert for `settings`; a byte takes `byte_ns` on the line.

        `on_reset` is called when the unit has restarted or its settings differ from ours.
        """
        self.resets = 0
        self.out_of_range = 0
        self.not_finite = 0
        self._settings = settings
        self._byte_ns = byte_ns
        self._on_reset = on_reset
        self._places: dict[bytes, _Places | None] = {}
        self._device_ns = 0
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._odd_steps = self._odd_polls = 0
        self._sample: tuple[tuple[float, ...], ...] = ()
        self._alike = 0

    def reading(self, item: BinaryPacket | AsciiLine) -> ImuReading | None:
        """Return the reading that an item carries, None when it carries none or an impossible one."""
        sample = self._binary_sample(item) if isinstance(item, BinaryPacket) else self._ascii_sample(item)
        if sample is None:
            return None
        device_ns, q, rate, mag, accel = sample
        numbers = (*q, *rate, *mag, *accel)
        # The sum is finite only when all are: floats of 32 bits cannot overflow it.
        if not math.isfinite(sum(numbers)):
            self.not_finite += 1
            return None
        settings = self._settings
        self._alike = self._alike + 1 if sample[1:] == self._sample else 0
        self._sample = sample[1:]
        norm = math.hypot(*q)
        if (
            0 < settings.stuck_after <= self._alike
            or abs(norm - 1.0) > _UNIT_NORM_TOLERANCE
            or max(map(abs, rate)) > settings.rate_range
            or max(map(abs, mag)) > settings.field_range / TESLA_PER_GAUSS
            or max(map(abs, accel)) > settings.acceleration_range
        ):
            self.out_of_range += 1
            return None
        # One array for all: making one of each takes longer than the products.
        values = np.array(numbers)
        quaternion = settings.attitude_map @ values[:4]
        # Both signs are one attitude; the one of the shorter turn from the reference frame is returned.
        quaternion /= math.copysign(norm, quaternion[3])
        length = item.layout.length if isinstance(item, BinaryPacket) else item.length
        return ImuReading(
            time_ns=item.arrival_ns - round(length * self._byte_ns),
            arrival_ns=item.arrival_ns,
            device_time_ns=device_ns,
            quaternion=quaternion,
            rate=settings.mounting @ values[4:7],
            field=settings.mounting @ values[7:10] * TESLA_PER_GAUSS,
            acceleration=settings.mounting @ values[10:],
        )

    def check_for_lines(self, items: Sequence[BinaryPacket | AsciiLine]) -> None:
        """Detect a unit that was set up for packets and also sends measurements as lines."""
        lines = (item.sentence for item in items if isinstance(item, AsciiLine))
        found = self._settings.output == "binary" and any(measurement(line) is not None for line in lines)
        self._odd_polls = self._odd_polls + 1 if found else 0
        if self._odd_polls == _CERTAIN:
            self._on_reset()

    def _binary_sample(self, packet: BinaryPacket) -> _Sample | None:
        header = packet.layout.header
        if header not in self._places:
            self._places[header] = _places(packet.layout)
        places = self._places[header]
        if places is None:
            return None
        values: tuple[float, ...] = packet.values  # type: ignore[assignment]  # these fields hold no bytes
        device_ns = 0
        if places.time is not None:
            device_ns = int(values[places.time])
            if device_ns < self._device_ns:
                self.resets += 1
                self._on_reset()
            self._check_step(device_ns - self._device_ns)
            self._device_ns = device_ns
        q, rate, mag, accel = places.sensors
        return device_ns, values[q], values[rate], values[mag], values[accel]

    def _check_step(self, step_ns: int) -> None:
        """Detect a unit that sends samples at another rate: its register differs from what was written.

        Lost packets leave whole periods; a divisor with one bit flipped leaves fractions of one, a tick at
        least.
        """
        part_ns = step_ns % self._period_ns
        off = min(part_ns, self._period_ns - part_ns) > 500_000_000 // IMU_RATE_HZ
        self._odd_steps = self._odd_steps + 1 if off else 0
        if self._odd_steps == _CERTAIN:
            self._on_reset()

    def _ascii_sample(self, line: AsciiLine) -> _Sample | None:
        values = measurement(line.sentence)
        # A VNYMR line is no reading: a unit that lost its settings sends it.
        if values is None or len(values.attitude) != 4:
            return None
        return 0, values.attitude, values.gyro, values.mag, values.accel


@dataclass(frozen=True, slots=True)
class _Places:
    """Where a packet's values are: index of the time; slices of quaternion, rate, field, acceleration."""

    time: int | None
    sensors: tuple[slice, slice, slice, slice]


def _places(layout: Layout) -> _Places | None:
    """Return where a packet carries a reading; None when any part but the time is missing."""
    sensors: list[slice] = []
    for names in _SOURCES:
        place = next((layout.places[name] for name in names if name in layout.places), None)
        if place is None:
            return None
        sensors.append(place)
    time = next((layout.places[name].start for name in _TIMES if name in layout.places), None)
    q, rate, mag, accel = sensors
    # The first three values of MagPres are the field.
    return _Places(time, (q, rate, slice(mag.start, mag.start + 3), accel))


__all__ = ["OUTPUT_SET", "Vn100", "Vn100Settings"]

_LONGEST_PACKET = 128  # above any output set that 40 Hz needs; bounds the wait on a false start
_POLL_STEP_NS = 1_000_000


class Vn100:
    """A VN-100 on a serial port; implements `hal.interfaces.devices.InertialUnit`."""

    def __init__(self, port: SerialPort, clock: Clock, settings: Vn100Settings) -> None:
        """Use the port. Raises Refused or OutOfRange for settings beyond the unit or the line."""
        check(settings, port.baud_rate)
        self._unit_error = ""
        self._port = port
        self._clock = clock
        self._settings = settings
        byte_ns = 10e9 / port.baud_rate
        self._parser = StreamParser(byte_ns, _LONGEST_PACKET)
        self._recovery = Recovery(port, settings)
        self._converter = ReadingConverter(settings, byte_ns, self._recovery.reset)
        self._last_byte_ns = -1
        self._last_packet_ns = -1

    def configure(self) -> None:
        """Set the unit up in its volatile memory; its flash is not written.

        Raises NotResponding on silence, CorruptData when the answers make no sense, Refused when the unit
        refuses, is no VN-100, or does not keep what was written.
        """
        if not self._settings.configure:
            return
        # Its output is switched off first, so that answers are not lost in it.
        self._ask(Question("ASY", (0,)))
        dialogue = set_up(self._settings)
        question = next(dialogue)
        with contextlib.suppress(StopIteration):
            while True:
                question = dialogue.send(self._ask(question))

    def model(self) -> str:
        """Return what the unit calls itself; nothing is changed in it. Raises as `configure`."""
        return ",".join(self._ask(Question("RRG", (1,))))

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        A unit that sends none is searched for and set up again, one question per call. Raises NotResponding
        when the line itself is gone. Corrupt and implausible packets are counted in `link`.
        """
        items = self._receive()
        found = (self._converter.reading(item) for item in items)
        readings = [reading for reading in found if reading is not None]
        if self._settings.configure:
            self._converter.check_for_lines(items)
            sentences = [item.sentence for item in items if not isinstance(item, BinaryPacket)]
            parser = self._parser
            self._recovery.advance(
                self._clock.now_ns(), len(readings), sentences, parser.packets, parser.bytes_received
            )
        return readings

    def link(self) -> ImuLink:
        """Return the line's counters; `packets` are all packets and lines whose checksum held."""
        parser = self._parser
        return ImuLink(
            parser.bytes_received,
            parser.packets,
            parser.bad_checksum,
            parser.discarded_bytes,
            self._converter.out_of_range,
            self._converter.not_finite,
            self._last_byte_ns,
            self._last_packet_ns,
        )

    @property
    def resets(self) -> int:
        """How often the unit restarted: its own time went backwards."""
        return self._converter.resets

    @property
    def recoveries(self) -> int:
        """How often a lost unit was found and set up again."""
        return self._recovery.completed

    def close(self) -> None:
        """Release the line."""
        self._port.close()

    def _receive(self) -> list[BinaryPacket | AsciiLine]:
        items: list[BinaryPacket | AsciiLine] = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            items += self._parser.feed(arrival_ns, data)
        if items:
            self._last_packet_ns = items[-1].arrival_ns
        return items

    def _ask(self, question: Question) -> tuple[str, ...]:
        """Send a command until its answer comes; return the answer's fields after the first."""
        before = self.link()
        self._unit_error = ""
        for _ in range(self._settings.tries):
            self._port.send(question.message())
            answer = self._await(question)
            if answer is not None:
                return answer
        raise self._no_answer(question.text(), before)

    def _await(self, question: Question) -> tuple[str, ...] | None:
        """Return the answer, or None when the time is up or the try failed."""
        deadline_ns = self._clock.now_ns() + self._settings.response_timeout_ns
        while True:
            for item in self._receive():
                if isinstance(item, BinaryPacket):
                    continue
                answer = question.answer(item.sentence)
                if answer is not None:
                    return answer
                complaint = question.complaint(item.sentence)
                if complaint is not None:
                    code, self._unit_error = complaint
                    if code in PASSING_ERRORS:
                        return None
                    raise Refused(DEVICE, f"{question.text()} was answered with {self._unit_error}")
            now_ns = self._clock.now_ns()
            if now_ns >= deadline_ns:
                return None
            self._clock.sleep_until_ns(min(deadline_ns, now_ns + _POLL_STEP_NS))

    def _no_answer(self, command: str, before: ImuLink) -> DeviceError:
        link = self.link()
        received = link.bytes_received - before.bytes_received
        tried = (
            f"no answer to {command} in {self._settings.tries} tries of "
            f"{self._settings.response_timeout_ns / 1e6:.0f} ms at {self._port.baud_rate} baud"
        )
        if received == 0:
            return NotResponding(
                DEVICE, f"{tried}, not one byte: check power, the cable, the port's name, and the baud rate"
            )
        if self._unit_error:
            return CorruptData(DEVICE, f"{tried} but {self._unit_error}: the line to the unit is noisy")
        if link.packets == before.packets:
            return CorruptData(
                DEVICE, f"{tried}; {received} bytes came, none made sense: check the baud rate (register 5)"
            )
        return NotResponding(
            DEVICE, f"{tried}, though its output arrives: check the wire from the host's TX to the unit's RX"
        )
