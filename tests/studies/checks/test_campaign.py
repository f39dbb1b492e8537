"""Tests that a campaign has the same results however it is executed, and resumes after an interruption."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns import CampaignError
from ground.campaigns.runner import Campaign, Case, Result, Summary, fly, fly_here, results_in
from knightcube.errors import UsageError
from tests.hal.guardian.states import state, wait_until
from tests.studies.bench.killed_campaign import killed


def cases(runs: int, seed: int) -> list[Case]:
    return [Case(f"{k}", (seed, k), {"factor": k}) for k in range(runs)]


def draw(case: Case) -> Result:
    generator = np.random.default_rng(case.seed)
    return {"value": case.parameters["factor"] + float(generator.random())}


def summarise(results: Sequence[Result], out: Path) -> Summary:
    total = sum(result["value"] for result in results)
    return Summary(f"total {total:.3f}\n", {"total": total, "runs": len(results)})


def wait(case: Case) -> Result:
    Path(case.parameters["log"]).write_text(str(os.getpid()))
    time.sleep(300.0)
    return {}


def die(case: Case) -> Result:
    """End the worker process: always for a case with factor 2, in the first two attempts for factor 1."""
    attempts = Path(case.parameters["log"]) / case.key
    attempts.write_text(attempts.read_text() + "x" if attempts.exists() else "x")
    if case.parameters["factor"] == 2 or (case.parameters["factor"] == 1 and attempts.read_text() != "xxx"):
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(case)


def deaths(folder: Path, *factors: int) -> Campaign:
    """Return a campaign whose cases end their worker processes."""
    folder.mkdir()
    listed = [Case(f"{k}", (k,), {"factor": factor, "log": str(folder)}) for k, factor in enumerate(factors)]
    return Campaign("deaths", "ends workers", lambda runs, seed: listed, die, summarise, 1)


TOY = Campaign("toy", "adds draws", cases, draw, summarise, 6)


@pytest.mark.slow
def test_results_on_many_cores_equal_those_on_one(tmp_path: Path) -> None:
    expected = sum(result["value"] for result in fly_here(TOY, 6, 3))
    assert fly(TOY, 6, 3, tmp_path, workers=2).facts == {"total": pytest.approx(expected), "runs": 6}
    assert (tmp_path / "summary.txt").read_text().startswith("total")


@pytest.mark.slow
def test_an_interrupted_campaign_resumes_and_runs_no_case_twice(tmp_path: Path) -> None:
    whole = fly(TOY, 6, 3, tmp_path / "whole", workers=1).facts
    fly(TOY, 6, 3, tmp_path / "part", workers=1)
    log = tmp_path / "part" / "results.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:3]) + lines[3][:9])
    assert fly(TOY, 6, 3, tmp_path / "part", workers=1).facts == whole
    keys = [line.split('"')[3] for line in log.read_text().splitlines()]
    assert sorted(keys) == list("012345")


@pytest.mark.slow
def test_selected_cases_have_the_results_of_the_whole_campaign(tmp_path: Path) -> None:
    whole = fly_here(TOY, 12, 3)
    found = fly(TOY, 12, 3, tmp_path, workers=1, only="1")  # selects cases 1, 10 and 11
    total = whole[1]["value"] + whole[10]["value"] + whole[11]["value"]
    assert found.facts == {"total": pytest.approx(total), "runs": 3}
    with pytest.raises(UsageError, match="give another folder"):
        fly(TOY, 12, 3, tmp_path, workers=1)
    with pytest.raises(UsageError, match="no case of toy contains"):
        fly(TOY, 12, 3, tmp_path / "none", only="coil")


@pytest.mark.slow
def test_the_case_of_a_dead_worker_is_run_again_and_one_that_ends_three_workers_is_named(
    tmp_path: Path,
) -> None:
    assert fly(deaths(tmp_path / "once", 0, 1), 1, 1, tmp_path / "a", workers=1).facts["runs"] == 2
    assert (tmp_path / "once" / "1").read_text() == "xxx"
    with pytest.raises(CampaignError, match="case 1: 3 worker processes died, the last with status -9"):
        fly(deaths(tmp_path / "always", 0, 2), 1, 1, tmp_path / "b", workers=1)
    assert not (tmp_path / "b" / "temporary").is_symlink()


def test_a_second_campaign_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    fly(TOY, 0, 3, tmp_path)
    with (tmp_path / "results.jsonl").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="another process runs this campaign"):
            fly(TOY, 0, 3, tmp_path)


def test_a_damaged_line_is_dropped_and_the_last_line_is_whole(tmp_path: Path) -> None:
    """A power failure can leave zeros in the middle of the file, and a kill can truncate the last line."""
    fly(TOY, 0, 3, tmp_path)
    log = tmp_path / "results.jsonl"
    log.write_text(
        '{"key": "0", "result": {"value": 1}}\n\x00\x00\n{"key": "2", "result": {"value": 2}}\n{"key'
    )
    fly(TOY, 0, 3, tmp_path)
    assert log.read_text().endswith("}\n")
    assert [result["value"] for result in results_in(tmp_path)] == [1, 2]


def test_the_folder_of_another_campaign_is_refused(tmp_path: Path) -> None:
    fly(TOY, 0, 3, tmp_path)
    with pytest.raises(UsageError, match="give another folder"):
        fly(TOY, 0, 4, tmp_path)


@pytest.mark.slow
def test_a_campaign_that_is_killed_leaves_no_worker_behind(tmp_path: Path) -> None:
    log = tmp_path / "worker"
    code = (
        "import sys; from pathlib import Path; from tests.studies.checks import test_campaign as t;"
        "one = lambda runs, seed: [t.Case('0', (1,), {'log': sys.argv[1]})];"
        "t.fly(t.Campaign('waits', '', one, t.wait, t.summarise, 1), 1, 1, Path(sys.argv[2]), workers=1)"
    )
    command = [sys.executable, "-c", code, str(log), str(tmp_path / "out")]
    with subprocess.Popen(command, cwd=Path(__file__).parents[3]) as campaign:
        wait_until(lambda: log.exists() and log.read_text() != "")
        campaign.kill()
    worker = int(log.read_text())
    wait_until(lambda: state(worker) in {"", "Z"})


@pytest.mark.slow
def test_a_killed_campaign_is_equal_to_an_undisturbed_one_and_leaves_nothing(tmp_path: Path) -> None:
    found = killed(tmp_path, 6, 0.1, kills=2, seed=4)["killed"]
    assert found.sound(6), found
    assert found.interruptions >= 1
