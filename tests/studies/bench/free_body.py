"""The cost of a free body in orbit as a world: `python -m tests.studies.bench free_body`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import numpy as np

from sim_hal.settings import FreeBodySection
from sim_hal.worlds.free_body import FreeBody

PERIOD_NS = 25_000_000


def cost(seconds: float, looks: int = 1) -> float:
    """Return the CPU time, s, of a control cycle of 25 ms; `looks` devices read the motion in each."""
    currents = [np.zeros(3)]
    body = FreeBody(FreeBodySection(), lambda: currents[0])
    body.release_at(0)
    generator = np.random.default_rng(1)
    cycles = round(seconds * 1e9 / PERIOD_NS)
    begin = time.process_time()
    for cycle in range(cycles):
        currents[0] = generator.uniform(-0.1, 0.1, 3)
        for look in range(1, looks + 1):
            body.motion(PERIOD_NS * cycle + PERIOD_NS * look // looks)
    return (time.process_time() - begin) / cycles


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the cost of a cycle; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench free_body", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1000.0, help="of flight, %(default)s by default")
    options = parser.parse_args(arguments)
    for looks in (1, 2):
        sys.stdout.write(f"{looks} readings a cycle: {1e6 * cost(options.seconds, looks):.0f} us\n")
    return 0
