"""Tests of the runner of campaigns: progress, tables, resumption, locks, and worker processes that die.

Threads take the place of worker processes, because the start of a process takes half a second.
"""

from __future__ import annotations

import fcntl
import gc
import io
import json
import os
import signal
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ground.campaigns import CampaignError, runner
from ground.campaigns.runner import (
    Campaign,
    Case,
    Progress,
    Result,
    Summary,
    fly,
    fly_here,
    results_in,
    show,
    summary,
)
from knightcube.errors import UsageError

# Progress.


class Screen(io.StringIO):
    """Test double of standard error, which is a terminal or a file."""

    def __init__(self, terminal: bool) -> None:
        super().__init__()
        self.terminal = terminal

    def isatty(self) -> bool:
        return self.terminal

    def new(self) -> str:
        """Return the text since the last call."""
        text = self.getvalue()
        self.seek(0)
        self.truncate()
        return text


class Watch:
    """Clock that a test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> None:
        self.now, self.screen = 1000.0, Screen(terminal)
        monkeypatch.setattr("ground.campaigns.runner.time.perf_counter", lambda: self.now)
        monkeypatch.setattr("sys.stderr", self.screen)

    def after(self, seconds: float, progress: Progress) -> str:
        """Return the text that the progress display writes when a case ends after a time (s)."""
        self.now += seconds
        progress.advance()
        return self.screen.new()


def test_a_terminal_shows_a_bar_with_the_expected_remaining_time(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(monkeypatch, terminal=True)
    progress = Progress(10, 0)
    assert watch.screen.new() == f"\r\x1b[K[{'.' * 30}] 0/10  "
    assert watch.after(5.0, progress) == f"\r\x1b[K[###{'.' * 27}] 1/10  45 s left"
    assert watch.after(15.0, progress) == f"\r\x1b[K[######{'.' * 24}] 2/10  80 s left"
    progress.note("a line")
    assert watch.screen.new() == "\r\x1b[Ka line\n"
    progress.close()
    assert watch.screen.new() == "\r\x1b[K"


def test_earlier_cases_do_not_count_for_the_remaining_time(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(monkeypatch, terminal=True)
    progress = Progress(10, 6)
    first = watch.screen.new()
    assert "\r\x1b[Kcontinuing: 6 of 10 were done before\n" in first
    assert first.endswith("] 6/10  ")
    assert watch.after(7.0, progress).endswith("] 7/10  21 s left")


def test_a_file_gets_a_line_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    watch = Watch(monkeypatch, terminal=False)
    progress = Progress(10, 2)
    assert watch.screen.new() == "continuing: 2 of 10 were done before\n"
    assert not watch.after(9.0, progress)
    assert watch.after(1.0, progress) == "4 of 10 done, 30 s left\n"
    assert not watch.after(9.9, progress)
    assert watch.after(0.2, progress) == "6 of 10 done, 20 s left\n"
    progress.note("a line")
    progress.close()
    assert watch.screen.new() == "a line\n"
    Progress(10, 0)
    assert not watch.screen.new()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (99.4, "99 s"),
        (101.0, "2 min"),
        (150.1, "3 min"),
        (99.4 * 60, "99 min"),
        (100 * 60, "1 h 40 min"),
        (185 * 60, "3 h 05 min"),
    ],
)
def test_a_duration_has_the_unit_that_fits(
    seconds: float, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = Watch(monkeypatch, terminal=True)
    progress = Progress(2, 0)
    assert watch.after(seconds, progress).endswith(f"] 1/2  {text} left")


# Summaries.

FACTS = {
    "flights": 12,
    "limit": 0.0123456,
    "missing": None,
    "names": ["a", "b"],
    "rows": [{"n": 1, "value": 2.5}, {"n": 20, "other": {"k": 1.23456}}],
    "by name": {"one": {"x": 1}, "three": {"x": 22}},
    "empty": [],
    "none": {},
    "plain": {"x": 1},
}
TEXT = """\
flights: 12
limit: 0.01235
missing: -
names: a, b

rows
 n  value    other
 1    2.5        -
20      -  k=1.235

by name
by name   x
    one   1
  three  22
empty: 
none: 
plain: x=1
"""  # noqa: W291 - an empty list is an empty text


def test_rows_are_shown_as_tables_and_other_values_as_lines() -> None:
    found = summary(FACTS)
    assert found.text == TEXT
    assert found.facts is FACTS
    assert summary({"rows": [{"n": 1}]}).text == "rows\nn\n1\n"


def test_a_summary_is_printed_as_text_or_as_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    show(FACTS)
    assert capsys.readouterr().out == TEXT
    show(FACTS, True)
    assert json.loads(capsys.readouterr().out) == FACTS


# Campaigns.

ran: list[str] = []


def cases(runs: int, seed: int) -> list[Case]:
    return [Case(f"case-{k}", (seed, k), {"factor": 10 * k}) for k in range(runs)]


def double(case: Case) -> Result:
    ran.append(case.key)
    return {"value": 2 * case.parameters["factor"] + case.seed[0]}


def summarise(results: Sequence[Result], out: Path) -> Summary:
    return Summary(f"total of {out.name}\n", {"values": [result["value"] for result in results]})


TOY = Campaign("toy", "doubles numbers", cases, double, summarise, 4)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Run cases in this process, and return the keys of the cases that ran."""
    monkeypatch.setattr(
        runner, "_here", lambda workers, campaign, missing, out: ((c.key, campaign.run(c)) for c in missing)
    )
    ran.clear()
    return ran


def test_the_results_are_stored_and_a_second_campaign_runs_the_missing_cases_only(
    tmp_path: Path, in_process: list[str]
) -> None:
    out = tmp_path / "new" / "out"
    assert fly(TOY, 3, 5, out).facts == {"values": [5, 25, 45]}
    assert in_process == ["case-0", "case-1", "case-2"]
    lines = (out / "results.jsonl").read_text().splitlines(keepends=True)
    assert json.loads(lines[1]) == {"key": "case-1", "result": {"value": 25}}
    assert json.loads((out / "campaign.json").read_text()) == {"campaign": "toy", "runs": 3, "seed": 5}
    assert json.loads((out / "summary.json").read_text()) == {"values": [5, 25, 45]}
    assert (out / "summary.txt").read_text() == "total of out\n"
    # The second line is damaged, and the last line is incomplete.
    (out / "results.jsonl").write_text(lines[0] + "\0\0\n" + lines[2][:-5])
    in_process.clear()
    assert fly(TOY, 3, 5, out).facts == {"values": [5, 25, 45]}
    assert in_process == ["case-1", "case-2"]
    kept = (out / "results.jsonl").read_text()
    assert kept.startswith(lines[0] + "\0\0\n" + lines[1])
    assert kept.endswith(lines[2])
    assert results_in(out) == [{"value": 5}, {"value": 25}, {"value": 45}]
    in_process.clear()
    fly(TOY, 3, 5, out)
    assert in_process == []


def test_only_the_cases_with_a_text_run(tmp_path: Path, in_process: list[str]) -> None:
    assert fly(TOY, 3, 5, tmp_path / "out", only="-1").facts == {"values": [25]}
    assert in_process == ["case-1"]
    assert json.loads((tmp_path / "out" / "campaign.json").read_text())["only"] == "-1"
    with pytest.raises(UsageError, match="--only 'x': no case of toy contains this text"):
        fly(TOY, 3, 5, tmp_path / "out", only="x")


def test_a_row_without_results_is_null_in_the_summary(tmp_path: Path, in_process: list[str]) -> None:
    facts = {"rows": [{"mean": float("nan")}, {"mean": 2.0}], "none": None}
    campaign = replace(TOY, summarise=lambda *_: Summary("-", facts))
    fly(campaign, 1, 5, tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text()) == {
        "rows": [{"mean": None}, {"mean": 2.0}],
        "none": None,
    }


@pytest.mark.parametrize(
    ("other", "difference"),
    [({"runs": 4}, "runs 3, not 4"), ({"seed": 6}, "seed 5, not 6"), ({"only": "-1"}, "only none, not -1")],
)
def test_the_folder_of_another_campaign_is_refused(
    other: dict[str, Any], difference: str, tmp_path: Path, in_process: list[str]
) -> None:
    fly(TOY, 3, 5, tmp_path)
    in_process.clear()
    with pytest.raises(
        UsageError, match=rf"another campaign \({difference}\): give another folder with --out"
    ):
        fly(TOY, **({"runs": 3, "seed": 5} | other), out=tmp_path)
    assert in_process == []
    assert len(results_in(tmp_path)) == 3


def test_a_folder_that_another_process_uses_is_refused(tmp_path: Path, in_process: list[str]) -> None:
    with (tmp_path / "results.jsonl").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match=r"another process runs this campaign: wait, or give --out"):
            fly(TOY, 3, 5, tmp_path)
    assert fly(TOY, 3, 5, tmp_path).facts == {"values": [5, 25, 45]}


def test_progress_counts_all_cases_and_those_that_were_done_before(
    tmp_path: Path, in_process: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(TOY, 3, 5, tmp_path)
    lines = (tmp_path / "results.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "results.jsonl").write_text(lines[0])
    watch = Watch(monkeypatch, terminal=True)
    fly(TOY, 3, 5, tmp_path, progress=True)
    shown = watch.screen.new()
    assert "continuing: 1 of 3 were done before\n" in shown
    assert shown.count("\r\x1b[K[") == 3  # one bar at the start, and one after each case
    assert "] 2/3  0 s left" in shown
    assert shown.endswith("] 3/3  0 s left\r\x1b[K")


def test_a_complete_campaign_reports_its_start_and_that_no_case_ran(
    tmp_path: Path, in_process: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(TOY, 3, 5, tmp_path)
    begun = datetime(2026, 11, 28, 21, 16)
    os.utime(tmp_path / "campaign.json", times=(begun.timestamp(), begun.timestamp()))
    watch = Watch(monkeypatch, terminal=True)
    fly(TOY, 3, 5, tmp_path, progress=True)
    said = "contains all results of the campaign of 2026-11-28 21:16; delete the folder to run it again"
    assert watch.screen.new() == f"no case ran: {tmp_path} {said}\n"


def test_a_campaign_in_this_process_returns_its_results() -> None:
    assert fly_here(TOY, 3, 1) == [{"value": 1}, {"value": 21}, {"value": 41}]


def test_a_cluster_needs_dask(tmp_path: Path, in_process: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground.campaigns.runner.importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"--dask needs distributed: pip install"):
        fly(TOY, 3, 5, tmp_path, dask="tcp://127.0.0.1:9")


# Workers.


class Thread:
    """Worker that runs cases in a thread, and dies in a case like a process that is killed."""

    def __init__(self, campaign: Campaign, scratch: str) -> None:
        self.pipe, self.end = Pipe()
        self.campaign, self.scratch = campaign, scratch
        self.exitcode, self.pid, self.died, self.killed = -9, 4711, False, False
        self.thread = threading.Thread(target=self._serve, args=(self.end,))
        self.thread.start()

    def _serve(self, end: Connection) -> None:
        with end:
            while True:
                try:
                    case = end.recv()
                except EOFError:
                    return
                try:
                    answer: tuple[Result | None, Exception | None] = self.campaign.run(case), None
                except SystemExit:
                    self.died = True
                    return
                except ValueError as error:
                    answer = None, error
                with suppress(OSError):  # the campaign has ended
                    end.send(answer)

    def is_alive(self) -> bool:
        return self.thread.is_alive()

    def join(self, timeout: float | None = None) -> None:
        self.thread.join(timeout)

    def kill(self) -> None:
        self.killed = True


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Thread]]:
    """Replace worker processes by threads, and check that all of them have ended afterwards."""
    started: list[Thread] = []

    def start(campaign: Campaign, scratch: str) -> Any:
        started.append(Thread(campaign, scratch))
        return runner._Worker(started[-1], started[-1].pipe)

    monkeypatch.setattr(runner, "_worker", start)
    yield started
    assert all(one.killed != one.died and not one.is_alive() for one in started)


@pytest.fixture
def signals(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Return the list of pairs (process, signal) given to `os.kill`, which then sends no signal."""
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr("os.kill", lambda pid, number: sent.append((pid, number)))
    return sent


def toy(run: Any) -> Campaign:
    return Campaign("toy", "", cases, run, summarise, 4)


def test_each_case_runs_once_on_as_many_workers_as_are_allowed(tmp_path: Path, threads: list[Thread]) -> None:
    ran.clear()
    assert fly(TOY, 5, 1, tmp_path / "two", workers=2).facts == {"values": [1, 21, 41, 61, 81]}
    assert sorted(ran) == [f"case-{k}" for k in range(5)]
    assert len(threads) == 2
    fly(TOY, 2, 1, tmp_path / "few", workers=8)
    assert len(threads) == 4
    assert len({one.scratch for one in threads}) == 2
    assert not any(Path(one.scratch).exists() for one in threads)
    assert not list(tmp_path.glob("*/temporary"))


class Cycle:
    """An object with a reference to itself, which reference counting does not free."""

    def __init__(self) -> None:
        self.own = self


cycles: weakref.WeakSet[Cycle] = weakref.WeakSet()


def leave_a_cycle(case: Case) -> Result:
    """Return the number of existing reference cycles, and leave a new one as a flight in lock-step does."""
    before = len(cycles)
    cycles.add(Cycle())
    gc.freeze()
    gc.unfreeze()
    return {"value": before}


def test_a_worker_frees_the_garbage_of_each_case(tmp_path: Path) -> None:
    campaign = Campaign("toy", "", cases, leave_a_cycle, summarise, 4)
    assert fly(campaign, 3, 1, tmp_path, workers=1).facts == {"values": [0, 0, 0]}


def test_the_default_is_one_worker_for_each_core(
    tmp_path: Path, threads: list[Thread], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    fly(TOY, 5, 1, tmp_path)
    assert len(threads) == 3


def test_workers_write_into_a_temporary_folder_that_the_campaign_names(
    tmp_path: Path, threads: list[Thread]
) -> None:
    seen: list[Path] = []

    def look(case: Case) -> Result:
        seen.append((tmp_path / "temporary").resolve())
        assert seen[-1].is_dir()
        return double(case)

    fly(toy(look), 1, 1, tmp_path, workers=1)
    assert seen[0] == Path(threads[0].scratch).resolve()
    assert seen[0].name.startswith("knightcube-campaign-")


def test_a_case_runs_again_if_its_worker_dies_twice(
    tmp_path: Path, threads: list[Thread], signals: list[tuple[int, int]]
) -> None:
    tried: list[str] = []

    def dies_twice(case: Case) -> Result:
        tried.append(case.key)
        if case.key == "case-1" and tried.count("case-1") < 3:
            raise SystemExit
        return double(case)

    assert fly(toy(dies_twice), 3, 1, tmp_path, workers=1).facts == {"values": [1, 21, 41]}
    assert tried == ["case-0", "case-1", "case-1", "case-1", "case-2"]
    assert len(threads) == 3
    assert not signals


def test_a_case_that_kills_three_workers_ends_the_campaign_and_the_results_stay(
    tmp_path: Path, threads: list[Thread]
) -> None:
    def dies(case: Case) -> Result:
        if case.key == "case-1":
            raise SystemExit
        return double(case)

    text = r"case case-1: 3 worker processes died, the last with status -9: check the memory"
    with pytest.raises(CampaignError, match=text):
        fly(toy(dies), 3, 1, tmp_path, workers=1)
    assert results_in(tmp_path) == [{"value": 1}]
    assert len(threads) == 3
    assert not (tmp_path / "temporary").is_symlink()


def test_the_error_of_a_case_ends_the_campaign_and_interrupts_busy_workers(
    tmp_path: Path, threads: list[Thread], signals: list[tuple[int, int]]
) -> None:
    def fails(case: Case) -> Result:
        if case.key == "case-1":
            raise ValueError("case-1 is wrong")
        until = time.monotonic() + 3.0
        while case.key == "case-0" and not signals and time.monotonic() < until:
            time.sleep(0.001)
        return double(case)

    with pytest.raises(ValueError, match="case-1 is wrong"):
        fly(toy(fails), 2, 1, tmp_path, workers=2)
    # The second worker counts as busy because the campaign has not taken its next case from it.
    assert set(signals) == {(4711, signal.SIGINT)}
    assert (tmp_path / "results.jsonl").read_text() == ""


class PairError(Exception):
    """Error that can be pickled but not unpickled, because its constructor needs two arguments."""

    def __init__(self, name: str, value: int) -> None:
        super().__init__(f"{name} is {value}")


class LockedError(Exception):
    """Error that cannot be pickled."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.lock = threading.Lock()


@pytest.mark.parametrize(
    ("outcome", "text"),
    [
        (PairError("mass", 3), "case case-1 failed: PairError: mass is 3"),
        (LockedError("the lock is open"), "case case-1 failed: LockedError: the lock is open"),
        (
            {"value": threading.Lock()},
            "case case-1 has a result that cannot be sent: TypeError: cannot pickle",
        ),
    ],
)
def test_what_cannot_be_pickled_is_reported_with_its_case_and_text(
    outcome: Any, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = SimpleNamespace(prctl=lambda *_: 0)
    monkeypatch.setattr(runner, "ctypes", SimpleNamespace(CDLL=lambda _: library))

    def run(case: Case) -> Result:
        if isinstance(outcome, Exception):
            raise outcome
        found: Result = outcome
        return found

    ours, theirs = Pipe()
    ours.send(Case("case-1", (1,), {}))
    arguments = theirs, run, os.getppid(), tempfile.gettempdir()
    worker = threading.Thread(target=runner._serve, args=arguments)
    worker.start()
    assert ours.poll(20.0)
    result, error = ours.recv()
    ours.close()
    worker.join()
    assert result is None
    assert isinstance(error, CampaignError)
    assert str(error).startswith(text)
    if isinstance(outcome, Exception):
        assert "in case case-1:" in error.__notes__[0]
