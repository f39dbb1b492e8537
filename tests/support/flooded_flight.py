"""A real-time flight of the demonstration under a flood of datagrams, and the lateness of its cycles."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ground.telemetry import read_run
from tests.hal.guardian.live_flight import ROOT
from tests.support.lateness import QUANTILES

_BURST_S = 0.01
_START_S = 20.0
_WARM_UP_S = 5.0


@contextmanager
def process(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run `python -m flight WORDS`, and end the process when the context ends."""
    line = [sys.executable, "-m", "flight", *map(str, words)]
    with subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.kill(process.pid, signal.SIGTERM)


def free_port() -> int:
    """Return an unused UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        return int(line.getsockname()[1])


def wait_for(path: Path) -> None:
    """Wait until a file exists. Raises TimeoutError."""
    until = time.monotonic() + _START_S
    while not path.exists():
        if time.monotonic() > until:
            raise TimeoutError(f"{path} did not come within {_START_S:g} s")
        time.sleep(0.05)


def flood(
    port: int, datagrams: Sequence[bytes], a_second: int, ended: threading.Event, sent: list[int]
) -> None:
    """Send `a_second` random datagrams per second until `ended` is set, and record the size of each burst."""
    draw = np.random.default_rng(1)
    burst = round(a_second * _BURST_S)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        due = time.monotonic()
        while not ended.is_set():
            for number in draw.integers(0, len(datagrams), burst).tolist():
                line.sendto(datagrams[number], ("127.0.0.1", port))
            sent.append(burst)
            due += _BURST_S
            time.sleep(max(0.0, due - time.monotonic()))


def lateness(run: Path) -> dict[str, Any]:
    """Return the number of cycles after the first seconds of a run, and quantiles (ms) of their lateness."""
    cycles = read_run(run)["cycle_timing"]
    late = cycles["lateness"][cycles["time_ns"] > _WARM_UP_S * 1e9]
    figures = {name: round(1e3 * float(np.quantile(late, part)), 3) for name, part in QUANTILES.items()}
    return {"cycles": len(late), "lateness_ms": figures}
