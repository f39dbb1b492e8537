"""A worker process of `flight.loop.executive.processes`: serves one function until its socket closes.

The function's module may define `prepare`, for imports that only the worker needs: called before the first
job. Run as `python -m flight.loop.executive.worker MODULE:FUNCTION SOCKET_FD MEMORY_FD`, by the runner only.
"""

from __future__ import annotations

import importlib
import mmap
import os
import socket
import sys
import time
from typing import Any

from flight.loop.executive.memory import give_back
from flight.loop.executive.processes import SLAB_BYTES, message_length, pack_message, unpack_message


def serve(function: Any, line: socket.socket, slab: mmap.mmap) -> None:
    """Answer each message with (outcome, value, error, execution time in ns)."""
    received = bytearray()
    while chunk := line.recv(1 << 20):
        received += chunk
        while (length := message_length(received)) is not None and len(received) >= length:
            argument = unpack_message(bytes(received[:length]), slab)
            del received[:length]
            line.sendall(pack_message(_run(function, argument), slab))
            del argument
            # After the result was sent, so that nothing waits for this.
            give_back()


def _run(function: Any, argument: Any) -> tuple[str, Any, str, int]:
    begun = time.perf_counter_ns()
    try:
        value = function(argument)
    except Exception as error:  # noqa: BLE001 - containment boundary: the worker runner
        return "failed", None, f"{type(error).__name__}: {error}", time.perf_counter_ns() - begun
    return "done", value, "", time.perf_counter_ns() - begun


def _nothing() -> None:
    """No-op."""


def main(arguments: list[str]) -> None:
    """Import the function, then serve."""
    function_name, socket_fd, memory_fd = arguments
    module, _, name = function_name.partition(":")
    os.nice(5)  # the control loop comes first
    home = importlib.import_module(module)
    getattr(home, "prepare", _nothing)()
    function = getattr(home, name)
    line = socket.socket(fileno=int(socket_fd))
    slab = mmap.mmap(int(memory_fd), SLAB_BYTES)
    serve(function, line, slab)


if __name__ == "__main__":
    main(sys.argv[1:])
