"""The guardian's process: listens on its line, zeroes the coils through a bus of its own.

Its arguments are the descriptor of the line, the function that opens the bus (`module:function` and its
argument) and the PWM chip's address. It ignores SIGTERM and SIGINT: they end the flight process, whose
goodbye or death ends the guardian.
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

from hal.buses import real_time
from hal.buses.clock import SystemClock
from hal.drivers.pca9685 import switch_off
from hal.guardian import line
from hal.guardian.watch import Watch
from hal.interfaces.errors import NotResponding

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
    """Listens and acts until the flight process says goodbye or dies."""

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
            self._send(line.READY)
        while not self._watch.over(self._now_ns()):
            if self._listen():
                self._switch.off()
                return
            if self._watch.attempt(self._now_ns()):
                self._zero()

    def _listen(self) -> bool:
        """Wait for a message until zero is due; return whether it was the goodbye."""
        left = max(0, self._watch.due_ns - self._now_ns()) * 1e-9
        ears = [] if self._watch.orphaned else [self._flight]
        if not select.select(ears, [], [], left)[0]:
            return False
        try:
            heard = self._flight.recv(4096)
        except ConnectionError:
            heard = b""
        if line.BYE in heard:
            return True
        if heard:
            self._watch.beat(self._now_ns())
        else:
            self._watch.orphan(self._now_ns())
        return False

    def _zero(self) -> None:
        if not self._switch.off():
            if not self._failing:
                self._send(line.FAILED)
            self._failing = True
            return
        self._failing = False
        self._watch.acknowledged()
        if self._watch.outages > self._reported:
            self._reported = self._watch.outages
            self._send(line.ACTED)

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
    real_time.prioritise(0, PRIORITY)
    real_time.lock_memory()
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as score:
        score.write("-1000")
    os.chdir("/")
