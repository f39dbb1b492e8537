"""Samples of the processor time and memory of running processes, read from /proc.

The proportional set size (PSS) divides each page among the processes that map it, so a sum over processes
counts no page twice (proc_pid_smaps(5)). If other processes map a page too, the sum contains only a part of
this page. `unshared` computes the memory that the watched processes would hold if no other process shared
their memory.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

MIB = 1024.0 * 1024.0
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Look:
    """One sample: monotonic time (s), and processor time (s) and proportional set (bytes) by process name.

    `own` is the part of the proportional set that is not mapped from files; other processes do not change it.
    `turns` contains two times (s) of each main thread since its start: the time in which it ran, and the time
    in which it was ready but had no processor.
    """

    time: float
    processor: dict[str, float]
    memory: dict[str, float]
    own: dict[str, float]
    turns: dict[str, tuple[float, float]]


class ProcessWatch:
    """Thread that samples processes by name until it is closed."""

    def __init__(self, processes: Callable[[], Mapping[str, int]], period: float) -> None:
        """Start sampling.

        `processes` returns the process identifiers at each sample; `period` is in s.
        """
        self.looks: list[Look] = []
        self._processes = processes
        self._period = period
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop sampling."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._stopped.wait(self._period):
            try:
                self.looks.append(look(self._processes()))
            except (OSError, LookupError, ValueError):
                continue  # a process has just ended


def look(processes: Mapping[str, int]) -> Look:
    """Return a sample. Raises OSError, ValueError or LookupError if a process does not exist."""
    sets = {name: _proportional(process) for name, process in processes.items()}
    return Look(
        time.monotonic(),
        {name: _processor(process) for name, process in processes.items()},
        {name: parts["Pss:"] for name, parts in sets.items()},
        {name: parts["Pss:"] - parts["Pss_File:"] for name, parts in sets.items()},
        {name: _turns(process) for name, process in processes.items()},
    )


@contextmanager
def answering(module: str, *words: str) -> Iterator[None]:
    """Run `python -m MODULE WORDS` during a `with` block. The block begins after the first line of output."""
    root = Path(__file__).parents[2]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-m", module, *words], cwd=root, env=environment, stdout=subprocess.PIPE
    ) as process:
        try:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise RuntimeError(f"{module} ended with status {process.wait()} before it answered")
            yield
        finally:
            process.terminate()


def below(parent: int) -> list[int]:
    """Return the identifiers of all descendants of the process `parent`."""
    found = []
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        for word in task.read_text().split():
            found += [int(word), *below(int(word))]
    return found


def command(process: int) -> str:
    """Return the command line of a process, or an empty string if the process has just ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def unshared(processes: Mapping[str, int]) -> float:
    """Return the memory (bytes) that some processes would hold if no other process mapped their files.

    The result is the sum of their private memory and, for each mapped segment of a file, the largest amount
    that any of the processes holds. This assumes that all processes use the same pages of a file.
    """
    private = 0.0
    of_files: defaultdict[tuple[str, str], float] = defaultdict(float)
    for process in processes.values():
        piece = ("", "")
        resident = 0.0
        for line in Path(f"/proc/{process}/smaps").read_text().splitlines():
            words = line.split()
            if not words[0].endswith(":"):
                piece = (words[2], " ".join(words[5:]))
            elif words[0] == "Rss:":
                resident = float(words[1]) * 1024.0
            elif words[0] == "Anonymous:":
                anonymous = float(words[1]) * 1024.0
                private += anonymous
                if piece[1].startswith("/"):
                    of_files[piece] = max(of_files[piece], resident - anonymous)
    return private + sum(of_files.values())


def stolen_ns() -> int:
    """Return the processor time (ns) of all cores since boot that the host gave to other virtual machines."""
    with open("/proc/stat", "rb", buffering=0) as file:
        return int(file.read(256).split(maxsplit=9)[8]) * (1_000_000_000 // _TICKS)


def _processor(process: int) -> float:
    # The name in brackets may contain any character. User and system time are the words 14 and 15 (proc(5)).
    words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / _TICKS


def _turns(process: int) -> tuple[float, float]:
    """Return the times (s) in which the main thread ran and was ready; NaN if the kernel has no counts."""
    try:
        words = Path(f"/proc/{process}/task/{process}/schedstat").read_text().split()
    except FileNotFoundError:  # the kernel does not count these times
        return math.nan, math.nan
    return 1e-9 * int(words[0]), 1e-9 * int(words[1])


def _proportional(process: int) -> dict[str, float]:
    """Return the proportional set size (PSS) of a process and of its parts, in bytes."""
    lines = [line.split() for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()]
    return {words[0]: float(words[1]) * 1024.0 for words in lines if words[0].startswith("Pss")}
