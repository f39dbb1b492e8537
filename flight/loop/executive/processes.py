"""Jobs in real time: each worker is a process of its own, with a socket, and shared memory for arrays.

A worker that dies is reported and restarted; a worker that exceeds its timeout is killed first. Frames of
megabytes go through a memory file that both sides map, so the control thread never waits for a pipe.
"""

from __future__ import annotations

import mmap
import os
import pickle
import socket
import struct
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from flight.gnc.errors import FlightError
from flight.loop.executive.jobs import JobResult, Outcome, Worker
from hal.interfaces.wires import Clock

SLAB_BYTES = 64 * 1024 * 1024
"""Shared memory for a job's arrays: only address space until used."""

_HEADER = struct.Struct("<QQ")
_CHUNK_BYTES = 1 << 16


def pack_message(value: Any, slab: mmap.mmap) -> bytes:
    """Pickle a value: its large buffers go into the slab, the rest is returned with its length in front."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [buffer.raw() for buffer in buffers]
    if sum(view.nbytes for view in views) > len(slab):
        raise FlightError(f"a job's arrays exceed the {len(slab)} bytes that a worker's memory holds")
    offset = 0
    sizes = []
    for view in views:
        slab[offset : offset + view.nbytes] = view
        sizes.append(view.nbytes)
        offset += view.nbytes
    head = pickle.dumps(sizes)
    return _HEADER.pack(len(head), len(body)) + head + body


def unpack_message(message: bytes, slab: mmap.mmap) -> Any:
    """Undo `pack_message`, copying the buffers out of the slab."""
    head_length, body_length = _HEADER.unpack_from(message)
    head_end = _HEADER.size + head_length
    sizes = pickle.loads(message[_HEADER.size : head_end])
    buffers = []
    offset = 0
    for size in sizes:
        buffers.append(bytearray(slab[offset : offset + size]))
        offset += size
    return pickle.loads(message[head_end : head_end + body_length], buffers=buffers)


def message_length(data: bytes | bytearray) -> int | None:
    """Return the length of the message that `data` begins with, None before the header is complete."""
    if len(data) < _HEADER.size:
        return None
    head_length, body_length = _HEADER.unpack_from(data)
    return _HEADER.size + int(head_length) + int(body_length)


class _WorkerProcess:
    """One worker's process, its socket and its shared memory."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self.submitted_ns = -1
        self._received = bytearray()
        self._chunk = memoryview(bytearray(_CHUNK_BYTES))
        memory = os.memfd_create(f"knightcube-{worker.name}")
        os.ftruncate(memory, SLAB_BYTES)
        self._slab = mmap.mmap(memory, SLAB_BYTES)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        ours.setblocking(False)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
        self._socket = ours
        function = f"{worker.function.__module__}:{worker.function.__qualname__}"
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "flight.loop.executive.worker",
                function,
                str(theirs.fileno()),
                str(memory),
            ],
            pass_fds=(theirs.fileno(), memory),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the control process, which then closes its workers
        )
        theirs.close()
        os.close(memory)

    @property
    def busy(self) -> bool:
        return self.submitted_ns >= 0

    def send(self, argument: Any, now_ns: int) -> bool:
        """Submit a job; return False when the process has died (`receive` then raises)."""
        message = pack_message(argument, self._slab)
        try:
            if self._socket.send(message) != len(message):
                raise FlightError(f"a job for {self.worker.name} of {len(message)} bytes is too large")
        except OSError:
            return False
        self.submitted_ns = now_ns
        return True

    def receive(self) -> tuple[bool, Any]:
        """Return (True, message) when one has arrived, else (False, None). Raises EOFError at a death."""
        try:
            # Into a buffer that exists: this runs in every cycle, mostly without data.
            while count := self._socket.recv_into(self._chunk):
                self._received += self._chunk[:count]
            raise EOFError(self.worker.name)
        except BlockingIOError:
            pass
        except ConnectionError as error:
            raise EOFError(self.worker.name) from error
        length = message_length(self._received)
        if length is None or len(self._received) < length:
            return False, None
        message = bytes(self._received[:length])
        del self._received[:length]
        return True, unpack_message(message, self._slab)

    def kill(self) -> None:
        """Kill the process and release its socket and memory."""
        self._process.kill()
        self._process.wait()
        self._socket.close()
        self._slab.close()


class ProcessRunner:
    """A JobRunner whose workers are processes."""

    borrowed_ns = 0

    def __init__(self, clock: Clock, workers: Sequence[Worker]) -> None:
        self._clock = clock
        self._processes = {worker.name: _WorkerProcess(worker) for worker in workers}

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job; return False when that worker is busy or has died."""
        process = self._processes[worker]
        return not process.busy and process.send(argument, self._clock.now_ns())

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived; replace workers that died or exceeded their timeout."""
        now_ns = self._clock.now_ns()
        results = []
        for name, process in list(self._processes.items()):
            spec = process.worker
            try:
                arrived, message = process.receive()
            except EOFError:
                results.append(self._replace(name, "died", "the worker's process ended", now_ns))
                continue
            if arrived:
                outcome, value, error, execution_ns = message
                results.append(
                    JobResult(name, outcome, value, error, process.submitted_ns, now_ns, execution_ns)
                )
                process.submitted_ns = -1
            elif process.busy and now_ns - process.submitted_ns > spec.timeout_ns:
                text = f"no result within {spec.timeout_ns * 1e-9:g} s"
                results.append(self._replace(name, "timed-out", text, now_ns))
        return results

    def close(self) -> None:
        """Kill the workers."""
        for process in self._processes.values():
            process.kill()
        self._processes.clear()

    def process_identifiers(self) -> dict[str, int]:
        """Return the process identifier of each worker."""
        return {name: process._process.pid for name, process in self._processes.items()}

    def _replace(self, name: str, outcome: Outcome, error: str, now_ns: int) -> JobResult:
        process = self._processes[name]
        submitted_ns = process.submitted_ns
        process.kill()
        self._processes[name] = _WorkerProcess(process.worker)
        begun_ns = submitted_ns if submitted_ns >= 0 else now_ns
        return JobResult(name, outcome, None, error, begun_ns, now_ns, now_ns - begun_ns)
