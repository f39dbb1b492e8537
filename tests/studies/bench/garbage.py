"""Pauses of the garbage collector in flight: `python -m tests.studies.bench garbage [--minutes M]`.

The full load of `bench executive` is flown. A flight collects by itself never, and every 2 s when it says
so (`flight.app.service`): printed is how long each collection held the interpreter, in processor
time and on the clock, and what it found. Exit status 1 where one took 1 ms of processor time or more.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from knightcube.errors import UsageError
from tests.hal.guardian import live_flight
from tests.studies.bench.executive import Load, fifo_allowed, fly

LIMIT_MS = 1.0

_WATCH = """
import gc, time
_begun = []
def _note(phase, found):
    now = time.thread_time_ns(), time.perf_counter_ns()
    if phase == "start":
        _begun[:] = now
    elif not gc.isenabled():
        with open({place!r}, "a") as file:
            print(now[0] - _begun[0], now[1] - _begun[1], found["collected"], file=file)
gc.callbacks.append(_note)
"""


def main(arguments: Sequence[str]) -> int:
    """Fly, print the pauses; return 1 where one was too long."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, metavar="M", help="default %(default)s")
    minutes = parser.parse_args(arguments).minutes
    with tempfile.TemporaryDirectory() as name:
        place, whole = Path(name) / "collections", live_flight.FLIGHT
        live_flight.FLIGHT = _WATCH.format(place=str(place)) + whole
        try:
            fly(Path(name), Load(60.0 * minutes, warm_up=0.0), fifo_allowed())
        finally:
            live_flight.FLIGHT = whole
        if not place.exists():
            raise UsageError("no collection within the flight: give it more than 4 s")
        pauses = np.loadtxt(place, ndmin=2)
    spent_ms, passed_ms, found = pauses.T * np.array([[1e-6], [1e-6], [1.0]])
    sys.stdout.write(
        f"{len(pauses)} collections in {minutes:g} min; processor time median {np.median(spent_ms):.2f} ms, "
        f"longest {spent_ms.max():.2f} ms; on the clock median {np.median(passed_ms):.2f} ms, longest "
        f"{passed_ms.max():.2f} ms; {found.sum():.0f} objects found\n"
    )
    return int(spent_ms.max() >= LIMIT_MS)
