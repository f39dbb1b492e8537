"""Processor time of the attitude filter in a control cycle: `python -m tests.studies.bench filter_cycle`.

Each cycle measures an attitude and a rate of estimated age, records a command 10 ms after them, and asks for
the estimate of that time, as the testbed's loop does. The last estimate is printed to compare two versions.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from knightcube.gnc.estimation.attitude_filter import AttitudeFilter
from knightcube.gnc.estimation.estimate import Estimate
from tests.knightcube.gnc.estimation.flights import FREE, SETTINGS, SUSPENDED, Flight, fly
from tests.support.consistency_worlds import CYCLE_NS

_COMMANDED_NS = 10_000_000
_AGED = replace(SETTINGS, latency_start=0.01, latency_walk=1e-5, unknown_current=0.1)


def cost(flight: Flight, suspended: bool) -> tuple[float, Estimate]:
    """Return the processor time that nine of ten cycles exceed, s, and the last estimate.

    The fast cycles show least of what else the machine does.
    """
    filter_ = AttitudeFilter(SUSPENDED if suspended else FREE, _AGED)
    filter_.start(*flight.samples[0])
    samples = [tuple(replace(sample, latency=0.0) for sample in pair) for pair in flight.samples]
    taken = []
    for cycle, pair in enumerate(samples[1:], 1):
        begin = time.process_time()
        for sample in pair:
            filter_.measure(sample)
        now_ns = cycle * CYCLE_NS + _COMMANDED_NS
        found = filter_.at(now_ns)
        filter_.command(now_ns, flight.commands[cycle], flight.fields[cycle])
        taken.append(time.process_time() - begin)
    return statistics.quantiles(taken, n=10)[0], found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the cost of a cycle; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench filter_cycle", description=__doc__)
    parser.add_argument("--cycles", type=int, default=2000, help="of flight, %(default)s by default")
    options = parser.parse_args(arguments)
    for suspended in (True, False):
        taken, found = cost(fly(1, options.cycles, suspended), suspended)
        name = "suspended" if suspended else "free"
        sys.stdout.write(f"{name}: {1e6 * taken:.0f} us; rate {found.rate.tolist()} rad/s, ")
        sys.stdout.write(f"trace of covariance {found.covariance.trace():.12g}\n")
    return 0
