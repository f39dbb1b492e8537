"""Checks that this checkout behaves as REV does: `python -m tests.studies.same_bytes --against REV`.

The study flies ten flights and runs commands in this checkout, with its uncommitted changes, and in a
temporary checkout of REV, with the same interpreter on the same machine. It compares the flight logs and the
commands' results.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from tests.studies.same_bytes.answers import GROUPS, PHOTOGRAPHS, PICTURES, Answers, ask, photographs
from tests.studies.same_bytes.checkout import CheckoutError, cache_folder, check_out, repository, resolve
from tests.studies.same_bytes.comparison import Difference, Verdict, compare
from tests.studies.same_bytes.flights import FLIGHTS, SHORT, Flight, fly
from tests.studies.same_bytes.texts import Texts

AT_ONCE = 2  # number of runs at the same time
Run = Flight | Answers
"""A flight, or a group of commands with results."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, compare, print. Returns 0 if all results are equal, 1 if not, 2 for wrong use."""
    real = photographs()
    sets: dict[str, tuple[Run, ...]] = {"flights": FLIGHTS, "answers": (*GROUPS, real) if real else GROUPS}
    choices = sets | {run.name: (run,) for run in (*sets["flights"], SHORT, *sets["answers"])}
    options = _parser(list(choices)).parse_args(arguments)
    if real is None:
        sys.stderr.write(f"same_bytes: no photographs in {PHOTOGRAPHS}: they are left out\n")
    chosen = dict.fromkeys(run for name in options.only or sets for run in choices[name])
    try:
        commit = resolve(options.against)
        with tempfile.TemporaryDirectory(prefix="same-bytes-") as temporary:
            keep = Path(temporary) if options.keep is None else options.keep.resolve()
            verdicts = run_all(commit, list(chosen), keep, options.cache.resolve(), options.refresh)
    except (CheckoutError, ValueError) as error:
        sys.stderr.write(f"same_bytes: {error}\n")
        return 2
    if options.json:
        report = {"against": commit, "runs": [verdict.as_json() for verdict in verdicts]}
        sys.stdout.write(json.dumps(report) + "\n")
    else:
        sys.stdout.write(table(commit, verdicts))
    return int(any(verdict.difference is not None for verdict in verdicts))


def run_all(commit: str, runs: Sequence[Run], keep: Path, cache: Path, refresh: bool) -> list[Verdict]:
    """Perform the runs that the cache lacks, two at a time, and compare.

    The results of this checkout are stored in `keep`.

    Raises CheckoutError if REV's side fails, and ValueError for a wrong table of renamed texts.
    """
    texts = Texts.read()
    old = {run: cache_folder(cache, commit, run.name, run.key) for run in (PICTURES, *runs)}
    needed = dict.fromkeys((PICTURES, *runs) if any(isinstance(run, Answers) for run in runs) else runs)
    missing = [run for run in needed if refresh or not old[run].is_dir()]
    pictures = old[PICTURES]
    with tempfile.TemporaryDirectory(prefix="same-bytes-old-") as temporary:
        checkout = Path(temporary) / "checkout"
        if missing:
            check_out(commit, checkout)
        if PICTURES in missing:  # the other groups need the pictures
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
        if isinstance(run, Flight):
            fly(checkout, run, work)
        else:
            work.mkdir()
            (work / "pictures").symlink_to(pictures)
            (work / "photographs").symlink_to(PHOTOGRAPHS)
            ask(checkout, run, work)
    except CheckoutError as error:
        shutil.rmtree(work, ignore_errors=True)
        raise CheckoutError(f"{run.name} in {checkout}: {error}") from error
    shutil.rmtree(out, ignore_errors=True)
    work.rename(out)
    sys.stderr.write(f"same_bytes: {run.name} in {checkout}: {time.monotonic() - begin:.0f} s\n")


def _verdict(run: Run, old: Path, new: Path, job: Future[None], texts: Texts) -> Verdict:
    """Return the result of the comparison of a run when its job is done.

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


def _parser(names: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.same_bytes",
        description="Run this checkout and another revision; compare flight logs byte for byte, and answers.",
    )
    parser.add_argument("--against", required=True, metavar="REV", help="the revision to compare with")
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep this side's logs and answers there")
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        default=repository() / "runs" / "same_bytes",
        help="REV's logs and answers",
    )
    parser.add_argument("--refresh", action="store_true", help="run REV's side again")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
