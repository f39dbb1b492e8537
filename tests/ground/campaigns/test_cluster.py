"""Tests that a campaign on a Dask cluster loses no result if a worker or the scheduler dies."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import threading
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ground.campaigns import CampaignError
from ground.campaigns import cluster as cluster_code
from ground.campaigns.runner import Campaign, Case, Result, Summary, fly, fly_here
from knightcube.errors import UsageError
from tests.support.dask_cluster import cluster

pytest.importorskip("distributed", reason="Dask is an optional extra and not installed")

pytestmark = pytest.mark.filterwarnings("ignore")  # ignores warnings of Dask's own libraries


def cases(runs: int, seed: int) -> list[Case]:
    return [Case(f"{k}", (seed, k), {"factor": k}) for k in range(runs)]


def draw(case: Case) -> Result:
    time.sleep(0.05)
    value = case.parameters["factor"] + float(np.random.default_rng(case.seed).random())
    return {"value": value, "worker": os.getpid(), "code": __file__}


def summarise(results: Sequence[Result], out: Path) -> Summary:
    return Summary("", {"total": sum(result["value"] for result in results), "runs": len(results)})


TOY = Campaign("toy-cluster", "adds draws", cases, draw, summarise, 40)


def lines(out: Path) -> int:
    log = out / "results.jsonl"
    return log.read_text().count("\n") if log.is_file() else 0


def results(out: Path) -> dict[str, Result]:
    entries = map(json.loads, (out / "results.jsonl").read_text().splitlines())
    return {entry["key"]: entry["result"] for entry in entries}


@contextmanager
def killing(process: subprocess.Popen[bytes], out: Path, count: int) -> Iterator[None]:
    """Kill a process as soon as a campaign has `count` results on disk."""

    def wait_and_kill() -> None:
        while lines(out) < count and not over.wait(0.02):
            pass
        process.kill()

    over = threading.Event()
    thread = threading.Thread(target=wait_and_kill)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.slow
def test_a_cluster_without_the_checkout_survives_a_workers_death_and_a_lost_scheduler_loses_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, part = tmp_path / "whole", tmp_path / "part"
    expected = sum(case.parameters["factor"] for case in cases(30, 3))
    with cluster(tmp_path) as (address, (scheduler, first, _)):
        with killing(first, whole, 8):
            facts = fly(TOY, 30, 3, whole, dask=address, progress=True).facts
        assert first.wait(timeout=10) == -signal.SIGKILL
        assert facts["runs"] == 30
        assert expected < facts["total"] < expected + 30
        assert len({result["worker"] for result in results(whole).values()}) == 2
        assert all("knightcube-code-" in result["code"] for result in results(whole).values())
        assert f"cluster at {address}, workers: 2, dashboard: http" in capsys.readouterr().err

        with killing(scheduler, part, 8), pytest.raises(CampaignError, match=r"scheduler at .* is lost"):
            fly(TOY, 30, 3, part, dask=address)
    kept = lines(part)
    assert 8 <= kept < 30
    assert fly(TOY, 30, 3, part, workers=2).facts == facts
    assert lines(part) == 30
    assert fly_here(TOY, 1, 3)[0]["value"] == results(part)["0"]["value"]


def test_a_missing_scheduler_is_reported_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ground.campaigns.cluster.CONNECT_S", 0.3)
    with pytest.raises(UsageError, match=r"--dask tcp://127.0.0.1:9: no scheduler answers there"):
        fly(TOY, 1, 3, tmp_path, dask="tcp://127.0.0.1:9")


def test_a_worker_with_another_checkouts_code_runs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    words = (__name__, "draw", {"key": "1", "seed": (3, 1), "parameters": {"factor": 1}})
    monkeypatch.setenv("KNIGHTCUBE_CODE", "this")
    assert cluster_code.carry_out("this", *words)["value"] == draw(cases(2, 3)[1])["value"]
    assert cluster_code.carry_out("other", *words) is None


def test_the_archive_is_the_same_for_the_same_files_and_holds_what_is_imported() -> None:
    root = Path(__file__).parents[3]
    sent = cluster_code.archive_of(root)
    assert sent == cluster_code.archive_of(root)
    names = set(zipfile.ZipFile(io.BytesIO(sent)).namelist())
    assert {"knightcube/astro/catalogue/hipparcos.npz", "config/step_demo.yaml"} <= names
    assert {"flight/schema/configurations/step_demo.yaml", "tests/ground/campaigns/test_cluster.py"} <= names
    assert not any("__pycache__" in name for name in names)
