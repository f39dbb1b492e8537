"""Tests that jobs behave the same in simulated time and in processes, and that no call waits for a job."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from flight.loop.executive import (
    BUDGET,
    STEADY_NS,
    Attempts,
    JobResult,
    JobRunner,
    LockStepRunner,
    ProcessRunner,
    Worker,
    WorkerChange,
    WorkerNews,
    WorkerProcess,
)
from hal.buses.system import SystemClock, worker_cores
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock
from tests.flight.loop.odd_jobs import cores, die, double, fail, function, hang
from tests.hal.guardian.campaign import lives
from tests.hal.guardian.states import state, wait_until

MS = 1_000_000


def worker(name: str, function: Callable[[Any], Any]) -> Worker:
    # Timeouts (s): a short timeout for tests of the timeout itself, and a long one because processes start
    # slowly.
    patience = 1500 if function is hang else 20_000
    return Worker(name, function, latency_ns=50 * MS, timeout_ns=patience * MS)


WORKERS = [worker("double", double), worker("fail", fail)]


def wait(runner: JobRunner, seconds: float = 20.0) -> list[JobResult]:
    """Poll for a result as the control loop does, until the result arrives."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if results := runner.collect():
            return results
        time.sleep(0.005)
    raise AssertionError("no result arrived")


def test_a_process_that_cannot_be_started_leaves_no_descriptor_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    before = sorted(os.listdir("/proc/self/fd"))
    for owner, name in (
        (socket, "socketpair"),
        (os, "memfd_create"),
        (os, "ftruncate"),
        (subprocess, "Popen"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fail)
            with pytest.raises(OSError, match="Too many"):
                WorkerProcess(worker("double", double))
        assert sorted(os.listdir("/proc/self/fd")) == before, name


def started(runner: ProcessRunner, name: str, seconds: float = 20.0) -> int:
    """Return the process identifier of a worker, once its supervisor has started the worker."""
    deadline = time.monotonic() + seconds
    while name not in runner.process_identifiers() and time.monotonic() < deadline:
        time.sleep(0.005)
    return runner.process_identifiers()[name]


@pytest.fixture(scope="module")
def processes() -> Iterator[ProcessRunner]:
    """Yield workers that all tests of this module share; each test leaves the workers idle or replaced."""
    more = [worker("hang", hang), worker("die", die), worker("function", function)]
    runner = ProcessRunner(SystemClock(), [*WORKERS, *more])
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


def test_a_result_that_cannot_be_sent_is_a_failure_and_not_a_death(processes: ProcessRunner) -> None:
    processes.submit("function", None)
    (result,) = wait(processes)
    assert result.outcome == "failed"
    assert "a worker cannot send this value of class" in result.error


def test_a_job_sent_only_in_part_costs_the_process_and_not_the_next_job(processes: ProcessRunner) -> None:
    processes.submit("double", bytes(8 << 20))
    (result,) = wait(processes)
    assert result.outcome == "died"
    assert "of the job's 8388" in result.error
    deadline = time.monotonic() + 20.0
    while not processes.submit("double", 4) and time.monotonic() < deadline:
        time.sleep(0.005)
    assert wait(processes)[0].value == 8


def test_a_failure_in_a_process_names_its_reason(processes: ProcessRunner) -> None:
    processes.submit("fail", 7)
    (result,) = wait(processes)
    assert (result.outcome, result.error) == ("failed", "ValueError: cannot do 7")


@pytest.mark.slow
def test_a_hung_worker_is_killed_and_replaced(processes: ProcessRunner) -> None:
    old = started(processes, "hang")
    processes.submit("hang", None)
    (result,) = wait(processes)
    assert (result.worker, result.outcome) == ("hang", "timed-out")
    assert processes.process_identifiers().get("hang") != old
    with pytest.raises(ProcessLookupError):
        os.kill(old, 0)


def first_report(runner: ProcessRunner, name: str, change: WorkerChange) -> WorkerNews:
    """Return the first report of a given change of a worker's state, as the health task receives it."""
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline:
        for news in runner.news():
            if (news.worker, news.change) == (name, change):
                return news
        time.sleep(0.005)
    raise AssertionError(f"{name} was not {change.value}")


def test_a_worker_that_dies_is_reported_and_replaced_at_work_or_idle(processes: ProcessRunner) -> None:
    assert processes.submit("die", None)
    (result,) = wait(processes)
    assert (result.worker, result.outcome) == ("die", "died")
    assert "status 3" in first_report(processes, "die", WorkerChange.DIED).text
    os.kill(started(processes, "double"), signal.SIGKILL)
    assert "signal 9" in first_report(processes, "double", WorkerChange.DIED).text
    first_report(processes, "double", WorkerChange.READY)
    assert processes.collect() == [], "no job was lost"
    assert processes.submit("double", 3)
    assert wait(processes)[0].value == 6


@pytest.mark.parametrize("while_it_starts", [True, False])
def test_a_worker_that_is_stopped_is_reported_and_replaced_idle_or_starting(while_it_starts: bool) -> None:
    with closing(ProcessRunner(SystemClock(), [worker("double", double)])) as runner:
        stopped = started(runner, "double")
        if not while_it_starts:
            assert runner.submit("double", 1)
            assert wait(runner)[0].value == 2
        os.kill(stopped, signal.SIGSTOP)
        assert "stopped by a signal" in first_report(runner, "double", WorkerChange.DIED).text
        first_report(runner, "double", WorkerChange.READY)
        assert started(runner, "double") != stopped


def test_a_worker_that_cannot_start_takes_no_jobs_and_costs_the_control_thread_nothing() -> None:
    def nowhere(_: Any) -> Any: ...

    nowhere.__module__ = "tests.flight.loop.no_such_module"
    with closing(ProcessRunner(SystemClock(), [worker("nowhere", nowhere)])) as runner:
        begun = time.thread_time()
        assert runner.submit("nowhere", 1)
        assert wait(runner)[0].outcome == "died"
        assert "status 1" in first_report(runner, "nowhere", WorkerChange.DIED).text
        first_report(runner, "nowhere", WorkerChange.DIED)
        assert not runner.submit("nowhere", 2)
        assert time.thread_time() - begun < 0.5, "it polls 200 times a second here, and no more"


def test_restarts_come_at_growing_intervals_within_a_budget_and_a_new_one_after_a_rest() -> None:
    attempts = Attempts()
    waits = [attempts.died(lived_ns=SECOND_NS) / SECOND_NS for _ in range(2 * BUDGET)]
    one = [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 600.0]
    assert waits == 2 * one
    assert attempts.is_spent
    attempts.died(SECOND_NS)
    attempts.died(SECOND_NS)
    assert attempts.died(STEADY_NS) == 0
    assert not attempts.is_spent


_ORPHANED = """
import sys, time
from flight.loop.executive import Worker
from flight.loop.executive import ProcessRunner
from hal.buses.system import SystemClock
from hal.buses.system import worker_cores
from hal.interfaces.wires import SECOND_NS
from tests.flight.loop.odd_jobs import hang
runner = ProcessRunner(SystemClock(), [Worker("hang", hang, 0, 10**12)])
runner.submit("hang", None)
while not all(one.process and one.process.ready for one in runner._workers.values()):
    time.sleep(0.01)
print(*runner.process_identifiers().values(), flush=True)
time.sleep(60.0)
"""


def test_a_worker_ends_quietly_in_the_middle_of_a_job_when_its_flight_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _ORPHANED], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as flight:
        assert flight.stdout is not None
        assert flight.stderr is not None
        orphan = int(flight.stdout.readline())
        flight.kill()
        # The worker inherits standard error, so the pipe closes only when the worker has ended too.
        assert flight.stderr.read() == ""
    assert not lives(orphan)


_STARTED = """
import os, signal, time
from flight.loop.executive import Worker
from flight.loop.executive import WorkerProcess
from tests.flight.loop.odd_jobs import hang
process = WorkerProcess(Worker("hang", hang, 0, 10**12)).process_id
os.kill(process, signal.SIGSTOP)
print(process, flush=True)
time.sleep(60.0)
"""


def test_a_worker_that_was_stopped_before_python_ran_does_not_outlive_its_flight() -> None:
    words = [sys.executable, "-c", _STARTED]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, start_new_session=True) as flight:
        assert flight.stdout is not None
        orphan = int(flight.stdout.readline())
        wait_until(lambda: state(orphan) == "T")
        flight.kill()
    wait_until(lambda: state(orphan) in {"", "Z"})


def test_workers_leave_the_last_core_to_the_control_process() -> None:
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2:
        pytest.skip("one core only: nothing to leave free")
    with closing(ProcessRunner(SystemClock(), [worker("cores", cores)], worker_cores())) as runner:
        started(runner, "cores")
        assert runner.submit("cores", None)
        assert wait(runner)[0].value == allowed[:-1]
    assert sorted(os.sched_getaffinity(0)) == allowed


def test_the_time_of_a_job_excludes_the_compilation_of_functions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ns = {"clock": 0, "compilation": 0}

    def job(_: object) -> None:
        now_ns["clock"] += 60_000_000_000
        now_ns["compilation"] += 59_000_000_000

    monkeypatch.setattr("flight.loop.executive.time.perf_counter_ns", lambda: now_ns["clock"])
    monkeypatch.setattr("flight.loop.executive.compilation_ns", lambda: now_ns["compilation"])
    runner = LockStepRunner(SimClock(), [Worker("vision", job, 0, 0)])
    assert runner.submit("vision", None)
    (result,) = runner.collect()
    assert (result.execution_ns, runner.borrowed_ns) == (1_000_000_000, 1_000_000_000)
