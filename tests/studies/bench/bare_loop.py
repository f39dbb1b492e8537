"""A bare sleep loop that runs in a separate process beside a flight, and measures stalls of the machine.

The loop calls clock_nanosleep with TIMER_ABSTIME for the next slot, as a minimal C program does. It records
each wake-up's time, and the processor time that the host has given to other virtual machines since boot. Its
slots are multiples of the period in CLOCK_MONOTONIC, like those of a real-time flight. Command: `python -m
tests.studies.bench.bare_loop PERIOD_NS PRIORITY FILE`. A priority above zero selects SCHED_FIFO. At SIGTERM
the program writes its records to the file: rows of two int64, the monotonic time (ns) and the stolen time
since boot (ns).
"""

from __future__ import annotations

import ctypes
import gc
import signal
import sys
import time
from array import array
from pathlib import Path

from hal.buses import system
from tests.support.process_watch import stolen_ns

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_SECOND_NS = 1_000_000_000


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def loop(period_ns: int, noted: array[int], stopped: list[int]) -> None:
    """Wake at every slot, and record the wake-up and stolen times, until `stopped` is not empty.

    Missed slots are skipped.
    """
    nanosleep = ctypes.CDLL(None).clock_nanosleep
    deadline = _Timespec()
    slot = time.monotonic_ns() // period_ns + 1
    while not stopped:
        deadline.seconds, deadline.nanoseconds = divmod(slot * period_ns, _SECOND_NS)
        if nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(deadline), None) == 0:
            now_ns = time.monotonic_ns()
            noted.extend((now_ns, stolen_ns()))
            slot = now_ns // period_ns + 1


def _serve(words: list[str]) -> None:
    """Loop until SIGTERM, then write the records."""
    period_ns, priority, path = int(words[0]), int(words[1]), Path(words[2])
    noted: array[int] = array("q")
    stopped: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stopped.append(number))
    if priority and (refusal := system.prioritise(0, priority)):
        raise SystemExit(refusal)
    gc.disable()
    sys.stdout.write("looping\n")
    sys.stdout.flush()
    loop(period_ns, noted, stopped)
    path.write_bytes(noted.tobytes())


if __name__ == "__main__":
    _serve(sys.argv[1:])
