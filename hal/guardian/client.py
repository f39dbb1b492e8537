"""The flight process's end of the guardian: started before the coils can be energised, fed each cycle.

A guardian that dies, or does not read its line any more, is replaced; what became of it is told as news.
Nothing here waits once the flight has begun: a beat is one byte that is written or dropped.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from hal.guardian import line
from hal.interfaces.errors import NotResponding
from hal.interfaces.guardian import GuardianNews

DEVICE = "guardian"
NOTE = "coils"
_ROOT = Path(__file__).resolve().parents[2]
_QUEUE_BYTES = 16384  # room for about a second of heartbeats: each byte takes its own bookkeeping
_RETRY_NS = 1_000_000_000
_FAREWELL_S = 0.5


@dataclass(frozen=True, slots=True)
class CoilReach:
    """How a process without numpy reaches the coils' PWM chip.

    `opener` is `module:function` of what opens the bus, `where` that function's argument.
    """

    opener: str
    where: str
    address: int

    def note(self, folder: Path) -> None:
        """Leave word of bus and address, durably, in a folder, for `deploy/coils-off`. Never raises."""
        beside = folder / f"{NOTE}.part"
        with contextlib.suppress(OSError):
            with beside.open("wb") as note:
                note.write(f"{self.where} 0x{self.address:02x}\n".encode())
                note.flush()
                os.fsync(note.fileno())
            beside.replace(folder / NOTE)
            names = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                os.fsync(names)
            finally:
                os.close(names)


_NEWS = {line.READY: GuardianNews.READY, line.ACTED: GuardianNews.ACTED, line.FAILED: GuardianNews.FAILED}


class GuardianLine:
    """A guardian on watch. For one thread, the control loop's."""

    def __init__(self, reach: CoilReach) -> None:
        """Start the guardian; `wait_ready` tells when it is on watch."""
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
        """Wait until the guardian has told the coils zero.

        Raises NotResponding when it has not within `patience` s; not where the flight is `patient` and waits
        for its coils as well: the guardian goes on trying, and tells when it succeeds.
        """
        heard = b""
        if select.select([self._line], [], [], patience)[0]:
            with contextlib.suppress(OSError):
                heard = self._line.recv(1)
        if heard != line.READY and not patient:
            raise NotResponding(DEVICE, "it does not reach the coils' PWM chip, see above: nothing is flown")

    def beat(self) -> None:
        """Tell that a control cycle ran well. Never waits, never raises."""
        if self._lost:
            return
        try:
            self._line.send(line.BEAT, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:  # it has died; or, BlockingIOError, it has not read for a second
            self._lost = True

    def tend(self, now_ns: int) -> list[GuardianNews]:
        """Replace a guardian that is lost; return what has happened since the last call."""
        news = self._hear()
        if self._lost and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + _RETRY_NS
            news.append(GuardianNews.LOST)
            self._drop()
            # One that cannot be started now is tried again; the task that asks must not fail for that.
            with contextlib.suppress(NotResponding):
                self._process, self._line = self._start()
                self._lost = False
        self._ended = [process for process in self._ended if process.poll() is None]
        return news

    def close(self) -> None:
        """Say goodbye, the coils being off; the guardian zeroes them once more. Safe to call twice."""
        try:
            self._line.send(line.BYE, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            self._process.wait(_FAREWELL_S)
        except (OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        self._line.close()

    def _hear(self) -> list[GuardianNews]:
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
        """Part with a lost guardian; it is reaped when it has ended, which is not waited for."""
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
                # Without site-packages and the user's environment: nothing to slow it down or lead it astray.
                [sys.executable, "-S", "-E", "-m", "hal.guardian", *words],
                cwd=_ROOT,
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # what is sent to the flight's process group is not for the guardian
            )
        except OSError as error:
            ours.close()
            raise NotResponding(DEVICE, f"could not be started: {error.strerror}") from error
        finally:
            theirs.close()
        return process, ours
