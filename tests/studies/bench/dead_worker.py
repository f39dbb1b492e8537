"""Workers that cannot start, in real time: `python -m tests.studies.bench dead_worker [--minutes M]`.

The full load of `bench executive` runs, but a module of the workers is missing, so each worker process ends
at once. The benchmark prints the start attempts and their reports. It also prints three numbers of lost
control cycles: all of them, those that a bare loop beside the flight did not lose, and those within a second
of a start attempt. Only the cycles of the third number can be lost because of the workers. Run it alone on
two cores.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from flight.link import events
from flight.loop.worker_processes import BUDGET
from ground.telemetry import read_run
from hal.interfaces.wires import SECOND_NS
from tests.hal.guardian import live_flight
from tests.studies.bench.executive import Load, fifo_allowed, fly

_BREAK = """
from flight.loop.executive import processes
processes.MODULE = "flight.loop.no_such_module"
"""
WORKERS = ("planner", "vision")

_BESIDE_S = 1.0


def main(arguments: Sequence[str]) -> int:
    """Run the flight, and print the counts.

    Returns 1 if a cycle was lost or an attempt was not limited and reported.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, metavar="M", help="default %(default)s")
    minutes = parser.parse_args(arguments).minutes
    with tempfile.TemporaryDirectory() as name, _broken_workers():
        load = Load(60.0 * minutes, warm_up=0.0)
        figures = fly(Path(name), load, fifo_allowed()).figures
        happened = read_run(Path(name) / "run")["event"]
        codes, texts = happened["code"], happened["text"]
        died_s = happened["time_ns"][codes == events.WORKER_DIED.code] / SECOND_NS
    beside = [at for at in figures["lost_at_s"] if (np.abs(died_s - at) <= _BESIDE_S).any()]
    kinds = (events.WORKER_DIED, events.WORKER_RESTS, events.WORKER_READY)
    found = {kind.name: Counter(_workers(texts[codes == kind.code].tolist())) for kind in kinds}
    sys.stdout.write(
        f"{minutes:g} min, {figures['slots']} slots: lost {figures['lost']}, "
        f"beyond the machine's stalls {figures['lost_beyond_machine']}, "
        f"within a second of an attempt {len(beside)}\n"
        f"lateness p99 {1e3 * figures['lateness_s']['p99']:.2f} ms, "
        f"execution max {1e3 * figures['execution_s']['max']:.1f} ms\n"
    )
    for kind, counts in found.items():
        sys.stdout.write(f"{kind}: {', '.join(f'{name} {counts[name]}' for name in WORKERS)}\n")
    bounded = all(1 <= found["worker-died"][name] <= BUDGET for name in WORKERS)
    return int(not bounded or bool(beside))


def _workers(texts: Sequence[bytes]) -> list[str]:
    """Return the worker that each event text names first."""
    return [text.decode().partition(":")[0] for text in texts]


@contextmanager
def _broken_workers() -> Iterator[None]:
    whole = live_flight.FLIGHT
    live_flight.FLIGHT = _BREAK + whole
    try:
        yield
    finally:
        live_flight.FLIGHT = whole
