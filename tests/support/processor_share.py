"""Limits processes under test to a share of a core, so that they are as slow as on a slower processor.

The kernel enforces the share on one core (CFS bandwidth of the controller `cpu`, cgroup v1 or v2). The period
is 5 ms, and longer for shares below 20 %, because the kernel grants at least 1 ms per period. Within the
share, the control process has priority over its workers, as on a board: it is in a separate group with a far
greater weight. A limitation by SIGSTOP and SIGCONT would not work, because the flight replaces a stopped
worker.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

PERIOD_US = 5_000
"""Period (us) of the limit: the unit's `CPUQuotaPeriodSec`."""
_LEAST_QUOTA_US = 1_000
"""Shortest run time (us) in a period that the kernel accepts."""
ROOT = Path("/sys/fs/cgroup")
"""Folder that contains the hierarchy of cgroup v2, or the hierarchies of cgroup v1."""
_SOURCE = Path(__file__).with_name("yardstick.c")


@dataclass(frozen=True, slots=True)
class Published:
    """Published speed of a processor in two benchmarks, heap sort and Linpack.

    Attributes:
        sorts: arrays of 8,111 integers that heap sort sorts per second (NBench's numeric sort).
        mflops: million floating-point operations per second of Linpack in double precision.
        source: publication of the two speeds.
    """

    name: str
    sorts: float
    mflops: float
    source: str


CORTEX_A53 = Published(
    "ARM Cortex-A53 at 800 MHz (TI AM65x)",
    355.67,
    325.3,
    "Texas Instruments, Processor SDK Linux for AM65x, RT-linux 11.02 Performance Guide",
)


@dataclass(frozen=True, slots=True)
class Yardstick:
    """Speed of this machine's core in the two benchmarks, in the units of `Published`."""

    sorts: float
    mflops: float

    def share(self, slow: Published) -> float:
        """Return the share of this core that is as fast as `slow`: the geometric mean of two speed ratios."""
        return math.sqrt(slow.sorts / self.sorts * slow.mflops / self.mflops)


def measure() -> Yardstick:
    """Compile the benchmarks and run them. Raises RuntimeError without a C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise RuntimeError("no C compiler for the yardstick: install one, or give the share by --share")
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "yardstick")
        subprocess.run([compiler, "-O2", str(_SOURCE), "-o", str(program), "-lm"], check=True)
        printed = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    sorts, mflops, _ = map(float, printed.split())
    return Yardstick(sorts, mflops)


@dataclass(frozen=True, slots=True)
class Used:
    """Resource use of a control group: periods (total, throttled), memory (bytes), hits of its limit.

    The memory is NaN if the kernel is older than Linux 5.19, in which cgroup v2 does not record the largest
    use.
    """

    periods: int
    throttled: int
    memory: float
    refusals: int


class Limits:
    """Control groups of a run: `control` and `workers` are within the limit, and `devices` is outside."""

    def __init__(self, share: float, memory: int, root: Path = ROOT) -> None:
        """Create the groups below `root`.

        Raises OSError with the name of the file if the kernel refuses a setting or access is denied.
        """
        name = f"knightcube-board-{os.getpid()}"
        self._is_v2 = (root / "cgroup.controllers").exists()
        if self._is_v2:
            _write(root / "cgroup.subtree_control", "+cpu +memory")
        self._cpu = (root if self._is_v2 else root / "cpu") / name
        self._memory = self._cpu if self._is_v2 else root / "memory" / name
        self._devices = self._cpu.with_name(f"{name}-devices")
        self.period_us = max(PERIOD_US, math.ceil(_LEAST_QUOTA_US / share))
        self.quota_us = round(share * self.period_us)
        try:
            self._make(memory)
        except OSError:
            self.close()
            raise

    def _make(self, memory: int) -> None:
        for folder in {self._cpu, self._memory, self._devices}:
            folder.mkdir()
        if self._is_v2:
            _write(self._cpu / "cgroup.subtree_control", "+cpu")
            _write(self._cpu / "cpu.max", f"{self.quota_us} {self.period_us}")
            _write(self._cpu / "memory.max", str(memory))
        else:
            _write(self._cpu / "cpu.cfs_period_us", str(self.period_us))
            _write(self._cpu / "cpu.cfs_quota_us", str(self.quota_us))
            _write(self._memory / "memory.limit_in_bytes", str(memory))
        for part in ("control", "workers"):
            (self._cpu / part).mkdir()
        weight, most, least = ("cpu.weight", 10000, 1) if self._is_v2 else ("cpu.shares", 262144, 2)
        # The groups have priority over other work on this machine, which would otherwise use a part of the
        # share.
        for folder in (self._cpu, self._devices, self._cpu / "control"):
            _write(folder / weight, str(most))
        _write(self._cpu / "workers" / weight, str(least))

    def line(self) -> str:
        """Return a line of Python code by which a process enters the group of the control process."""
        places = {self._cpu / "control", self._memory if not self._is_v2 else self._cpu / "control"}
        files = [str(place / "cgroup.procs") for place in sorted(places)]
        core = sorted(os.sched_getaffinity(0))[-1]
        enter = f"for name in {files!r}: open(name, 'w').write(str(os.getpid()))"
        return f"{enter}\nos.sched_setaffinity(0, {{{core}}})"

    def demote(self, process: int) -> None:
        """Move a worker to the group with the smaller weight."""
        self._enter(self._cpu / "workers", process)

    def release(self, process: int) -> None:
        """Move a process out of the limit, into the group of the devices."""
        self._enter(self._devices, process)

    @staticmethod
    def _enter(folder: Path, process: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            _write(folder / "cgroup.procs", str(process))

    def used(self) -> Used:
        """Return the resources that the group has used."""
        rows = dict(line.split() for line in (self._cpu / "cpu.stat").read_text().splitlines())
        peak, refused = ("peak", "events") if self._is_v2 else ("max_usage_in_bytes", "failcnt")
        words = (self._memory / f"memory.{refused}").read_text().split()
        refusals = int(words[words.index("max") + 1] if self._is_v2 else words[0])
        memory = math.nan
        with contextlib.suppress(FileNotFoundError):
            memory = float((self._memory / f"memory.{peak}").read_text())
        return Used(int(rows["nr_periods"]), int(rows["nr_throttled"]), memory, refusals)

    def close(self) -> None:
        """Remove the groups after their processes have ended."""
        for folder in (self._cpu / "control", self._cpu / "workers", self._cpu, self._memory, self._devices):
            for _ in range(100):
                if not folder.exists():
                    break
                with contextlib.suppress(OSError):
                    folder.rmdir()
                    break
                time.sleep(0.05)


def _write(file: Path, text: str) -> None:
    """Write a setting of a group. Raises OSError with the name of the file."""
    try:
        file.write_text(text, encoding="ascii")
    except OSError as error:
        raise OSError(error.errno, f"the kernel refuses {text!r}: {error.strerror}", str(file)) from error


@contextmanager
def limited(share: float, memory: int) -> Iterator[Limits]:
    """Create the groups, and remove them at the end of the `with` block."""
    limits = Limits(share, memory)
    try:
        yield limits
    finally:
        limits.close()
