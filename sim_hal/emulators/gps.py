"""Emulated GPS receivers on a serial line, with the errors of a receiver in orbit: u-blox and NMEA 0183.

The u-blox receiver starts without a configuration and sends NMEA sentences until a message enables NAV-PVT.
In orbit it has no fix until the dynamic model for high speeds is selected. Fixes are computed at UTC times
that are multiples of the period, and their frames are sent `latency` s later. The position error is a random
walk (ionosphere, ephemerides) plus white noise, and the velocity error is white noise. The NMEA receiver
sends its sentences without being configured and ignores commands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np

from hal.drivers.gps import (
    ACK_ACK,
    ACK_NAK,
    AIRBORNE_4G,
    BAUD_RATE_KEYS,
    CFG_MSG,
    CFG_NAV5,
    CFG_PRT,
    CFG_RATE,
    CFG_VALSET,
    DATE_AND_TIME,
    DYNAMIC_MODEL,
    FIX_OK,
    KNOT,
    MON_VER,
    NAV_PVT,
    PORT_KEYS,
    RANGE_ERROR,
    RATE_MEASUREMENT,
    RATE_SOLUTION,
    RATE_TIME,
    THREE_DIMENSIONS,
    UART1,
    UNKNOWN_ACCURACY,
    VALSET_PROTOCOL,
    VALUE_SIZES,
    Kind,
    Pvt,
    UbxParser,
    frame,
)
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.orientation import (
    ROTATION_RATE,
    celestial_to_terrestrial,
    geodetic,
    north_east_down,
)
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from sim_hal.clock import NEVER
from sim_hal.emulators.serial_line import DeviceEnd
from sim_hal.worlds.world import OrbitingWorld

WITHOUT_PORTS = 34.0
"""Lowest protocol version of receivers that do not have the command CFG-PRT (M10)."""
NMEA = b"$GNTXT,01,01,02,u-blox*12\r\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsErrors:
    """Errors and delays of an emulated GPS receiver.

    Attributes:
        walk: standard deviation of the position's random walk on each axis, m.
        walk_time: correlation time of the position's random walk, s.
        noise: standard deviation of the position's white noise on each axis, m.
        velocity_noise: standard deviation of the velocity's white noise on each axis, m/s.
        latency: delay from the time of a fix to the transmission of its message, s.
        start: time from power-on to the first fix, s.
    """

    walk: float = 2.0
    walk_time: float = 600.0
    noise: float = 1.0
    velocity_noise: float = 0.03
    latency: float = 0.06
    start: float = 30.0


class EmulatedGps:
    """An emulated GPS receiver.

    Attributes:
        shift: position error (3,) that a fault adds, m, ITRS.
        clock_ns: error of the reported time that a fault adds, ns.
        blind: whether a fault blocks the signals of all satellites.
        frozen: whether a fault makes the receiver repeat its last fix.
        protocol: u-blox protocol version; a receiver with version 27 or later accepts only CFG-VALSET.
        obeys: whether the receiver executes commands.
        ports: ports of the receiver, beginning with the port that is connected.
        needs_model: whether the receiver has a fix in orbit only with the dynamic model AIRBORNE_4G.
    """

    needs_model = True

    def __init__(
        self,
        world: OrbitingWorld,
        line: DeviceEnd,
        generator: np.random.Generator,
        errors: GpsErrors,
        now_ns: int = 0,
    ) -> None:
        """Connect a receiver that has been on for a long time, so that it has a fix at once."""
        self.shift: FloatArray = np.zeros(3)
        self.clock_ns = 0
        self.blind = False
        self.frozen = False
        self.protocol = 18.0
        self.obeys = True
        self.ports: tuple[int, ...] = (UART1,)
        self._world, self._line, self._generator, self._errors = world, line, generator, errors
        self._period_ns = SECOND_NS
        self._utc_offset_ns = world.utc_ns() - now_ns
        self._walk = generator.standard_normal(3)
        self._last: Pvt | None = None
        self._power(now_ns, start=0.0)

    def switch_off(self) -> None:
        """Remove the power."""
        self._epoch_ns = NEVER
        self._sending.clear()

    def switch_on(self, now_ns: int) -> None:
        """Apply power; the receiver has lost its configuration and starts to search for satellites."""
        self._power(now_ns, self._errors.start)

    def next_event_ns(self) -> int:
        """Return the time at which the receiver next measures, sends or receives."""
        sends_ns = self._sending[0][0] if self._sending else NEVER
        return min(self._epoch_ns, sends_ns, self._line.next_arrival_ns())

    def advance(self, now_ns: int) -> None:
        """Receive, measure and send everything that is due by `now_ns`."""
        if self._line.next_arrival_ns() <= now_ns:
            data = self._line.read(now_ns)
            for kind, payload, _ in self._parser.feed(data) if self._epoch_ns != NEVER else ():
                self._execute(kind, payload, now_ns)
        while self._epoch_ns <= now_ns:
            epoch_ns = self._epoch_ns
            self._epoch_ns += self._period_ns
            data = self._message(epoch_ns)
            self._sending.append((epoch_ns + round(self._errors.latency * SECOND_NS), data))
        while self._sending and self._sending[0][0] <= now_ns:
            sent_ns, data = self._sending.pop(0)
            self._line.write(data, sent_ns)

    def _message(self, epoch_ns: int) -> bytes:
        """Return the message for the fix at `epoch_ns`: NAV-PVT if enabled, otherwise NMEA sentences."""
        return frame(NAV_PVT, self._measure(epoch_ns).packed()) if self._enabled else NMEA

    def _power(self, now_ns: int, start: float) -> None:
        self._parser = UbxParser()
        self._sending: list[tuple[int, bytes]] = []
        self._enabled = False
        self._model = 0
        self._found_ns = now_ns + round(start * SECOND_NS)
        utc_ns = now_ns + self._utc_offset_ns
        self._epoch_ns = now_ns + (-utc_ns) % self._period_ns

    def _execute(self, kind: Kind, payload: bytes, now_ns: int) -> None:
        if not self.obeys:
            return
        if kind == MON_VER:
            version = f"PROTVER={self.protocol:.2f}".encode("ascii").ljust(30, b"\0")
            self._line.write(frame(MON_VER, bytes(40) + version), now_ns)
            return
        if kind == CFG_PRT and not payload and self.protocol < WITHOUT_PORTS:
            self._line.write(frame(CFG_PRT, bytes((self.ports[0], *bytes(19)))), now_ns)
            return
        older = {CFG_PRT, CFG_RATE, CFG_MSG, CFG_NAV5}
        known = kind in ({CFG_VALSET} if self.protocol >= VALSET_PROTOCOL else older)
        if known and kind == CFG_VALSET:
            known = self._set_values(payload[4:])
        if known and kind == CFG_MSG and payload[:2] == bytes(NAV_PVT):
            self._enabled = payload[-1] > 0
        if known and kind == CFG_PRT and payload[0] == self.ports[0] and payload[0] in BAUD_RATE_KEYS:
            self._line.baud_rate = int.from_bytes(payload[8:12], "little")
        if known and kind == CFG_RATE:
            self._period_ns = max(100, int.from_bytes(payload[:2], "little")) * 1_000_000
        if known and kind == CFG_NAV5 and payload[0] & 1:
            self._model = payload[2]
        self._line.write(frame(ACK_ACK if known else ACK_NAK, bytes(kind)), now_ns)

    def _set_values(self, pairs: bytes) -> bool:
        """Apply the settings of a CFG-VALSET message, which contains pairs of key and value.

        Return whether the receiver has all keys; otherwise, the receiver ignores the message.
        """
        values: dict[int, int] = {}
        while len(pairs) > 4:
            key = int.from_bytes(pairs[:4], "little")
            size = VALUE_SIZES[key >> 28]
            values[key] = int.from_bytes(pairs[4 : 4 + size], "little")
            pairs = pairs[4 + size :]
        keys = {RATE_MEASUREMENT, RATE_SOLUTION, RATE_TIME, DYNAMIC_MODEL}
        keys.update(*(PORT_KEYS[port] for port in self.ports))
        keys.update(BAUD_RATE_KEYS[port] for port in self.ports if port in BAUD_RATE_KEYS)
        if not keys >= values.keys():
            return False
        port = self.ports[0]
        self._enabled = values.get(PORT_KEYS[port][-1], self._enabled) > 0
        self._line.baud_rate = values.get(BAUD_RATE_KEYS.get(port, 0), self._line.baud_rate)
        self._model = values.get(DYNAMIC_MODEL, self._model)
        if RATE_MEASUREMENT in values:
            self._period_ns = max(100, values[RATE_MEASUREMENT]) * 1_000_000
        return True

    def _measure(self, epoch_ns: int) -> Pvt:
        if self.frozen and self._last is not None:
            return self._last
        errors = self._errors
        utc_ns = epoch_ns + self._utc_offset_ns
        keep = math.exp(-self._period_ns / SECOND_NS / errors.walk_time)
        self._walk = keep * self._walk + math.sqrt(1.0 - keep * keep) * self._generator.standard_normal(3)
        noise = self._generator.standard_normal(6)
        date = UNIX_EPOCH + utc_ns * 1e-9 / DAY
        around = self._world.surroundings()
        to_ground = celestial_to_terrestrial(date)
        exact = to_ground @ np.array(around.position)
        x, y, _ = exact.tolist()
        velocity = to_ground @ np.array(around.velocity) - ROTATION_RATE * np.array([-y, x, 0.0])
        position = exact + errors.walk * self._walk + errors.noise * noise[:3] + self.shift
        velocity = velocity + errors.velocity_noise * noise[3:]
        suits = self._model == AIRBORNE_4G or not self.needs_model
        found = suits and not self.blind and epoch_ns >= self._found_ns
        self._last = self._report(utc_ns + self.clock_ns, position, velocity, found)
        return self._last

    def _report(self, utc_ns: int, position: FloatArray, velocity: FloatArray, found: bool) -> Pvt:
        errors = self._errors
        longitude, latitude, height = (float(part) for part in geodetic(position))
        north, east, down = (1e3 * north_east_down(longitude, latitude) @ velocity).tolist()
        if not found:
            longitude = latitude = height = north = east = down = 0.0
        when = datetime.fromtimestamp(utc_ns // SECOND_NS, UTC)
        accuracy = max(1, round(1e3 * math.sqrt(2.0) * math.hypot(errors.walk, errors.noise)))
        return Pvt(
            date=(when.year, when.month, when.day, when.hour, when.minute, when.second),
            nano=utc_ns % SECOND_NS,
            valid=DATE_AND_TIME,
            fix=THREE_DIMENSIONS if found else 0,
            flags=FIX_OK if found else 0,
            satellites=11 if found else 0,
            longitude=round(math.degrees(longitude) * 1e7),
            latitude=round(math.degrees(latitude) * 1e7),
            height=round(1e3 * height),
            horizontal=accuracy if found else UNKNOWN_ACCURACY,
            vertical=accuracy if found else UNKNOWN_ACCURACY,
            velocity=(round(north), round(east), round(down)),
            speed_accuracy=max(1, round(1e3 * math.sqrt(3.0) * errors.velocity_noise)) if found else 20_000,
        )


class EmulatedNmeaGps(EmulatedGps):
    """An emulated receiver with RMC and GGA sentences instead of UBX messages."""

    needs_model = False

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
