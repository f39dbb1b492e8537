"""Campaign `renewal-trials`: valid, damaged and unusable updates over the link, killed at random times.

A case is a board that runs a release with a configuration. The ground sends one bundle, activates it, and may
confirm it. Every second run of the privileged program is killed with all its child processes at a random
time; the link is restarted at random. After the trial period the old or the new version must be in use; if
the bundle had a flaw, it must be the old version. The link must still execute a command.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from flight.link.process.commanding import Stage
from flight.link.process.directives import KINDS, Confirm
from ground.campaigns.runner import Case, Result, Summary, summary
from tests.deploy.renewed_board import RenewedBoard
from tests.deploy.renewed_ends import RenewedEnds, linked_text

FLAWS = {
    "configuration": ("", "", "byte", "cut", "foreign key", "bounds", "body", "world", "keys", "reacts"),
    "release": ("", "crashes", "self-test", "cut", "packages"),
}
"""Flaws of the bundles of each kind; an empty string means no flaw."""
HOURS, STEPS, LONGEST_S = 2.0, 12, 8.0
_REPLACED = {
    "bounds": ("duration:", "duration: -1 #"),
    "body": ("name:", "body: nosuch:x\nname:"),
    "world": ("simulation:", "simulation:\n  world: nosuch:x"),
    "keys": ("/var/lib/knightcube-link/keys", "/nowhere/keys"),
}


def cases(runs: int, seed: int) -> list[Case]:
    """Return boards with the kind and the flaw of their bundle."""
    found = []
    for number in range(runs):
        rng = np.random.default_rng((seed, number))
        kind = "release" if number % 4 == 3 else "configuration"
        flaws = FLAWS[kind]
        flaw = flaws[(number // 4 if kind == "release" else number) % len(flaws)]
        parameters = {"kind": kind, "flaw": flaw, "confirmed": bool(rng.random() < 0.5)}
        found.append(Case(str(number), (seed, number, 1), parameters))
    return found


@cache
def _made() -> RenewedBoard:
    """Return the template board, which is copied for each case."""
    return RenewedBoard.make(Path(tempfile.mkdtemp(prefix="renewal-")) / "board", linked_text())


def run(case: Case) -> Result:
    """Activate one bundle, kill processes at random times, and return the version in use after the trial."""
    rng = np.random.default_rng(case.seed)
    kind, flaw = case.parameters["kind"], case.parameters["flaw"]
    with tempfile.TemporaryDirectory(prefix="renewal-") as name:
        board = RenewedBoard.copy(_made(), Path(name) / "board")
        ends = RenewedEnds(board, int(rng.integers(1 << 30)))
        ends.reacts = "new" if flaw == "reacts" else ""
        old = board.flown(), ends.flown_release()
        board.step()
        ends.activate(_bundle(board, kind, flaw), kind, HOURS)
        killed, confirmed = 0, False
        for _ in range(STEPS):
            killed += _step(ends, rng)
            if rng.random() < 0.1:
                ends.restart()
            ends.turn(1.5)
            tried = any("trial of" in report.text for report in ends.reports())
            if case.parameters["confirmed"] and tried and not confirmed and rng.random() < 0.5:
                ends.ask(Confirm(KINDS.index(kind)))
                confirmed = True
        for seconds in (3600.0 * HOURS, 10.0, 10.0, 10.0):
            board.step(seconds)
            ends.services()
            ends.turn(1.5)
        kept = any(r.name == "activate" and r.stage is Stage.COMPLETED for r in ends.reports())
        flown = board.flown(), ends.flown_release()
        answers = ends.answers() and all(ends.up.values())
        texts = [report.text for report in ends.reports() if report.name == "activate"]
        ends.close()
    new = ("new", old[1]) if kind == "configuration" else (old[0], "new")
    which = {old: "old", new: "new"}.get(flown, "another")
    return {
        "kind": kind,
        "flaw": flaw,
        "which": which,
        "answers": answers,
        "killed": killed,
        "kept": kept,
        "texts": texts,
    }


def _bundle(board: RenewedBoard, kind: str, flaw: str) -> Path:
    """Return a signed bundle with a flaw."""
    if kind == "release":
        path = board.source({"crashes": "crashes", "self-test": ""}.get(flaw, "new"))
        if flaw == "packages":
            (path / "deploy/requirements.lock").write_text("numpy==1\n", encoding="ascii")
    else:
        path = board.changed("new")
        before, after = _REPLACED.get(flaw, ("", ""))
        if before:
            text = path.read_text(encoding="utf-8")
            path.write_text(text.replace(before, after, 1), encoding="utf-8")
    if flaw == "foreign key":
        from ground.commands.renewal import make_signing_keys  # noqa: PLC0415

        shutil.rmtree(board.place / "signing")
        make_signing_keys(board.place / "signing")
    bundle = board.bundle(kind, path, 1, unchecked=True)
    data = bytearray(bundle.read_bytes())
    if flaw == "byte":
        data[len(data) // 2] ^= 1
    bundle.write_bytes(data[:-100] if flaw == "cut" else data)
    return bundle


def _step(ends: RenewedEnds, rng: np.random.Generator) -> bool:
    """Run one step of the privileged program, and return whether it was killed."""
    board = ends.board
    board.now += float(rng.uniform(5.0, 60.0))
    process = subprocess.Popen(
        board.words(),
        env=board.environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    if rng.random() < 0.5:
        try:
            process.wait(float(LONGEST_S ** rng.uniform(-2.0, 1.0)))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return True
    process.wait()
    ends.services()
    return False


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the versions in use after the trials, and the results that are wrong."""
    wrong = [
        result
        for result in results
        if result["which"] == "another"
        or not result["answers"]
        or (result["which"] == "new") != result["kept"]
        or (result["flaw"] not in {"", "reacts"} and result["which"] != "old")
    ]
    which = Counter(f"{result['kind']} {result['flaw'] or 'good'}: {result['which']}" for result in results)
    killed = sum(result["killed"] for result in results)
    facts = {"trials": len(results), "killed": killed, "which": dict(sorted(which.items())), "wrong": wrong}
    return summary(facts)
