"""Runner of campaigns: runs cases on all cores or on a Dask cluster, shows progress, and resumes.

A campaign makes cases, each with a key and a seed of its own. The function `run` of the campaign turns a case
into a result that JSON can represent. Each result is appended to the file `results.jsonl` at once, so that
an interrupted campaign continues with the missing cases. Results do not depend on the order of the cases or
on the process that runs them.
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

from ground.campaigns import cluster
from knightcube.errors import UsageError

_PLAIN_S = 10.0
"""Time (s) between two lines of progress if the output is not a terminal."""
_WIDTH = 30
"""Width of the progress bar in characters."""


class Progress:
    """Display of the number of completed cases and of the expected remaining time."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._before = done
        self._done = done
        self._begun = self._written = time.perf_counter()
        self._terminal = sys.stderr.isatty()

    def note(self, line: str) -> None:
        """Write a line above the progress bar."""
        self._write(("\r\x1b[K" if self._terminal else "") + line + "\n")

    def advance(self) -> None:
        """Count one more completed case."""
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
        """Remove the progress bar."""
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


@dataclass(frozen=True, slots=True)
class Case:
    """Case of a campaign, with a unique `key` and the `seed` of the case's random generator."""

    key: str
    seed: tuple[int, ...]
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class Summary:
    """Result of a campaign as text and as values for JSON."""

    text: str
    facts: dict[str, Any]


def summary(facts: dict[str, Any]) -> Summary:
    """Return a summary whose text shows each list or dictionary of rows as a table."""
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
    """Print values as tables, or as one JSON object."""
    sys.stdout.write(json.dumps(facts) + "\n" if as_json else summary(facts).text)


def _table(rows: Sequence[Result]) -> list[str]:
    """Return the lines of a table whose head contains the keys of the rows."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [keys, *([_cell(row.get(key)) for key in keys] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells]


def _cell(value: Any) -> str:
    """Return a value as text, and None as a dash."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return " ".join(f"{key}={_cell(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    return "-" if value is None else str(value)


@dataclass(frozen=True, slots=True)
class Campaign:
    """Definition of a campaign.

    Attributes:
        name: name of the campaign.
        purpose: what the campaign measures, in one line.
        cases: function that returns the cases for a number of runs and a seed.
        run: function that runs a case, at the top level of a module, because other processes and machines
            import the function.
        summarise: function that summarises the results of all cases, given the results and the folder.
        default_runs: default number of runs.
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
    """Run the cases of a campaign that have no result in the folder `out`, and summarise all results.

    Raises UsageError if the folder contains another campaign or if no cluster is found, and CampaignError if
    the cluster is lost.

    Args:
        campaign: campaign to run.
        runs: number of runs.
        seed: seed of all random draws.
        out: folder of the results.
        workers: number of processes (default: the number of cores).
        dask: address of the scheduler of a Dask cluster that runs the cases instead of this machine.
        progress: whether to show the progress on standard error.
        only: text that the key of a case must contain for the case to be run.
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
    """Run a campaign in this process, and return its results."""
    return [campaign.run(case) for case in campaign.cases(runs, seed)]


def _selected(campaign: Campaign, runs: int, seed: int, only: str) -> list[Case]:
    """Return the cases whose key contains the text `only`. Raises UsageError without such a case."""
    cases = [case for case in campaign.cases(runs, seed) if only in case.key]
    if only and not cases:
        raise UsageError(f"--only {only!r}: no case of {campaign.name} contains this text")
    return cases


def _resume(label: Parameters, out: Path) -> dict[str, Result]:
    """Return the results in a folder by key, and remove a last line that was cut off by a kill.

    Raises UsageError if the folder contains a campaign with another `label`.
    """
    label_path, results_path = out / "campaign.json", out / "results.jsonl"
    if label_path.exists():
        found = json.loads(label_path.read_text(encoding="utf-8"))
        if found != label:
            raise UsageError(f"{out} contains {found}, not {label}: give another folder with --out")
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
    """Run cases on the cores of this machine, and yield each result when its case ends."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    count, context = workers or os.cpu_count(), get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_end_with_the_campaign) as pool:
        keys = {pool.submit(campaign.run, case): case.key for case in cases}
        try:
            for future in as_completed(keys):
                yield keys[future], future.result()
        except BaseException:
            # After Ctrl-C, cases that have not begun are cancelled; the other results are already on disk.
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _end_with_the_campaign() -> None:
    """Make the kernel kill this worker process when the process of its campaign ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _on_cluster(address: str, campaign: Campaign, cases: Sequence[Case], bar: Progress | None) -> Results:
    """Run cases on a cluster, and yield each result when its case ends."""
    if importlib.util.find_spec("distributed") is None:
        raise UsageError("--dask needs distributed: pip install 'knightcube-flight[dask]'")
    report = bar.note if bar is not None else lambda _: None
    yield from cluster.finished(address, campaign.run, cases, report)
