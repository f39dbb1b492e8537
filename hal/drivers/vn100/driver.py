"""The VN-100 driver: sets the unit up over its own protocol, and turns its packets into readings.

Attitude: the unit sends (q0, q1, q2, q3), scalar last, a Hamilton quaternion that rotates body into NED;
by our convention the same four numbers rotate NED into the sensor. Two constant linear maps, given by whoever
composes, take it to the mission's reference frame and the body's axes (`flight.frames.attitude_map`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from hal.drivers.vn100.ascii import AsciiLine, Sentence, build, error_meaning, measurement
from hal.drivers.vn100.codec import BinaryPacket, Layout, layout_of
from hal.drivers.vn100.stream import StreamParser
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.readings import FloatArray, ImuLink, ImuReading
from hal.interfaces.wires import Clock, SerialPort

DEVICE = "vn100"
IMU_RATE_HZ = 800
ASCII_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
TESLA_PER_GAUSS = 1e-4
STANDARD_GRAVITY = 9.80665

# TimeStartup, Quaternion, AngularRate, Accel of group 1 and Mag of group 3: all of a reading in 67 bytes.
OUTPUT_SET = {0: 0x0131, 2: 0x0100}
_QMR_LENGTH = 137  # with a CRC16
_LINE_LOAD_LIMIT = 0.8  # the rest is left for answers
_LONGEST_PACKET = 128  # more than any output set that 40 Hz asks for; bounds the wait on a false start
_POLL_STEP_NS = 1_000_000
_UNIT_NORM_TOLERANCE = 1e-2

# The unit met our bytes, or itself, in a bad moment: worth another try. All other codes are a no.
_PASSING_ERRORS = frozenset({-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF})

# Where a packet may carry each quantity, in order of preference.
_SOURCES = (
    ("common.quaternion", "attitude.quaternion"),
    ("common.angular_rate", "imu.angular_rate"),
    ("imu.mag", "common.mag_pres", "imu.uncomp_mag"),
    ("common.accel", "imu.accel"),
)
_TIMES = ("common.time_startup", "time.time_startup")


@dataclass(frozen=True, slots=True)
class Vn100Settings:
    """How the unit is mounted, and what is asked of it.

    Attributes:
        attitude_map: (4, 4), takes the unit's quaternion (NED into sensor) to ours (reference into body).
        mounting: (3, 3) rotation matrix, sensor axes into body axes.
        rate_hz: samples a second; binary rates divide 800, ASCII rates are register 7's.
        output: binary packets, or ASCII VNQMR lines (which carry no device time).
        unit_port: the unit's own serial port that the cable is on, 1 or 2.
        rate_range, field_range, acceleration_range: rad/s, T, m/s^2, per axis; beyond is refused. The field's
            default is the 6 G of the testbed's unit; present-day units state 2.5 G.
        configure: False leaves the unit as it is; any output that carries a whole reading is then taken.
        response_timeout_ns: the wait for an answer, each try.
        tries: how often a command is sent before the unit counts as silent.
    """

    attitude_map: FloatArray = field(default_factory=lambda: np.eye(4))
    mounting: FloatArray = field(default_factory=lambda: np.eye(3))
    rate_hz: int = 40
    output: Literal["binary", "ascii"] = "binary"
    unit_port: int = 1
    rate_range: float = math.radians(2000.0)
    field_range: float = 6e-4
    acceleration_range: float = 16.0 * STANDARD_GRAVITY
    configure: bool = True
    response_timeout_ns: int = 100_000_000
    tries: int = 3


class Vn100:
    """A VN-100 on a serial port; implements `hal.interfaces.devices.InertialUnit`.

    Attributes:
        resets: how often the device's time went backwards: the unit started anew, and runs on its saved
            settings until `configure` is called again.
        unit_error: the text of the last error that the unit reported, empty when none.
    """

    def __init__(self, port: SerialPort, clock: Clock, settings: Vn100Settings) -> None:
        """Take the line. Raises Refused or OutOfRange when the unit or the line cannot do what is asked."""
        _check(settings, port.baud_rate)
        self.resets = 0
        self.unit_error = ""
        self._port = port
        self._clock = clock
        self._settings = settings
        self._byte_ns = 10e9 / port.baud_rate
        self._parser = StreamParser(self._byte_ns, _LONGEST_PACKET)
        self._places: dict[bytes, _Places | None] = {}
        self._device_ns = 0
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
        self._ask("ASY", 0)
        model = self._ask("RRG", 1)
        if not model or not model[0].startswith("VN-100"):
            raise Refused(DEVICE, f"the unit calls itself {','.join(model)!r}: this line needs a VN-100")
        self._write(6, 0)
        # The unit's own learning of hard and soft iron would take the coils' field for the unit's.
        self._write(44, 0, 1, 5)
        # Boxcar filters as long as one 40 Hz period (magnetometer, accelerometer, gyro), on both outputs.
        self._write(85, 20, 20, 20, 4, 0, 3, 3, 3, 3, 0)
        self._switch_off(76)
        self._switch_off(77)
        if self._settings.output == "binary":
            groups = f"{sum(1 << bit for bit in OUTPUT_SET):02X}"
            words = (f"{OUTPUT_SET[bit]:04X}" for bit in sorted(OUTPUT_SET))
            divisor = IMU_RATE_HZ // self._settings.rate_hz
            self._write(75, self._settings.unit_port, divisor, groups, *words)
        else:
            self._switch_off(75)
            # CRC16 on the lines too: 8 bits of XOR let two flips in one column pass.
            self._write(30, 0, 0, 0, 0, 3, 0, 1)
            self._write(7, self._settings.rate_hz)
            self._write(6, 8)
        self._ask("ASY", 1)

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        Raises NotResponding when the line itself is gone. Corrupt and implausible packets are counted in
        `link`.
        """
        readings = (self._reading(item) for item in self._receive())
        return [reading for reading in readings if reading is not None]

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

    def _write(self, register: int, *values: object) -> None:
        echo = self._ask("WRG", register, *values)
        asked = [str(value) for value in values]
        base16 = 75 <= register <= 77
        if len(echo) != len(asked) or not all(_same(a, b, base16) for a, b in zip(asked, echo, strict=True)):
            wanted, found = ",".join(asked), ",".join(echo)
            raise Refused(DEVICE, f"register {register} was to be {wanted}, the unit answered {found}")

    def _switch_off(self, register: int) -> None:
        """Switch a binary output off; what the unit remembers of the fields is its own affair."""
        echo = self._ask("WRG", register, 0, 20, "01", "0001")
        if not echo or not _same("0", echo[0], True):
            raise Refused(DEVICE, f"register {register} was to be off, the unit answered {','.join(echo)}")

    def _ask(self, command: str, *fields: object) -> tuple[str, ...]:
        """Send a command until its answer comes; return the answer's fields after those that identify it."""
        before = self.link()
        self.unit_error = ""
        for _ in range(self._settings.tries):
            self._port.send(build(command, *fields))
            answer = self._await(command, fields)
            if answer is not None:
                return answer
        raise self._no_answer(f"$VN{command},{','.join(map(str, fields))}", before)

    def _await(self, command: str, fields: Sequence[object]) -> tuple[str, ...] | None:
        """Return the answer, or None when the time is up or the try was in vain."""
        deadline_ns = self._clock.now_ns() + self._settings.response_timeout_ns
        while True:
            for item in self._receive():
                if isinstance(item, BinaryPacket):
                    continue
                if _answers(item.sentence, command, fields[0]):
                    return item.sentence.fields[1:]
                error = error_meaning(item.sentence)
                if error is not None:
                    code, meaning = error
                    self.unit_error = f"error {code:02X}, {meaning}"
                    if code in _PASSING_ERRORS:
                        return None
                    asked = ",".join((command, *map(str, fields)))
                    raise Refused(DEVICE, f"$VN{asked} was answered with {self.unit_error}")
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
        norm = math.hypot(*q)
        if (
            abs(norm - 1.0) > _UNIT_NORM_TOLERANCE
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
            self._device_ns = device_ns
        q, rate, mag, accel = places.sensors
        return device_ns, values[q], values[rate], values[mag], values[accel]

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


def _check(settings: Vn100Settings, baud_rate: int) -> None:
    if settings.output == "binary":
        possible = tuple(rate for rate in range(1, IMU_RATE_HZ + 1) if IMU_RATE_HZ % rate == 0)
        length = layout_of(OUTPUT_SET).length
    else:
        possible, length = ASCII_RATES_HZ, _QMR_LENGTH
    if settings.rate_hz not in possible:
        raise Refused(
            DEVICE,
            f"rate_hz = {settings.rate_hz} is no {settings.output} output rate of the unit; "
            f"it has {', '.join(map(str, possible))}",
        )
    load = settings.rate_hz * length * 10 / baud_rate
    if load > _LINE_LOAD_LIMIT:
        raise OutOfRange(DEVICE, f"line load at {baud_rate} baud", load, 0.0, _LINE_LOAD_LIMIT, "of the line")
    if settings.unit_port not in {1, 2}:
        raise Refused(DEVICE, f"unit_port = {settings.unit_port}: the unit has serial ports 1 and 2")


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


def _answers(sentence: Sentence, command: str, first: object) -> bool:
    """Tell whether a sentence answers a command whose first field is `first`; numbers may be zero-padded."""
    if sentence.command != command or not sentence.fields:
        return False
    return _same(str(first), sentence.fields[0], False)


def _same(asked: str, echoed: str, base16: bool) -> bool:
    if asked == echoed:
        return True
    try:
        return int(asked, 16) == int(echoed, 16) if base16 else float(asked) == float(echoed)
    except ValueError:
        return False
