"""What a packet costs in lock-step: emulator, line and driver together."""

from __future__ import annotations

import argparse
import json
import sys
import time

from tests.hal.vn100.bench_line import bench_line


def main() -> None:
    """Run some simulated time at 40 Hz and print microseconds a packet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=100.0, help="simulated time (default 100)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    bench = bench_line()
    bench.driver.configure()
    start = time.perf_counter()
    packets = len(bench.run(options.seconds))
    spent = time.perf_counter() - start
    cost = round(1e6 * spent / packets, 1)
    facts = {"packets": packets, "seconds": round(spent, 3), "microseconds_a_packet": cost}
    text = json.dumps(facts) if options.json else ", ".join(f"{key} {value}" for key, value in facts.items())
    sys.stdout.write(text + "\n")


if __name__ == "__main__":
    main()
