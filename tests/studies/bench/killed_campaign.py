"""A user's campaign, killed and resumed.

The command `knightcube campaign` runs twice with the same draws: undisturbed, and killed at random times
(once by SIGINT, otherwise by SIGKILL) and restarted each time. With `--dask` it also runs on a cluster of two
workers, one of which is killed. The benchmark compares the printed summaries and the result of each flight.
It counts the flights that were flown twice, the processes that outlive a campaign, and the remaining
temporary files.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ground.campaigns.runner import show
from knightcube.errors import UsageError
from tests.studies.command import Seed, command, scratch
from tests.support.dask_cluster import cluster

ROOT = Path(__file__).parents[3]
VARIED = ("plant.inertia=10%", "plant.thread_stiffness=normal 5%", "coils.current_limit=0.1|0.14")
_END_S = 60.0
"""Longest time (s) to wait for the end of processes."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of a disturbed campaign with the undisturbed one.

    Attributes:
        flights: number of flights with a result.
        repeated: number of results beyond the first of a flight.
        unequal: number of flights whose result differs from that of the undisturbed campaign.
        same_figures: whether the printed summaries are equal.
        interruptions: number of times that the campaign was interrupted before its end.
        orphans: number of processes that outlived the campaign.
        remains: number of temporary files and folders that remain.
    """

    flights: int
    repeated: int
    unequal: int
    same_figures: bool
    interruptions: int
    orphans: int
    remains: int

    def sound(self, runs: int) -> bool:
        """Return whether the campaign is complete, has equal results, and left no processes or files."""
        wrong = self.repeated + self.unequal + self.orphans + self.remains
        return self.flights == runs and self.same_figures and not wrong


@dataclass(frozen=True, slots=True)
class UserCampaign:
    """A user's campaign command that runs in a separate folder."""

    folder: Path
    runs: int
    duration: float
    dask: str = ""

    def start(self) -> subprocess.Popen[str]:
        """Start the command."""
        (self.folder / "tmp").mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "flight", "campaign", str(ROOT / "config" / "step_demo.yaml")]
        for text in VARIED:
            command += ["--vary", text]
        command += ["--runs", str(self.runs), "--duration", str(self.duration), "--out", "campaign", "--json"]
        command += ["--dask", self.dask] if self.dask else ["--workers", "2"]
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "PYTHONPATH": path, "TMPDIR": str(self.folder / "tmp")}
        with (self.folder / "log").open("a", encoding="utf-8") as log:
            return subprocess.Popen(
                command, cwd=self.folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=log
            )

    def finish(self) -> dict[str, Any]:
        """Run the command to its end, and return the summary that it prints."""
        with self.start() as process:
            return self.printed(process)

    def printed(self, process: subprocess.Popen[str]) -> dict[str, Any]:
        """Wait for the end of the command, and return its summary. Raises RuntimeError without a summary."""
        text, _ = process.communicate()
        if not text:
            raise RuntimeError(f"status {process.returncode}: {(self.folder / 'log').read_text()}")
        found: dict[str, Any] = json.loads(text)
        return found

    def lines(self) -> list[str]:
        """Return the complete lines of the file of the results."""
        path = self.folder / "campaign" / "results.jsonl"
        return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []

    def interrupt(self, number: signal.Signals, results: int, delay: float) -> tuple[bool, int]:
        """Start the command, and send a signal `delay` seconds after it has written a number of results.

        Returns whether the signal arrived before the command ended, and the number of processes that outlived
        the command by more than a minute.
        """
        with self.start() as process:
            while process.poll() is None and len(self.lines()) < results:
                time.sleep(0.02)
            time.sleep(delay)
            children = _children(process.pid)
            interrupted = process.poll() is None
            process.send_signal(number)
            process.communicate()
        return interrupted, _outliving(children)

    def compare(
        self, found: Any, expected: Any, reference: UserCampaign, interruptions: int, orphans: int
    ) -> Comparison:
        """Return the comparison of the printed summary `found` with that of the undisturbed campaign."""
        keys = Counter(json.loads(line)["key"] for line in self.lines())
        own, other = (
            {entry["key"]: entry["result"] for entry in map(json.loads, one.lines())}
            for one in (self, reference)
        )
        return Comparison(
            len(keys),
            keys.total() - len(keys),
            sum(own.get(key) != result for key, result in other.items()),
            found == expected,
            interruptions,
            orphans,
            len(list((self.folder / "tmp").iterdir()))
            + (self.folder / "campaign" / "temporary").is_symlink(),
        )


def killed(
    folder: Path, runs: int, duration: float, kills: int, seed: int, dask: bool = False
) -> dict[str, Comparison]:
    """Return the comparison of the killed campaign and, if `dask` is true, of the campaign on a cluster."""
    chance = np.random.default_rng(seed)
    whole = UserCampaign(folder / "whole", runs, duration)
    expected = whole.finish()
    part = UserCampaign(folder / "killed", runs, duration)
    interruptions = orphans = 0
    for number, results in enumerate(sorted(chance.choice(runs, kills, replace=False))):
        kind = signal.SIGINT if number == 1 else signal.SIGKILL
        before, left = part.interrupt(kind, int(results), float(chance.uniform(0.0, 0.5)))
        interruptions, orphans = interruptions + before, orphans + left
    found = {"killed": part.compare(part.finish(), expected, whole, interruptions, orphans)}
    if dask:
        with cluster(folder) as (address, (_, _, worker)):
            spread = UserCampaign(folder / "cluster", runs, duration, address)
            with spread.start() as process:
                while process.poll() is None and len(spread.lines()) < runs // 3:
                    time.sleep(0.02)
                lost = process.poll() is None
                worker.kill()
                printed = spread.printed(process)
        found["cluster"] = spread.compare(printed, expected, whole, int(lost), 0)
    return found


def _children(process: int) -> list[int]:
    """Return the processes that a process has started and that still run."""
    try:
        return list(map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split()))
    except OSError:
        return []


def _outliving(processes: Sequence[int]) -> int:
    """Wait for the end of processes, and return the number of those that run after a minute."""
    latest = time.monotonic() + _END_S
    while (left := sum(map(_runs, processes))) and time.monotonic() < latest:
        time.sleep(0.05)
    return left


def _runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@command
def main(
    *,
    runs: Annotated[int, "flights of the campaign"] = 500,
    duration: Annotated[float, "of each flight, s"] = 0.3,
    kills: Annotated[int, "of the campaign"] = 5,
    seed: Seed = 1,
    dask: Annotated[bool, "also on a cluster with a lost worker"] = False,
) -> int:
    """Print the comparisons. Returns 1 if a campaign is incomplete, differs, or left processes or files."""
    if dask and find_spec("distributed") is None:
        raise UsageError("--dask needs the package distributed: pip install 'knightcube-flight[dask]'")
    with scratch() as folder:
        found = killed(folder, runs, duration, kills, seed, dask)
    show({"campaigns": {kind: asdict(one) for kind, one in found.items()}})
    return 0 if all(one.sound(runs) for one in found.values()) else 1
