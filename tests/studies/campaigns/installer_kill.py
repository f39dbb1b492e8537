"""Campaign `installer-kill`: kill -9 of the installer during an update, at a random time or system call.

A case is a board that runs one release. Updates to other releases are killed repeatedly. Half of the kills
end the installer and its child processes at a random time. The other half end one process at a random system
call that changes files (by strace, if it is installed). After each kill the board must run the old or the new
release without an error. At the end an update must complete, and the board must run its release.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ground.campaigns.runner import Campaign, Case, Result, Summary, summary
from tests.deploy.boards import FakeBoard

KILLS = 10
"""Number of kills of a board, after which its update completes."""
_CALLS = "mkdir,mkdirat,symlink,symlinkat,rename,renameat,renameat2,unlink,unlinkat,fsync,openat"
_MOST_CALLS = 1500


def cases(runs: int, seed: int) -> list[Case]:
    """Return boards with `runs` kills in total."""
    sizes = [min(KILLS, runs - done) for done in range(0, runs, KILLS)]
    return [Case(str(number), (seed, number), {"kills": size}) for number, size in enumerate(sizes)]


def run(case: Case) -> Result:
    """Kill updates of one board repeatedly, and let the last update complete."""
    rng = np.random.default_rng(case.seed)
    with tempfile.TemporaryDirectory() as name:
        board = FakeBoard(Path(name) / "root")
        begun = time.monotonic()
        board.install("0")
        took, flown, label = time.monotonic() - begun, [], "0"
        for number in range(case.parameters["kills"]):
            flown.append(_kill(board, took, label, str(number + 1), rng))
            label = flown[-1]["label"]
        board.install("last")
        end = board.fly()
    return {"flown": flown, "end": end}


def _kill(board: FakeBoard, took: float, old: str, new: str, rng: np.random.Generator) -> Result:
    """Start an update from release `old` to `new`, kill it, and start the flight."""
    words, by_time = board.words(new), bool(rng.random() < 0.5) or shutil.which("strace") is None
    place = float(rng.random())
    if not by_time:
        number = 1 + round(place * place * _MOST_CALLS)
        inject = f"inject={_CALLS}:signal=SIGKILL:when={number}"
        words = ["strace", "-f", "-qq", "-o", "/dev/null", "-e", f"trace={_CALLS}", "-e", inject, *words]
    update = subprocess.Popen(
        words,
        env=board.environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    if by_time:
        time.sleep(place * 1.2 * took)
        os.killpg(update.pid, signal.SIGKILL)
    update.wait()
    label, complaint = board.fly()
    shutil.rmtree(board.root / "state")
    which = {old: "old", new: "new", "": "none"}.get(label, "another")
    return {"by_time": by_time, "place": place, "label": label, "which": which, "complaint": complaint}


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return which release the board ran after each kill."""
    del folder
    kills = [kill for result in results for kill in result["flown"]]
    labels = Counter(kill["which"] for kill in kills)
    bad = [kill for kill in kills if kill["which"] not in {"old", "new"} or kill["complaint"]]
    ends = sum(list(result["end"]) == ["last", ""] for result in results)
    facts = {
        "kills": len(kills),
        "by_time": sum(kill["by_time"] for kill in kills),
        "labels": dict(labels),
        "bad": bad,
        "ends": ends,
        "boards": len(results),
    }
    return summary(facts)


INSTALLER_KILL = Campaign(
    "installer-kill",
    "kill -9 of the installer at every step of an update: a release flies, always",
    cases,
    run,
    summarise,
    default_runs=100,
)
