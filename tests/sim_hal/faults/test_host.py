"""Tests of faults in the flight process: jobs, wall clock, disk, and configuration file."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.loop.executive import JobResult, LockStepRunner, Worker
from flight.schema import reader as configuration
from flight.schema.document import ConfigError
from sim_hal.clock import SimClock
from sim_hal.faults.host import ProcessFaults, Task, corrupted, corrupted_by, perform, without_numbers
from sim_hal.faults.schedule import parse
from tests.support.flights import TEXT

SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Found:
    """A result of a worker."""

    angle: float
    path: np.ndarray[Any, Any]
    count: int
    inner: tuple[float, str]


def find(argument: float) -> Found:
    """Perform a job, and return its result."""
    return Found(argument, np.array([argument, 1.0]), 3, (argument, "text"))


def flown(fault: str) -> tuple[SimClock, ProcessFaults]:
    clock = SimClock()
    faults = ProcessFaults([parse(fault)], clock, realtime=False)
    faults.begin(SECOND_NS)
    return clock, faults


def runner_of(fault: str) -> tuple[SimClock, Any]:
    clock, faults = flown(fault)
    specs = [Worker("planner", find, 50_000_000, 2 * SECOND_NS)]
    return clock, faults.jobs(LockStepRunner(clock, faults.workers(specs)), specs, JobResult)


def outcome_at(fault: str, seconds: float, patience: float = 4.0) -> tuple[JobResult, float]:
    """Submit a job at a mission time, and return its result and the delay, s."""
    clock, runner = runner_of(fault)
    clock.sleep_until_ns(round((1.0 + seconds) * SECOND_NS))
    begun_ns = clock.now_ns()
    assert runner.submit("planner", 0.5)
    while clock.now_ns() < begun_ns + patience * SECOND_NS:
        clock.sleep_until_ns(clock.now_ns() + 25_000_000)
        results = runner.collect()
        if results:
            return results[0], (clock.now_ns() - begun_ns) * 1e-9
    raise AssertionError("no result at all")


@pytest.mark.parametrize(
    ("kind", "outcome", "after"),
    [
        ("nan", "done", 0.05),
        ("exception", "failed", 0.05),
        ("killed", "died", 0.05),
        ("endless", "timed-out", 2.0),
    ],
)
def test_a_faulty_worker_fails_like_a_real_worker(kind: str, outcome: str, after: float) -> None:
    result, seconds = outcome_at(f"planner: {kind} @ 2 for 3", 2.5)
    assert result.outcome == outcome
    assert seconds == pytest.approx(after, abs=0.026)
    if kind == "nan":
        assert np.isnan(result.value.angle)
        assert np.isnan(result.value.path).all()
        assert result.value.count == 3


@pytest.mark.parametrize("seconds", [1.5, 5.5])
def test_a_worker_is_healthy_before_and_after_its_fault(seconds: float) -> None:
    result, _ = outcome_at("planner: exception @ 2 for 3", seconds)
    assert result.outcome == "done"
    assert result.value.angle == 0.5


def test_a_slow_worker_answers_later_and_takes_no_second_job_meanwhile() -> None:
    result, seconds = outcome_at("planner: slow (delay=1.2) @ 0", 1.0)
    assert result.outcome == "done"
    assert seconds == pytest.approx(1.25, abs=0.03)
    clock, runner = runner_of("planner: endless @ 0")
    clock.sleep_until_ns(2 * SECOND_NS)
    assert runner.submit("planner", 0.5)
    assert not runner.submit("planner", 0.5)


def test_only_numbers_become_nan() -> None:
    value = without_numbers(find(2.0))
    assert np.isnan(value.inner[0])
    assert value.inner[1] == "text"


def test_a_task_without_a_fault_is_the_job_itself() -> None:
    assert perform(Task("tests.sim_hal.faults.test_host:find", 0.25)).angle == 0.25


def test_a_stepped_clock_changes_its_label_only() -> None:
    clock, faults = flown("clock: stepped (by=7200) @ 1 for 2")
    seen = faults.clock()
    clock.sleep_until_ns(SECOND_NS)
    assert seen.utc_ns() == clock.utc_ns()
    clock.sleep_until_ns(2 * SECOND_NS + 1)
    assert seen.utc_ns() - clock.utc_ns() == 7200 * SECOND_NS
    assert seen.now_ns() == clock.now_ns()
    clock.sleep_until_ns(4 * SECOND_NS)
    assert seen.utc_ns() == clock.utc_ns()


@pytest.mark.parametrize(("kind", "code"), [("full", errno.ENOSPC), ("failing", errno.EIO)])
def test_a_disk_fails_for_its_time_and_takes_bytes_again(tmp_path: Path, kind: str, code: int) -> None:
    clock, faults = flown(f"disk: {kind} @ 1 for 2")
    opener: Callable[[Path], Any] = faults.opener(lambda path: path.open("wb"))
    clock.sleep_until_ns(SECOND_NS)
    broken = opener(tmp_path / "second")
    broken.write(b"before")
    clock.sleep_until_ns(2 * SECOND_NS + 1)
    with pytest.raises(OSError, match=r"No space|Input/output") as caught:
        broken.write(b"during")
    assert caught.value.errno == code
    with pytest.raises(OSError, match=r"No space|Input/output"):
        opener(tmp_path / "third")
    clock.sleep_until_ns(4 * SECOND_NS)
    broken.write(b"after")
    broken.close()
    assert (tmp_path / "second").read_bytes() == b"beforeafter"


def test_without_faults_of_the_host_its_parts_are_unchanged() -> None:
    clock, faults = flown("imu: silent")
    specs = [Worker("planner", find, 0, SECOND_NS)]
    runner = LockStepRunner(clock, specs)
    assert faults.jobs(runner, specs, JobResult) is runner
    assert faults.workers(specs) == specs
    assert faults.clock() is clock
    assert faults.opener(open) is open  # any function would do


def test_a_corrupted_configuration_is_refused_in_one_line_or_still_a_valid_one() -> None:
    refused = 0
    for seed in range(40):
        text = corrupted(TEXT, 3, seed)
        assert sum(a != b for a, b in zip(text, TEXT, strict=False)) >= 1
        try:
            configuration.parse(text)
        except ConfigError as error:
            refused += "\n" not in str(error)
    assert refused > 10
    assert corrupted_by(["imu: silent"], TEXT, 1) == TEXT
    assert corrupted_by(["config: corrupted"], TEXT, 1) == corrupted(TEXT, 3, 1)
