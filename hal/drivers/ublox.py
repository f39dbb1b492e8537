"""Driver of a u-blox GPS receiver on a serial line, which reads one NAV-PVT message per period.

UBX is the binary protocol of u-blox receivers (u-blox M8 interface description, UBX-13003221, chapter 32). A
UBX frame consists of the bytes B5 62, class, identifier, length (little endian), payload and checksum. The
checksum is an 8-bit Fletcher checksum over all bytes except the first two. One NAV-PVT message contains the
time, position, velocity and accuracies of one epoch. The NMEA protocol is not used, because it distributes
these values over several sentences, usually rounds the position to 2 m, and lacks the vertical velocity.

The receiver loses its configuration at a power loss. The driver therefore requests NAV-PVT messages at the
start, and again whenever none has arrived for three seconds. No call blocks. Consumer receivers stop working
above 18 km or 515 m/s, so that a satellite needs a firmware without this limit.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from hal.interfaces.devices import FloatArray, GpsLink, GpsReading
from hal.interfaces.errors import OutOfRange
from hal.interfaces.wires import SECOND_NS, Clock, SerialPort

SYNC = b"\xb5\x62"
NAV_PVT = 0x01, 0x07
ACK_NAK, ACK_ACK = (0x05, 0x00), (0x05, 0x01)
CFG_PRT, CFG_MSG, CFG_RATE = (0x06, 0x00), (0x06, 0x01), (0x06, 0x08)
OVERHEAD = 8
PVT_LENGTH = 92
_PVT = struct.Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH")
THREE_DIMENSIONS = 3
"""Value of the NAV-PVT field `fixType` for a three-dimensional fix."""
DATE_AND_TIME = 0b011
"""Bits of the NAV-PVT field `valid` for a valid date and time."""
FIX_OK = 0b1
"""Bit of the NAV-PVT field `flags` for a valid fix."""

Kind = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Pvt:
    """Content of a NAV-PVT message in the units of the receiver.

    Attributes:
        date: UTC year, month, day, hour, minute and second.
        nano: fraction of the second to be added to the date, ns; may be negative.
        valid: validity bits of date and time.
        fix: type of the fix.
        flags: status bits of the fix.
        satellites: number of GPS satellites used in the solution.
        longitude, latitude: geodetic longitude and latitude, 1e-7 deg.
        height: height above the WGS 84 ellipsoid, mm.
        horizontal, vertical: horizontal and vertical accuracy of the position, mm.
        velocity: velocity to the north, to the east and downwards, mm/s.
        speed_accuracy: accuracy of the speed, mm/s.
    """

    date: tuple[int, int, int, int, int, int]
    nano: int
    valid: int
    fix: int
    flags: int
    satellites: int
    longitude: int
    latitude: int
    height: int
    horizontal: int
    vertical: int
    velocity: tuple[int, int, int]
    speed_accuracy: int

    def packed(self, time_of_week_ms: int = 0) -> bytes:
        """Return the payload of the NAV-PVT message."""
        north, east, _ = self.velocity
        ground = round((north * north + east * east) ** 0.5)
        return _PVT.pack(
            time_of_week_ms,
            *self.date,
            self.valid,
            30,  # time accuracy, ns
            self.nano,
            self.fix,
            self.flags,
            0,
            self.satellites,
            self.longitude,
            self.latitude,
            self.height,
            self.height,
            self.horizontal,
            self.vertical,
            *self.velocity,
            ground,
            0,
            self.speed_accuracy,
            0,
            150,  # position dilution of precision, units of 0.01
            0,
            0,
            0,
            0,
            0,
        )


def unpack_pvt(payload: bytes) -> Pvt:
    """Return the content of a NAV-PVT payload of 92 bytes."""
    values = _PVT.unpack(payload)
    (_, year, month, day, hour, minute, second, valid, _, nano, fix, flags, _, satellites) = values[:14]
    longitude, latitude, height, _, horizontal, vertical, north, east, down, _, _, accuracy = values[14:26]
    return Pvt(
        date=(year, month, day, hour, minute, second),
        nano=nano,
        valid=valid,
        fix=fix,
        flags=flags,
        satellites=satellites,
        longitude=longitude,
        latitude=latitude,
        height=height,
        horizontal=horizontal,
        vertical=vertical,
        velocity=(north, east, down),
        speed_accuracy=accuracy,
    )


def checksum(body: bytes) -> bytes:
    """Return the two checksum bytes of a frame body: class, identifier, length and payload."""
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def frame(kind: Kind, payload: bytes = b"") -> bytes:
    """Return a complete UBX frame with the given class, identifier and payload."""
    body = bytes(kind) + len(payload).to_bytes(2, "little") + payload
    return SYNC + body + checksum(body)


class UbxParser:
    """Decoder that extracts UBX frames from received bytes.

    If a candidate frame is invalid, the search continues two bytes after the candidate's start.

    Attributes:
        bytes_received: number of received bytes.
        frames: number of frames with a valid checksum.
        bad_checksum: number of frames with a wrong checksum.
        discarded_bytes: number of bytes outside valid frames.
    """

    def __init__(self, longest: int = 256) -> None:
        """Accept frames with at most `longest` bytes of payload."""
        self.bytes_received = 0
        self.frames = 0
        self.bad_checksum = 0
        self.discarded_bytes = 0
        self._longest = longest
        self._buffer = b""

    def feed(self, data: bytes) -> list[tuple[Kind, bytes, int]]:
        """Return the frames that `data` completes.

        Each frame is a tuple of kind (class and identifier), payload, and number of bytes after the frame.
        """
        self.bytes_received += len(data)
        buffer, found, position = self._buffer + data, [], 0
        while True:
            start = buffer.find(SYNC, position)
            if start < 0:
                start = len(buffer) - buffer.endswith(SYNC[:1])
            self.discarded_bytes += start - position
            position = start
            if len(buffer) - start < OVERHEAD:
                break
            length = int.from_bytes(buffer[start + 4 : start + 6], "little")
            end = start + OVERHEAD + length
            if length <= self._longest and end > len(buffer):
                break
            body = buffer[start + 2 : end - 2]
            if length > self._longest or checksum(body) != buffer[end - 2 : end]:
                self.bad_checksum += 1
                self.discarded_bytes += len(SYNC)
                position = start + len(SYNC)
                continue
            self.frames += 1
            found.append(((body[0], body[1]), body[4:], len(buffer) - end))
            position = end
        self._buffer = buffer[position:]
        return found


DEVICE = "gps"
SILENCE_NS = 3 * SECOND_NS
_BITS = 10
_SEMI_MAJOR_AXIS, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84, NGA.STND.0036
_FASTEST = 12_000.0
_HIGHEST = 3e6


class UbloxReceiver:
    """Driver of a u-blox receiver, which implements `hal.interfaces.devices.GpsReceiver`."""

    def __init__(self, port: SerialPort, clock: Clock, period_ns: int = SECOND_NS) -> None:
        """Request a fix every `period_ns`. Raises OutOfRange for a period outside 0.1 to 60 s."""
        if not 0.1 <= period_ns / SECOND_NS <= 60.0:
            raise OutOfRange(DEVICE, "period", period_ns / SECOND_NS, 0.1, 60.0, "s")
        self._port = port
        self._clock = clock
        self._period_ns = period_ns
        self._parser = UbxParser()
        self._requested_ns = -SILENCE_NS
        self._fix_arrival_ns = clock.now_ns()
        self._last_byte_ns = -1
        self._refused = self._out_of_range = 0

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Raises NotResponding if the port is lost."""
        readings = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            for kind, payload, behind in self._parser.feed(data):
                sent_ns = arrival_ns - behind * _BITS * SECOND_NS // self._port.baud_rate
                reading = self._reading(kind, payload, sent_ns)
                if reading is not None:
                    readings.append(reading)
        self._set_up()
        return readings

    def link(self) -> GpsLink:
        """Return the counters of the serial line."""
        parser = self._parser
        return GpsLink(
            bytes_received=parser.bytes_received,
            frames=parser.frames,
            bad_checksum=parser.bad_checksum,
            discarded_bytes=parser.discarded_bytes,
            out_of_range=self._out_of_range,
            refused=self._refused,
            last_byte_ns=self._last_byte_ns,
        )

    def close(self) -> None:
        """Close the serial port."""
        self._port.close()

    def _reading(self, kind: Kind, payload: bytes, arrival_ns: int) -> GpsReading | None:
        if kind == ACK_NAK:
            self._refused += 1
        if kind == NAV_PVT and len(payload) == PVT_LENGTH:
            self._fix_arrival_ns = self._clock.now_ns()
            try:
                return reading_of(unpack_pvt(payload), arrival_ns, self._port.baud_rate)
            except OutOfRange:
                self._out_of_range += 1
        return None

    def _set_up(self) -> None:
        """Configure the receiver to send only NAV-PVT.

        The request is repeated every three seconds.
        """
        now_ns = self._clock.now_ns()
        never = self._parser.frames == 0 and self._requested_ns < 0
        if (
            not never and now_ns - self._fix_arrival_ns < SILENCE_NS
        ) or now_ns - self._requested_ns < SILENCE_NS:
            return
        self._requested_ns = now_ns
        rate = (self._period_ns // 1_000_000).to_bytes(2, "little") + b"\x01\x00\x01\x00"  # time system GPS
        # Port 1 is UART 1, configured as 8N1 with UBX in both directions and without NMEA.
        port = (
            b"\x01\x00\x00\x00\xd0\x08\x00\x00" + self._port.baud_rate.to_bytes(4, "little") + b"\x01\x00" * 2
        )
        request = frame(CFG_PRT, port + b"\x00" * 4) + frame(CFG_RATE, rate)
        self._port.send(request + frame(CFG_MSG, bytes((*NAV_PVT, 1))))


def reading_of(pvt: Pvt, arrival_ns: int, baud_rate: int) -> GpsReading:
    """Return the reading of a NAV-PVT message. Raises OutOfRange for physically impossible values.

    Args:
        pvt: content of the message.
        arrival_ns: host time at which the last byte of the message was received, ns.
        baud_rate: baud rate of the serial line.
    """
    limits: tuple[tuple[str, float, float, float, str], ...] = (
        ("latitude", pvt.latitude * 1e-7, -90.0, 90.0, "deg"),
        ("longitude", pvt.longitude * 1e-7, -180.0, 180.0, "deg"),
        ("height", pvt.height * 1e-3, -1e4, _HIGHEST, "m"),
        ("speed", 1e-3 * math.hypot(*pvt.velocity), 0.0, _FASTEST, "m/s"),
    )
    for name, value, low, high, unit in limits:
        if not low <= value <= high:
            raise OutOfRange(DEVICE, name, value, low, high, unit)
    position, axes = _position(pvt)
    timed = pvt.valid & DATE_AND_TIME == DATE_AND_TIME
    return GpsReading(
        time_ns=arrival_ns - (PVT_LENGTH + OVERHEAD) * _BITS * SECOND_NS // baud_rate,
        arrival_ns=arrival_ns,
        utc_ns=_utc_ns(pvt) if timed else 0,
        position=position,
        velocity=1e-3 * np.array(pvt.velocity, dtype=float) @ axes,
        sigma=1e-3 * math.hypot(pvt.horizontal, pvt.vertical) / math.sqrt(3.0),
        velocity_sigma=1e-3 * pvt.speed_accuracy / math.sqrt(3.0),
        satellites=pvt.satellites,
        valid=timed and pvt.fix == THREE_DIMENSIONS and bool(pvt.flags & FIX_OK),
    )


def _utc_ns(pvt: Pvt) -> int:
    year, month, day, hour, minute, second = pvt.date
    try:
        # Second 60 is a leap second, which is converted to the first second of the next minute.
        whole = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC).timestamp()
    except ValueError as error:
        raise OutOfRange(DEVICE, "year", year, 1999, 2099, "") from error
    return round(whole) * SECOND_NS + (second > 59) * SECOND_NS + pvt.nano


def _position(pvt: Pvt) -> tuple[FloatArray, FloatArray]:
    """Return the ITRS position (3,), m, and the unit vectors north, east and down as rows (3, 3)."""
    longitude, latitude = math.radians(pvt.longitude * 1e-7), math.radians(pvt.latitude * 1e-7)
    co, so, ca, sa = math.cos(longitude), math.sin(longitude), math.cos(latitude), math.sin(latitude)
    squared = _FLATTENING * (2.0 - _FLATTENING)
    across = _SEMI_MAJOR_AXIS / math.sqrt(1.0 - squared * sa * sa)
    height = pvt.height * 1e-3
    out = (across + height) * ca
    position = np.array([out * co, out * so, (across * (1.0 - squared) + height) * sa])
    return position, np.array([[-sa * co, -sa * so, ca], [-so, co, 0.0], [-ca * co, -ca * so, -sa]])
