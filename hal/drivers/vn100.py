"""VN-100 driver, which configures the unit, converts its output to readings and recovers a lost unit.

The unit sends its attitude as a Hamilton quaternion (q0, q1, q2, q3), scalar last, which rotates the sensor
frame into NED. In this project's quaternion convention the four numbers that the unit sends describe the
rotation of NED into the sensor frame. Constant linear maps in the settings convert the attitude and the
measured vectors to the mission's reference frame and the body axes
(`knightcube.astro.quaternion.attitude_map`). Readings that are not finite or physically impossible are
rejected and counted.

The generator `set_up` yields the commands that configure a unit, and receives the answers from its caller,
which may wait or poll. `Recovery` advances by one step at each poll and never blocks. A unit that lost power
or was reset runs with the settings in its flash memory, possibly at another baud rate. Received packets, even
with unknown fields, show that the baud rate is correct. If bytes arrive but no packets, the recovery first
sends a query at the configured baud rate. If the unit does not answer, the recovery tries other baud rates,
alternating with the configured rate. At the correct baud rate, the recovery configures the unit again, one
command at a time. A unit that sends an output that was not requested is also configured again.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hal.drivers.sensor_unit import UnitSettings
from hal.drivers.vn100_protocol import (
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

# A packet contains TimeStartup, Quaternion, AngularRate and Accel (group 1) and Mag (group 3).
OUTPUT_SET = {0: 0x0131, 2: 0x0100}
_QMR_LENGTH = 137  # length (bytes) of an ASCII line VNQMR with a CRC16
_LINE_LOAD_LIMIT = 0.8  # largest fraction of the serial line's capacity that measurements may use


@dataclass(frozen=True, slots=True, kw_only=True)
class Vn100Settings(UnitSettings):
    """Settings of the VN-100 driver.

    For binary packets, `rate_hz` must divide 800; for ASCII lines, register 7 must permit the rate. The
    largest accepted field is 6 gauss for the testbed's unit, and 2.5 gauss for newer units.

    Attributes:
        attitude_map: (4, 4) matrix that maps the unit's quaternion (NED into sensor frame) to the project's
            quaternion (reference frame into body frame).
        output: output format, either binary packets or ASCII VNQMR lines without device time.
        unit_port: number of the unit's serial port to which the cable is connected, 1 or 2.
        acceleration_range: largest accepted acceleration per axis, m/s^2.
        configure: whether the driver configures the unit; otherwise any output with a complete reading is
            accepted.
        response_timeout_ns: timeout of the answer to each attempt, ns.
        tries: number of attempts to send a command before the unit is considered silent.
        stuck_after: number of consecutive identical samples after which samples are rejected as stuck; a
            working sensor has noise. The value 0 disables the check for stuck samples.
    """

    attitude_map: FloatArray
    output: Literal["binary", "ascii"]
    unit_port: int = 1
    acceleration_range: float = 16.0 * STANDARD_GRAVITY
    configure: bool = True
    response_timeout_ns: int = 100_000_000
    tries: int = 3
    stuck_after: int = 10


def check(settings: Vn100Settings, baud_rate: int) -> None:
    """Raise Refused or OutOfRange for settings that the unit or the serial line does not support."""
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
        most = int(_LINE_LOAD_LIMIT * baud_rate / (10 * length))
        cure = f"raise `baud_rate`, or reduce `rate_hz` to at most {most}"
        what, share = f"line load at {baud_rate} baud", round(load, 3)
        raise OutOfRange(DEVICE, what, share, 0.0, _LINE_LOAD_LIMIT, "of the line", cure)
    if settings.unit_port not in {1, 2}:
        raise Refused(DEVICE, f"unit_port = {settings.unit_port}: the unit has serial ports 1 and 2")


# Error codes after which a command is sent again; all other error codes are refusals.
PASSING_ERRORS = frozenset({-1, 0x01, 0x02, 0x03, 0x0A, 0x0B, 0xFF})


@dataclass(frozen=True, slots=True)
class Question:
    """Command to the unit; its answer contains the same command name and first field."""

    command: str
    fields: tuple[object, ...]

    def message(self) -> bytes:
        """Return the command as bytes to be sent."""
        return build(self.command, *self.fields)

    def text(self) -> str:
        """Return the command as text for error messages."""
        return f"$VN{self.command},{','.join(map(str, self.fields))}"

    def answer(self, sentence: Sentence) -> tuple[str, ...] | None:
        """Return the fields after the first field if `sentence` answers this command, otherwise None.

        Numbers in the answer may be padded with zeros.
        """
        if sentence.command != self.command or not sentence.fields:
            return None
        return sentence.fields[1:] if _same(str(self.fields[0]), sentence.fields[0], False) else None

    def complaint(self, sentence: Sentence) -> tuple[int, str] | None:
        """Return code and text if `sentence` is an error message of the unit, otherwise None."""
        error = error_meaning(sentence)
        return None if error is None else (error[0], f"error {error[0]:02X}, {error[1]}")


Dialogue = Generator[Question, tuple[str, ...], None]
"""Generator that yields commands and receives the answers' fields. Raises Refused."""


def set_up(settings: Vn100Settings) -> Dialogue:
    """Yield the commands that configure the unit. The flash memory of the unit is not written."""
    model = yield Question("RRG", (1,))
    if not model or not model[0].startswith("VN-100"):
        raise Refused(DEVICE, f"the unit reports the model {','.join(model)!r}, but a VN-100 is needed")
    yield from _write(6, 0)
    # The unit's hard and soft iron estimation is disabled, because the coils would disturb it.
    yield from _write(44, 0, 1, 5)
    # The boxcar filters of magnetometer, accelerometer and gyro average over one period of 40 Hz.
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
        # ASCII lines are sent with a CRC16, because an 8-bit XOR does not detect two flips of the same bit.
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
    """Yield the command that switches a binary output off."""
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


# Baud rates in order of likelihood, beginning with the factory setting.
BAUD_RATES = (115200, 230400, 921600, 460800, 57600, 38400, 19200, 9600)

_PATIENCE_NS = 150_000_000  # time (ns) without a reading after which the recovery begins
_LISTEN_NS = 90_000_000  # listening time (ns) at one baud rate: three packets at 40 Hz
_REFUSED_WAIT_NS = 1_000_000_000


class Recovery:
    """Recovery of a lost unit.

    Attributes:
        completed: number of completed recoveries.
        refusal: last refusal of the unit, or an empty text after a completed recovery.
        upsets: number of times that a unit which had sent readings was reset or had wrong settings.
        upset: cause of the newest of these upsets as text, or an empty text.
    """

    def __init__(self, port: SerialPort, settings: Vn100Settings) -> None:
        self.completed = self.upsets = 0
        self.refusal = self.upset = ""
        self._port, self._settings = port, settings
        self._own_rate = port.baud_rate
        self._others = [rate for rate in BAUD_RATES if rate != port.baud_rate]
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
        self._has_asked = False
        self._has_read = False

    def reset(self, cause: str) -> None:
        """Record that the unit needs to be configured, because it has restarted or has wrong settings."""
        if self._has_read and not (self._was_reset or self._is_fresh):
            self.upsets += 1
            self.upset = cause
        # The first time stamp after a recovery steps back, because the unit was restarted before the
        # recovery.
        self._was_reset = not self._is_fresh

    def advance(
        self, now_ns: int, readings: int, sentences: Sequence[Sentence], packets: int, received: int
    ) -> None:
        """Advance the recovery by one poll, which received `sentences` and the given number of `readings`.

        `received` is the number of bytes since the start of the driver, and `packets` the number of valid
        packets, including those with unknown fields. Raises NotResponding if the port is lost.
        """
        if self._reading_ns is None:
            self._reading_ns = now_ns
        if readings:
            self._is_fresh, self._has_read = False, True
        if readings and self._port.baud_rate == self._own_rate and not self._was_reset:
            self._reading_ns = now_ns
            self._has_asked = False
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
        """Listen at the current baud rate and then either configure the unit or change the baud rate.

        The driver starts to configure the unit if valid packets arrive or if the line stays silent. If only
        invalid bytes arrive, the driver first tries to configure the unit at the configured baud rate,
        because these bytes may be packets with an unknown layout.
        """
        assert self._listening_since_ns is not None
        if packets > self._packets:
            self._begin(now_ns)
        elif now_ns - self._listening_since_ns >= _LISTEN_NS:
            if received == self._bytes or not (self._has_asked or self._port.baud_rate != self._own_rate):
                # The line may be silent because the output of the unit is switched off.
                self._has_asked = received != self._bytes
                self._begin(now_ns)
            else:
                if self._port.baud_rate == self._own_rate:
                    # If the port rejects this baud rate, the next attempt uses another baud rate.
                    self._others.append(self._others.pop(0))
                    self._port.set_baud_rate(self._others[-1])
                else:
                    self._port.set_baud_rate(self._own_rate)
                self._listen(now_ns, packets, received)

    def _begin(self, now_ns: int) -> None:
        self._dialogue = self._whole_dialogue()
        self._tries = 0
        self._ask(next(self._dialogue), now_ns)

    def _whole_dialogue(self) -> Dialogue:
        if self._port.baud_rate != self._own_rate:
            # The unit answers this command at the old baud rate.
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
            self._tries += 1
            if self._tries < self._settings.tries:
                self._ask(question, now_ns)
                return
            self._give_up()
            if self._port.baud_rate != self._own_rate:
                self._port.set_baud_rate(self._own_rate)

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
            # If no readings arrive, the recovery begins again after `_PATIENCE_NS`.
            self._reading_ns = now_ns

    def _give_up(self) -> None:
        """Abort the configuration, so that the next step listens again."""
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
_ZERO_RATE = (0.0, 0.0, 0.0)
_CERTAIN = 4  # number of unexpected samples or messages that show a misconfigured unit
_ODD_TIME_NS = 5_000_000_000  # time (ns) without unexpected messages after which their count is reset
_ANSWERS = frozenset(
    {"RRG", "WRG", "WNV", "RFS", "RST", "ASY", "TAR", "KMD", "KAD", "SGB", "SFB", "SIH", "ERR"}
)

# Each row lists the packet fields that can contain a quantity, in order of preference.
_SOURCES = (
    ("common.quaternion", "attitude.quaternion"),
    ("common.angular_rate", "imu.angular_rate"),
    ("imu.mag", "common.mag_pres", "imu.uncomp_mag"),
    ("common.accel", "imu.accel"),
)
_TIMES = ("common.time_startup", "time.time_startup")

# Index of the time in a packet's values (or None), and slices of quaternion, rate, field and acceleration.
_Places = tuple[int | None, tuple[slice, slice, slice, slice]]
# A sample contains device time (ns), quaternion, rate, magnetic field (gauss) and acceleration.
_Sample = tuple[int, tuple[float, ...], tuple[float, ...], tuple[float, ...], tuple[float, ...]]


class ReadingConverter:
    """Converter of packets and ASCII lines to readings, which also detects a unit with wrong settings.

    Attributes:
        resets: number of restarts of the unit, detected by backward steps of the device time.
        out_of_range: number of samples whose values are physically impossible or stuck.
        not_finite: number of samples with a value that is not finite.
        rejection: quantity and value of the last sample with an invalid value, or an empty text.
    """

    def __init__(self, settings: Vn100Settings, byte_ns: float, on_reset: Callable[[str], None]) -> None:
        """Use the settings of the driver and the transmission time of one byte, `byte_ns`.

        The function `on_reset` is called with the cause if the unit has restarted or has wrong settings.
        """
        self.resets = 0
        self.out_of_range = 0
        self.not_finite = 0
        self.rejection = ""
        self._settings = settings
        rate_map, field_map, self._field_offset = settings.body_maps()
        # One matrix maps all values of a sample: quaternion, rate, magnetic field and acceleration.
        self._map: FloatArray = np.zeros((13, 13))
        self._map[:4, :4] = settings.attitude_map
        self._map[4:7, 4:7] = rate_map
        self._map[7:10, 7:10] = field_map * TESLA_PER_GAUSS
        self._map[10:, 10:] = settings.mounting
        self._byte_ns, self._on_reset = byte_ns, on_reset
        self._places: dict[bytes, _Places | None] = {}
        self._device_ns = 0
        self._period_ns = 1_000_000_000 // settings.rate_hz
        self._odd_steps = self._odd_outputs = 0
        self._odd_ns = 0
        self._wanted = layout_of(OUTPUT_SET).header if settings.output == "binary" else b""
        self._sample: tuple[tuple[float, ...], ...] = ()
        self._alike = 0

    def reading(self, item: BinaryPacket | AsciiLine) -> ImuReading | None:
        """Return the reading in a packet or line, or None if there is no reading or the reading is rejected.

        If only the rate of a reading is invalid, the rate is set to NaN.
        """
        sample = self._binary_sample(item) if isinstance(item, BinaryPacket) else self._ascii_sample(item)
        if sample is None:
            return None
        device_ns, q, rate, mag, accel = sample
        settings = self._settings
        # The sum of 32-bit floats cannot overflow, so the sum is finite only if all values are finite.
        if not math.isfinite(sum((*q, *mag, *accel))):
            self.not_finite += 1
            self.rejection = self._fault(q, rate, mag, accel)
            return None
        (x, y, z), limit = rate, settings.rate_range
        has_rate = abs(x) <= limit and abs(y) <= limit and abs(z) <= limit  # NaN compares false
        compared = sample[1:] if has_rate else (q, mag, accel)
        self._alike = self._alike + 1 if compared == self._sample else 0
        self._sample = compared
        norm = math.hypot(*q)
        if (
            0 < settings.stuck_after <= self._alike
            or abs(norm - 1.0) > _UNIT_NORM_TOLERANCE
            or max(map(abs, mag)) > settings.field_range / TESLA_PER_GAUSS
            or max(map(abs, accel)) > settings.acceleration_range
        ):
            self.out_of_range += 1
            self.rejection = self._fault(q, rate, mag, accel)
            return None
        if not has_rate:
            self.rejection = self._fault(q, rate, mag, accel)
            finite = math.isfinite(sum(rate))
            self.out_of_range, self.not_finite = self.out_of_range + finite, self.not_finite + (not finite)
            rate = _ZERO_RATE
        values = self._map.dot(np.array((*q, *rate, *mag, *accel)))
        if not has_rate:
            values[4:7] = math.nan
        length = item.layout.length if isinstance(item, BinaryPacket) else item.length
        return ImuReading(
            time_ns=item.arrival_ns - round(length * self._byte_ns),
            arrival_ns=item.arrival_ns,
            device_time_ns=device_ns,
            # The quaternions q and -q are equivalent; the one with a positive scalar part is returned.
            quaternion=values[:4] / math.copysign(norm, values[3]),
            rate=values[4:7],
            field=values[7:10] - self._field_offset,
            acceleration=values[10:],
        )

    def _fault(self, *sample: tuple[float, ...]) -> str:
        """Return a text that names the impossible quantity of a rejected sample, with its value and limit."""
        settings, quaternion = self._settings, sample[0]
        quantities = (
            ("rate", 1.0, settings.rate_range, "rad/s"),
            ("magnetic field", TESLA_PER_GAUSS, settings.field_range, "T"),
            ("acceleration", 1.0, settings.acceleration_range, "m/s^2"),
        )
        for (name, scale, limit, unit), values in zip(quantities, sample[1:], strict=True):
            for axis, value in zip("xyz", values, strict=True):
                if not abs(scale * value) <= limit:
                    return f"{name} {axis} = {scale * value:g} {unit}, limit {limit:g}"
        norm = math.hypot(*quaternion)
        if not abs(norm - 1.0) <= _UNIT_NORM_TOLERANCE:
            return f"norm of the quaternion = {norm:g}, must be 1"
        return f"{self._alike + 1} samples in a row are identical"

    def check_for_others(self, items: Sequence[BinaryPacket | AsciiLine], foreign: int, now_ns: int) -> None:
        """Detect a unit that sends an output that was not requested.

        `items` are the packets and lines received in this poll, and `foreign` is the number of received
        packets with unknown fields.
        """
        count = foreign + sum(map(self._is_other, items))
        if count == 0:
            return
        if now_ns - self._odd_ns > _ODD_TIME_NS:
            self._odd_outputs = 0
        self._odd_ns = now_ns
        self._odd_outputs += count
        if self._odd_outputs >= _CERTAIN:
            self._odd_outputs = 0
            self._on_reset("the unit sends an output that was not requested")

    def _is_other(self, item: BinaryPacket | AsciiLine) -> bool:
        """Return whether a packet or line is neither the requested output nor an answer to a command."""
        if isinstance(item, BinaryPacket):
            return item.layout.header != self._wanted
        command = item.sentence.command
        return command not in _ANSWERS and not (command == "QMR" and not self._wanted)

    def _binary_sample(self, packet: BinaryPacket) -> _Sample | None:
        header = packet.layout.header
        if header not in self._places:
            self._places[header] = _places(packet.layout)
        places = self._places[header]
        if places is None:
            return None
        values: tuple[float, ...] = packet.values  # type: ignore[assignment]  # these fields are numbers
        device_ns = 0
        time, (q, rate, mag, accel) = places
        if time is not None:
            device_ns = int(values[time])
            if device_ns < self._device_ns:
                self.resets += 1
                self._on_reset("the clock of the unit stepped back: the unit has restarted")
            self._check_step(device_ns - self._device_ns)
            self._device_ns = device_ns
        return device_ns, values[q], values[rate], values[mag], values[accel]

    def _check_step(self, step_ns: int) -> None:
        """Detect a unit that sends samples at a wrong rate, because its rate divisor register was corrupted.

        Lost packets cause time steps that are multiples of the sample period. A corrupted rate divisor causes
        time steps that are not multiples of the sample period.
        """
        part_ns = step_ns % self._period_ns
        off = min(part_ns, self._period_ns - part_ns) > 500_000_000 // IMU_RATE_HZ
        self._odd_steps = self._odd_steps + 1 if off else 0
        if self._odd_steps == _CERTAIN:
            self._on_reset("the unit sends samples at a wrong rate")

    def _ascii_sample(self, line: AsciiLine) -> _Sample | None:
        values = measurement(line.sentence)
        # VNYMR lines are not accepted, because a unit that has lost its settings sends them.
        if values is None or len(values.attitude) != 4:
            return None
        return 0, values.attitude, values.gyro, values.mag, values.accel


def _places(layout: OutputLayout) -> _Places | None:
    """Return the positions of a reading's values in a packet, or None if a sensor value is missing."""
    sensors: list[slice] = []
    for names in _SOURCES:
        place = next((layout.places[name] for name in names if name in layout.places), None)
        if place is None:
            return None
        sensors.append(place)
    time = next((layout.places[name].start for name in _TIMES if name in layout.places), None)
    q, rate, mag, accel = sensors
    # The first three values of the field MagPres are the magnetic field.
    return time, (q, rate, slice(mag.start, mag.start + 3), accel)


_LONGEST_PACKET = 128  # maximum packet length (bytes), which limits the delay that a false header causes
_POLL_STEP_NS = 1_000_000


class Vn100:
    """Driver of a VN-100 on a serial port, which implements `hal.interfaces.devices.InertialUnit`."""

    def __init__(self, port: SerialPort, clock: Clock, settings: Vn100Settings) -> None:
        """Use an open port.

        Raises Refused or OutOfRange for settings that the unit or the serial line does not support.
        """
        check(settings, port.baud_rate)
        self._unit_error = ""
        self._port, self._clock, self._settings = port, clock, settings
        byte_ns = 10e9 / port.baud_rate
        self._parser = StreamParser(byte_ns, _LONGEST_PACKET)
        self._recovery = Recovery(port, settings)
        self._converter = ReadingConverter(settings, byte_ns, self._recovery.reset)
        self._last_byte_ns = -1
        self._foreign = 0

    def configure(self) -> None:
        """Configure the unit in its volatile memory. The flash memory is not written.

        Raises NotResponding if the unit does not answer, CorruptData for corrupted answers, and Refused if
        the unit refuses a command, is not a VN-100, or does not keep its settings.
        """
        if not self._settings.configure:
            return
        # The measurement output is switched off first, so that answers are not lost between measurements.
        self._ask(Question("ASY", (0,)))
        dialogue = set_up(self._settings)
        question = next(dialogue)
        with contextlib.suppress(StopIteration):
            while True:
                question = dialogue.send(self._ask(question))

    def model(self) -> str:
        """Return the model name that the unit reports. Raises the same exceptions as `configure`."""
        return ",".join(self._ask(Question("RRG", (1,))))

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Raises NotResponding if the port is lost.

        If the unit sends no samples, the driver searches for the unit and configures it again, one command
        per call.
        """
        items = self._receive()
        found = (self._converter.reading(item) for item in items)
        readings = [reading for reading in found if reading is not None]
        if self._settings.configure:
            sentences = [item.sentence for item in items if not isinstance(item, BinaryPacket)]
            parser, now_ns = self._parser, self._clock.now_ns()
            foreign, self._foreign = parser.foreign - self._foreign, parser.foreign
            self._converter.check_for_others(items, foreign, now_ns)
            packets = parser.packets + parser.foreign
            try:
                self._recovery.advance(now_ns, len(readings), sentences, packets, parser.bytes_received)
            except NotResponding:
                # If the port is lost, the next call raises the error again.
                if not readings:
                    raise
        return readings

    def link(self) -> ImuLink:
        """Return the counters of the serial line. The count `packets` includes ASCII lines."""
        parser = self._parser
        return ImuLink(
            parser.bytes_received,
            parser.packets,
            parser.bad_checksum,
            parser.discarded_bytes,
            self._converter.out_of_range,
            self._converter.not_finite,
            self._last_byte_ns,
            self._converter.rejection,
            self._recovery.upsets,
            self._recovery.upset,
        )

    @property
    def resets(self) -> int:
        """Number of restarts of the unit, detected by backward steps of the device time."""
        return self._converter.resets

    @property
    def recoveries(self) -> int:
        """Number of times that a lost unit was found and configured again."""
        return self._recovery.completed

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()

    def _receive(self) -> list[BinaryPacket | AsciiLine]:
        items: list[BinaryPacket | AsciiLine] = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            items += self._parser.feed(arrival_ns, data)
        return items

    def _ask(self, question: Question) -> tuple[str, ...]:
        """Send a command with retries and return the answer's fields after the first field."""
        before = self.link()
        self._unit_error = ""
        for _ in range(self._settings.tries):
            self._port.send(question.message())
            answer = self._await(question)
            if answer is not None:
                return answer
        raise self._no_answer(question.text(), before)

    def _await(self, question: Question) -> tuple[str, ...] | None:
        """Wait for the answer to a command and return it, or None after the timeout or a transient error."""
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
                DEVICE,
                f"{tried}, no byte received: check power, the cable, the port's name, and the baud rate",
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
