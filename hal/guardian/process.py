"""The guardian's process: receives heartbeats and zeroes the coils through a bus of its own when they stop.

The coils are zeroed from the start until the first heartbeat, and 0.3 s after the last one. Without
heartbeats zero is repeated every 0.1 s, to override a late write of the flight process or the effect of a
brown-out. The guardian stops writing zero as soon as heartbeats return.

The arguments of the process are the descriptor of the socket, the function that opens the bus
(`module:function` and its argument) and the PWM chip's address. The process ignores SIGTERM and SIGINT,
because they end the flight process, whose goodbye or death ends the guardian.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import select
import signal
import socket
import sys
from collections.abc import Callable
from typing import Protocol

from hal.buses import linux_process
from hal.buses.clock import SystemClock
from hal.drivers.pca9685 import switch_off
from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import ACTED, BYE, FAILED, READY

SILENCE_NS = 300_000_000
"""Longest gap (ns) between heartbeats before the coils are zeroed."""

REPEAT_NS = 100_000_000
"""Interval (ns) between writes of zero while heartbeats are missing."""

FINAL_ZEROS = 3
"""Number of acknowledged writes of zero after which an orphaned guardian ends."""

PATIENCE_NS = 5_000_000_000
"""Longest time (ns) for which an orphaned guardian tries to zero the coils."""


class Watch:
    """Decides when to zero the coils; times are of a monotonic clock."""

    def __init__(self, now_ns: int) -> None:
        self.orphaned = False
        """Whether the flight process died, so that no more heartbeats will arrive."""
        self.outages = 0
        """Number of times that heartbeats stopped."""
        self._beating = False
        self._due_ns = now_ns
        self._zeroed = 0
        self._last_ns = now_ns

    @property
    def due_ns(self) -> int:
        """When zero is due unless a heartbeat arrives before."""
        return self._due_ns

    def over(self, now_ns: int) -> bool:
        """Return whether the guardian may end: the flight is dead, the coils at zero or out of reach."""
        return self.orphaned and (self._zeroed >= FINAL_ZEROS or now_ns > self._last_ns)

    def beat(self, now_ns: int) -> None:
        """Accept a heartbeat."""
        self._beating = True
        self._due_ns = now_ns + SILENCE_NS

    def orphan(self, now_ns: int) -> None:
        """Note that the flight process ended without a goodbye: zero is due now."""
        self.orphaned = True
        self._zeroed = 0
        self._due_ns = now_ns
        self._last_ns = now_ns + PATIENCE_NS

    def attempt(self, now_ns: int) -> bool:
        """Return whether zero is due now; if so, schedule the next time."""
        if now_ns < self._due_ns:
            return False
        if self._beating:
            self._beating = False
            self.outages += 1
        self._due_ns = now_ns + REPEAT_NS
        return True

    def acknowledged(self) -> None:
        """Note that zero was acknowledged."""
        self._zeroed += 1


PRIORITY = 60
"""SCHED_FIFO priority, above the control loop: a loop that spins must not starve the guardian."""


class ByteWriter(Protocol):
    """The part of an I2C bus that switching the coils off needs."""

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte. Raises OSError."""

    def close(self) -> None:
        """Close the bus."""


class CoilSwitch:
    """Zeroes the coils over a bus that is reopened after each failure."""

    def __init__(self, opener: Callable[[str], ByteWriter], where: str, address: int) -> None:
        self._opener = opener
        self._where = where
        self._address = address
        self._bus: ByteWriter | None = None

    def off(self) -> bool:
        """Write zero once; return whether it was acknowledged."""
        try:
            if self._bus is None:
                self._bus = self._opener(self._where)
            # switch_off declares a whole bus, but it writes one byte.
            switch_off(self._bus, self._address, tries=1)  # type: ignore[arg-type]
        except (OSError, NotResponding):
            self.close()
            return False
        return True

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()


class Guardian:
    """Watches the heartbeat and zeroes the coils until the flight process says goodbye or dies."""

    def __init__(self, flight: socket.socket, switch: CoilSwitch, now_ns: Callable[[], int]) -> None:
        self._flight = flight
        self._switch = switch
        self._now_ns = now_ns
        self._watch = Watch(now_ns())
        self._reported = 0  # outages
        self._failing = False

    def serve(self) -> None:
        """Guard."""
        if self._switch.off():
            self._send(READY)
        while not self._watch.over(self._now_ns()):
            if self._listen():
                self._switch.off()
                return
            if self._watch.attempt(self._now_ns()):
                self._zero()

    def _listen(self) -> bool:
        """Wait for a message until zero is due; return whether it was the goodbye."""
        left = max(0, self._watch.due_ns - self._now_ns()) * 1e-9
        sockets = [] if self._watch.orphaned else [self._flight]
        if not select.select(sockets, [], [], left)[0]:
            return False
        try:
            received = self._flight.recv(4096)
        except ConnectionError:
            received = b""
        if BYE in received:
            return True
        if received:
            self._watch.beat(self._now_ns())
        else:
            self._watch.orphan(self._now_ns())
        return False

    def _zero(self) -> None:
        if not self._switch.off():
            if not self._failing:
                self._send(FAILED)
            self._failing = True
            return
        self._failing = False
        self._watch.acknowledged()
        if self._watch.outages > self._reported:
            self._reported = self._watch.outages
            self._send(ACTED)

    def _send(self, message: bytes) -> None:
        with contextlib.suppress(OSError):
            self._flight.send(message, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)


def main(arguments: list[str]) -> int:
    """Guard with the arguments LINE OPENER WHERE ADDRESS. Started by `hal.guardian.client` only."""
    descriptor, opener, where, address = arguments
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    module, _, function = opener.partition(":")
    flight = socket.socket(fileno=int(descriptor))
    switch = CoilSwitch(getattr(importlib.import_module(module), function), where, int(address))
    if not switch.off():
        sys.stderr.write(
            f"guardian: the coils' PWM chip at 0x{int(address):02x} on {where} does not answer\n"
        )
    _survive()
    Guardian(flight, switch, SystemClock().now_ns).serve()
    switch.close()
    return 0


def _survive() -> None:
    """Request to be scheduled first and killed last; go on where that is refused."""
    linux_process.prioritise(0, PRIORITY)
    linux_process.lock_memory()
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as score:
        score.write("-1000")
    os.chdir("/")
