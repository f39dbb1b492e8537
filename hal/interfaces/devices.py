"""Protocols of the devices as the flight application uses them."""

from __future__ import annotations

from typing import Protocol

from hal.interfaces.readings import CoilState, FloatArray, Frame, ImuLink, ImuReading, PowerReading


class InertialUnit(Protocol):
    """Attitude, rate, field and acceleration at a steady rate."""

    def configure(self) -> None:
        """Set the unit up; may take seconds. Raises DeviceError when it does not answer or refuses."""

    def poll(self) -> list[ImuReading]:
        """Return the samples since the last call, oldest first. Never blocks.

        Raises NotResponding when the line itself is gone. Corrupt and implausible packets are
        counted in `link`.
        """

    def link(self) -> ImuLink:
        """Return the line's counters."""

    def close(self) -> None:
        """Stop and release the line."""


class TorqueCoils(Protocol):
    """Three torque coils: currents in, zero on any doubt."""

    def start(self) -> None:
        """Set the PWM chip up with every output off. Raises DeviceError when it does not answer."""

    def command(self, currents: FloatArray) -> None:
        """Ask for currents (3,) in A; limited explicitly. Never waits for the bus.

        Raises OutOfRange, and brings the coils to zero, if a value is not finite.
        """

    def brake(self, axes: tuple[bool, bool, bool]) -> None:
        """Hold both inputs of these bridges high from now on, whatever is commanded: never waits for the bus.

        A leg stuck high then drives nothing; nor does a sound bridge. Until `start` or another call.
        """

    def off(self) -> None:
        """Bring all coils to zero now, with retries; returns when written or given up.

        What is braked stays so: low inputs would let a leg that is stuck high drive its coil.
        """

    def state(self) -> CoilState:
        """Return what is on the wire."""

    def close(self) -> None:
        """Coils off, then release the bus."""


class PowerMonitor(Protocol):
    """The total coil current and power."""

    def latest(self) -> PowerReading | None:
        """Return the newest reading, None before the first."""

    def error(self) -> str:
        """Return the last failure while it lasts, empty when readings come."""

    def close(self) -> None:
        """Stop reading."""


class FrameSource(Protocol):
    """A camera that exposes when told to."""

    def trigger(self, exposure_ns: int) -> None:
        """Start one exposure now. Raises NotResponding when the camera is gone."""

    def poll(self) -> Frame | None:
        """Return the newest finished frame once, None when there is no new one. Never blocks."""

    def close(self) -> None:
        """Release the camera."""
