"""What a campaign is, and the machine that runs one: on all cores, resumable, with progress.

A campaign makes cases, each with a key and a seed of its own; `run` turns one into a result that JSON can
hold. Results are appended to `results.jsonl` as they come, so that a campaign that is broken off goes on
where it was; whoever runs which case, and in which order, changes nothing.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from knightcube.errors import FlightError, UsageError
from tests.studies.campaigns import cluster

_PLAIN_S = 10.0
_WIDTH = 30


class Progress:
    """How many cases are done, and how long the rest takes at the pace so far."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._before = done
        self._done = done
        self._begun = self._written = time.perf_counter()
        self._terminal = sys.stderr.isatty()

    def note(self, line: str) -> None:
        """Write a line of its own."""
        self._write(("\r\x1b[K" if self._terminal else "") + line + "\n")

    def advance(self) -> None:
        """Count one more."""
        self._done += 1
        now = time.perf_counter()
        left = (now - self._begun) / (self._done - self._before) * (self._total - self._done)
        if self._terminal:
            filled = _WIDTH * self._done // self._total
            bar = "#" * filled + "." * (_WIDTH - filled)
            self._write(f"\r\x1b[K[{bar}] {self._done}/{self._total}  {left:.0f} s left")
        elif now - self._written >= _PLAIN_S:
            self._written = now
            self._write(f"{self._done} of {self._total} done, {left:.0f} s left\n")

    def close(self) -> None:
        """Take the line away."""
        if self._terminal:
            self._write("\r\x1b[K")

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


_PR_SET_PDEATHSIG = 1  # prctl(2)

Result = dict[str, Any]
Parameters = dict[str, Any]
Results = Generator[tuple[str, Result], None, None]


class CampaignError(FlightError):
    """A campaign that cannot go on here; what is done is kept."""


@dataclass(frozen=True, slots=True)
class Case:
    """One run: `key` is unique in its campaign, `seed` feeds numpy's generator."""

    key: str
    seed: tuple[int, ...]
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class Summary:
    """Text to print and facts for JSON."""

    text: str
    facts: dict[str, Any]


def summary(facts: dict[str, Any]) -> Summary:
    """Return facts with a text: a table for each list or dictionary of rows, a line for each value."""
    lines: list[str] = []
    for name, value in facts.items():
        rows = value
        if isinstance(value, dict) and value and all(isinstance(row, dict) for row in value.values()):
            rows = [{name: key, **row} for key, row in value.items()]
        if isinstance(rows, list) and rows and all(isinstance(row, dict) for row in rows):
            lines += ["", name, *_table(rows)]
        else:
            lines.append(f"{name}: {_cell(value)}")
    return Summary("\n".join(lines).lstrip("\n") + "\n", facts)


def show(facts: dict[str, Any], as_json: bool = False) -> None:
    """Print facts as tables, or as one JSON object."""
    sys.stdout.write(json.dumps(facts) + "\n" if as_json else summary(facts).text)


def _table(rows: Sequence[Result]) -> list[str]:
    """Return rows as aligned columns under their keys."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [keys, *([_cell(row.get(key)) for key in keys] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells]


def _cell(value: Any) -> str:
    """Return a value as text; a dash means that there is none."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return " ".join(f"{key}={_cell(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    return "-" if value is None else str(value)


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign by name.

    Attributes:
        cases: makes the cases of (runs, seed).
        run: a function at the top level of a module, so that it reaches other processes and machines.
        summarise: takes the results in the order of the cases, and the campaign's folder.
        default_runs: what `runs` is when not given, and what it counts.
    """

    name: str
    purpose: str
    cases: Callable[[int, int], list[Case]]
    run: Callable[[Case], Result]
    summarise: Callable[[Sequence[Result], Path], Summary]
    default_runs: int


def fly(
    campaign: Campaign,
    runs: int,
    seed: int,
    out: Path,
    workers: int | None = None,
    dask: str | None = None,
    progress: bool = False,
    only: str = "",
) -> Summary:
    """Run the missing cases of a campaign in `out`, then summarise.

    Of the cases, `only` keeps those whose key contains it.
    `dask` is the address of a cluster's scheduler, which runs them instead of this machine. Raises UsageError
    when the folder holds another campaign or there is no cluster, CampaignError when the cluster is lost.
    """
    cases = _selected(campaign, runs, seed, only)
    out.mkdir(parents=True, exist_ok=True)
    label = {"campaign": campaign.name, "runs": runs, "seed": seed} | ({"only": only} if only else {})
    done = _resume(label, out)
    missing = [case for case in cases if case.key not in done]
    if missing:
        log = out / "results.jsonl"
        bar = Progress(len(cases), len(cases) - len(missing)) if progress else None
        results = _on_cluster(dask, campaign, missing, bar) if dask else _here(workers, campaign, missing)
        with log.open("a", encoding="utf-8") as sink, closing(results):
            for key, result in results:
                done[key] = result
                sink.write(json.dumps({"key": key, "result": result}, allow_nan=True) + "\n")
                sink.flush()
                if bar is not None:
                    bar.advance()
        if bar is not None:
            bar.close()
    summary = campaign.summarise([done[case.key] for case in cases], out)
    facts = json.dumps(summary.facts, indent=1, allow_nan=False) + "\n"
    (out / "summary.json").write_text(facts, encoding="utf-8")
    (out / "summary.txt").write_text(summary.text, encoding="utf-8")
    return summary


def fly_here(campaign: Campaign, runs: int, seed: int) -> list[Result]:
    """Run a campaign in this process and return its results: for the tests' small slices."""
    return [campaign.run(case) for case in campaign.cases(runs, seed)]


def _selected(campaign: Campaign, runs: int, seed: int, only: str) -> list[Case]:
    """Return the cases whose key contains `only`. Raises UsageError where none does."""
    cases = [case for case in campaign.cases(runs, seed) if only in case.key]
    if only and not cases:
        raise UsageError(f"--only {only!r}: {campaign.name} has no such case")
    return cases


def _resume(label: Parameters, out: Path) -> dict[str, Result]:
    """Return the results that a folder already holds; a line cut off by a kill is left out.

    Raises UsageError when the folder holds a campaign with another `label`.
    """
    label_path, results_path = out / "campaign.json", out / "results.jsonl"
    if label_path.exists():
        found = json.loads(label_path.read_text(encoding="utf-8"))
        if found != label:
            raise UsageError(f"{out} holds {found}, not {label}: give another folder with --out")
    else:
        label_path.write_text(json.dumps(label) + "\n", encoding="utf-8")
    done: dict[str, Result] = {}
    if results_path.exists():
        text = results_path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            results_path.write_text(whole, encoding="utf-8")
        for line in whole.splitlines():
            entry = json.loads(line)
            done[entry["key"]] = entry["result"]
    return done


def _here(workers: int | None, campaign: Campaign, cases: Sequence[Case]) -> Results:
    """Run cases on this machine's cores; yield them as they come."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    count, context = workers or os.cpu_count(), get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_end_with_the_campaign) as pool:
        keys = {pool.submit(campaign.run, case): case.key for case in cases}
        try:
            for future in as_completed(keys):
                yield keys[future], future.result()
        except BaseException:
            # Ctrl-C: what has come is on disk, what has not begun need not begin.
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_the_campaign() -> None:
    """Ask the kernel to end this worker with its campaign, which may be killed."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _on_cluster(address: str, campaign: Campaign, cases: Sequence[Case], bar: Progress | None) -> Results:
    """Run cases on a cluster; yield them as they come."""
    if importlib.util.find_spec("distributed") is None:
        raise UsageError("--dask needs the extra of that name: pip install '.[dask]'")
    report = bar.note if bar is not None else lambda _: None
    yield from cluster.finished(address, campaign.run, cases, report)
