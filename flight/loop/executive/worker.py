"""A worker process of `flight.loop.executive.worker_processes`: serves one function until its socket closes.

The function's module may define `prepare`, for imports that only the worker needs: called before the first
job. Run by the runner only, as `python -m flight.loop.executive.worker MODULE:FUNCTION SOCKET_FD MEMORY_FD
PARENT CORES`. The kernel kills the process when its parent's thread ends, so no worker outlives its flight.
"""

from __future__ import annotations

import ctypes
import importlib
import mmap
import os
import signal
import socket
import sys
import time
from typing import Any

from flight.loop.executive.memory import give_back, lean_numpy
from flight.loop.executive.messages import SLAB_BYTES, message_length, pack_values, unpack_trusted
from knightcube.errors import FlightError

_PR_SET_PDEATHSIG = 1  # prctl(2)


def serve(function: Any, line: socket.socket, slab: mmap.mmap) -> None:
    """Announce readiness, then answer each message with (outcome, value, error, execution time in ns)."""
    line.sendall(pack_values(None, slab))
    received = bytearray()
    while chunk := line.recv(1 << 20):
        received += chunk
        while (length := message_length(received)) is not None and len(received) >= length:
            argument = unpack_trusted(bytes(received[:length]), slab)
            del received[:length]
            line.sendall(_answer(function, argument, slab))
            del argument
            # After the result was sent, so that nothing waits for this.
            give_back()


def _answer(function: Any, argument: Any, slab: mmap.mmap) -> bytes:
    """Return the message of a job's result, or of its failure where the result cannot be sent."""
    outcome = _run(function, argument)
    try:
        return pack_values(outcome, slab)
    except FlightError as error:
        return pack_values(("failed", None, str(error), outcome[3]), slab)


def _run(function: Any, argument: Any) -> tuple[str, Any, str, int]:
    begun = time.perf_counter_ns()
    try:
        value = function(argument)
    except Exception as error:  # noqa: BLE001 - containment boundary: the worker runner
        return "failed", None, f"{type(error).__name__}: {error}", time.perf_counter_ns() - begun
    return "done", value, "", time.perf_counter_ns() - begun


def _nothing() -> None:
    """No-op."""


def end_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends; end now where the parent has ended already."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


def main(arguments: list[str]) -> None:
    """Import the function, then serve."""
    function_name, socket_fd, memory_fd, parent, cores = arguments
    end_with(int(parent))
    module, _, name = function_name.partition(":")
    os.nice(5)  # the control loop comes first
    if cores:
        os.sched_setaffinity(0, map(int, cores.split(",")))
    lean_numpy()
    home = importlib.import_module(module)
    getattr(home, "prepare", _nothing)()
    function = getattr(home, name)
    line = socket.socket(fileno=int(socket_fd))
    slab = mmap.mmap(int(memory_fd), SLAB_BYTES)
    try:
        serve(function, line, slab)
    except ConnectionError:
        return  # the control process ended


if __name__ == "__main__":
    main(sys.argv[1:])
