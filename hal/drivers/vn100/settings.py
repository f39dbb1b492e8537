"""Settings of a VN-100, and a check against the limits of the unit and its line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from hal.drivers.vn100.codec import layout_of
from hal.interfaces.errors import OutOfRange, Refused
from hal.interfaces.readings import FloatArray

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
            f"rate_hz = {settings.rate_hz} is no {settings.output} output rate of the unit; "
            f"it has {', '.join(map(str, possible))}",
        )
    load = settings.rate_hz * length * 10 / baud_rate
    if load > _LINE_LOAD_LIMIT:
        raise OutOfRange(DEVICE, f"line load at {baud_rate} baud", load, 0.0, _LINE_LOAD_LIMIT, "of the line")
    if settings.unit_port not in {1, 2}:
        raise Refused(DEVICE, f"unit_port = {settings.unit_port}: the unit has serial ports 1 and 2")
