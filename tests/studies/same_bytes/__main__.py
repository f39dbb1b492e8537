"""Checks that this checkout flies as REV does: `python -m tests.studies.same_bytes --against REV`.

Flies seven flights in this checkout, with its uncommitted changes, and in a temporary checkout of REV, with
the same interpreter on the same machine, and compares the flight and truth logs.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.studies.same_bytes.comparison import Verdict, compare
from tests.studies.same_bytes.flights import (
    FLIGHTS,
    SHORT,
    Flight,
    FlightError,
    cache_folder,
    check_out,
    fly,
    repository,
    resolve,
)

AT_ONCE = 2  # flights


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, compare, print; return 0 when all is equal, 1 when not, 2 for wrong use."""
    options = _parser().parse_args(arguments)
    known = {flight.name: flight for flight in (*FLIGHTS, SHORT)}
    flights = [known[name] for name in options.only] if options.only else list(FLIGHTS)
    try:
        commit = resolve(options.against)
        with tempfile.TemporaryDirectory(prefix="same-bytes-") as temporary:
            keep = Path(temporary) if options.keep is None else options.keep.resolve()
            verdicts = run(commit, flights, keep, options.cache.resolve(), options.refresh)
    except FlightError as error:
        sys.stderr.write(f"same_bytes: {error}\n")
        return 2
    if options.json:
        report = {"against": commit, "flights": [verdict.as_json() for verdict in verdicts]}
        sys.stdout.write(json.dumps(report) + "\n")
    else:
        sys.stdout.write(table(commit, verdicts))
    return int(any(verdict.difference is not None for verdict in verdicts))


def run(commit: str, flights: Sequence[Flight], keep: Path, cache: Path, refresh: bool) -> list[Verdict]:
    """Fly what the cache does not hold, two flights at a time, and compare; this side's logs go to `keep`."""
    old = {flight: cache_folder(cache, commit, flight) for flight in flights}
    new = {flight: keep / flight.name for flight in flights}
    for flight in flights:
        shutil.rmtree(new[flight], ignore_errors=True)
    missing = [flight for flight in flights if refresh or not old[flight].is_dir()]
    with tempfile.TemporaryDirectory(prefix="same-bytes-old-") as temporary:
        checkout = Path(temporary) / "checkout"
        if missing:
            check_out(commit, checkout)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            jobs = [pool.submit(fly, checkout, flight, old[flight]) for flight in missing]
            jobs += [pool.submit(fly, repository(), flight, new[flight]) for flight in flights]
            for number, job in enumerate(jobs, 1):
                job.result()
                sys.stderr.write(f"same_bytes: {number} of {len(jobs)} flights flown\n")
    return [compare(flight.name, old[flight], new[flight]) for flight in flights]


def table(commit: str, verdicts: Sequence[Verdict]) -> str:
    """Return the verdicts as a table."""
    lines = [f"against {commit[:12]}", f"{'flight':10} {'compared':>9} {'added':>7} {'extended':>9}  result"]
    for verdict in verdicts:
        total = sum(verdict.added.values())
        lines.append(
            f"{verdict.flight:10} {verdict.compared:9} {total:7} {verdict.extended:9}  {_result(verdict)}"
        )
    names = sorted({name for verdict in verdicts for name in verdict.added})
    if names:
        lines.append(f"packets added: {', '.join(names)}")
    return "\n".join(lines) + "\n"


def _result(verdict: Verdict) -> str:
    first = verdict.difference
    if first is None:
        return "equal"
    where = f"{first.log} log, {first.packet} at {first.time:.3f} s, {first.field}"
    return f"DIFFERENT: {where}: {first.old} -> {first.new}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.same_bytes",
        description="Fly this checkout and another revision; compare their logs byte for byte.",
    )
    names = [flight.name for flight in (*FLIGHTS, SHORT)]
    parser.add_argument("--against", required=True, metavar="REV", help="the revision to compare with")
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"of {', '.join(names)}")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep this checkout's logs there")
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        default=repository() / "runs" / "same_bytes",
        help="REV's flights",
    )
    parser.add_argument("--refresh", action="store_true", help="fly REV's flights again")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
