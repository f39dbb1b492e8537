"""One worker's process, with a socket for messages, and a memory file for arrays that both sides map.

Frames of megabytes go through the memory file, never through a pipe. All of this runs in the supervisor's
thread (`flight.loop.executive.supervisor`), never in the control thread.
"""

from __future__ import annotations

import mmap
import os
import socket
import subprocess
import sys
from collections.abc import Set
from contextlib import suppress
from typing import Any

from flight.loop.executive.jobs import Outcome, Worker
from flight.loop.executive.messages import (
    LONGEST_BYTES,
    SLAB_BYTES,
    message_length,
    pack_trusted,
    unpack_values,
)
from knightcube.errors import FlightError

Answer = tuple[Outcome, Any, str, int]
"""Outcome, value, error and execution time in ns of a job."""

MODULE = "flight.loop.executive.worker"
"""The module that a worker's process runs."""

_REAPED_WITHIN_S = 1.0


class WorkerProcess:
    """A running worker; `ready` once it has imported its function. For one thread."""

    def __init__(self, worker: Worker, cores: Set[int] = frozenset()) -> None:
        """Start the process on the given cores, on all where none is given. Raises OSError."""
        self._name = worker.name
        self._received = bytearray()
        self.ready = False
        memory = os.memfd_create(f"knightcube-{worker.name}")
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            os.ftruncate(memory, SLAB_BYTES)
            self._slab = mmap.mmap(memory, SLAB_BYTES)
            ours.setblocking(False)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
            self._process = self._start(worker, theirs.fileno(), memory, cores)
        except OSError:
            ours.close()
            raise
        finally:
            theirs.close()
            os.close(memory)
        self._socket = ours

    @staticmethod
    def _start(worker: Worker, line: int, memory: int, cores: Set[int]) -> subprocess.Popen[bytes]:
        function = f"{worker.function.__module__}:{worker.function.__qualname__}"
        words = [function, str(line), str(memory), str(os.getpid()), ",".join(map(str, sorted(cores)))]
        return subprocess.Popen(
            [sys.executable, "-m", MODULE, *words],
            pass_fds=(line, memory),
            stdin=subprocess.DEVNULL,
            # Ctrl-C is for the control process, which then closes its workers. A group of this session, not a
            # session: once the control process has died nobody in it could continue a stopped worker, and the
            # kernel ends such a worker by SIGHUP and SIGCONT (setpgid(2)), also before Python runs in it.
            process_group=0,
        )

    @property
    def process_id(self) -> int:
        """The process identifier."""
        return self._process.pid

    def is_stopped(self) -> bool:
        """Return whether a signal such as SIGSTOP has stopped the process; it may still be starting."""
        look = os.WSTOPPED | os.WNOHANG | os.WNOWAIT  # takes nothing from who reaps it
        with suppress(ChildProcessError):  # reaped already
            return os.waitid(os.P_PID, self._process.pid, look) is not None
        return False

    def fileno(self) -> int:
        """Return the socket's descriptor, to wait for an answer."""
        return self._socket.fileno()

    def send(self, argument: Any) -> None:
        """Submit a job. Raises FlightError for one that cannot be sent, EOFError where the process died."""
        message = pack_trusted(argument, self._slab)
        if len(message) > LONGEST_BYTES:
            raise FlightError(f"a job for {self._name} of {len(message)} bytes is too large")
        try:
            sent = self._socket.send(message)
        except ConnectionError as error:
            raise EOFError(self._name) from error
        if sent != len(message):
            raise FlightError(f"a job for {self._name} of {len(message)} bytes is too large")

    def receive(self) -> Answer | None:
        """Return an arrived answer, else None. Raises EOFError at a death, FlightError for damage."""
        try:
            while chunk := self._socket.recv(1 << 16):
                self._received += chunk
            raise EOFError(self._name)
        except BlockingIOError:
            pass
        except ConnectionError as error:
            raise EOFError(self._name) from error
        while (length := message_length(self._received)) is not None and len(self._received) >= length:
            message = bytes(self._received[:length])
            del self._received[:length]
            match unpack_values(message, self._slab):
                case None:
                    self.ready = True
                case ("done" | "failed" as outcome, value, str(text), int(execution_ns)):
                    return outcome, value, text, execution_ns
                case _:
                    raise FlightError("the answer is none of a job")
        return None

    def end(self) -> str:
        """Kill the process, reap it and release its memory; return how it ended where it ended by itself."""
        status = self._process.poll()
        if status is None:
            with suppress(subprocess.TimeoutExpired):  # at its end the process may still be writing
                status = self._process.wait(0.05)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # one that hangs in the kernel is reaped by a later start
            self._process.wait(_REAPED_WITHIN_S)
        self._socket.close()
        self._slab.close()
        if status is None:
            return "killed"
        return f"signal {-status}" if status < 0 else f"status {status}"
