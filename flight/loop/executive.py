"""The executive, which runs rate groups on a given clock, and job runners, which run jobs outside its thread.

Each rate group has a fixed grid of time slots. The executive runs the groups one at a time, in the order in
which they are due. The cycle of a slot is run if it starts less than half a period late; otherwise the slot
is skipped and counted. Two cycles of a group are therefore never closer than half a period, and missed cycles
are not run later in a burst. The number of run and skipped slots always equals the number of slots elapsed.

Rate groups are listed in order of importance. If several groups are due at the same time, the most important
one runs first. The executive's task runner is one of the documented containment boundaries: an exception in a
task is reported, and the loop continues.

The control thread submits a job and later collects its result; it never waits for a job. In a lock-step
simulation, `LockStepRunner` runs a job when it is submitted, and delivers its result after the modelled
latency in simulated time. The result of a flight therefore does not depend on the speed of the machine. In a
real-time flight, `ProcessRunner` runs jobs in separate processes, which a thread starts, supervises, restarts
and reaps. The control thread and the supervising thread exchange values through queues that never wait, so
that starts and unexpected exits of workers do not delay the control thread. Each worker process has a socket
for messages, and a memory file for arrays that both processes map, so that frames of several megabytes are
not sent through a pipe. Each unexpected exit is reported as `WorkerNews`.

A worker that exits or exceeds its time limit is restarted, unless its budget of restarts is used up. The
first restart is immediate, the second is delayed by half a second, and each later delay is twice as long as
the previous one. The budget of restarts is reset when a worker has run for a minute. After `BUDGET`
consecutive exits, the worker is not restarted for ten minutes. After this pause, the budget is reset, so that
a worker recovers on a long flight once the cause has disappeared. A worker is therefore started at most
`BUDGET` times in 12 minutes.
"""

from __future__ import annotations

import mmap
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence, Set
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import Enum
from typing import Any, Literal, NamedTuple, Protocol

from flight.loop.worker import LONGEST_BYTES, SLAB_BYTES, message_length, pack_trusted, unpack_values
from hal.interfaces.wires import SECOND_NS, Clock
from knightcube.compiled import compilation_ns
from knightcube.errors import KnightCubeError

Outcome = Literal["done", "failed", "timed-out", "died"]


@dataclass(frozen=True, slots=True)
class Worker:
    """A worker, which runs one kind of job: a function of one argument at the top level of a module.

    Attributes:
        name: short name of the worker for telemetry.
        function: function of one argument, which runs in a separate process in a real-time flight. The
            argument of the worker's function must be picklable. The result of the worker's function must
            consist of plain values, arrays of numbers, and dataclasses and enumerations from modules that the
            control process has imported.
        latency_ns: time (ns) from a job's submission to its result in a lock-step simulation.
        timeout_ns: longest execution time (ns) of a job in real time, after which the job is killed.
    """

    name: str
    function: Callable[[Any], Any]
    latency_ns: int
    timeout_ns: int


@dataclass(frozen=True, slots=True)
class JobResult:
    """The outcome of a job. The attribute `value` is the function's result if the outcome is "done"."""

    worker: str
    outcome: Outcome
    value: Any
    error: str
    submitted_ns: int
    delivered_ns: int
    execution_ns: int


class WorkerChange(Enum):
    """State change of a worker: its process ended, runs again, or ended so often that restarts pause."""

    DIED = "died"
    READY = "ready"
    SPENT = "spent"


@dataclass(frozen=True, slots=True)
class WorkerNews:
    """State change of a worker process, with a text on the cause."""

    worker: str
    change: WorkerChange
    text: str


class JobRunner(Protocol):
    """Runs the jobs of several workers, at most one job at a time for each worker."""

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job, and return False if the worker is busy or not running. Never waits."""

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived since the last call. Never waits."""

    def news(self) -> list[WorkerNews]:
        """Return the changes of workers since the last call. Never waits."""

    @property
    def borrowed_ns(self) -> int:
        """Time (ns) spent on jobs in the calling thread; zero if jobs run in separate processes."""

    def close(self) -> None:
        """Stop the workers. Safe to call twice."""


class LockStepRunner:
    """Runs jobs in lock-step with simulated time; implements JobRunner.

    The attribute `borrowed_ns` is the total real time (ns) of the jobs, which run in the calling thread. It
    excludes the time in which numba compiles functions.
    """

    def __init__(self, clock: Clock, workers: Sequence[Worker]) -> None:
        self._clock = clock
        self._workers = {worker.name: worker for worker in workers}
        self._pending: dict[str, JobResult] = {}
        self.borrowed_ns = 0

    def submit(self, worker: str, argument: Any) -> bool:
        """Run a job at once, and keep its result until the modelled latency has passed."""
        if worker in self._pending:
            return False
        spec = self._workers[worker]
        now_ns = self._clock.now_ns()
        begun = time.perf_counter_ns() - compilation_ns()
        outcome: Outcome = "done"
        value, error = None, ""
        try:
            value = spec.function(argument)
        except Exception as failure:  # noqa: BLE001 - containment boundary: the worker runner
            outcome, error = "failed", f"{type(failure).__name__}: {failure}"
        spent_ns = time.perf_counter_ns() - compilation_ns() - begun
        self.borrowed_ns += spent_ns
        self._pending[worker] = JobResult(
            worker, outcome, value, error, now_ns, now_ns + spec.latency_ns, spent_ns
        )
        return True

    def collect(self) -> list[JobResult]:
        """Return the results whose modelled latency has passed."""
        now_ns = self._clock.now_ns()
        ready = [result for result in self._pending.values() if result.delivered_ns <= now_ns]
        for result in ready:
            del self._pending[result.worker]
        return ready

    def news(self) -> list[WorkerNews]:
        """Return an empty list, because there are no processes that could end."""
        return []

    def close(self) -> None:
        """Discard pending results."""
        self._pending.clear()


class Cycle(NamedTuple):
    """A cycle of a rate group: slot number, time (ns) at which it was due, and start time (ns)."""

    slot: int
    due_ns: int
    start_ns: int


Task = Callable[[Cycle], None]


class RateGroup:
    """A periodic task with the statistics of its cycles; `due_ns` is the time (ns) of the next slot."""

    def __init__(self, name: str, period_ns: int, task: Task) -> None:
        if period_ns <= 0:
            raise KnightCubeError(f"rate group {name}: a period of {period_ns} ns is not positive")
        self.name, self.period_ns, self.task = name, period_ns, task
        self.cycles = self.completed = self.slips = self.overruns = self.total_execution_ns = 0
        self.max_execution_ns = self._slot = self._epoch_ns = self.due_ns = 0

    def begin(self, epoch_ns: int) -> None:
        """Start the grid of slots; slot 0 is due at `epoch_ns`."""
        self._epoch_ns = self.due_ns = epoch_ns
        self._slot = 0

    @property
    def mean_execution_ns(self) -> float:
        """Mean execution time (ns) of the task."""
        return self.total_execution_ns / self.cycles if self.cycles else 0.0

    def claim(self, now_ns: int) -> tuple[Cycle | None, int]:
        """Return the cycle to run now, or None if no slot is due, and the number of newly skipped slots."""
        late_ns = now_ns - self.due_ns
        if late_ns < 0:
            return None, 0
        skipped, phase_ns = divmod(late_ns, self.period_ns)
        cycle: Cycle | None = None
        if 2 * phase_ns >= self.period_ns:
            skipped += 1
        else:
            slot = self._slot + skipped
            cycle = Cycle(slot, self._epoch_ns + slot * self.period_ns, now_ns)
        self._slot += skipped + (cycle is not None)
        self.due_ns = self._epoch_ns + self._slot * self.period_ns
        self.slips += skipped
        return cycle, skipped

    def account(self, execution_ns: int, completed: bool = True) -> None:
        """Record the execution time of a cycle, and whether its task completed."""
        self.cycles += 1
        self.completed += completed
        self.total_execution_ns += execution_ns
        self.max_execution_ns = max(self.max_execution_ns, execution_ns)
        self.overruns += execution_ns > self.period_ns


class Observer(Protocol):
    """Receives the executive's reports; its methods must be quick and must not raise exceptions."""

    def ran(self, group: RateGroup, cycle: Cycle, execution_ns: int) -> None:
        """Accept the report of a cycle that has ended."""

    def slipped(self, group: RateGroup, slots: int) -> None:
        """Accept the report of skipped slots."""

    def failed(self, group: RateGroup, error: Exception) -> None:
        """Accept the report of a task that raised an exception, and bring the devices into a safe state."""


class CyclicExecutive:
    """Runs rate groups. The function `stopwatch` returns times (ns) to measure execution times."""

    def __init__(
        self,
        clock: Clock,
        groups: Sequence[RateGroup],
        observer: Observer,
        stopwatch: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self._clock = clock
        self._groups = tuple(groups)
        self._observer, self._stopwatch = observer, stopwatch
        self._stop = False

    def stop(self) -> None:
        """Let `run` return after the current cycle. A signal handler may call this method."""
        self._stop = True

    def run(self, epoch_ns: int, until_ns: int) -> None:
        """Run all rate groups on the grid that starts at `epoch_ns`, until `until_ns`."""
        for group in self._groups:
            group.begin(epoch_ns)
        while not self._stop:
            due_ns = min([group.due_ns for group in self._groups])
            if due_ns >= until_ns:
                self._clock.sleep_until_ns(until_ns)
                return
            self._clock.sleep_until_ns(due_ns)
            for group in self._groups:
                if not self._stop and group.due_ns <= self._clock.now_ns():
                    self._serve(group)

    def _serve(self, group: RateGroup) -> None:
        cycle, slipped = group.claim(self._clock.now_ns())
        if slipped:
            self._observer.slipped(group, slipped)
        if cycle is None:
            return
        begun = self._stopwatch()
        completed = False
        try:
            group.task(cycle)
            completed = True
        except Exception as error:  # noqa: BLE001 - containment boundary: the task runner
            self._observer.failed(group, error)
        execution_ns = self._stopwatch() - begun
        group.account(execution_ns, completed)
        self._observer.ran(group, cycle, execution_ns)


BUDGET = 10
"""Number of consecutive unexpected exits of a worker after which restarts pause. The delays of the restarts
before the pause add up to 127.5 s."""
FIRST_NS = SECOND_NS // 2
"""Delay (ns) of the second of several consecutive restarts; each later delay is twice as long."""
STEADY_NS = 60 * SECOND_NS
"""Running time (ns) after which a worker's budget of restarts is reset."""
REST_NS = 600 * SECOND_NS
"""Pause (ns) after the budget of restarts is used up."""


class Attempts:
    """Counts the unexpected exits of a worker (`deaths`) since the worker last ran for `STEADY_NS`."""

    def __init__(self) -> None:
        self.deaths = 0

    def died(self, lived_ns: int) -> int:
        """Count an unexpected exit after `lived_ns` of running, and return the delay (ns) of the restart."""
        if lived_ns >= STEADY_NS or self.is_spent:
            self.deaths = 0
        self.deaths += 1
        if self.is_spent:
            return REST_NS
        return 0 if self.deaths == 1 else FIRST_NS << (self.deaths - 2)

    @property
    def is_spent(self) -> bool:
        """Whether the budget of restarts is used up; if so, restarts pause."""
        return self.deaths >= BUDGET


JobAnswer = tuple[Outcome, Any, str, int]
"""A worker's answer: outcome, value, error, and execution time (ns) of the job."""

MODULE = "flight.loop.worker"
"""Name of the module that a worker process runs."""

_REAPED_WITHIN_S = 1.0
"""Longest time (s) to wait for the end of a killed process."""


class WorkerProcess:
    """A worker process, used by one thread only; it is `ready` once it has imported its function."""

    def __init__(self, worker: Worker, cores: Set[int] = frozenset()) -> None:
        """Start the process on the given cores; an empty set permits all cores.

        Raises OSError if the process cannot be started.
        """
        self._name = worker.name
        self._received = bytearray()
        self.ready = False
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs, ExitStack() as unused:
            unused.enter_context(ours)
            memory = os.memfd_create(f"knightcube-{worker.name}")
            try:
                os.ftruncate(memory, SLAB_BYTES)
                self._slab = mmap.mmap(memory, SLAB_BYTES)
                ours.setblocking(False)
                ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
                self._process = self._start(worker, theirs.fileno(), memory, cores)
            finally:
                os.close(memory)
            unused.pop_all()
        self._socket = ours

    @staticmethod
    def _start(worker: Worker, line: int, memory: int, cores: Set[int]) -> subprocess.Popen[bytes]:
        function = f"{worker.function.__module__}:{worker.function.__qualname__}"
        words = [function, str(line), str(memory), str(os.getpid()), ",".join(map(str, sorted(cores)))]
        return subprocess.Popen(
            # With -I, as in a service, modules are not imported from the working folder or the environment.
            [sys.executable, *(["-I"] if sys.flags.isolated else []), "-m", MODULE, *words],
            pass_fds=(line, memory),
            stdin=subprocess.DEVNULL,
            # A separate process group protects the worker from Ctrl-C; the control process ends its worker.
            # The group is in the session of the control process, and is orphaned if the control process dies.
            # The kernel ends a stopped worker in an orphaned group by sending SIGHUP and SIGCONT.
            process_group=0,
        )

    @property
    def process_id(self) -> int:
        """The process identifier."""
        return self._process.pid

    def is_stopped(self) -> bool:
        """Return whether a signal such as SIGSTOP has stopped the process, even during its start."""
        look = os.WSTOPPED | os.WNOHANG | os.WNOWAIT  # with WNOWAIT, the process can still be reaped
        with suppress(ChildProcessError):  # reaped already
            return os.waitid(os.P_PID, self._process.pid, look) is not None
        return False

    def fileno(self) -> int:
        """Return the descriptor of the socket, so that `select` can wait for an answer."""
        return self._socket.fileno()

    def send(self, argument: Any) -> None:
        """Submit a job.

        Raises KnightCubeError if the job is too large, and EOFError if the process has ended. Raises OSError
        if only a part of the job was sent; then the process cannot receive another job.
        """
        message = pack_trusted(argument, self._slab)
        if len(message) > LONGEST_BYTES:
            raise KnightCubeError(f"a job for {self._name} of {len(message)} bytes is too large")
        try:
            sent = self._socket.send(message)
        except ConnectionError as error:
            raise EOFError(self._name) from error
        if sent != len(message):
            raise OSError(f"the socket accepted {sent} of the job's {len(message)} bytes")

    def receive(self) -> JobAnswer | None:
        """Return an answer, or None if no answer has arrived.

        Raises EOFError if the process has ended, and KnightCubeError for a damaged answer.
        """
        try:
            while chunk := self._socket.recv(1 << 16):
                self._received += chunk
            raise EOFError(self._name)
        except BlockingIOError:
            pass
        except ConnectionError as error:
            raise EOFError(self._name) from error
        while (length := message_length(self._received)) is not None and len(self._received) >= length:
            message = bytes(self._received[:length])
            del self._received[:length]
            match unpack_values(message, self._slab):
                case None:
                    self.ready = True
                case ("done" | "failed" as outcome, value, str(text), int(execution_ns)):
                    return outcome, value, text, execution_ns
                case _:
                    raise KnightCubeError("the answer does not belong to a job")
        return None

    def end(self) -> str:
        """Kill the process, reap it and release its memory; return how the process ended."""
        status = self._process.poll()
        if status is None:
            with suppress(subprocess.TimeoutExpired):  # the process may still be writing while it ends
                status = self._process.wait(0.05)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):  # a process that hangs in the kernel is reaped later
            self._process.wait(_REAPED_WITHIN_S)
        self._socket.close()
        self._slab.close()
        if status is None:
            return "killed"
        return f"signal {-status}" if status < 0 else f"status {status}"


START_LIMIT_NS = 60 * SECOND_NS
"""Longest time (ns) in which a worker must import its function; otherwise it is restarted."""
_IDLE_MS = 1000.0
"""Longest time (ms) between two checks of the workers."""
_CLOSE_S = 5.0
"""Longest time (s) to wait for the end of the supervising thread."""


class _SupervisedWorker:
    """A worker that the supervising thread keeps running, and its present job."""

    def __init__(self, worker: Worker, clock: Clock, cores: Set[int]) -> None:
        self.worker = worker
        self.process: WorkerProcess | None = None
        self.inbox: deque[tuple[Any, int]] = deque()
        self.accepts = True
        self.submitted_ns = -1
        self._clock, self._cores = clock, cores
        self._attempts = Attempts()
        self._due_ns = self._begun_ns = clock.now_ns()

    def dues_ns(self) -> list[int]:
        """Return the times (ns) of the worker's pending timeouts, or of its restart."""
        if self.process is None:
            return [self._due_ns]
        dues = [self.submitted_ns + self.worker.timeout_ns] if self.submitted_ns >= 0 else []
        return dues if self.process.ready else [*dues, self._begun_ns + START_LIMIT_NS]

    def serve(self) -> tuple[list[JobResult], list[WorkerNews]]:
        """Start, reap or communicate with the worker process, and return job results and state changes."""
        now_ns = self._clock.now_ns()
        try:
            if self.process is None:
                if now_ns < self._due_ns:
                    # The job was accepted while the process was ending.
                    return self._lost_results("died", "the worker is not running", now_ns), []
                self._begun_ns = now_ns
                self.process = WorkerProcess(self.worker, self._cores)
            return self._exchange(self.process, now_ns)
        except EOFError:
            return self._reap("died", "the worker's process ended", now_ns)
        except TimeoutError as error:
            return self._reap("timed-out", str(error), now_ns)
        except Exception as error:  # noqa: BLE001 - containment boundary: the worker runner
            return self._reap("died", f"{type(error).__name__}: {error}", now_ns)

    def _exchange(self, process: WorkerProcess, now_ns: int) -> tuple[list[JobResult], list[WorkerNews]]:
        news, results = [], []
        was_ready = process.ready
        answer = process.receive()
        if process.ready and not was_ready:
            self.accepts = True
            if self._attempts.deaths:
                news.append(WorkerNews(self.worker.name, WorkerChange.READY, "runs again"))
        if answer is not None and self.submitted_ns >= 0:
            results.append(JobResult(self.worker.name, *answer[:3], self.submitted_ns, now_ns, answer[3]))
            self.submitted_ns = -1
        if self.inbox:
            argument, submitted_ns = self.inbox.popleft()
            self.submitted_ns = submitted_ns
            try:
                process.send(argument)
            except (EOFError, OSError):
                raise
            except Exception as error:  # noqa: BLE001 - containment boundary: the worker runner
                results += self._lost_results("failed", f"{type(error).__name__}: {error}", now_ns)
        self._check(process, now_ns)
        return results, news

    def _check(self, process: WorkerProcess, now_ns: int) -> None:
        """Raise TimeoutError for a worker that is stopped, late with its job, or late with its start."""
        if process.is_stopped():
            raise TimeoutError("stopped by a signal")
        if self.submitted_ns >= 0 and now_ns - self.submitted_ns > self.worker.timeout_ns:
            raise TimeoutError(f"no result within {self.worker.timeout_ns * 1e-9:g} s")
        if not process.ready and now_ns - self._begun_ns > START_LIMIT_NS:
            raise TimeoutError(f"not ready within {START_LIMIT_NS * 1e-9:g} s")

    def _reap(self, outcome: Outcome, text: str, now_ns: int) -> tuple[list[JobResult], list[WorkerNews]]:
        """Reap a failed process, and set the time of the next start."""
        self.accepts = False
        process, self.process = self.process, None
        if process is not None:
            ended = process.end()
            text = f"{text}, {ended}" if outcome == "died" else text
        results = self._lost_results(outcome, text, now_ns)
        wait_ns = self._attempts.died(now_ns - self._begun_ns)
        self._due_ns = self._clock.now_ns() + wait_ns
        news = [WorkerNews(self.worker.name, WorkerChange.DIED, f"{text}; starts in {wait_ns * 1e-9:g} s")]
        if self._attempts.is_spent:
            spent = f"died {self._attempts.deaths} times in a row; not restarted for {REST_NS * 1e-9:g} s"
            news.append(WorkerNews(self.worker.name, WorkerChange.SPENT, spent))
        return results, news

    def _lost_results(self, outcome: Outcome, text: str, now_ns: int) -> list[JobResult]:
        """Return failed results for all lost jobs: the running job and the waiting jobs."""
        lost = [self.submitted_ns] if self.submitted_ns >= 0 else []
        while self.inbox:
            lost.append(self.inbox.popleft()[1])
        self.submitted_ns = -1
        return [JobResult(self.worker.name, outcome, None, text, t, now_ns, now_ns - t) for t in lost]


class ProcessRunner:
    """A JobRunner whose workers are processes. Only the control thread may call the methods of this class."""

    borrowed_ns = 0

    def __init__(self, clock: Clock, workers: Sequence[Worker], cores: Set[int] = frozenset()) -> None:
        """Start the workers on the given cores; an empty set permits all cores."""
        self._clock = clock
        self._workers = {worker.name: _SupervisedWorker(worker, clock, cores) for worker in workers}
        self._busy: set[str] = set()
        self._results: deque[JobResult] = deque()
        self._news: deque[WorkerNews] = deque()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._supervise, name="workers", daemon=True)
        self._thread.start()

    def submit(self, worker: str, argument: Any) -> bool:
        """Submit a job, and return False if the worker is busy or not yet ready after a restart."""
        supervised = self._workers[worker]
        if worker in self._busy or not supervised.accepts:
            return False
        self._busy.add(worker)
        supervised.inbox.append((argument, self._clock.now_ns()))
        os.eventfd_write(self._bell, 1)
        return True

    def collect(self) -> list[JobResult]:
        """Return the results that have arrived since the last call. Never waits."""
        results = []
        while self._results:
            results.append(self._results.popleft())
            self._busy.discard(results[-1].worker)
        return results

    def news(self) -> list[WorkerNews]:
        """Return the unexpected exits and restarts of workers since the last call. Never waits."""
        return [self._news.popleft() for _ in range(len(self._news))]

    def close(self) -> None:
        """Kill the workers. Safe to call twice."""
        if self._closing.is_set():
            return
        self._closing.set()
        os.eventfd_write(self._bell, 1)
        self._thread.join(_CLOSE_S)
        if not self._thread.is_alive():
            os.close(self._bell)

    def process_identifiers(self) -> dict[str, int]:
        """Return the process identifier of each running worker."""
        running = [(name, supervised.process) for name, supervised in self._workers.items()]
        return {name: process.process_id for name, process in running if process is not None}

    def _supervise(self) -> None:
        """Serve the workers until `close`; the kernel kills them when the thread that started them ends."""
        while not self._closing.is_set():
            for supervised in self._workers.values():
                results, news = supervised.serve()
                self._news.extend(news)
                self._results.extend(results)
            self._wait()
        for supervised in self._workers.values():
            if supervised.process is not None:
                supervised.process.end()

    def _wait(self) -> None:
        """Wait for a job, an answer, or the next time at which a worker is due."""
        poll = select.poll()
        poll.register(self._bell, select.POLLIN)
        for supervised in self._workers.values():
            if supervised.process is not None:
                poll.register(supervised.process, select.POLLIN)
        now_ns = self._clock.now_ns()
        dues = [due_ns for supervised in self._workers.values() for due_ns in supervised.dues_ns()]
        wait_ms = min([_IDLE_MS, *(1e-6 * (due_ns - now_ns) + 1.0 for due_ns in dues)])
        poll.poll(max(wait_ms, 0.0))
        with suppress(BlockingIOError):
            os.eventfd_read(self._bell)
