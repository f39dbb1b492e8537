"""The guardian: a small process that sets the coils to zero when the control loop's heartbeats stop.

The guardian has its own connection to the I2C bus. The guardian sets the coils to zero from its start until
the first heartbeat, and 0.3 s after the last heartbeat. While heartbeats are missing, zero is written again
every 0.1 s, to override a late write by the flight process or the effect of a brown-out. When heartbeats
arrive again, the guardian stops writing zero. The guardian ignores SIGTERM and SIGINT, and ends only when the
flight process sends the goodbye message or dies. Neither this module nor its imports use numpy, so that the
guardian starts within a few hundredths of a second and needs little memory.

`GuardianLine` runs in the flight process. `GuardianLine` starts the guardian before the coils can be
energised, sends the heartbeats, and replaces a guardian that dies or stops reading. Sending a heartbeat never
blocks: a heartbeat is one byte, which is dropped if it cannot be written at once.

The flight process starts the guardian by the following command:

    python -S -E -m hal.guardian DESCRIPTOR OPENER WHERE NUMBER...

DESCRIPTOR is the descriptor of the socket to the flight process. OPENER is the function (`module:function`)
that opens the bus, and WHERE is the function's argument. The numbers are the address, register and value of
each I2C write that switches the coils off.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from hal.buses import system
from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import ACTED, BEAT, BYE, FAILED, READY, CoilReach, GuardianNews

SILENCE_NS = 300_000_000
"""Longest gap (ns) between heartbeats before the coils are zeroed."""

REPEAT_NS = 100_000_000
"""Interval (ns) between writes of zero while heartbeats are missing."""

FINAL_ZEROS = 3
"""Number of acknowledged zero writes after which the guardian ends, if the flight process has died."""

PATIENCE_NS = 5_000_000_000
"""Longest time (ns) for which the guardian tries to zero the coils after the flight process has died."""


class Watch:
    """Decides when to set the coils to zero, from the times (monotonic clock, ns) of the heartbeats."""

    def __init__(self, now_ns: int) -> None:
        self.orphaned = False
        """Whether the flight process has ended without a goodbye message."""
        self.outages = 0
        """Number of times that the heartbeats have stopped."""
        self.due_ns = now_ns
        """Time (ns) at which the next write of zero is due, unless a heartbeat arrives earlier."""
        self._beating = False
        self._zeroed = 0
        self._last_ns = now_ns

    def over(self, now_ns: int) -> bool:
        """Return whether the guardian may end.

        The guardian may end if the flight process is dead, and the coils are at zero or have not answered for
        `PATIENCE_NS`.
        """
        return self.orphaned and (self._zeroed >= FINAL_ZEROS or now_ns > self._last_ns)

    def beat(self, now_ns: int) -> None:
        """Record a heartbeat."""
        self._beating = True
        self.due_ns = now_ns + SILENCE_NS

    def orphan(self, now_ns: int) -> None:
        """Record that the flight process ended without a goodbye message; a write of zero is due now."""
        self.orphaned = True
        self._zeroed = 0
        self.due_ns = now_ns
        self._last_ns = now_ns + PATIENCE_NS

    def attempt(self, now_ns: int) -> bool:
        """Return whether a write of zero is due now, and if so, schedule the next write."""
        if now_ns < self.due_ns:
            return False
        if self._beating:
            self._beating = False
            self.outages += 1
        self.due_ns = now_ns + REPEAT_NS
        return True

    def acknowledged(self) -> None:
        """Record that the PWM chip acknowledged a write of zero."""
        self._zeroed += 1


PRIORITY = 60
"""SCHED_FIFO priority of the guardian, higher than the priority of the control loop."""


class ByteWriter(Protocol):
    """Interface of an I2C bus that is sufficient to switch the coils off."""

    def write_byte_data(self, address: int, register: int, value: int) -> None:
        """Write one byte to a register of a device. Raises OSError."""

    def close(self) -> None:
        """Close the bus."""


class CoilSwitch:
    """Switch that sets the coils to zero over an I2C bus, which is reopened after each failure."""

    def __init__(self, opener: Callable[[str], ByteWriter], where: str, numbers: Sequence[int]) -> None:
        """Use I2C writes that consist of three `numbers` each: address, register and value."""
        self._opener, self._where = opener, where
        self._writes = tuple(zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True))
        self._bus: ByteWriter | None = None

    def off(self) -> bool:
        """Execute each write once and return whether the chips acknowledged all of them."""
        acknowledged = True
        for write in self._writes:
            try:
                if self._bus is None:
                    self._bus = self._opener(self._where)
                self._bus.write_byte_data(*write)
            except OSError:
                self.close()
                acknowledged = False
        return acknowledged

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()


class Guardian:
    """Guardian loop, which monitors the heartbeats until the flight process ends."""

    def __init__(self, flight: socket.socket, switch: CoilSwitch, now_ns: Callable[[], int]) -> None:
        self._flight, self._switch, self._now_ns = flight, switch, now_ns
        self._watch = Watch(now_ns())
        self._reported = 0  # number of reported outages of the heartbeats
        self._failing = self._is_ready = False

    def serve(self) -> None:
        """Run the guardian until the flight process sends the goodbye message or dies."""
        self._zero()
        while not self._watch.over(self._now_ns()):
            if self._listen():
                self._switch.off()
                return
            if self._watch.attempt(self._now_ns()):
                self._zero()

    def _listen(self) -> bool:
        """Wait for messages until a write of zero is due; return whether the goodbye message arrived."""
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
        if not self._is_ready:
            self._is_ready = True
            self._send(READY)
        if self._watch.outages > self._reported:
            self._reported = self._watch.outages
            self._send(ACTED)

    def _send(self, message: bytes) -> None:
        with contextlib.suppress(OSError):
            self._flight.send(message, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)


def main(arguments: list[str]) -> int:
    """Run the guardian with the arguments DESCRIPTOR OPENER WHERE NUMBER..., as `GuardianLine` starts it."""
    descriptor, opener, where, *numbers = arguments
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    module, _, function = opener.partition(":")
    flight = socket.socket(fileno=int(descriptor))
    opened = getattr(importlib.import_module(module), function)
    switch = CoilSwitch(opened, where, [int(number, 0) for number in numbers])
    if not switch.off():
        with contextlib.suppress(OSError):
            sys.stderr.write(f"guardian: the coils' chip at {numbers[0]} on {where} does not answer\n")
            sys.stderr.flush()
    # The guardian also works without real-time priority, locked memory and protection from the OOM killer.
    system.prioritise(0, PRIORITY)
    system.lock_memory()
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as score:
        score.write("-1000")
    os.chdir("/")
    Guardian(flight, switch, system.SystemClock().now_ns).serve()
    switch.close()
    return 0


DEVICE = "guardian"
_ROOT = Path(__file__).resolve().parents[1]
_QUEUE_BYTES = 16384  # send buffer (bytes) for about one second of heartbeats, including kernel overhead
_RETRY_NS = 1_000_000_000
_END_TIMEOUT_S = 0.5


_NEWS = {READY: GuardianNews.READY, ACTED: GuardianNews.ACTED, FAILED: GuardianNews.FAILED}


class GuardianLine:
    """Connection of the flight process to a running guardian. Only one thread may use this object."""

    def __init__(self, reach: CoilReach) -> None:
        """Start the guardian without waiting until the guardian is ready."""
        self._reach = reach
        self._lost = False
        self._retry_ns = 0
        self._ended: list[subprocess.Popen[bytes]] = []
        self._process, self._line = self._start()

    @property
    def process_id(self) -> int:
        """Process identifier of the guardian."""
        return self._process.pid

    def wait_ready(self, patience: float = 2.0, *, patient: bool = False) -> None:
        """Wait until the guardian has set the coils to zero.

        Raises NotResponding after `patience` seconds, unless `patient` is true. In that case, `tend` later
        returns the guardian's report that the coils are at zero.
        """
        received = b""
        if select.select([self._line], [], [], patience)[0]:
            with contextlib.suppress(OSError):
                received = self._line.recv(1)
        if received != READY and not patient:
            raise NotResponding(
                DEVICE, "the guardian cannot reach the coils' PWM chip (see above): the flight does not start"
            )

    def beat(self) -> None:
        """Send a heartbeat after a successful control cycle, without blocking or raising errors."""
        if self._lost:
            return
        try:
            self._line.send(BEAT, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:  # the guardian died, or has not read for a second (BlockingIOError)
            self._lost = True

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a lost guardian and return the events since the last call."""
        news = self._receive()
        if self._lost and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + _RETRY_NS
            news.append(GuardianNews.LOST)
            # The killed guardian has possibly not ended yet.
            self._process.kill()
            self._ended.append(self._process)
            self._line.close()
            # A failed start does not raise an error, because the start is retried later.
            with contextlib.suppress(NotResponding):
                self._process, self._line = self._start()
                self._lost = False
        self._ended = [process for process in self._ended if process.poll() is None]
        return news

    def close(self) -> None:
        """End the guardian, which sets the coils to zero once more. A second call has no effect."""
        try:
            self._line.send(BYE, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            self._process.wait(_END_TIMEOUT_S)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._line.close()

    def _receive(self) -> list[GuardianNews]:
        try:
            words = self._line.recv(256, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return []
        except OSError:
            words = b""
        if not words:
            self._lost = True
        return [_NEWS[word] for value in words if (word := bytes([value])) in _NEWS]

    def _start(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        except OSError as error:
            raise NotResponding(DEVICE, f"its socket cannot be opened: {error.strerror}") from error
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _QUEUE_BYTES)
        reach = self._reach
        words = [str(theirs.fileno()), reach.opener, reach.where, *reach.words]
        try:
            process = subprocess.Popen(
                # The options -S and -E skip site-packages and environment variables, for a fast start.
                [sys.executable, "-S", "-E", "-m", "hal.guardian", *words],
                cwd=_ROOT,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Signals to the flight's process group must not reach the guardian. If a signal has stopped
                # the guardian, the kernel lets it continue when the flight process dies.
                process_group=0,
            )
        except OSError as error:
            ours.close()
            raise NotResponding(DEVICE, f"could not be started: {error.strerror}") from error
        finally:
            theirs.close()
        return process, ours


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
