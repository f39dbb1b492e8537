"""Protocols of the devices that the flight application uses, and their readings.

Times are integer nanoseconds of the injected clock (`hal.interfaces.wires.Clock`), so a grid of 25 ms stays
exact for years. Arrays are float64 and must be treated as read-only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Axes = tuple[bool, bool, bool]
"""One flag for each coil."""
NO_AXES: Axes = (False, False, False)


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One sample of the inertial unit, in the body frame and the mission's reference frame.

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
    """Counters of the inertial unit's line since start; they only grow, so differences give rates.

    On a silent line `last_byte_ns` does not change; on a corrupt one bytes arrive without packets.
    `last_byte_ns` is -1 before the first byte.
    """

    bytes_received: int
    packets: int
    bad_checksum: int
    discarded_bytes: int
    out_of_range: int
    not_finite: int
    last_byte_ns: int


@dataclass(frozen=True, slots=True)
class GpsReading:
    """One epoch of a GPS receiver.

    Attributes:
        time_ns: host clock when the receiver began to send; the epoch itself is up to 0.2 s older.
        arrival_ns: host clock when the last byte was received.
        utc_ns: UTC of the epoch, ns since 1970; 0 if the receiver does not know the time.
        position: (3,) m, ITRS.
        velocity: (3,) m/s with respect to the ground, ITRS.
        sigma: reported standard deviation per axis, m; `velocity_sigma` in m/s.
        satellites: number of satellites in use.
        valid: whether the receiver reports time and position as valid.
    """

    time_ns: int
    arrival_ns: int
    utc_ns: int
    position: FloatArray
    velocity: FloatArray
    sigma: float
    velocity_sigma: float
    satellites: int
    valid: bool


@dataclass(frozen=True, slots=True)
class GpsLink:
    """Counters of the receiver's line since start; they only grow. `last_byte_ns` is -1 before any byte.

    `refused` counts commands that the receiver rejected, `out_of_range` impossible epochs.
    """

    bytes_received: int
    frames: int
    bad_checksum: int
    discarded_bytes: int
    out_of_range: int
    refused: int
    last_byte_ns: int


@dataclass(frozen=True, slots=True)
class StringReading:
    """Currents (n,) A of the solar strings at `time_ns` of the host clock."""

    time_ns: int
    currents: FloatArray


@dataclass(frozen=True, slots=True)
class Frame:
    """One image: `pixels` is (rows, columns), uint8 or uint16; times are of the host clock.

    The exposure lasts `exposure_ns` from `exposure_start_ns`; `sequence` is the camera's own count, which
    reveals a frozen camera.
    """

    sequence: int
    exposure_start_ns: int
    exposure_ns: int
    arrival_ns: int
    pixels: npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class PowerReading:
    """A measurement of bus voltage (V), total current of the coils (A) and power (W).

    The values are means over about a second; `newest` (A) is the current of the last conversion alone, whose
    window lies between `newest_since_ns` and `time_ns`. `clipped`: a conversion was beyond the monitor's
    range, so the currents are at least these.
    """

    time_ns: int
    voltage: float
    current: float
    power: float
    newest: float
    newest_since_ns: int
    clipped: bool = False


@dataclass(frozen=True, slots=True)
class CoilState:
    """The coil driver's last command and last acknowledged output.

    Attributes:
        command: (3,) A, as requested, finite.
        current: (3,) A, as written, after limiting and rounding to PWM counts; zeros when off.
        written_ns: host clock since when that current is on the wire, -1 before the first.
        saturated: whether any axis was limited.
        command_ns: host clock of the newest command, -1 before the first.
        stale: the command was too old, so the driver brought the coils to zero.
        faults: failed transactions since start.
        error: the text of the last failure while it lasts, empty when the last transaction succeeded.
        braked: (3,) bridges with both inputs high, so that a leg stuck high drives no current.
    """

    command: FloatArray
    current: FloatArray
    written_ns: int
    saturated: bool
    command_ns: int
    stale: bool
    faults: int
    error: str
    braked: Axes = NO_AXES


class InertialUnit(Protocol):
    """Measures attitude, rate, field and acceleration at a steady rate."""

    def configure(self) -> None:
        """Set the unit up; may take seconds. Raises DeviceError when the unit does not answer or refuses."""

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        Raises NotResponding when the line itself is lost. Corrupt and implausible packets are
        counted in `link`.
        """

    def link(self) -> ImuLink:
        """Return the line's counters."""

    def close(self) -> None:
        """Stop and release the line."""


class TorqueCoils(Protocol):
    """Three torque coils; any failure leads to zero current."""

    def start(self) -> None:
        """Set the PWM chip up with every output off. Raises DeviceError when it does not answer."""

    def command(self, currents: FloatArray) -> None:
        """Request currents (3,) in A; values beyond the limit are limited. Never waits for the bus.

        Raises OutOfRange, and brings the coils to zero, if a value is not finite.
        """

    def brake(self, axes: Axes) -> None:
        """Hold both inputs of these bridges high from now on, whatever is commanded: never waits for the bus.

        A bridge then drives no current, even with a leg stuck high. Valid until `start` or another call.
        """

    def off(self) -> None:
        """Bring all coils to zero now, with retries; returns when written or given up.

        Braked bridges stay braked: with low inputs a leg that is stuck high would drive its coil.
        """

    def state(self) -> CoilState:
        """Return what is on the wire."""

    def close(self) -> None:
        """Bring the coils to zero, then release the bus."""


class PowerMonitor(Protocol):
    """Measures the total coil current and power."""

    def latest(self) -> PowerReading | None:
        """Return the newest reading, None before the first."""

    def error(self) -> str:
        """Return the last failure while it lasts, empty when readings arrive."""

    def close(self) -> None:
        """Stop reading."""


class FrameSource(Protocol):
    """A camera that exposes on a trigger."""

    def trigger(self, exposure_ns: int) -> None:
        """Start one exposure now. Raises NotResponding when the camera is lost."""

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, None without a new one. Never blocks."""

    def close(self) -> None:
        """Release the camera."""


class GpsReceiver(Protocol):
    """Reports where the satellite is, and the time, about once a second."""

    def poll(self) -> list[GpsReading]:
        """Return the epochs since the last call, oldest first. Never blocks.

        Raises NotResponding when the line itself is lost.
        """

    def link(self) -> GpsLink:
        """Return the line's counters."""

    def close(self) -> None:
        """Release the line."""


class SolarStrings(Protocol):
    """Measures the currents of the solar strings."""

    def latest(self) -> StringReading | None:
        """Return the newest reading, None before the first."""

    def error(self) -> str:
        """Return the last failure while it lasts, empty when readings arrive."""

    def close(self) -> None:
        """Stop reading."""
