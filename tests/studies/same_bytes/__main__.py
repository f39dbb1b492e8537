"""Checks that this checkout behaves as another revision does.

The study flies ten flights and runs commands in two checkouts: this one with its uncommitted changes, and a
temporary checkout of the other revision (REV). Both use the same interpreter on the same machine. It compares
the flight logs and the commands' results.
"""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

from knightcube.errors import UsageError
from tests.studies.command import Json, command, say, scratch
from tests.studies.same_bytes.checkout import CheckoutError, cache_folder, check_out, repository, resolve
from tests.studies.same_bytes.comparison import Difference, Texts, Verdict, compare
from tests.studies.same_bytes.runs import (
    FLIGHTS,
    GROUPS,
    PHOTOGRAPHS,
    PICTURES,
    SHORT,
    Run,
    perform,
    photographs,
)

CACHE = repository() / "runs" / "same_bytes"
AT_ONCE = 2  # number of runs at the same time


@command
def main(
    *,
    against: Annotated[str, "the revision to compare with"],
    only: Annotated[tuple[str, ...], "names of runs, or `flights` or `answers`"] = (),
    keep: Annotated[Path | None, "folder that keeps this side's logs and answers"] = None,
    cache: Annotated[Path, "folder of REV's logs and answers"] = CACHE,
    refresh: Annotated[bool, "run REV's side again"] = False,
    json: Json = False,
) -> int:
    """Run, compare, print. Returns 0 if all results are equal, 1 if not, 2 for wrong use."""
    real = photographs()
    sets: dict[str, tuple[Run, ...]] = {"flights": FLIGHTS, "answers": (*GROUPS, real) if real else GROUPS}
    choices = sets | {run.name: (run,) for run in (*sets["flights"], SHORT, *sets["answers"])}
    if unknown := set(only) - choices.keys():
        raise UsageError(f"--only {', '.join(sorted(unknown))}: choose from {', '.join(choices)}")
    if real is None:
        sys.stderr.write(f"same_bytes: no photographs in {PHOTOGRAPHS}: they are left out\n")
    chosen = dict.fromkeys(run for name in only or sets for run in choices[name])
    commit = resolve(against)
    with scratch() as temporary:
        verdicts = run_all(commit, list(chosen), (keep or temporary).resolve(), cache.resolve(), refresh)
    if json:
        say(against=commit, runs=[verdict.as_json() for verdict in verdicts])
    else:
        sys.stdout.write(table(commit, verdicts))
    return int(any(verdict.difference is not None for verdict in verdicts))


def run_all(commit: str, runs: Sequence[Run], keep: Path, cache: Path, refresh: bool) -> list[Verdict]:
    """Perform the runs that the cache lacks, two at a time, and compare.

    The results of this checkout are stored in `keep`.

    Raises CheckoutError if REV's side fails, and UsageError for a wrong table of renamed texts.
    """
    texts = Texts.read()
    old = {run: cache_folder(cache, commit, run.name, run.key) for run in (PICTURES, *runs)}
    needed = dict.fromkeys((PICTURES, *runs) if any(run.reads_pictures for run in runs) else runs)
    missing = [run for run in needed if refresh or not old[run].is_dir()]
    pictures = old[PICTURES]
    with scratch() as temporary:
        checkout = temporary / "checkout"
        if missing:
            check_out(commit, checkout)
        if PICTURES in missing:  # other groups read the pictures
            _timed(checkout, PICTURES, old[PICTURES], pictures)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            first = [
                pool.submit(_timed, checkout, run, old[run], pictures) for run in missing if run != PICTURES
            ]
            second = {run: pool.submit(_timed, repository(), run, keep / run.name, pictures) for run in runs}
            for job in first:
                job.result()
            return [_verdict(run, old[run], keep / run.name, second[run], texts) for run in runs]


def _timed(checkout: Path, run: Run, out: Path, pictures: Path) -> None:
    """Run, and print the duration. Raises CheckoutError on failure; `out` then does not exist."""
    work = out.with_name(f"{out.name}.{os.getpid()}.part")  # several processes may share the cache
    shutil.rmtree(work, ignore_errors=True)
    work.parent.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    try:
        perform(checkout, run, work, pictures)
    except CheckoutError as error:
        shutil.rmtree(work, ignore_errors=True)
        raise CheckoutError(f"{run.name} in {checkout}: {error}") from error
    shutil.rmtree(out, ignore_errors=True)
    work.rename(out)
    sys.stderr.write(f"same_bytes: {run.name} in {checkout}: {time.monotonic() - begin:.0f} s\n")


def _verdict(run: Run, old: Path, new: Path, job: Future[None], texts: Texts) -> Verdict:
    """Wait for the job of a run, and return the result of the comparison.

    A run that failed in this checkout counts as different.
    """
    try:
        job.result()
    except CheckoutError as error:
        return Verdict(run.name, 0, {}, 0, Difference("run", run.name, None, "end", "ended well", str(error)))
    return compare(run.name, old, new, texts)


def table(commit: str, verdicts: Sequence[Verdict]) -> str:
    """Return the results of the comparisons as a table."""
    lines = [f"against {commit[:12]}", f"{'run':12} {'compared':>9} {'added':>7} {'extended':>9}  result"]
    for verdict in verdicts:
        total = sum(verdict.added.values())
        lines.append(
            f"{verdict.name:12} {verdict.compared:9} {total:7} {verdict.extended:9}  {_result(verdict)}"
        )
    names = sorted({name for verdict in verdicts for name in verdict.added})
    if names:
        lines.append(f"added: {', '.join(names)}")
    return "\n".join(lines) + "\n"


def _result(verdict: Verdict) -> str:
    first = verdict.difference
    if first is None:
        return "equal"
    time = "" if first.time is None else f" at {first.time:.3f} s"
    return f"DIFFERENT: {first.log}, {first.packet}{time}, {first.field}: {first.old} -> {first.new}"


if __name__ == "__main__":
    raise SystemExit(main())
