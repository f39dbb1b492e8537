"""Tests of the benchmark `executive`: its bare loop, workers that are never idle, and a short flight.

The criteria for the flight do not depend on the load of the machine: the kernel reports for how long the
control thread had no processor. The lateness is checked only if the machine was calm.
"""

from __future__ import annotations

import os
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.app import flight as opening
from flight.app.flight import workers
from flight.schema import reader as configuration
from tests.hal.guardian.live_flight import ROOT
from tests.studies.bench import bare_loop, busy_jobs
from tests.studies.bench.executive import Load, fly, full_load
from tests.support.executive_figures import ASKED, PERIOD_NS, misses, table

CALM = 0.05
"""Largest fraction of time for which the control thread waits for a processor on a calm machine."""


def test_the_bare_loop_wakes_at_its_slots_and_never_before() -> None:
    noted: list[tuple[int, int]] = []
    stopped: list[int] = []

    class Ending(array):  # type: ignore[type-arg]
        def extend(self, row: tuple[int, int]) -> None:  # type: ignore[override]
            noted.append(row)
            if len(noted) == 20:
                stopped.append(1)

    begun = time.monotonic_ns()
    bare_loop.loop(5_000_000, Ending("q"), stopped)
    assert len(noted) == 20
    wakes, stolen_ns = np.array(noted).T
    slots = wakes // 5_000_000
    assert np.diff(slots).min() >= 1
    assert slots[0] > begun // 5_000_000
    assert np.median(wakes % 5_000_000) < 2_500_000
    # The stolen time is at most the elapsed time of all cores.
    assert 0 <= stolen_ns[-1] - stolen_ns[0] <= (os.cpu_count() or 1) * (wakes[-1] - wakes[0]) + 20_000_000


runs: list[Any] = []


def run(job: Any) -> int:
    """Record a job; the tests use this module instead of a worker's module."""
    runs.append(job)
    time.sleep(0.001)
    return len(runs)


def test_a_busy_worker_does_its_last_job_again_until_the_next_one_comes() -> None:
    runs.clear()
    again = busy_jobs.Again()
    assert again(__name__, "first") == 1
    deadline = time.monotonic() + 300.0
    while runs.count("first") < 3 and time.monotonic() < deadline:
        time.sleep(0.005)
    again(__name__, "second")
    while runs[-1] != "second" and time.monotonic() < deadline:
        time.sleep(0.005)
    begun = runs.index("second")
    while runs.count("second") < 3 and time.monotonic() < deadline:
        time.sleep(0.005)
    again.rest()
    assert begun >= 3
    assert set(runs[begun:]) == {"second"}
    assert runs.count("second") >= 3


@pytest.mark.parametrize("name", ["orbit.yaml", "step_demo.yaml"])
def test_every_worker_of_a_flight_is_kept_busy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.app.flight.workers", workers)  # the patch is undone after the test
    busy_jobs.keep_busy()
    config = configuration.load(ROOT / "config" / name)
    made, plain = opening.workers(config), workers(config)
    assert [worker.name for worker in made] == [worker.name for worker in plain]
    assert len(made) >= 2
    for busy, worker in zip(made, plain, strict=True):
        assert busy.function is busy_jobs.BUSY[worker.function.__module__]


def test_the_executive_flies_testbed_and_satellite_with_workers_that_hardly_rest() -> None:
    for orbit in (False, True):
        config = configuration.parse(full_load(Load(600.0, camera_period=0.4, orbit=orbit)))
        assert config.body == ("orbit" if orbit else "testbed")
        assert config.camera is not None
        assert config.camera.period == 0.4
        assert config.replan_period() == (10.0 if orbit else 0.025)


@pytest.mark.slow
def test_four_seconds_of_flight_keep_the_grid_with_planner_and_vision_at_work(tmp_path: Path) -> None:
    flown = fly(tmp_path, Load(4.0, camera_period=1.0, replan_period=0.25, warm_up=0.0), fifo=False)
    figures = flown.figures
    assert figures["slots"] >= 130
    assert figures["slips"] == pytest.approx(figures["slips_computed"], abs=1)
    # After a late cycle, no burst of cycles follows, and no cycle waits for a worker.
    assert figures["closest_s"] >= 0.499e-9 * PERIOD_NS
    assert figures["blocked"] < 0.1
    assert figures["processor_control"] < 0.8
    assert {"control", "guardian", "planner", "vision"} == figures["memory_mib"].keys()
    assert 40.0 < figures["memory_median_mib"] < 300.0
    assert figures["memory_alone_max_mib"] >= figures["memory_max_mib"]
    assert 0.0 < figures["ready_s"] < figures["first_command_s"]
    if figures["queued"] < CALM:
        assert figures["jobs"]["planner"]["done"] >= 3
        assert figures["lost_beyond_machine"] < 0.4 * figures["slots"]
        assert figures["lateness_s"]["p50"] < 0.5e-9 * PERIOD_NS
        assert figures["execution_s"]["p50"] < 1e-9 * PERIOD_NS
        assert figures["first_command_s"] < 30.0
    # The same flight would fail with a higher processor load or one more lost cycle.
    assert "processor_control" in misses(figures | {"processor_control": 0.36})
    assert "lost_beyond_machine" in misses(figures | {"lost_beyond_machine": 1})
    assert "memory_slope_mib_per_hour" in misses(figures | {"memory_slope_interval": (1.5, 3.0)})
    assert not misses(figures | ASKED | {"memory_slope_interval": (-3.0, 1.5)})
    assert "MISSED" in table(figures | {"lost_beyond_machine": 1}, "slice")
