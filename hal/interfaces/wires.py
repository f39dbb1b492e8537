"""Protocols of the connections to the hardware: clock, serial port, I2C bus, and the rig that contains them.

The package hal implements these Protocols on Linux, and sim_hal implements them with emulated devices. Flight
and simulation use the same software on top of these Protocols, so that each simulated run executes the flight
drivers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hal.interfaces.devices import FrameSource
from hal.interfaces.guardian import CoilReach

SECOND_NS = 1_000_000_000
LATE_NS = 25_000_000
"""Smallest lateness (ns) of an emulated device that affects a flight: the period of a control cycle."""


class Ticker(Protocol):
    """Short job that a clock runs periodically, in parallel with the control loop.

    Attributes:
        name: name of the periodic job.
        period_ns: period of the job, ns; the method `kick` runs the job earlier.
        error: exception of the last run as text, or an empty text if the run succeeded.
        served_ns: time (ns) at which a run last succeeded, initially the time of creation.
    """

    name: str
    period_ns: int
    error: str
    served_ns: int

    def kick(self) -> None:
        """Run the job as soon as possible, without waiting for the next period."""

    def stop(self) -> None:
        """Stop the job and return when no run is in progress. Calling `stop` again has no effect."""


class Clock(Protocol):
    """Clock of the flight software, with monotonic time in integer nanoseconds.

    All modules get the time from such a clock.
    """

    def now_ns(self) -> int:
        """Return the monotonic time, ns."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep until the monotonic time `deadline_ns`. Return at once if the deadline has passed."""

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns`, in a separate thread or, in a simulation, interleaved with the caller.

        A job must be thread-safe and must not block for long. If a job raises an exception, the ticker stores
        the exception and runs the job again in the next period.
        """

    @property
    def tickers(self) -> Sequence[Ticker]:
        """Running tickers in the order of their creation."""

    def utc_ns(self) -> int:
        """Return UTC in ns since 1970. UTC may jump, so the control loop never measures time by it."""


class SerialPort(Protocol):
    """Serial port. Receiving never blocks, and received data carry the host time of their arrival."""

    baud_rate: int

    def receive(self) -> list[tuple[int, bytes]]:
        """Return the data received since the last call as tuples (arrival_ns, bytes), oldest first.

        The time `arrival_ns` is the host time of the last byte. Raises NotResponding if the port is lost.
        """

    def send(self, data: bytes) -> None:
        """Queue bytes for sending. Raises NotResponding if the port is lost, or OutputFull."""

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the baud rate of the port."""

    def close(self) -> None:
        """Close the port. Calling `close` again has no effect."""


class I2cBus(Protocol):
    """I2C bus with those methods of smbus2 that the drivers use. Each call is one bus transaction.

    A call returns within the timeout of the bus, and raises OSError with the kernel's I2C fault code if the
    bus or device does not answer. The methods are thread-safe.
    """

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte to a device without a register address, for example to general call address 0."""

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte from a register of a device."""

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte to a register of a device."""

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read `length` bytes, at most 32, from consecutive registers of a device."""

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write at most 32 bytes to consecutive registers of a device."""

    def close(self) -> None:
        """Close the bus. Calling `close` again has no effect."""


class RawI2cBus(I2cBus, Protocol):
    """I2C bus that also executes transactions without a register address."""

    def exchange(self, address: int, data: bytes, count: int) -> bytes:
        """Write `data` (if not empty) and read `count` bytes (if not 0) in one transaction."""


class SpiDevice(Protocol):
    """One device on an SPI bus, which is selected by its chip select line during each frame."""

    def transfer(self, frames: Sequence[bytes]) -> list[bytes]:
        """Send frames one after the other, and return the bytes received during each frame.

        Raises OSError if the transfer fails.
        """


class Wires(Protocol):
    """Connections to real or emulated devices, opened by name.

    A second request for a connection returns the open connection, or opens a serial port again that its
    driver has closed. All connections are closed at the end of the flight.
    """

    def serial(self, device: str, baud_rate: int) -> SerialPort:
        """Return the serial port of a device file. Raises NotResponding if the port cannot be opened."""

    def i2c(self, bus: int | str | None = None) -> RawI2cBus:
        """Return the I2C bus with the number or device file `bus`, or the coils' bus if `bus` is None.

        Raises DeviceError if the bus cannot be opened.
        """

    def spi(self, device: str, speed_hz: int, mode: int) -> SpiDevice:
        """Return a device on an SPI bus, for example `/dev/spidev0.0`. Raises DeviceError."""


class HostFaults(Protocol):
    """Simulated faults inside the flight process, in its workers and file operations."""

    def workers(self, specs: Sequence[Any]) -> list[Any]:
        """Return copies of the worker specifications whose functions fail during simulated faults."""

    def jobs(self, runner: Any, specs: Sequence[Any], result: Callable[..., Any]) -> Any:
        """Return a job runner that wraps `runner` and fails during simulated faults.

        The function `result` creates a job result.
        """

    def opener(self, opener: Callable[[Path], Any]) -> Callable[[Path], Any]:
        """Return a file opener that wraps `opener` and fails like a faulty disk during simulated faults."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Hardware or simulation on which the flight software runs: clock, connections and settings.

    Attributes:
        clock: clock of the flight software.
        wires: connections to the devices.
        release: function called with the clock time of mission time zero, ns, when the flight starts.
        realtime: whether the flight runs in real time; otherwise it is a lock-step simulation.
        seed: seed of the simulation, or 0 on hardware.
        latency: simulated latencies of planner and vision (ns), used in a lock-step simulation only.
        reach: how the guardian accesses the coils, used in real time only.
        host: simulated faults inside the flight process, or None.
        cameras: emulated cameras, first the star camera (None if not fitted), or None for real cameras.
        earliest_utc_ns: earliest possible UTC (ns since 1970) of the flight, which resolves the ambiguous
            week number of a GPS receiver.
        lateness: function that returns how often emulated devices were later than `LATE_NS`, and their
            largest lateness, s. It is None unless emulated devices run in real time.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)
    reach: CoilReach | None = None
    host: HostFaults | None = None
    cameras: tuple[FrameSource | None, ...] | None = None
    earliest_utc_ns: int = 0
    lateness: Callable[[], tuple[int, float]] | None = None
