"""Emulated GPS receiver that sends NMEA 0183 sentences by itself and ignores commands."""

from __future__ import annotations

import math
from functools import reduce
from operator import xor

from hal.drivers.nmea import KNOT, RANGE_ERROR
from hal.drivers.ublox import FIX_OK
from sim_hal.emulators.gps import EmulatedGps


class EmulatedNmeaGps(EmulatedGps):
    """An emulated receiver with RMC and GGA sentences instead of UBX messages."""

    def _message(self, epoch_ns: int) -> bytes:
        pvt = self._measure(epoch_ns)
        year, month, day, hour, minute, second = pvt.date
        clock = f"{hour:02}{minute:02}{second + pvt.nano * 1e-9:06.3f}"
        fixed = bool(pvt.flags & FIX_OK)
        latitude = _angle(pvt.latitude, 2, "NS") if fixed else ","
        longitude = _angle(pvt.longitude, 3, "EW") if fixed else ","
        place = f"{latitude},{longitude}"
        north, east, _ = pvt.velocity
        speed = (
            f"{1e-3 * math.hypot(north, east) / KNOT:.3f},{math.degrees(math.atan2(east, north)) % 360.0:.4f}"
        )
        dilution = math.hypot(self._errors.walk, self._errors.noise) / RANGE_ERROR
        height = f"{dilution:.2f},{1e-3 * pvt.height:.2f},M,0.0,M" if fixed else ",,M,,M"
        bodies = (
            f"GNRMC,{clock},{'A' if fixed else 'V'},{place},{speed if fixed else ','},"
            f"{day:02}{month:02}{year % 100:02},,,A",
            f"GNGGA,{clock},{place},{int(fixed)},{pvt.satellites:02},{height},,",
        )
        return b"".join(f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode() for body in bodies)


def _angle(value: int, digits: int, hemispheres: str) -> str:
    """Return an angle (1e-7 deg) as degrees and minutes, with its hemisphere."""
    minutes = round(abs(value) * 60e-7, 6)
    return f"{int(minutes // 60):0{digits}}{minutes % 60.0:09.6f},{hemispheres[value < 0]}"
