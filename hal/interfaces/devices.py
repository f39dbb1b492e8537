"""Protocols of the devices that the flight application uses, and the readings of these devices.

Times are integer nanoseconds of the injected clock (`hal.interfaces.wires.Clock`), so that a time grid of 25
ms stays exact for years. Arrays are float64 and must be treated as read-only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
MOST_COILS = 6
"""Largest number of coils: two sets of three, for which the telemetry packets have fields."""
COIL_NAMES = ("x", "y", "z", "4", "5", "6")
"""Names of the coils in messages, in configured order; from the fourth coil on, the names are numbers."""
Axes = frozenset[int]
"""Indices of coils in the order of `COIL_NAMES`."""
NO_AXES: Axes = frozenset()


class ImuReading(NamedTuple):
    """One sample of the inertial unit, in the body frame and the mission's reference frame.

    Attributes:
        time_ns: host time of the sample, ns, which is the packet's arrival minus the duration of its
            transmission.
        arrival_ns: host time at which the last byte of the packet was received, ns.
        device_time_ns: time of the unit's own clock since the unit was started, ns.
        quaternion: (4,) rotation of the reference frame into the body frame, scalar last.
        rate: (3,) body rate with respect to inertial space, in body axes, rad/s, or NaN if the gyro's output
            is invalid.
        field: (3,) magnetic field in body axes, T.
        acceleration: (3,) specific force in body axes, m/s^2.
    """

    time_ns: int
    arrival_ns: int
    device_time_ns: int
    quaternion: FloatArray
    rate: FloatArray
    field: FloatArray
    acceleration: FloatArray

    @property
    def has_rate(self) -> bool:
        """Whether the gyro's output is valid."""
        return math.isfinite(self.rate[0])


class ImuLink(NamedTuple):
    """Counters of the inertial unit's serial line since the start of the driver.

    The counters never decrease. If the line is silent, `last_byte_ns` does not change. If the line is
    corrupted, bytes arrive but no packets.

    Attributes:
        bytes_received: number of received bytes.
        packets: number of valid packets.
        bad_checksum: number of packets with a wrong checksum.
        discarded_bytes: number of bytes outside valid packets.
        out_of_range: number of samples with a value that is physically impossible.
        not_finite: number of samples with a value that is not finite.
        last_byte_ns: host time of the last received byte, ns; -1 before the first byte.
        rejection: quantity and value of the last sample with an invalid value, or an empty text.
        upsets: number of times that the unit restarted or had wrong settings, after which it is configured
            again.
        upset: cause of the newest of these upsets as text, or an empty text.
    """

    bytes_received: int
    packets: int
    bad_checksum: int
    discarded_bytes: int
    out_of_range: int
    not_finite: int
    last_byte_ns: int
    rejection: str = ""
    upsets: int = 0
    upset: str = ""


@dataclass(frozen=True, slots=True)
class GpsReading:
    """Navigation solution of a GPS receiver for one epoch.

    Attributes:
        time_ns: host time at which the receiver began to send, ns, up to 0.2 s after the epoch of the fix.
        arrival_ns: host time at which the last byte of the message was received, ns.
        utc_ns: UTC of the epoch, ns since 1970; 0 if the receiver does not know the time.
        position: (3,) position in the ITRS, m.
        velocity: (3,) velocity with respect to the ground, in ITRS axes, m/s.
        sigma: reported standard deviation of the position per axis, m, or NaN if unknown.
        velocity_sigma: reported standard deviation of the velocity per axis, m/s, or NaN if unknown.
        satellites: number of satellites used in the solution.
        valid: whether the receiver reports time, leap seconds and position as valid.
        rolled_over: whether the date was moved by 1024 weeks, the period of the receiver's week number.
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
    rolled_over: bool = False


@dataclass(frozen=True, slots=True)
class GpsLink:
    """Counters of the GPS receiver's serial line since the start of the driver, which never decrease.

    Attributes:
        bytes_received: number of received bytes.
        frames: number of valid frames.
        long_frames: number of valid frames with more than 256 bytes of payload.
        bad_checksum: number of frames with a wrong checksum.
        discarded_bytes: number of bytes outside valid frames.
        sentences: number of valid NMEA sentences.
        out_of_range: number of navigation solutions rejected because a value is physically impossible.
        unresolved: number of navigation solutions without a valid date, time or leap seconds.
        no_fix: number of navigation solutions without a valid fix.
        rolled_over: number of navigation solutions whose date was moved by 1024 weeks.
        refused: number of commands that the receiver rejected.
        refusal: text about the last rejected command, or an empty text.
        protocol: protocol version that the receiver reports, or 0 if unknown.
        condition: reason why no usable fix arrives, with the remedy, or an empty text.
        last_byte_ns: host time of the last received byte, ns; -1 before the first byte.
    """

    bytes_received: int = 0
    frames: int = 0
    long_frames: int = 0
    bad_checksum: int = 0
    discarded_bytes: int = 0
    sentences: int = 0
    out_of_range: int = 0
    unresolved: int = 0
    no_fix: int = 0
    rolled_over: int = 0
    refused: int = 0
    refusal: str = ""
    protocol: float = 0.0
    condition: str = ""
    last_byte_ns: int = -1


@dataclass(frozen=True, slots=True)
class StringReading:
    """Currents (n,) of the solar cell strings, A, with the host time `time_ns` of the measurement."""

    time_ns: int
    currents: FloatArray


@dataclass(frozen=True, slots=True)
class Frame:
    """Image of a camera, with the times of its exposure.

    Attributes:
        sequence: frame number assigned by the camera, by which a frozen camera is detected.
        exposure_start_ns: host time of the start of the exposure, ns.
        exposure_ns: duration of the exposure, ns.
        arrival_ns: host time at which the frame arrived, ns.
        pixels: (rows, columns) pixel values, uint8 or uint16.
    """

    sequence: int
    exposure_start_ns: int
    exposure_ns: int
    arrival_ns: int
    pixels: npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class PowerReading:
    """Measurement of the coils' supply voltage, total current and power.

    Attributes:
        time_ns: host time of the reading, ns.
        voltage: mean supply voltage over about one second, V.
        current: mean total current of the coils over about one second, A.
        power: mean power over about one second, W.
        newest: total current of the newest ADC conversion, A.
        newest_since_ns: earliest possible start of the newest ADC conversion, host time in ns.
        clipped: whether a conversion exceeded the range of the monitor, so that the true current may be
            larger.
    """

    time_ns: int
    voltage: float
    current: float
    power: float
    newest: float
    newest_since_ns: int
    clipped: bool = False


class CoilState(NamedTuple):
    """State of the coil driver: newest command and last acknowledged output.

    Attributes:
        command: (n,) requested currents of the coils, A.
        current: (n,) currents written to the PWM chip, limited and rounded to PWM counts, A.
        written_ns: host time at which `current` was first written, ns; -1 before the first write.
        saturated: whether the current of any coil was limited.
        command_ns: host time of the newest command, ns; -1 before the first command.
        stale: whether the newest command was too old, so that the driver set the coils to zero.
        faults: number of failed bus transactions since start.
        error: text of the present failure, or an empty text if the last transaction succeeded.
        braked: indices of the braked bridges. Both inputs of a braked bridge are high, so that no current
            flows even if a leg is stuck high.
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
    """Inertial unit that measures attitude, body rate, magnetic field and acceleration at a fixed rate."""

    def configure(self) -> None:
        """Configure the unit, which may take seconds.

        Raises DeviceError if the unit does not answer or refuses a command.
        """

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        Corrupted and implausible packets are counted, see `link`. Raises NotResponding if the serial port is
        lost.
        """

    def link(self) -> ImuLink:
        """Return the counters of the serial line."""

    def close(self) -> None:
        """Stop the driver and close the serial line."""


class TorqueCoils(Protocol):
    """Driver of the torque coils, which sets the currents to zero after any failure."""

    def start(self, patient: bool = False) -> None:
        """Configure the chips with all outputs off.

        Raises DeviceError if a chip does not answer. If `patient` is true, the driver keeps trying instead.
        """

    def command(self, currents: FloatArray) -> None:
        """Request the current of each coil (n,), A. Never waits for the bus.

        Currents above the limit are reduced to it. If a value is not finite, the coils are set to zero and
        OutOfRange is raised.
        """

    def brake(self, axes: Axes) -> None:
        """Brake the given bridges: hold both inputs high, whatever currents are commanded.

        Never waits for the bus. A braked bridge drives no current, even if a leg is stuck high. The
        bridges stay braked until `start` or the next call of this method.
        """

    def off(self) -> None:
        """Set all coils to zero now, and return after a successful write or after the last retry.

        Braked bridges stay braked, because a leg that is stuck high would drive its coil if the inputs were
        low.
        """

    def state(self) -> CoilState:
        """Return the newest command and the last acknowledged output."""

    def close(self) -> None:
        """Set the coils to zero and release the bus."""


class PowerMonitor(Protocol):
    """Monitor of the total current and power of the coils."""

    def latest(self) -> PowerReading | None:
        """Return the newest reading, or None before the first reading."""

    def error(self) -> str:
        """Return the text of the current failure, or an empty text while readings arrive."""

    def close(self) -> None:
        """Stop reading."""


class FrameSource(Protocol):
    """Camera that starts an exposure at each trigger."""

    def trigger(self, exposure_ns: int) -> None:
        """Start one exposure now. Raises NotResponding if the camera is lost."""

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, or None if there is no new frame. Never blocks."""

    def close(self) -> None:
        """Close the camera."""


class GpsReceiver(Protocol):
    """GPS receiver that reports position, velocity and UTC about once a second."""

    def poll(self) -> list[GpsReading]:
        """Return the readings since the last call, oldest first. Never blocks.

        Raises NotResponding if the serial port is lost.
        """

    def link(self) -> GpsLink:
        """Return the counters of the serial line."""

    def close(self) -> None:
        """Close the serial line."""


class SolarStrings(Protocol):
    """Monitor of the currents of the solar cell strings."""

    def latest(self) -> StringReading | None:
        """Return the newest reading, or None before the first reading."""

    def error(self) -> str:
        """Return the text of the current failure, or an empty text while readings arrive."""

    def close(self) -> None:
        """Stop reading."""
