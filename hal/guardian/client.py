"""The flight process's end of the guardian: starts it before the coils can be energised, sends heartbeats.

A guardian that dies, or stops reading its line, is replaced and the replacement reported. Nothing here waits
once the flight has begun: a heartbeat is one byte that is written or dropped.
"""

from __future__ import annotations

import contextlib
import select
import socket
import subprocess
import sys
from pathlib import Path

from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import ACTED, BEAT, BYE, FAILED, READY, CoilReach, GuardianNews

DEVICE = "guardian"
_ROOT = Path(__file__).resolve().parents[2]
_QUEUE_BYTES = 16384  # about a second of heartbeats, each with the kernel's bookkeeping
_RETRY_NS = 1_000_000_000
_END_TIMEOUT_S = 0.5


_NEWS = {
    READY: GuardianNews.READY,
    ACTED: GuardianNews.ACTED,
    FAILED: GuardianNews.FAILED,
}


class GuardianLine:
    """A running guardian. For one thread, the control loop's."""

    def __init__(self, reach: CoilReach) -> None:
        """Start the guardian; `wait_ready` waits until it guards."""
        self._reach = reach
        self._lost = False
        self._retry_ns = 0
        self._ended: list[subprocess.Popen[bytes]] = []
        self._process, self._line = self._start()

    @property
    def process_id(self) -> int:
        """The process identifier of the guardian."""
        return self._process.pid

    def wait_ready(self, patience: float = 2.0, *, patient: bool = False) -> None:
        """Wait until the guardian has zeroed the coils.

        Raises NotResponding when that takes more than `patience` s, except where the flight is `patient` and
        waits for its coils as well: the guardian then keeps trying and reports when it succeeds.
        """
        received = b""
        if select.select([self._line], [], [], patience)[0]:
            with contextlib.suppress(OSError):
                received = self._line.recv(1)
        if received != READY and not patient:
            raise NotResponding(
                DEVICE, "it cannot reach the coils' PWM chip, see above: the flight does not start"
            )

    def beat(self) -> None:
        """Report that a control cycle succeeded. Never waits, never raises."""
        if self._lost:
            return
        try:
            self._line.send(BEAT, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:  # it died; or, BlockingIOError, it has not read for a second
            self._lost = True

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a lost guardian; return what happened since the last call."""
        news = self._receive()
        if self._lost and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + _RETRY_NS
            news.append(GuardianNews.LOST)
            self._drop()
            # A failed start is tried again later; the calling task must not fail.
            with contextlib.suppress(NotResponding):
                self._process, self._line = self._start()
                self._lost = False
        self._ended = [process for process in self._ended if process.poll() is None]
        return news

    def close(self) -> None:
        """End the guardian, the coils being off; it zeroes them once more. Safe to call twice."""
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

    def _drop(self) -> None:
        """Kill a lost guardian; it is reaped later, without waiting here."""
        self._process.kill()
        self._ended.append(self._process)
        self._line.close()

    def _start(self) -> tuple[subprocess.Popen[bytes], socket.socket]:
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        except OSError as error:
            raise NotResponding(DEVICE, f"no line to it: {error.strerror}") from error
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _QUEUE_BYTES)
        reach = self._reach
        words = [str(theirs.fileno()), reach.opener, reach.where, str(reach.address)]
        try:
            process = subprocess.Popen(
                # Without site-packages and the user's environment, for a fast and predictable start.
                [sys.executable, "-S", "-E", "-m", "hal.guardian", *words],
                cwd=_ROOT,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Signals to the flight's process group must not reach the guardian. A group, not a session:
                # one that is stopped when the flight dies is continued by the kernel (setpgid(2)), and acts.
                process_group=0,
            )
        except OSError as error:
            ours.close()
            raise NotResponding(DEVICE, f"could not be started: {error.strerror}") from error
        finally:
            theirs.close()
        return process, ours
