"""Processor time of scanning the log of a 700 s flight: `python -m tests.studies.bench scan`."""

from __future__ import annotations

import sys

from flight.link.telemetry.definitions import CONTROL, IMU, TRUTH
from flight.link.telemetry.packets import Packer
from ground.telemetry import scan
from tests.flight.link.telemetry.samples import plain_contents
from tests.pace import ordinary_seconds

LIMIT = 1.5
CYCLES = 28_000


def log(cycles: int) -> bytes:
    """Return the IMU, control and truth packets of as many control cycles."""
    packer = Packer()
    kinds = [(kind, plain_contents(kind)) for kind in (IMU, CONTROL, TRUTH)]
    return b"".join(packer.pack(kind, cycle, values) for cycle in range(cycles) for kind, values in kinds)


def main() -> int:
    """Print the time; fail when it exceeds the limit."""
    data = log(CYCLES)
    spent = ordinary_seconds(lambda: scan(data))
    sys.stdout.write(f"{len(data) / 1e6:.1f} MB, {CYCLES} cycles: {spent:.2f} s of {LIMIT} s\n")
    return int(spent > LIMIT)
