"""A u-blox GPS receiver: NAV-PVT once in `period_ns`, set up again whenever it falls silent.

The receiver loses its set-up with its power, so the driver asks for NAV-PVT until it is acknowledged and
whenever none arrives for three seconds. Nothing here waits. Consumer receivers stop at 18 km and 515 m/s; a
satellite flies a firmware without that limit.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np

from hal.drivers.ublox.codec import (
    ACK_NAK,
    CFG_MSG,
    CFG_PRT,
    CFG_RATE,
    DATE_AND_TIME,
    FIX_OK,
    NAV_PVT,
    OVERHEAD,
    PVT_LENGTH,
    THREE_DIMENSIONS,
    Kind,
    Pvt,
    StreamParser,
    frame,
    unpack_pvt,
)
from hal.interfaces.errors import OutOfRange
from hal.interfaces.readings import FloatArray, GpsLink, GpsReading
from hal.interfaces.wires import SECOND_NS, Clock, SerialPort

DEVICE = "gps"
SILENCE_NS = 3 * SECOND_NS
_BITS = 10
_SEMI_MAJOR_AXIS, _FLATTENING = 6_378_137.0, 1.0 / 298.257223563  # WGS 84, NGA.STND.0036
_FASTEST = 12_000.0
_HIGHEST = 3e6


class UbloxReceiver:
    """The receiver on a serial port; implements `hal.interfaces.devices.GpsReceiver`."""

    def __init__(self, port: SerialPort, clock: Clock, period_ns: int = SECOND_NS) -> None:
        """Ask for a fix every `period_ns`. Raises OutOfRange for a period that the receiver does not take."""
        if not 0.1 <= period_ns / SECOND_NS <= 60.0:
            raise OutOfRange(DEVICE, "period", period_ns / SECOND_NS, 0.1, 60.0, "s")
        self._port = port
        self._clock = clock
        self._period_ns = period_ns
        self._parser = StreamParser()
        self._asked_ns = -SILENCE_NS
        self._heard_ns = clock.now_ns()
        self._last_byte_ns = self._last_fix_ns = -1
        self._refused = self._out_of_range = 0

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Raises NotResponding for a lost port."""
        readings = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            for kind, payload, behind in self._parser.feed(data):
                sent_ns = arrival_ns - behind * _BITS * SECOND_NS // self._port.baud_rate
                reading = self._taken(kind, payload, sent_ns)
                if reading is not None:
                    readings.append(reading)
        self._set_up()
        return readings

    def link(self) -> GpsLink:
        """Return the line's counters."""
        parser = self._parser
        return GpsLink(
            bytes_received=parser.bytes_received,
            frames=parser.frames,
            bad_checksum=parser.bad_checksum,
            discarded_bytes=parser.discarded_bytes,
            out_of_range=self._out_of_range,
            refused=self._refused,
            last_byte_ns=self._last_byte_ns,
            last_fix_ns=self._last_fix_ns,
        )

    def close(self) -> None:
        """Release the port."""
        self._port.close()

    def _taken(self, kind: Kind, payload: bytes, arrival_ns: int) -> GpsReading | None:
        if kind == ACK_NAK:
            self._refused += 1
        if kind == NAV_PVT and len(payload) == PVT_LENGTH:
            self._heard_ns = self._clock.now_ns()
            try:
                reading = reading_of(unpack_pvt(payload), arrival_ns, self._port.baud_rate)
            except OutOfRange:
                self._out_of_range += 1
                return None
            if reading.valid:
                self._last_fix_ns = arrival_ns
            return reading
        return None

    def _set_up(self) -> None:
        """Ask for NAV-PVT alone while none arrives, at most once in three seconds."""
        now_ns = self._clock.now_ns()
        never = self._parser.frames == 0 and self._asked_ns < 0
        if (not never and now_ns - self._heard_ns < SILENCE_NS) or now_ns - self._asked_ns < SILENCE_NS:
            return
        self._asked_ns = now_ns
        rate = (self._period_ns // 1_000_000).to_bytes(2, "little") + b"\x01\x00\x01\x00"  # GPS time
        # Port 1 is UART 1: 8N1, UBX in and out, no NMEA.
        port = (
            b"\x01\x00\x00\x00\xd0\x08\x00\x00" + self._port.baud_rate.to_bytes(4, "little") + b"\x01\x00" * 2
        )
        request = frame(CFG_PRT, port + b"\x00" * 4) + frame(CFG_RATE, rate)
        self._port.send(request + frame(CFG_MSG, bytes((*NAV_PVT, 1))))


def reading_of(pvt: Pvt, arrival_ns: int, baud_rate: int) -> GpsReading:
    """Return a reading; raises OutOfRange for values that no receiver in orbit or on the ground has."""
    limits: tuple[tuple[str, float, float, float, str], ...] = (
        ("latitude", pvt.latitude * 1e-7, -90.0, 90.0, "deg"),
        ("longitude", pvt.longitude * 1e-7, -180.0, 180.0, "deg"),
        ("height", pvt.height * 1e-3, -1e4, _HIGHEST, "m"),
        ("speed", 1e-3 * math.hypot(*pvt.velocity), 0.0, _FASTEST, "m/s"),
    )
    for name, value, low, high, unit in limits:
        if not low <= value <= high:
            raise OutOfRange(DEVICE, name, value, low, high, unit)
    position, axes = _on_the_ground(pvt)
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
        # A leap second is 60: it is the first of the next minute.
        whole = datetime(year, month, day, hour, minute, min(second, 59), tzinfo=UTC).timestamp()
    except ValueError as error:
        raise OutOfRange(DEVICE, "year", year, 1999, 2099, "") from error
    return round(whole) * SECOND_NS + (second > 59) * SECOND_NS + pvt.nano


def _on_the_ground(pvt: Pvt) -> tuple[FloatArray, FloatArray]:
    """Return the place (3,) m, ITRS, and the rows north, east and down there (3, 3)."""
    longitude, latitude = math.radians(pvt.longitude * 1e-7), math.radians(pvt.latitude * 1e-7)
    co, so, ca, sa = math.cos(longitude), math.sin(longitude), math.cos(latitude), math.sin(latitude)
    squared = _FLATTENING * (2.0 - _FLATTENING)
    across = _SEMI_MAJOR_AXIS / math.sqrt(1.0 - squared * sa * sa)
    height = pvt.height * 1e-3
    out = (across + height) * ca
    place = np.array([out * co, out * so, (across * (1.0 - squared) + height) * sa])
    return place, np.array([[-sa * co, -sa * so, ca], [-so, co, 0.0], [-ca * co, -ca * so, -sa]])
