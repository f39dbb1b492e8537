"""Jobs: the same contract in simulated time and in processes of their own; nothing ever waits."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from flight.loop.executive.jobs import JobResult, JobRunner, Worker
from flight.loop.executive.lockstep import LockStepRunner
from flight.loop.executive.processes import ProcessRunner
from hal.buses.clock import SystemClock
from sim_hal.clock import SimClock
from tests.flight.loop.executive.odd_jobs import die, double, fail, hang

MS = 1_000_000


def worker(name: str, function: Callable[[Any], Any]) -> Worker:
    # Short where the timeout itself is tested; starting takes seconds on a shared machine.
    patience = 1500 if function is hang else 20_000
    return Worker(name, function, latency_ns=50 * MS, timeout_ns=patience * MS)


WORKERS = [worker("double", double), worker("fail", fail)]


def wait(runner: JobRunner, seconds: float = 20.0) -> list[JobResult]:
    """Poll as the control loop does until something arrives."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if results := runner.collect():
            return results
        time.sleep(0.005)
    raise AssertionError("no result arrived")


@pytest.fixture(scope="module")
def processes() -> Iterator[ProcessRunner]:
    """Return workers for all tests here: each of them leaves every worker idle, or replaced."""
    runner = ProcessRunner(SystemClock(), [*WORKERS, worker("hang", hang), worker("die", die)])
    yield runner
    runner.close()


def test_in_lock_step_a_result_arrives_when_its_latency_has_passed_and_not_before() -> None:
    clock = SimClock()
    runner = LockStepRunner(clock, WORKERS)
    assert runner.submit("double", 21)
    clock.sleep_until_ns(50 * MS - 1)
    assert runner.collect() == []
    clock.sleep_until_ns(50 * MS)
    (result,) = runner.collect()
    assert (result.outcome, result.value, result.submitted_ns) == ("done", 42, 0)
    assert runner.collect() == []


def test_in_lock_step_a_failure_is_a_result_too() -> None:
    clock = SimClock()
    runner = LockStepRunner(clock, WORKERS)
    runner.submit("fail", 7)
    clock.sleep_until_ns(50 * MS)
    (result,) = runner.collect()
    assert (result.outcome, result.error) == ("failed", "ValueError: cannot do 7")


def test_a_busy_worker_takes_no_second_job() -> None:
    runner = LockStepRunner(SimClock(), WORKERS)
    assert runner.submit("double", 1)
    assert not runner.submit("double", 2)
    assert runner.submit("fail", 1)


def test_a_process_does_the_job_and_megabytes_pass_both_ways(processes: ProcessRunner) -> None:
    frame = np.arange(1 << 20, dtype=np.uint16).reshape(1024, 1024)
    begun = time.perf_counter()
    assert processes.submit("double", frame)
    assert time.perf_counter() - begun < 0.2, "handing over must not wait for the worker"
    assert not processes.submit("double", frame)
    (result,) = wait(processes)
    assert result.outcome == "done"
    np.testing.assert_array_equal(result.value, 2 * frame)
    assert processes.submit("double", 4)
    assert wait(processes)[0].value == 8


def test_a_failure_in_a_process_names_its_reason(processes: ProcessRunner) -> None:
    processes.submit("fail", 7)
    (result,) = wait(processes)
    assert (result.outcome, result.error) == ("failed", "ValueError: cannot do 7")


@pytest.mark.slow
def test_a_hung_worker_is_killed_and_replaced(processes: ProcessRunner) -> None:
    old = processes.process_identifiers()["hang"]
    processes.submit("hang", None)
    (result,) = wait(processes)
    assert (result.worker, result.outcome) == ("hang", "timed-out")
    assert processes.process_identifiers()["hang"] != old
    with pytest.raises(ProcessLookupError):
        os.kill(old, 0)


def test_a_worker_that_dies_is_reported_and_replaced(processes: ProcessRunner) -> None:
    processes.submit("die", None)
    (result,) = wait(processes)
    assert (result.worker, result.outcome) == ("die", "died")
    os.kill(processes.process_identifiers()["double"], signal.SIGKILL)
    (result,) = wait(processes)
    assert (result.worker, result.outcome) == ("double", "died")
    assert processes.submit("double", 3)
    assert wait(processes)[0].value == 6
