"""What a campaign is, and the machine that runs one: on all cores, resumable, with progress.

A campaign makes cases, each with a key and a seed of its own; `run` turns one into a result that JSON can
hold. Results are appended to `results.jsonl` as they come, so that a campaign that is broken off goes on
where it was; whoever runs which case, and in which order, changes nothing.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from flight.gnc.errors import UsageError

Result = dict[str, Any]
Parameters = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Case:
    """One run: `key` is unique in its campaign, `seed` feeds numpy's generator."""

    key: str
    seed: tuple[int, ...]
    parameters: Parameters


@dataclass(frozen=True, slots=True)
class Summary:
    """What a campaign found: text to print, facts for JSON, pictures that were drawn."""

    text: str
    facts: dict[str, Any]
    pictures: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign by name.

    Attributes:
        cases: makes the cases of (runs, seed).
        run: a function at the top level of a module, so that it reaches other processes and machines.
        summarise: takes the results in the order of the cases, and a folder for pictures.
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
) -> Summary:
    """Run the missing cases of a campaign in `out`, then summarise.

    Raises UsageError when the folder holds another campaign.
    """
    cases = campaign.cases(runs, seed)
    out.mkdir(parents=True, exist_ok=True)
    done = _resume(campaign, runs, seed, out)
    missing = [case for case in cases if case.key not in done]
    if missing:
        log = out / "results.jsonl"
        with log.open("a", encoding="utf-8") as sink, _executor(workers, dask) as executor:
            bar = _Bar(len(cases), len(cases) - len(missing)) if progress else None
            for key, result in _finished(executor, campaign.run, missing):
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


def _resume(campaign: Campaign, runs: int, seed: int, out: Path) -> dict[str, Result]:
    """Return the results that a folder already holds; a line cut off by a kill is left out."""
    label = {"campaign": campaign.name, "runs": runs, "seed": seed}
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


@contextmanager
def _executor(workers: int | None, dask: str | None) -> Iterator[Executor]:
    """Give an executor of this machine's cores, or of a Dask cluster whose scheduler is named."""
    if dask is not None:
        try:
            from distributed import Client  # noqa: PLC0415 - an optional extra
        except ModuleNotFoundError as error:
            raise UsageError("--dask needs the extra of that name: pip install '.[dask]'") from error
        with Client(dask) as client:
            yield client.get_executor()
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=get_context("spawn")) as pool:
        try:
            yield pool
        except BaseException:
            # Ctrl-C: what has come is on disk, what has not begun need not begin.
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _finished(
    executor: Executor, run: Callable[[Case], Result], cases: Sequence[Case]
) -> Iterator[tuple[str, Result]]:
    keys = {executor.submit(run, case): case.key for case in cases}
    for future in as_completed(keys):
        yield keys[future], future.result()


class _Bar:
    """A line of progress on standard error, with the time that is left."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._before = done
        self._done = done
        self._begun = time.perf_counter()

    def advance(self) -> None:
        """Count one more."""
        self._done += 1
        elapsed = time.perf_counter() - self._begun
        left = elapsed / (self._done - self._before) * (self._total - self._done)
        width = 30
        filled = width * self._done // self._total
        bar = "#" * filled + "." * (width - filled)
        sys.stderr.write(f"\r\x1b[K[{bar}] {self._done}/{self._total}  {left:.0f} s left")
        sys.stderr.flush()

    def close(self) -> None:
        """Take the line away."""
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()
