"""The VN-100 driver: sets the unit up over its own protocol, and turns its packets into readings.

Attitude: the unit sends (q0, q1, q2, q3), scalar last, a Hamilton quaternion that rotates body into NED;
by our convention the same four numbers rotate NED into the sensor. Two constant linear maps, given by whoever
composes, take it to the mission's reference frame and the body's axes
(`flight.gnc.math.frames.attitude_map`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

from hal.drivers.vn100.ascii import AsciiLine, error_meaning, measurement
from hal.drivers.vn100.codec import BinaryPacket, Layout
from hal.drivers.vn100.recovery import Recovery
from hal.drivers.vn100.set_up import PASSING_ERRORS, Question, set_up
from hal.drivers.vn100.settings import DEVICE, IMU_RATE_HZ, OUTPUT_SET, Vn100Settings, check
from hal.drivers.vn100.stream import StreamParser
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, Refused
from hal.interfaces.readings import ImuLink, ImuReading
from hal.interfaces.wires import Clock, SerialPort

__all__ = ["OUTPUT_SET", "Vn100", "Vn100Settings"]

TESLA_PER_GAUSS = 1e-4
_LONGEST_PACKET = 128  # more than any output set that 40 Hz asks for; bounds the wait on a false start
_POLL_STEP_NS = 1_000_000
_UNIT_NORM_TOLERANCE = 1e-2
_SURELY_OTHER = 4  # steps of time, or polls with lines, in a row that the settings do not ask for

# Where a packet may carry each quantity, in order of preference.
_SOURCES = (
    ("common.quaternion", "attitude.quaternion"),
    ("common.angular_rate", "imu.angular_rate"),
    ("imu.mag", "common.mag_pres", "imu.uncomp_mag"),
    ("common.accel", "imu.accel"),
)
_TIMES = ("common.time_startup", "time.time_startup")


class Vn100:
    """A VN-100 on a serial port; implements `hal.interfaces.devices.InertialUnit`.

    Attributes:
        resets: how often the device's time went backwards: the unit started anew.
        unit_error: the text of the last error that the unit reported, empty when none.
    """

    def __init__(self, port: SerialPort, clock: Clock, settings: Vn100Settings) -> None:
        """Take the line. Raises Refused or OutOfRange when the unit or the line cannot do what is asked."""
        check(settings, port.baud_rate)
        self.resets = 0
        self.unit_error = ""
        self._port = port
        self._clock = clock
        self._settings = settings
        self._byte_ns = 10e9 / port.baud_rate
        self._parser = StreamParser(self._byte_ns, _LONGEST_PACKET)
        self._places: dict[bytes, _Places | None] = {}
        self._recovery = Recovery(port, settings)
        self._device_ns = 0
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._odd_steps = self._odd_polls = 0
        self._sample: tuple[tuple[float, ...], ...] = ()
        self._alike = 0
        self._out_of_range = 0
        self._not_finite = 0
        self._last_byte_ns = -1
        self._last_packet_ns = -1

    def configure(self) -> None:
        """Set the unit up in its volatile memory; its flash is not written.

        Raises NotResponding on silence, CorruptData when what comes makes no sense, Refused when the unit
        says no, is no VN-100, or does not keep what was written.
        """
        if not self._settings.configure:
            return
        # Without its output between the answers there is less to mistake.
        self._ask(Question("ASY", (0,)))
        dialogue = set_up(self._settings)
        question = next(dialogue)
        with contextlib.suppress(StopIteration):
            while True:
                question = dialogue.send(self._ask(question))

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        A unit that gives none is looked for and set up anew, a question a call. Raises NotResponding when the
        line itself is gone. Corrupt and implausible packets are counted in `link`.
        """
        items = self._receive()
        found = (self._reading(item) for item in items)
        readings = [reading for reading in found if reading is not None]
        if self._settings.configure:
            self._look_for_lines(items)
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
            self._out_of_range,
            self._not_finite,
            self._last_byte_ns,
            self._last_packet_ns,
        )

    @property
    def recoveries(self) -> int:
        """How often a lost unit was found and set up anew."""
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
        self.unit_error = ""
        for _ in range(self._settings.tries):
            self._port.send(question.words())
            answer = self._await(question)
            if answer is not None:
                return answer
        raise self._no_answer(question.text(), before)

    def _await(self, question: Question) -> tuple[str, ...] | None:
        """Return the answer, or None when the time is up or the try was in vain."""
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
                    code, self.unit_error = complaint
                    if code in PASSING_ERRORS:
                        return None
                    raise Refused(DEVICE, f"{question.text()} was answered with {self.unit_error}")
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
        if self.unit_error:
            return CorruptData(DEVICE, f"{tried} but {self.unit_error}: the line to the unit is noisy")
        if link.packets == before.packets:
            return CorruptData(
                DEVICE, f"{tried}; {received} bytes came, none made sense: check the baud rate (register 5)"
            )
        return NotResponding(
            DEVICE, f"{tried}, though its output arrives: check the wire from the host's TX to the unit's RX"
        )

    def _reading(self, item: BinaryPacket | AsciiLine) -> ImuReading | None:
        """Return the reading that an item carries, None when it carries none or an impossible one."""
        sample = self._binary_sample(item) if isinstance(item, BinaryPacket) else self._ascii_sample(item)
        if sample is None:
            return None
        device_ns, q, rate, mag, accel = sample
        # One sum tells: it is finite only when all are, as floats of 32 bits cannot overflow it.
        if not math.isfinite(sum(map(abs, (*q, *rate, *mag, *accel)))):
            self._not_finite += 1
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
            self._out_of_range += 1
            return None
        quaternion = settings.attitude_map @ q
        # The two signs are one attitude; the shorter turn from the reference frame is the one given.
        quaternion /= math.copysign(norm, quaternion[3])
        length = item.layout.length if isinstance(item, BinaryPacket) else item.length
        return ImuReading(
            time_ns=item.arrival_ns - round(length * self._byte_ns),
            arrival_ns=item.arrival_ns,
            device_time_ns=device_ns,
            quaternion=quaternion,
            rate=settings.mounting @ rate,
            field=settings.mounting @ mag * TESLA_PER_GAUSS,
            acceleration=settings.mounting @ accel,
        )

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
                self._recovery.reset()
            self._look_at_step(device_ns - self._device_ns)
            self._device_ns = device_ns
        q, rate, mag, accel = places.sensors
        return device_ns, values[q], values[rate], values[mag], values[accel]

    def _look_at_step(self, step_ns: int) -> None:
        """Find out a unit that gives samples at another rate: its register is not what was written to it.

        Lost packets leave whole periods; a divisor with one bit flipped leaves parts of one, a tick at least.
        """
        part_ns = step_ns % self._period_ns
        off = min(part_ns, self._period_ns - part_ns) > 500_000_000 // IMU_RATE_HZ
        self._odd_steps = self._odd_steps + 1 if off else 0
        if self._odd_steps == _SURELY_OTHER:
            self._recovery.reset()

    def _look_for_lines(self, items: Sequence[BinaryPacket | AsciiLine]) -> None:
        """Find out a unit that was set up for packets and gives measurements as lines, too."""
        lines = (item.sentence for item in items if isinstance(item, AsciiLine))
        found = self._settings.output == "binary" and any(measurement(line) is not None for line in lines)
        self._odd_polls = self._odd_polls + 1 if found else 0
        if self._odd_polls == _SURELY_OTHER:
            self._recovery.reset()

    def _ascii_sample(self, line: AsciiLine) -> _Sample | None:
        error = error_meaning(line.sentence)
        if error is not None:
            self.unit_error = f"error {error[0]:02X}, {error[1]}"
        values = measurement(line.sentence)
        # A VNYMR line is no reading: it is what a unit sends that has lost its settings.
        if values is None or len(values.attitude) != 4:
            return None
        return 0, values.attitude, values.gyro, values.mag, values.accel


# Device time in ns, quaternion, rate, magnetic field in gauss, acceleration.
_Sample = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class _Places:
    """Where a packet's values are: index of the time; slices of quaternion, rate, field, acceleration."""

    time: int | None
    sensors: tuple[slice, slice, slice, slice]


def _places(layout: Layout) -> _Places | None:
    """Return where a packet carries a reading; None when it lacks any part but the time."""
    sensors: list[slice] = []
    for names in _SOURCES:
        place = next((layout.places[name] for name in names if name in layout.places), None)
        if place is None:
            return None
        sensors.append(place)
    time = next((layout.places[name].start for name in _TIMES if name in layout.places), None)
    q, rate, mag, accel = sensors
    # Of MagPres, the first three are the field.
    return _Places(time, (q, rate, slice(mag.start, mag.start + 3), accel))
