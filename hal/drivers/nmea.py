"""Driver of a GPS receiver that sends NMEA 0183 sentences by itself, about once a second.

The sentence RMC contains date, time, ground speed and course, and GGA the position with altitude, quality and
number of satellites. Two sentences RMC and GGA with the same time make a reading. NMEA does not provide a
vertical velocity; the driver computes it from the altitudes of two fixes. NMEA does not provide an accuracy
either; the driver reports the horizontal dilution of precision times an assumed range error.
"""

from __future__ import annotations

import math
import re
from functools import reduce
from operator import xor

from hal.drivers.ublox import (
    DATE_AND_TIME,
    EARLIEST_NS,
    FIX_OK,
    THREE_DIMENSIONS,
    UNKNOWN_ACCURACY,
    Pvt,
    reading_of,
)
from hal.interfaces.devices import GpsLink, GpsReading
from hal.interfaces.errors import OutOfRange
from hal.interfaces.wires import SECOND_NS, Clock, SerialPort

RANGE_ERROR = 3.0
"""Assumed standard deviation (m) of the position for a dilution of precision of 1."""
KNOT = 1852.0 / 3600.0
_SENTENCE = re.compile(rb"\$([\x20-\x23\x25-\x29\x2b-\x7e]{5,90})\*([0-9A-Fa-f]{2})\r?\n")
_LONGEST = 4096
_VERTICAL_SPEED_S = 10.0
"""Longest time (s) between two fixes from which a vertical velocity is computed."""
_NO_FIX = "the receiver has no fix: check the antenna and the view of the sky"


class NmeaReceiver:
    """Driver of an NMEA receiver, which implements `hal.interfaces.devices.GpsReceiver`."""

    def __init__(self, port: SerialPort, clock: Clock, earliest_ns: int = EARLIEST_NS) -> None:
        """Read sentences from the open `port`.

        Dates before `earliest_ns` (ns since 1970) are moved by 1024 weeks.
        """
        self._port, self._clock, self._earliest_ns = port, clock, earliest_ns
        self._buffer = b""
        self._halves: dict[str, list[str]] = {}
        self._height: tuple[float, float] | None = None  # seconds of the day and altitude (m) of the last fix
        self._bytes = self._sentences = self._bad = self._discarded = 0
        self._out_of_range = self._unresolved = self._no_fix = self._rolled_over = 0
        self._last_byte_ns = -1
        self._condition = ""

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Raises NotResponding if the port is lost."""
        readings = []
        for arrival_ns, data in self._port.receive():
            self._last_byte_ns = arrival_ns
            self._bytes += len(data)
            self._buffer += data
            taken = 0
            for found in _SENTENCE.finditer(self._buffer):
                self._discarded += found.start() - taken
                taken = found.end()
                if reduce(xor, found[1]) != int(found[2], 16):
                    self._bad += 1
                    continue
                self._sentences += 1
                reading = self._take(found[1].decode("ascii").split(","), arrival_ns, len(found[0]))
                readings += [] if reading is None else [reading]
            if len(self._buffer) - taken > _LONGEST:  # longer than any sentence
                self._discarded += len(self._buffer) - taken
                taken = len(self._buffer)
            self._buffer = self._buffer[taken:]
        return readings

    def link(self) -> GpsLink:
        """Return the counters of the serial line."""
        return GpsLink(
            bytes_received=self._bytes,
            frames=0,
            long_frames=0,
            bad_checksum=self._bad,
            discarded_bytes=self._discarded,
            sentences=self._sentences,
            out_of_range=self._out_of_range,
            unresolved=self._unresolved,
            no_fix=self._no_fix,
            rolled_over=self._rolled_over,
            refused=0,
            refusal="",
            protocol=0.0,
            condition=self._condition,
            last_byte_ns=self._last_byte_ns,
        )

    def close(self) -> None:
        """Close the serial line."""
        self._port.close()

    def _take(self, fields: list[str], arrival_ns: int, length: int) -> GpsReading | None:
        """Return the reading that a sentence completes, or None if the other sentence is missing."""
        kind = fields[0][2:]
        if kind not in {"RMC", "GGA"} or len(fields) < 10:
            return None
        other = self._halves.get("GGA" if kind == "RMC" else "RMC")
        self._halves[kind] = fields
        if other is None or other[1] != fields[1]:
            return None
        try:
            pvt = self._pvt(self._halves["RMC"], self._halves["GGA"])
            reading = reading_of(pvt, arrival_ns, self._port.baud_rate, self._earliest_ns, length)
        except (ValueError, OutOfRange) as error:
            self._out_of_range += 1
            self._condition = f"a sentence is implausible: {error}"
            return None
        self._halves.clear()
        self._unresolved += not pvt.valid
        self._no_fix += not pvt.fix
        self._rolled_over += reading.rolled_over
        self._condition = "" if reading.valid else _NO_FIX
        return reading

    def _pvt(self, rmc: list[str], gga: list[str]) -> Pvt:
        """Return the content of the sentences RMC and GGA in the units of a NAV-PVT message.

        Raises ValueError.
        """
        clock, date = rmc[1], rmc[9]
        fix = gga[6] not in {"", "0"} and rmc[2] == "A"
        known = len(date) == 6 and len(clock) >= 6
        day, month, year = (int(date[n : n + 2]) for n in (0, 2, 4)) if known else (0, 0, 0)
        hour, minute = (int(clock[n : n + 2]) for n in (0, 2)) if known else (0, 0)
        second = float(clock[4:]) if known else 0.0
        height = float(gga[9] or 0.0) + float(gga[11] or 0.0) if fix else 0.0
        speed, course = float(rmc[7] or 0.0) * KNOT, math.radians(float(rmc[8] or 0.0))
        accuracy = round(1e3 * RANGE_ERROR * float(gga[8] or 0.0)) if fix else 0
        return Pvt(
            date=(2000 + year, month, day, hour, minute, int(second)),
            nano=round(second % 1.0 * SECOND_NS),
            valid=DATE_AND_TIME if known else 0,
            fix=THREE_DIMENSIONS if fix else 0,
            flags=FIX_OK if fix else 0,
            satellites=int(gga[7] or 0),
            longitude=round(1e7 * _degrees(gga[4], gga[5])) if fix else 0,
            latitude=round(1e7 * _degrees(gga[2], gga[3])) if fix else 0,
            height=round(1e3 * height),
            horizontal=round(1.414 * accuracy) or UNKNOWN_ACCURACY,
            vertical=round(1.414 * accuracy) or UNKNOWN_ACCURACY,
            velocity=(
                round(1e3 * speed * math.cos(course)),
                round(1e3 * speed * math.sin(course)),
                round(1e3 * self._down(3600.0 * hour + 60.0 * minute + second, height)) if fix else 0,
            ),
            speed_accuracy=accuracy or UNKNOWN_ACCURACY,
        )

    def _down(self, seconds: float, height: float) -> float:
        """Return the downward velocity (m/s) from the change of the altitude, or zero if it is unknown."""
        before, self._height = self._height, (seconds, height)
        if before is None or not 0.0 < seconds - before[0] < _VERTICAL_SPEED_S:
            return 0.0
        return (before[1] - height) / (seconds - before[0])


def _degrees(text: str, hemisphere: str) -> float:
    """Return an angle (deg) written as degrees and minutes (dddmm.mmmm). Raises ValueError."""
    whole = int(float(text)) // 100
    return (whole + (float(text) - 100.0 * whole) / 60.0) * (-1.0 if hemisphere in {"S", "W"} else 1.0)
