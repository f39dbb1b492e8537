"""Workers that cannot start, in real time.

The full load of `bench executive` runs, but a module of the workers is missing, so each worker process ends
at once. The benchmark prints the start attempts and their reports. It also prints three numbers of lost
control cycles: all of them, those that a bare loop beside the flight did not lose, and those within a second
of a start attempt. Only the cycles of the third number can be lost because of the workers. Run it alone on
two cores.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import Annotated
from unittest.mock import patch

import numpy as np

from flight.link import events
from flight.loop.worker_processes import BUDGET
from ground.telemetry import read_run
from hal.interfaces.wires import SECOND_NS
from tests.hal.guardian import live_flight
from tests.studies.bench.executive import Load, fifo_allowed, fly
from tests.studies.command import command, scratch

_BREAK = """
from flight.loop.executive import processes
processes.MODULE = "flight.loop.no_such_module"
"""
WORKERS = ("planner", "vision")

_BESIDE_S = 1.0


@command
def main(*, minutes: Annotated[float, "of flight"] = 10.0) -> int:
    """Run the flight, and print the counts.

    Returns 1 if a cycle was lost or an attempt was not limited and reported.
    """
    with scratch() as folder, patch.object(live_flight, "FLIGHT", _BREAK + live_flight.FLIGHT):
        figures = fly(folder, Load(60.0 * minutes, warm_up=0.0), fifo_allowed()).figures
        happened = read_run(folder / "run")["event"]
    codes, texts = happened["code"], happened["text"]
    died_s = happened["time_ns"][codes == events.WORKER_DIED.code] / SECOND_NS
    beside = [at for at in figures["lost_at_s"] if (np.abs(died_s - at) <= _BESIDE_S).any()]
    sys.stdout.write(
        f"{minutes:g} min, {figures['slots']} slots: lost {figures['lost']}, "
        f"beyond the machine's stalls {figures['lost_beyond_machine']}, "
        f"within a second of an attempt {len(beside)}\n"
        f"lateness p99 {1e3 * figures['lateness_s']['p99']:.2f} ms, "
        f"execution max {1e3 * figures['execution_s']['max']:.1f} ms\n"
    )
    bounded = True
    for kind in (events.WORKER_DIED, events.WORKER_RESTS, events.WORKER_READY):
        # The text of an event begins with the name of its worker.
        counts = Counter(text.decode().partition(":")[0] for text in texts[codes == kind.code].tolist())
        sys.stdout.write(f"{kind.name}: {', '.join(f'{name} {counts[name]}' for name in WORKERS)}\n")
        if kind is events.WORKER_DIED:
            bounded = all(1 <= counts[name] <= BUDGET for name in WORKERS)
    return int(not bounded or bool(beside))
