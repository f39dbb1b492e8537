"""Protocols of the devices that the flight application uses."""

from __future__ import annotations

from typing import Protocol

from hal.interfaces.readings import (
    CoilState,
    FloatArray,
    Frame,
    GpsLink,
    GpsReading,
    ImuLink,
    ImuReading,
    PowerReading,
    StringReading,
)


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

    def brake(self, axes: tuple[bool, bool, bool]) -> None:
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
