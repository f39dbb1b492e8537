"""Campaign `process-kill`: kill -9 and SIGSTOP of workers, guardian and flight, in real time.

A case is one flight with active planner and vision, on devices in a separate process. Workers and guardian
are killed or stopped at random times; the log must report each event, and each process must be replaced.
Finally the flight process itself is killed or stopped. The coil currents must become zero, no process of the
flight may remain, and none of its files may remain in the folder for temporary files or in shared memory.

The emulated devices and the process that samples the coils have a higher priority, because real hardware
would not compete for the processor. Both run under SCHED_FIFO if it is permitted, so that a busy machine
delays only the flight.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from flight.link import events
from ground.campaigns.runner import Case, Result, Summary, summary
from ground.telemetry import read_run
from hal.buses import system
from sim_hal.serving.device_link import RemoteI2cBus
from tests.hal.guardian.campaign import lives
from tests.hal.guardian.live_flight import LiveFlight
from tests.studies.bench.executive import Load, full_load, members
from tests.studies.campaigns.faults_kill import Board, watch_coils
from tests.support.process_watch import answering, below, command

LIMIT_S = 0.35
ACTS = 10
"""Number of kills and stops in one flight: first of workers and guardian, and finally of the flight
itself."""
_LOAD = Load(600.0, camera_period=1.0, replan_period=0.5)
_NOTICED_S = 8.0
"""Time (s) within which the end of a process must be in the log on disk.

The end is detected within two seconds and stored a second later; the rest is a margin for busy machines.
"""
_HARDWARE = 70
"""SCHED_FIFO priority of the processes that represent hardware; it is higher than that of the flight."""
_GONE_S = 30.0
"""Time (s) after which all processes of a flight have ended by themselves; a starting process must finish its
start first.
"""
_SHARED = Path("/dev/shm")


def cases(runs: int, seed: int) -> list[Case]:
    """Return flights with `runs` kills and stops in total."""
    sizes = [min(ACTS, runs - done) for done in range(0, runs, ACTS)]
    return [Case(str(number), (seed, number), {"acts": size}) for number, size in enumerate(sizes)]


def run(case: Case) -> Result:
    """Fly, kill and stop processes, and read the log."""
    rng = np.random.default_rng(case.seed)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        config, facts, temporary = folder / "flight.yaml", folder / "facts.json", folder / "temporary"
        config.write_text(full_load(_LOAD), encoding="utf-8")
        temporary.mkdir()
        shared = _in_shared_memory()
        words = "--folder", str(folder), "--facts", str(facts)
        stack.enter_context(answering("sim_hal", "serve", str(config), *words))
        for child in below(os.getpid()):
            if "sim_hal serve" in command(child):
                system.prioritise(child, _HARDWARE)
        bus = RemoteI2cBus(json.loads(facts.read_text(encoding="utf-8"))["socket"])
        stack.callback(bus.close)
        notifications = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notifications.bind(str(folder / "notify"))
        os.environ["TMPDIR"] = str(temporary)
        flight = LiveFlight(folder, config, notifications, _LOAD.duration, "--devices", str(facts))
        stack.callback(flight.end)
        del os.environ["TMPDIR"]
        flight.wait_for("READY=1", 60.0)
        acts = _hurt_parts(flight, case.parameters["acts"] - 1, rng)
        time.sleep(_NOTICED_S)
        end = _hurt_flight(flight, Board(folder, facts, bus), rng)
        reported = _reported(flight.folder)
        left = [str(path) for path in (*temporary.iterdir(), *(_in_shared_memory() - shared))]
    return {"acts": dict(acts), "reported": reported, "left": left, **end}


def _in_shared_memory() -> set[Path]:
    """Return the files in shared memory, without the semaphores of Python's process pools."""
    return {path for path in _SHARED.iterdir() if not path.name.startswith("sem.mp-")}


def _hurt_parts(flight: LiveFlight, number: int, rng: np.random.Generator) -> Counter[str]:
    """Kill or stop workers and the guardian one after the other; return the counts by process."""
    acts: Counter[str] = Counter()
    hurt: set[int] = set()
    deadline = time.monotonic() + 20.0 * max(number, 1)
    while acts.total() < number and time.monotonic() < deadline:
        time.sleep(float(rng.uniform(0.5, 3.0)))
        victims = {
            role: pid for role, pid in members(flight).items() if pid not in hurt and role != "control"
        }
        if not victims:
            continue
        role = str(rng.choice(sorted(victims)))
        number_sent = signal.SIGKILL if rng.random() < 0.5 else signal.SIGSTOP
        hurt.add(victims[role])
        with suppress(ProcessLookupError):  # the guardian was replaced just now
            os.kill(victims[role], number_sent)
            acts[role] += 1
    return acts


def _hurt_flight(flight: LiveFlight, board: Board, rng: np.random.Generator) -> Result:
    """Kill or stop the flight; return the time until the coils were off, and the remaining processes."""
    children = flight.children()
    before = max(board.current() for _ in range(20))
    sent = signal.SIGKILL if rng.random() < 0.5 else signal.SIGSTOP
    system.prioritise(0, _HARDWARE)
    zero_after, _ = watch_coils(board, flight.do(sent), before)
    system.relinquish()
    flight.process.kill()
    flight.process.wait()
    deadline = time.monotonic() + _GONE_S
    while any(map(lives, children)) and time.monotonic() < deadline:
        time.sleep(0.02)
    gone_after = _GONE_S - (deadline - time.monotonic())
    orphans = [child for child in children if lives(child)]
    # These processes are already counted; a stopped process would keep the flight's pipe open.
    for child in orphans:
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    return {
        "sent": sent.name,
        "current_before_a": before,
        "zero_after_s": zero_after,
        "gone_after_s": gone_after,
        "orphans": len(orphans),
    }


def _reported(folder: Path) -> dict[str, int]:
    """Return the number of ended processes that the log reports, by process."""
    log = read_run(folder)["event"]
    died = log["code"] == events.WORKER_DIED.code
    found = Counter(text.decode().partition(":")[0] for text in log["text"][died].tolist())
    lost = log["code"] == events.GUARDIAN_LOST.code
    return {**found, "guardian": int(lost.sum() + log["suppressed"][lost].sum())}


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return counts of kills and reports, times to zero current, and remaining processes and files."""
    acts: Counter[str] = sum((Counter(result["acts"]) for result in results), Counter())
    reported = sum(
        (
            Counter({r: min(n, result["reported"].get(r, 0)) for r, n in result["acts"].items()})
            for result in results
        ),
        Counter(),
    )
    driven = [result for result in results if result["current_before_a"] > 0.0]
    worst = max((result["zero_after_s"] for result in driven), default=0.0)
    facts = {
        "acts": dict(acts),
        "reported": dict(reported),
        "flights": len(results),
        "driven": len(driven),
        "worst_zero_after_s": worst,
        "beyond_limit": sum(result["zero_after_s"] > LIMIT_S for result in driven),
        "longest_gone_after_s": max(result["gone_after_s"] for result in results),
        "orphans": sum(result["orphans"] for result in results),
        "left": [path for result in results for path in result["left"]],
    }
    return summary(facts)
