"""The VN-100 driver: sets the unit up over its own protocol, reads its output, recovers a lost unit.

Attitude: the unit sends (q0, q1, q2, q3), scalar last, a Hamilton quaternion that rotates body into NED. In
this project's convention the same four numbers rotate NED into the sensor frame. Two constant linear maps of
the settings convert it to the mission's reference frame and the body's axes
(`knightcube.astro.quaternion.attitude_map`). Readings that are not finite or physically impossible are
rejected and counted.

`set_up` is the dialogue that configures a unit, as a generator of questions; the caller decides how to wait.
`Recovery` advances one step at each poll and never waits. A unit that lost power or was reset runs on the
settings in its flash, perhaps at another baud rate; a unit that was unplugged may return in any of these
states. Packets show that the baud rate is right. Bytes without packets suggest that it is wrong; other baud
rates are then tried, alternating with the configured rate. At the right baud rate the unit is set up again,
one question at a time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hal.drivers.vn100.protocol import (
    AsciiLine,
    BinaryPacket,
    OutputLayout,
    Sentence,
    StreamParser,
    build,
    error_meaning,
    layout_of,
    measurement,
)
from hal.interfaces.devices import FloatArray, ImuLink, ImuReading
from hal.interfaces.errors import CorruptData, DeviceError, NotResponding, OutOfRange, Refused
from hal.interfaces.wires import Clock, SerialPort

DEVICE = "vn100"
IMU_RATE_HZ = 800
ASCII_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
STANDARD_GRAVITY = 9.80665

# TimeStartup, Quaternion, AngularRate, Accel of group 1 and Mag of group 3: one reading in 67 bytes.
OUTPUT_SET = {0: 0x0131, 2: 0x0100}
_QMR_LENGTH = 137  # with a CRC16
_LINE_LOAD_LIMIT = 0.8  # the rest is left for answers


@dataclass(frozen=True, slots=True, kw_only=True)
class Vn100Settings:
    """Mounting and output of the unit.

    Attributes:
        attitude_map: (4, 4), maps the unit's quaternion (NED into sensor) to ours (reference into body).
        mounting: (3, 3) rotation matrix, sensor axes into body axes.
        rate_hz: samples per second; binary rates divide 800, ASCII rates are register 7's.
        output: binary packets, or ASCII VNQMR lines (which carry no device time).
        unit_port: the unit's own serial port that the cable is on, 1 or 2.
        rate_range, field_range, acceleration_range: rad/s, T, m/s^2, per axis; samples beyond are
            rejected. The testbed's unit states 6 G, present-day units 2.5 G.
        configure: False leaves the unit unchanged; any output with a complete reading is then accepted.
        response_timeout_ns: the wait for an answer, each try.
        tries: how often a command is sent before the unit counts as silent.
        stuck_after: samples in a row with identical values after which they count as out of range, because
            every sensor has noise. 0: never.
    """

    attitude_map: FloatArray
    mounting: FloatArray
    rate_hz: int
    output: Literal["binary", "ascii"]
    unit_port: int = 1
    rate_range: float = math.radians(2000.0)
    field_range: float
    acceleration_range: float = 16.0 * STANDARD_GRAVITY
    configure: bool = True
    response_timeout_ns: int = 100_000_000
    tries: int = 3
    stuck_after: int = 10


def check(settings: Vn100Settings, baud_rate: int) -> None:
    """Raise Refused or OutOfRange for settings beyond the unit or the line."""
    if settings.output == "binary":
        possible = tuple(rate for rate in range(1, IMU_RATE_HZ + 1) if IMU_RATE_HZ % rate == 0)
        length = layout_of(OUTPUT_SET).length
    else:
        possible, length = ASCII_RATES_HZ, _QMR_LENGTH
    if settings.rate_hz not in possible:
        raise Refused(
            DEVICE,
            f"rate_hz = {settings.rate_hz} is not an output rate of {settings.output} packets; "
            f"possible are {', '.join(map(str, possible))}",
        )
    load = settings.rate_hz * length * 10 / baud_rate
    if load > _LINE_LOAD_LIMIT:
        raise OutOfRange(DEVICE, f"line load at {baud_rate} baud", load, 0.0, _LINE_LOAD_LIMIT, "of the line")
    if settings.unit_port not in {1, 2}:
        raise Refused(DEVICE, f"unit_port = {settings.unit_port}: the unit has serial ports 1 and 2")


# Transient errors, worth another try. All other codes are refusals.
PASSING_ERRORS = frozenset({-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF})


@dataclass(frozen=True, slots=True)
class Question:
    """A command and its fields; the first field identifies its answer."""

    command: str
    fields: tuple[object, ...]

    def message(self) -> bytes:
        """Return the bytes for the wire."""
        return build(self.command, *self.fields)

    def text(self) -> str:
        """Return the text for messages."""
        return f"$VN{self.command},{','.join(map(str, self.fields))}"

    def answer(self, sentence: Sentence) -> tuple[str, ...] | None:
        """Return the fields after the first if `sentence` is the answer; numbers may be zero-padded."""
        if sentence.command != self.command or not sentence.fields:
            return None
        return sentence.fields[1:] if _same(str(self.fields[0]), sentence.fields[0], False) else None

    def complaint(self, sentence: Sentence) -> tuple[int, str] | None:
        """Return (code, text) of an error that the unit reports; None for other sentences."""
        error = error_meaning(sentence)
        return None if error is None else (error[0], f"error {error[0]:02X}, {error[1]}")


Dialogue = Generator[Question, tuple[str, ...], None]
"""Yields questions and receives the fields of their answers. Raises Refused when the unit refuses."""


def set_up(settings: Vn100Settings) -> Dialogue:
    """Set the unit up in its volatile memory; its flash is not written."""
    model = yield Question("RRG", (1,))
    if not model or not model[0].startswith("VN-100"):
        raise Refused(DEVICE, f"the unit reports the model {','.join(model)!r}: this line needs a VN-100")
    yield from _write(6, 0)
    # The unit's own hard and soft iron estimation would mistake the coils' field for the unit's.
    yield from _write(44, 0, 1, 5)
    # Boxcar filters of one 40 Hz period (magnetometer, accelerometer, gyro), on both outputs.
    yield from _write(85, 20, 20, 20, 4, 0, 3, 3, 3, 3, 0)
    yield from _switch_off(76)
    yield from _switch_off(77)
    if settings.output == "binary":
        groups = f"{sum(1 << bit for bit in OUTPUT_SET):02X}"
        words = (f"{OUTPUT_SET[bit]:04X}" for bit in sorted(OUTPUT_SET))
        divisor = IMU_RATE_HZ // settings.rate_hz
        yield from _write(75, settings.unit_port, divisor, groups, *words)
    else:
        yield from _switch_off(75)
        # CRC16 on the lines too: XOR of 8 bits misses two flips in one column.
        yield from _write(30, 0, 0, 0, 0, 3, 0, 1)
        yield from _write(7, settings.rate_hz)
        yield from _write(6, 8)
    yield Question("ASY", (1,))


def _write(register: int, *values: object) -> Dialogue:
    echo = yield Question("WRG", (register, *values))
    asked = [str(value) for value in values]
    base16 = 75 <= register <= 77
    if len(echo) != len(asked) or not all(_same(a, b, base16) for a, b in zip(asked, echo, strict=True)):
        wanted, found = ",".join(asked), ",".join(echo)
        raise Refused(DEVICE, f"register {register} should be {wanted}, but the unit answered {found}")


def _switch_off(register: int) -> Dialogue:
    """Switch a binary output off; the remaining fields do not matter then."""
    echo = yield Question("WRG", (register, 0, 20, "01", "0001"))
    if not echo or not _same("0", echo[0], True):
        raise Refused(DEVICE, f"register {register} should be off, but the unit answered {','.join(echo)}")


def _same(asked: str, echoed: str, base16: bool) -> bool:
    if asked == echoed:
        return True
    try:
        return int(asked, 16) == int(echoed, 16) if base16 else float(asked) == float(echoed)
    except ValueError:
        return False


# In order of likelihood, the factory's setting first.
BAUD_RATES = (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)

_PATIENCE_NS = 150_000_000  # without a reading, before recovery begins
_LISTEN_NS = 90_000_000  # at one baud rate: three packets of 40 Hz
_REFUSED_WAIT_NS = 1_000_000_000


class Recovery:
    """The dialogue with a lost unit.

    Attributes:
        completed: how often a unit was set up again.
        refusal: the unit's last refusal, empty without one.
    """

    def __init__(self, port: SerialPort, settings: Vn100Settings) -> None:
        self.completed = 0
        self.refusal = ""
        self._port = port
        self._settings = settings
        self._own_rate = port.baud_rate
        self._others = [rate for rate in BAUD_RATES if rate != port.baud_rate]
        self._other = 0
        self._reading_ns: int | None = None
        self._listening_since_ns: int | None = None
        self._packets = self._bytes = 0
        self._dialogue: Dialogue | None = None
        self._question: Question | None = None
        self._asked_ns = 0
        self._tries = 0
        self._wait_until_ns = 0
        self._was_reset = False
        self._is_fresh = False
        self._has_written = False

    def reset(self) -> None:
        """Note that the unit has restarted: even with readings, its settings are those in its flash."""
        # The first sample after a recovery shows the restart that was handled already.
        self._was_reset = not self._is_fresh

    def advance(
        self, now_ns: int, readings: int, sentences: Sequence[Sentence], packets: int, received: int
    ) -> None:
        """Advance by one poll with its number of readings, its sentences, and all packets and bytes so far.

        Raises NotResponding when the port is gone.
        """
        if self._reading_ns is None:
            self._reading_ns = now_ns
        if readings:
            self._is_fresh = False
        if readings and self._port.baud_rate == self._own_rate and not self._was_reset:
            self._reading_ns = now_ns
            if not self._has_written:
                self._dialogue = None
                self._listening_since_ns = None
                return
        patient = now_ns - self._reading_ns <= _PATIENCE_NS and not (self._was_reset or self._has_written)
        if patient or now_ns < self._wait_until_ns:
            return
        if self._listening_since_ns is None:
            self._listen(now_ns, packets, received)
        try:
            if self._dialogue is not None:
                self._converse(now_ns, sentences)
            else:
                self._seek(now_ns, packets, received)
        except Refused as error:
            self.refusal = error.message
            self._give_up()
            self._wait_until_ns = now_ns + _REFUSED_WAIT_NS

    def _listen(self, now_ns: int, packets: int, received: int) -> None:
        self._listening_since_ns = now_ns
        self._packets, self._bytes = packets, received
        self._dialogue = None

    def _seek(self, now_ns: int, packets: int, received: int) -> None:
        """Listen at this baud rate; begin the dialogue if it is right or the line silent, else change it."""
        assert self._listening_since_ns is not None
        if packets > self._packets:
            self._begin(now_ns)
        elif now_ns - self._listening_since_ns >= _LISTEN_NS:
            if received == self._bytes:
                # Silence: its output may be switched off.
                self._begin(now_ns)
            else:
                self._change_rate()
                self._listen(now_ns, packets, received)

    def _change_rate(self) -> None:
        if self._port.baud_rate == self._own_rate:
            self._port.set_baud_rate(self._others[self._other])
            self._other = (self._other + 1) % len(self._others)
        else:
            self._port.set_baud_rate(self._own_rate)

    def _begin(self, now_ns: int) -> None:
        self._dialogue = self._whole_dialogue()
        self._tries = 0
        self._ask(next(self._dialogue), now_ns)

    def _whole_dialogue(self) -> Dialogue:
        if self._port.baud_rate != self._own_rate:
            # Answered at the old baud rate.
            yield Question("WRG", (5, self._own_rate))
            self._port.set_baud_rate(self._own_rate)
        yield from set_up(self._settings)

    def _converse(self, now_ns: int, sentences: Sequence[Sentence]) -> None:
        question = self._question
        assert question is not None
        assert self._dialogue is not None
        again = now_ns - self._asked_ns >= self._settings.response_timeout_ns
        for sentence in sentences:
            answer = question.answer(sentence)
            if answer is not None:
                self._accept(answer, now_ns)
                return
            complaint = question.complaint(sentence)
            if complaint is not None:
                if complaint[0] not in PASSING_ERRORS:
                    raise Refused("vn100", f"{question.text()} was answered with {complaint[1]}")
                again = True
        if again:
            self._repeat(question, now_ns)

    def _accept(self, answer: tuple[str, ...], now_ns: int) -> None:
        assert self._dialogue is not None
        self._tries = 0
        try:
            self._ask(self._dialogue.send(answer), now_ns)
        except StopIteration:
            self._give_up()
            self._was_reset = False
            self._is_fresh = True
            self.completed += 1
            self.refusal = ""
            # Readings should arrive now; if not, recovery begins again after the same time.
            self._reading_ns = now_ns

    def _repeat(self, question: Question, now_ns: int) -> None:
        self._tries += 1
        if self._tries < self._settings.tries:
            self._ask(question, now_ns)
            return
        self._give_up()
        if self._port.baud_rate != self._own_rate:
            self._port.set_baud_rate(self._own_rate)

    def _give_up(self) -> None:
        """Return to the state before the dialogue; the next step listens again."""
        self._dialogue = None
        self._listening_since_ns = None
        self._has_written = False

    def _ask(self, question: Question, now_ns: int) -> None:
        self._question, self._asked_ns = question, now_ns
        self._has_written = self._has_written or question.command == "WRG"
        try:
            self._port.send(question.message())
        except DeviceError:
            self._give_up()
            raise


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
        """Detect a unit that sends samples at another rate because its divisor register was corrupted.

        After lost packets a step is a whole number of periods; after a bit flip in the divisor it is not.
        """
        part_ns = step_ns % self._period_ns
        off = min(part_ns, self._period_ns - part_ns) > 500_000_000 // IMU_RATE_HZ
        self._odd_steps = self._odd_steps + 1 if off else 0
        if self._odd_steps == _CERTAIN:
            self._on_reset()

    def _ascii_sample(self, line: AsciiLine) -> _Sample | None:
        values = measurement(line.sentence)
        # A VNYMR line is not accepted as a reading: a unit that lost its settings sends it.
        if values is None or len(values.attitude) != 4:
            return None
        return 0, values.attitude, values.gyro, values.mag, values.accel


@dataclass(frozen=True, slots=True)
class _Places:
    """Positions of a packet's values: index of the time; slices of quaternion, rate, field, acceleration."""

    time: int | None
    sensors: tuple[slice, slice, slice, slice]


def _places(layout: OutputLayout) -> _Places | None:
    """Return the positions of a reading in a packet; None if a part other than the time is missing."""
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

    def configure(self) -> None:
        """Set the unit up in its volatile memory; its flash is not written.

        Raises NotResponding on silence, CorruptData for meaningless answers, and Refused if the unit refuses,
        is not a VN-100, or does not keep its settings.
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
        """Return the model that the unit reports; nothing is changed in it. Raises as `configure`."""
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
        """Return the line's counters; `packets` counts packets and lines with a valid checksum."""
        parser = self._parser
        return ImuLink(
            parser.bytes_received,
            parser.packets,
            parser.bad_checksum,
            parser.discarded_bytes,
            self._converter.out_of_range,
            self._converter.not_finite,
            self._last_byte_ns,
        )

    @property
    def resets(self) -> int:
        """Number of restarts of the unit, detected by steps back of its own time."""
        return self._converter.resets

    @property
    def recoveries(self) -> int:
        """Number of times that a lost unit was found and set up again."""
        return self._recovery.completed

    def close(self) -> None:
        """Release the line."""
        self._port.close()

    def _receive(self) -> list[BinaryPacket | AsciiLine]:
        items: list[BinaryPacket | AsciiLine] = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            items += self._parser.feed(arrival_ns, data)
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
                DEVICE,
                f"{tried}; {received} bytes arrived, but no valid packet: check the baud rate (register 5)",
            )
        return NotResponding(
            DEVICE, f"{tried}, though its output arrives: check the wire from the host's TX to the unit's RX"
        )
