"""Protocols at the wire: clock, serial port, I2C bus, and the rig that holds them.

hal implements these Protocols on Linux, sim_hal with emulated devices. Flight and simulation differ only
below these Protocols, so every simulated run exercises the flight drivers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from hal.interfaces.devices import FrameSource
from hal.interfaces.guardian import CoilReach

SECOND_NS = 1_000_000_000


class Ticker(Protocol):
    """A small job that a clock runs periodically beside the control loop."""

    @property
    def name(self) -> str:
        """The job's name."""

    @property
    def period_ns(self) -> int:
        """The period of the job, unless kicked."""

    @property
    def error(self) -> str:
        """The exception of the last run as text, empty when it completed."""

    @property
    def served_ns(self) -> int:
        """When a run last completed, or when the ticker was made."""

    def kick(self) -> None:
        """Run the job as soon as possible, without waiting for its next period."""

    def stop(self) -> None:
        """Stop running the job; returns when it is not running. Safe to call twice."""


class Clock(Protocol):
    """Monotonic time in integer nanoseconds; the only source of time."""

    def now_ns(self) -> int:
        """Return the monotonic time."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at or after the deadline; at once if it has passed."""

    def ticker(self, name: str, period_ns: int, job: Callable[[], None]) -> Ticker:
        """Run `job` every `period_ns`, beside the caller: on a thread in real time, in turn in simulation.

        A job must not block for long and must be safe beside the control loop. The ticker reports a job that
        raises, and runs it again in its next period.
        """

    @property
    def tickers(self) -> Sequence[Ticker]:
        """The running tickers, in the order in which they were made."""

    def utc_ns(self) -> int:
        """Return UTC as nanoseconds since 1970: a label for telemetry, never an input of control."""


class SerialPort(Protocol):
    """A byte line. Receiving never blocks; each chunk carries the host time of its last byte."""

    baud_rate: int

    def receive(self) -> list[tuple[int, bytes]]:
        """Return what arrived since the last call as (arrival_ns, bytes), oldest first.

        Raises NotResponding when the port itself is lost.
        """

    def send(self, data: bytes) -> None:
        """Queue bytes for sending. Raises NotResponding when the port is lost."""

    def set_baud_rate(self, baud_rate: int) -> None:
        """Change the line's speed."""

    def close(self) -> None:
        """Close the port. Safe to call twice."""


class I2cBus(Protocol):
    """The part of smbus2's interface that the drivers use; one transaction per call.

    Every call raises OSError (with the errno of the kernel's I2C fault codes) when the bus or the device does
    not answer, and always returns within the bus's time-out. Safe to call from several threads.
    """

    def write_byte(self, address: int, value: int) -> None:
        """Write one byte without a register, as to the general call address 0."""

    def read_byte_data(self, address: int, register: int) -> int:
        """Read one byte."""

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte."""

    def read_i2c_block_data(self, address: int, register: int, length: int) -> list[int]:
        """Read `length` <= 32 bytes."""

    def write_i2c_block_data(self, address: int, register: int, values: Sequence[int]) -> None:
        """Write up to 32 bytes."""

    def close(self) -> None:
        """Close the bus. Safe to call twice."""


@dataclass(frozen=True, slots=True)
class Wires:
    """The connections of the drivers: the inertial unit's serial line, one I2C bus, and a camera or None.

    A satellite has a GPS receiver's serial line and wide cameras besides.
    """

    serial: SerialPort
    i2c: I2cBus
    frames: FrameSource | None
    gps: SerialPort | None = None
    wide: tuple[FrameSource, ...] = ()


class HostFaults(Protocol):
    """Simulated faults inside the flight process itself: its workers and its disk."""

    def workers(self, specs: Sequence[Any]) -> list[Any]:
        """Return the worker specifications with functions that may fail."""

    def jobs(self, runner: Any, specs: Sequence[Any], result: Callable[..., Any]) -> Any:
        """Return a job runner before `runner` that may fail; `result` makes a job's result."""

    def opener(self, opener: Callable[[Path], Any]) -> Callable[[Path], Any]:
        """Return an opener of files on a disk that may fail."""


@dataclass(frozen=True, slots=True)
class Rig:
    """The clock, the wires and other values that depend on the kind of hardware.

    Attributes:
        release: function that is called with mission time zero.
        latency: latencies of planner and vision, ns, in lock-step only.
        reach: access of the guardian to the coils, in real time only.
        host: simulated faults inside this process, if any.
    """

    clock: Clock
    wires: Wires
    release: Callable[[int], None]
    realtime: bool
    seed: int
    latency: tuple[int, int] = (0, 0)
    reach: CoilReach | None = None
    host: HostFaults | None = None
