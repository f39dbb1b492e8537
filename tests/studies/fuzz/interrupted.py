"""Command lines typed in a process of their own, which a signal meets at a random time, or without a reader.

The process is forked, so thousands are affordable; its output is a file, a pipe that nobody reads, or closed.
No traceback may come, and no status but 0, 1, 2 or death by that signal.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

from tests.studies.fuzz.harness import Finding
from tests.studies.fuzz.mutation import Draw, integer

_PATIENCE_S = 60.0
_SIGNALS = (signal.SIGINT, signal.SIGHUP, None)
_OUTPUTS = ("file", "pipe", "closed")
_TRACES = ("Traceback", "Exception ignored", "Fatal Python error")


@dataclass(frozen=True, slots=True)
class Disturbance:
    """The signal, if any, and its time in s after the start; and where standard output goes."""

    number: signal.Signals | None
    after: float
    output: str

    @classmethod
    def drawn(cls, draw: Draw) -> Disturbance:
        """Return a disturbance; with a signal the output may be whole, without one it is not."""
        number = _SIGNALS[integer(draw, 0, len(_SIGNALS) - 1)]
        least = 0 if number is not None else 1
        return cls(number, float(10.0 ** draw.uniform(-3.5, 0.0)), _OUTPUTS[integer(draw, least, 2)])


def disturbed(type_line: Callable[[], int], disturbance: Disturbance) -> int:
    """Run `type_line` in a forked process; return its status, negative when a signal killed it.

    Raises Finding for a traceback, another status, or a process that does not end.
    """
    with tempfile.TemporaryFile() as complaint:
        before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # as `flight.__main__` has it
        child = os.fork()
        if child == 0:
            _live(type_line, disturbance.output, complaint)
        signal.signal(signal.SIGINT, before)
        if disturbance.number is not None:
            time.sleep(disturbance.after)
            os.kill(child, disturbance.number)
        status = _ended(child)
        complaint.seek(0)
        text = complaint.read().decode(errors="replace")
    if any(trace in text for trace in _TRACES):
        raise Finding(f"{disturbance} gave {text[-600:]!r}")
    allowed = {0, 1, 2, 130} | ({-disturbance.number} if disturbance.number is not None else set())
    if status not in allowed:
        raise Finding(f"{disturbance} gave status {status}")
    return status


def _live(type_line: Callable[[], int], output: str, complaint: IO[bytes]) -> None:
    """Be the child: take the streams as a new interpreter would, type the line, end."""
    status = 70
    try:
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0.0)
        os.dup2(complaint.fileno(), 2)
        sys.stderr = sys.__stderr__ = open(2, "w", closefd=False)  # type: ignore[misc]  # noqa: SIM115
        _put_output(output)
        status = type_line()
        if sys.stdout is not None:
            sys.stdout.flush()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0
    except BaseException:  # noqa: BLE001 - what an interpreter would print at its end
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _put_output(output: str) -> None:
    if output == "closed":
        os.close(1)
        sys.stdout = sys.__stdout__ = None  # type: ignore[misc]
        return
    if output == "pipe":
        reader, writer = os.pipe()
        os.close(reader)
    else:
        writer = os.open(os.devnull, os.O_WRONLY)
    os.dup2(writer, 1)
    os.close(writer)
    sys.stdout = sys.__stdout__ = open(1, "w", encoding="utf-8", closefd=False)  # type: ignore[misc]  # noqa: SIM115


def _ended(child: int) -> int:
    """Return the status of a child once it has ended. Raises Finding when it does not."""
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise Finding(f"did not end within {_PATIENCE_S:g} s")
