"""File transfer with losses.

Link and ground run in one process on a manual clock with protected frames. Frames are lost at random with the
same probability in both directions. For each probability and direction, the benchmark reports whether the
file arrived complete, whether both ends closed the transfer, its duration on the manual clock, and the
processor time.
"""

from __future__ import annotations

import hashlib
import time
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from flight.link.process.directives import SendFile
from tests.flight.link.process.filed_ends import FiledEnds
from tests.studies.command import Seed, command, say, scratch

_LOSSES = (0.0, 0.1, 0.3)
_RATE = 250_000.0
"""Data rate of frames (bytes/s) in both directions."""
_LONGEST_NS = 7200 * 10**9


@command
def main(*, megabytes: Annotated[float, "of the file"] = 10.0, seed: Seed = 1) -> int:
    """Run and print all transfers. Returns 0 if all files arrived complete."""
    sound = True
    for loss, down in product(_LOSSES, (True, False)):
        with scratch() as place:
            facts = measure(place, round(megabytes * 1e6), loss, seed, down=down)
        sound &= facts["whole"] and facts["closed"]
        say(**facts)
    return int(not sound)


def measure(place: Path, size: int, loss: float, seed: int, *, down: bool) -> dict[str, Any]:
    """Transfer one file, and return the result."""
    data = np.random.default_rng(seed).bytes(size)
    link = FiledEnds(place, rate=_RATE, loss=loss, up_rate=_RATE, seed=seed)
    begun, begun_ns = time.process_time(), link.clock.now_ns()
    if down:
        name = "log/run-000001/dump.bin"
        (place / "runs" / "run-000001" / "dump.bin").write_bytes(data)
        link.ask(SendFile(name))
        arrived = link.session.received / name
    else:
        path = place / "release.whl"
        path.write_bytes(data)
        link.session.put(path, "release/release.whl", link.clock.now_ns())
        arrived = place / "keys" / "files" / "received" / "release" / "release.whl"
    while not link.ended and link.clock.now_ns() - begun_ns < _LONGEST_NS:
        link.turn(1.0)
    link.until_closed()
    link.close()
    came = arrived.read_bytes() if arrived.exists() else b""
    whole = hashlib.sha256(came).digest() == hashlib.sha256(data).digest()
    return {
        "direction": "down" if down else "up",
        "loss": loss,
        "bytes": size,
        "whole": whole,
        "closed": [one.condition for one in link.ended] == [0] and not link.station.transfers,
        "seconds": round((link.clock.now_ns() - begun_ns) * 1e-9, 1),
        "processor_seconds": round(time.process_time() - begun, 1),
    }
