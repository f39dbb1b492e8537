"""The values that devices give: each with its time, its arrival and its validity.

Times are nanoseconds of the injected clock (`hal.interfaces.wires.Clock`), integers, so that a grid of
25 ms stays a grid for years. Arrays are float64 and must be treated as read-only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One sample of the inertial unit, already in the body frame and the reference frame of the mission.

    Attributes:
        time_ns: host clock at the instant of the sample (arrival less the time on the wire).
        arrival_ns: host clock when the last byte of the packet was received.
        device_time_ns: the unit's own clock, since its start-up.
        quaternion: (4,) scalar last, reference frame into body.
        rate: (3,) rad/s, body with respect to inertial, body axes.
        field: (3,) tesla, body axes.
        acceleration: (3,) m/s^2, specific force, body axes.
    """

    time_ns: int
    arrival_ns: int
    device_time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    field: FloatArray
    acceleration: FloatArray


@dataclass(frozen=True, slots=True)
class ImuLink:
    """Counters of the inertial unit's line since start: they only grow, so a rate is their difference.

    Silence is `last_byte_ns` standing still; corruption is bytes arriving without packets.
    `last_byte_ns` and `last_packet_ns` are -1 before the first.
    """

    bytes_received: int
    packets: int
    bad_checksum: int
    discarded_bytes: int
    out_of_range: int
    not_finite: int
    last_byte_ns: int
    last_packet_ns: int


@dataclass(frozen=True, slots=True)
class Frame:
    """One image: `pixels` is (rows, columns), uint8 or uint16; times are of the host clock.

    The exposure runs from `exposure_start_ns` for `exposure_ns`; `sequence` is the camera's own count,
    by which a frozen camera is known.
    """

    sequence: int
    exposure_start_ns: int
    exposure_ns: int
    arrival_ns: int
    pixels: npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class PowerReading:
    """What the current monitor measured: bus voltage (V), current of all coils together (A), power (W).

    They are means over about a second; `newest` A is the last conversion's current alone, of a window that
    lies between `newest_since_ns` and `time_ns`.
    """

    time_ns: int
    voltage: float
    current: float
    power: float
    newest: float
    newest_since_ns: int


@dataclass(frozen=True, slots=True)
class CoilState:
    """What the coil driver last put on the wire.

    Attributes:
        command: (3,) A, as asked for, finite.
        current: (3,) A, as written after saturation and the resolution of the PWM chip; zeros when off.
        written_ns: host clock since when that current is on the wire, -1 before the first.
        saturated: whether any axis was limited.
        command_ns: host clock of the newest command, -1 before the first.
        stale: the command was too old and the driver has let the coils decay to zero.
        faults: failed transactions since start.
        error: the text of the last failure while it lasts, empty when the last transaction succeeded.
        braked: (3,) which bridges have both inputs high, so that a leg stuck high drives nothing.
    """

    command: FloatArray
    current: FloatArray
    written_ns: int
    saturated: bool
    command_ns: int
    stale: bool
    faults: int
    error: str
    braked: tuple[bool, bool, bool] = (False, False, False)
