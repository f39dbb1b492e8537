"""Runner of campaigns: runs cases on all cores or on a Dask cluster, shows progress, and resumes.

A campaign consists of cases, each with its own key and seed. The function `run` of the campaign runs a case
and returns a result that JSON can represent. Each result is appended to the file `results.jsonl` at once, so
that an interrupted campaign continues with the missing cases. Results do not depend on the order of the cases
or on the process that runs them. A lock on `results.jsonl` prevents a second process from using the folder.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import importlib.util
import json
import math
import os
import pickle
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from multiprocessing import connection, get_context
from pathlib import Path
from typing import IO, Any

from ground.campaigns import CampaignError, cluster
from knightcube.errors import UsageError

_PLAIN_S = 10.0  # time (s) between two lines of progress if the output is not a terminal
_WIDTH = 30  # width of the progress bar in characters
_ATTEMPTS = 3  # maximum number of attempts to run a case whose worker process dies
_STOP_S = 5.0  # time (s) in which interrupted worker processes must end before they are killed
_SCRATCH = "knightcube-campaign-"
"""Prefix of the name of the folder that contains the temporary files of the workers."""
_TEMPORARY = "temporary"  # name of the link, in the campaign's folder, to the folder of temporary files


class Progress:
    """Display of the number of completed cases and of the expected remaining time."""

    def __init__(self, total: int, done: int) -> None:
        self._total = total
        self._before = done
        self._done = done
        self._begun = self._written = time.perf_counter()
        self._terminal = sys.stderr.isatty()
        if done:
            self.note(f"continuing: {done} of {total} were done before")
        self._draw("")

    def note(self, line: str) -> None:
        """Write a line above the progress bar."""
        self._write(("\r\x1b[K" if self._terminal else "") + line + "\n")

    def advance(self) -> None:
        """Count one more completed case."""
        self._done += 1
        now = time.perf_counter()
        left = (now - self._begun) / (self._done - self._before) * (self._total - self._done)
        self._draw(f"{_duration(left)} left")
        if not self._terminal and now - self._written >= _PLAIN_S:
            self._written = now
            self._write(f"{self._done} of {self._total} done, {_duration(left)} left\n")

    def close(self) -> None:
        """Remove the progress bar."""
        if self._terminal:
            self._write("\r\x1b[K")

    def _draw(self, left: str) -> None:
        """Draw the progress bar, followed by the text `left`, if the output is a terminal."""
        if self._terminal:
            filled = _WIDTH * self._done // self._total
            bar = "#" * filled + "." * (_WIDTH - filled)
            self._write(f"\r\x1b[K[{bar}] {self._done}/{self._total}  {left}")

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()


def _duration(seconds: float) -> str:
    """Return a duration as a text such as `40 s`, `12 min` or `3 h 05 min`."""
    minutes = round(seconds / 60.0)
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


_PR_SET_PDEATHSIG = 1  # prctl(2)
_RESULTS = "results.jsonl"  # name of the file of the results in the folder of a campaign
_LABEL = "campaign.json"  # name of the file with the campaign's name, number of runs and seed

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
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [keys, *([_cell(row.get(key)) for key in keys] for row in rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(keys))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in cells]


def _cell(value: Any) -> str:
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

    The cases run in `workers` processes (default: the number of cores), or on the Dask cluster whose
    scheduler has the address `dask`. If `only` is given, only the cases whose key contains this text are run.
    Raises UsageError if the folder contains another campaign or if no cluster is found, and CampaignError if
    the cluster is lost.
    """
    cases = [case for case in campaign.cases(runs, seed) if only in case.key]
    if only and not cases:
        raise UsageError(f"--only {only!r}: no case of {campaign.name} contains this text")
    label = {"campaign": campaign.name, "runs": runs, "seed": seed} | ({"only": only} if only else {})
    with _opened(out) as sink:
        done = _resume(label, out, sink)
        _clear(out / _TEMPORARY)  # a killed campaign leaves its temporary folder
        missing = [case for case in cases if case.key not in done]
        if missing:
            bar = Progress(len(cases), len(cases) - len(missing)) if progress else None
            if dask and importlib.util.find_spec("distributed") is None:
                raise UsageError("--dask needs distributed: pip install 'knightcube-flight[dask]'")
            report = bar.note if bar is not None else lambda _: None
            results = _here(workers, campaign, missing, out)
            if dask:
                results = cluster.finished(dask, campaign.run, missing, report)
            with closing(results):
                for key, result in results:
                    done[key] = result
                    sink.write(json.dumps({"key": key, "result": result}, allow_nan=True) + "\n")
                    sink.flush()
                    if bar is not None:
                        bar.advance()
            if bar is not None:
                bar.close()
        elif progress:
            _note_complete(out)
        summary = campaign.summarise([done[case.key] for case in cases], out)
        summary = replace(summary, facts=_without_nan(summary.facts))
        facts = json.dumps(summary.facts, indent=1, allow_nan=False) + "\n"
        (out / "summary.json").write_text(facts, encoding="utf-8")
        (out / "summary.txt").write_text(summary.text, encoding="utf-8")
    return summary


def _without_nan(value: Any) -> Any:
    """Return values for JSON, with None instead of NaN. The mean of a row without results is NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _note_complete(out: Path) -> None:
    """Print that no case ran because all cases have results, and when the campaign began."""
    begun = datetime.fromtimestamp((out / _LABEL).stat().st_mtime).isoformat(" ", "minutes")
    whole = f"contains all results of the campaign of {begun}; delete the folder to run it again"
    sys.stderr.write(f"no case ran: {out} {whole}\n")


def results_in(out: Path) -> list[Result]:
    """Return the results in the folder of a campaign, ordered by the keys of their cases."""
    if not (out / _RESULTS).exists():
        return []
    with (out / _RESULTS).open(encoding="utf-8") as lines:
        done = _read(lines)[0]
    return [done[key] for key in sorted(done)]


def fly_here(campaign: Campaign, runs: int, seed: int) -> list[Result]:
    """Run a campaign in this process, and return its results."""
    return [campaign.run(case) for case in campaign.cases(runs, seed)]


@contextmanager
def _opened(out: Path) -> Iterator[IO[str]]:
    """Open and lock the file of the results. Raises UsageError if another process holds the lock."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / _RESULTS).open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(f"{out}: another process runs this campaign: wait, or give --out") from error
        yield file


def _resume(label: Parameters, out: Path, file: IO[str]) -> dict[str, Result]:
    """Return the results by key, and remove an incomplete last line. Raises UsageError if `label` differs."""
    label_path = out / _LABEL
    if label_path.exists():
        found = json.loads(label_path.read_text(encoding="utf-8"))
        if found != label:
            differing = ", ".join(
                f"{key} {found.get(key, 'none')}, not {label.get(key, 'none')}"
                for key in dict.fromkeys((*found, *label))
                if found.get(key) != label.get(key)
            )
            raise UsageError(
                f"{out} contains another campaign ({differing}): give another folder with --out, or continue "
                "the campaign in this folder with its own options"
            )
    else:
        beside = label_path.with_suffix(".new")
        beside.write_text(json.dumps(label) + "\n", encoding="utf-8")
        beside.replace(label_path)
    file.seek(0)
    done, length = _read(file)
    file.truncate(length)
    file.seek(0, os.SEEK_END)
    return done


def _read(lines: IO[str]) -> tuple[dict[str, Result], int]:
    """Return the results by key, and the length (bytes) of the complete lines.

    The results are ASCII text. A complete line that is not JSON, for example after a power failure, is
    skipped, so that its case runs again.
    """
    text = lines.read()
    whole = text[: text.rfind("\n") + 1]
    done: dict[str, Result] = {}
    for line in whole.splitlines():
        with suppress(json.JSONDecodeError):
            entry = json.loads(line)
            done[entry["key"]] = entry["result"]
    return done, len(whole)


@dataclass(slots=True)
class _Worker:
    """Worker process, the parent's end of its pipe, and the case that the process runs."""

    process: Any
    pipe: Any
    case: Case | None = None


def _here(workers: int | None, campaign: Campaign, cases: Sequence[Case], out: Path) -> Results:
    """Run cases on the cores of this machine, and yield each result when its case ends.

    If a worker process dies, another process runs its case. Raises CampaignError if three processes die while
    they run the same case. If a case fails, its exception is raised here. All worker processes have ended
    when the function returns or raises an error.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    count = min(workers or os.cpu_count() or 1, len(cases))
    waiting, deaths = deque(cases), Counter[str]()
    crew: list[_Worker] = []
    with _scratch(out) as scratch:
        try:
            while waiting or any(worker.case for worker in crew):
                crew += [_worker(campaign, scratch) for _ in range(min(count, len(waiting)) - len(crew))]
                for worker in crew:
                    if worker.case is None and waiting:
                        worker.case = waiting.popleft()
                        # If the process has died, reading from its pipe below raises an error.
                        with suppress(OSError):
                            worker.pipe.send(worker.case)
                busy = {worker.pipe: (worker, worker.case) for worker in crew if worker.case is not None}
                for pipe in connection.wait(list(busy)):
                    worker, case = busy[pipe]
                    try:
                        result, error = worker.pipe.recv()
                    except (EOFError, OSError) as lost:
                        crew.remove(worker)
                        worker.process.join()
                        deaths[case.key] += 1
                        if deaths[case.key] == _ATTEMPTS:
                            status = worker.process.exitcode
                            raise CampaignError(
                                f"case {case.key}: {_ATTEMPTS} worker processes died, "
                                f"the last with status {status}: check the memory"
                            ) from lost
                        waiting.appendleft(case)
                        continue
                    if error is not None:
                        raise error
                    worker.case = None
                    yield case.key, result
        finally:
            _stop(crew)


def _worker(campaign: Campaign, scratch: str) -> _Worker:
    context = get_context("spawn")
    pipe, end = context.Pipe()
    process = context.Process(target=_serve, args=(end, campaign.run, os.getpid(), scratch))
    process.start()
    end.close()  # the pipe then closes when the worker process ends
    return _Worker(process, pipe)


def _stop(crew: Sequence[_Worker]) -> None:
    """End worker processes: idle processes by closing their pipes, busy processes by SIGINT, then SIGKILL."""
    for worker in crew:
        if worker.case is not None and worker.process.is_alive():
            os.kill(worker.process.pid, signal.SIGINT)
        worker.pipe.close()
    latest = time.monotonic() + _STOP_S
    for worker in crew:
        worker.process.join(max(0.0, latest - time.monotonic()))
        worker.process.kill()
        worker.process.join()


def _serve(pipe: Any, run: Callable[[Case], Result], parent: int, scratch: str) -> None:
    """Run the cases that a worker process receives through a pipe, and send back result or exception."""
    # The kernel kills this process when its parent, the process of the campaign, ends.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # the campaign's process ended before the call of prctl
        os._exit(1)
    tempfile.tempdir = scratch
    with suppress(EOFError, OSError, KeyboardInterrupt):
        while True:
            case = pipe.recv()
            answer: tuple[Result | None, Exception | None]
            try:
                answer = run(case), None
            except Exception as error:  # noqa: BLE001 - raised in the process of the campaign
                error.add_note(f"in case {case.key}:\n{traceback.format_exc()}")
                answer = None, error
            pipe.send(_sendable(case, answer))
            # A flight leaves reference cycles with large arrays. Because a flight suspends the collection of
            # older objects, the automatic collection would find these cycles only after dozens of flights.
            gc.collect()


def _sendable(
    case: Case, answer: tuple[Result | None, Exception | None]
) -> tuple[Result | None, Exception | None]:
    """Return result and exception of a case, or a CampaignError if they cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(answer))
    except Exception as problem:  # noqa: BLE001 - any error of the methods of a foreign class
        error = answer[1]
        found = f"failed: {type(error).__name__}: {error}"
        if error is None:
            found = f"has a result that cannot be sent: {type(problem).__name__}: {problem}"
        replaced = CampaignError(f"case {case.key} {found}")
        for note in getattr(error, "__notes__", ()):
            replaced.add_note(note)
        return None, replaced
    return answer


@contextmanager
def _scratch(out: Path) -> Iterator[str]:
    """Yield a folder for temporary files of the workers, and delete the folder at the end.

    A symbolic link in the campaign's folder points to the temporary folder. If the campaign is killed, its
    next start deletes the temporary folder through this link. The temporary folder has a short path, because
    paths of sockets are limited to 107 characters.
    """
    link = out / _TEMPORARY
    folder = tempfile.mkdtemp(prefix=_SCRATCH)
    link.symlink_to(folder)
    try:
        yield folder
    finally:
        _clear(link)


def _clear(link: Path) -> None:
    if link.is_symlink():
        folder = link.readlink()
        if folder.name.startswith(_SCRATCH):
            shutil.rmtree(folder, ignore_errors=True)
        link.unlink()
