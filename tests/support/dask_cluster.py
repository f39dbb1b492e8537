"""A Dask cluster on this machine: a scheduler process and two worker processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HOST = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")


@contextmanager
def started(folder: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start `dask ...` as in its documentation, in another folder and without our import paths."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, "-m", "dask", *words]
    with (folder / "dask.log").open("ab") as log:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Start a scheduler and two workers; yield the address and the processes, with the scheduler first."""
    from distributed import Client  # noqa: PLC0415 - Dask is optional

    facts = folder / "scheduler.json"
    where = ("--scheduler-file", str(facts))
    worker = ("worker", *where, "--no-nanny", "--nthreads", "1", *HOST)
    with (
        started(folder, "scheduler", *where, "--port", "0", *HOST) as scheduler,
        started(folder, *worker) as first,
        started(folder, *worker) as second,
    ):
        deadline = time.monotonic() + 30.0
        while not facts.is_file() and time.monotonic() < deadline:
            time.sleep(0.05)
        address = json.loads(facts.read_text())["address"]
        with Client(address) as client:
            client.wait_for_workers(2, timeout=30)
        yield address, [scheduler, first, second]
