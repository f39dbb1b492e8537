"""The 40 Hz loop under full load.

The step demonstration flies in real time on emulated devices in separate processes. Planner and vision work
without pause, and the guardian watches. With `--orbit` the satellite of `config/orbit.yaml` flies instead. It
points to nadir from the start. Its planner has the shortest period that the configuration allows (10 s), and
its horizon cameras run at their flight rate. With `--busy` each worker repeats its last job until the next
job arrives, so no worker is ever idle.

A bare sleep loop at the same rate (`tests.studies.bench.bare_loop`) runs beside the flight and measures
stalls of the machine. The kernel measures the stolen time: the time in which the host of a virtual machine
does not run it. A loop with work to do is affected by such stalls more often than a loop that only sleeps. If
SCHED_FIFO is permitted, the flight runs twice, with and without it. Run the benchmark alone on two cores. The
slope of memory needs flights of 16 minutes or longer.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal

import yaml

from knightcube.errors import UsageError
from tests.hal.guardian.live_flight import ROOT, LiveFlight
from tests.studies.command import Json, command, say, scratch
from tests.support import process_watch
from tests.support.executive_figures import (
    ASKED,
    PERIOD_NS,
    Began,
    Figures,
    Flown,
    Watched,
    evaluate,
    misses,
    table,
)
from tests.support.flights import TEXT
from tests.support.lateness import Grid, draw
from tests.support.process_watch import ProcessWatch, answering

PRIORITY = 50
"""Priority of the bare loop under SCHED_FIFO, equal to the priority of the flight's control thread."""

ORBIT = ROOT / "config" / "orbit.yaml"
SHARED_LOOKS = 9
"""Number of samples of the memory that the flight shares with other processes."""
SHORTEST_REPLAN = 10.0
"""Shortest interval (s) between pointing plans that the schema permits."""
AT_NADIR = {"attitude": [0.096, 0.701, 0.185, -0.682], "rate": [0.0, -1.1e-3, 0.0]}
"""Release state along the flight direction, with the star camera pointing to the sky.

In this state all tasks can run from the start.
"""

_PATIENCE_S = 240.0  # longest time until the flight is ready
_PR_CAPBSET_READ, _PR_CAPBSET_DROP, _CAP_SYS_NICE = 23, 24, 23  # linux/prctl.h, linux/capability.h
_KEPT_BUSY = "from tests.studies.bench.busy_jobs import keep_busy; keep_busy()"
_NO_BYTECODE, _BYTECODE = "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"
_IMPORTED = (
    "flight.app.flight",
    "flight.app.cli.run",
    "flight.loop.worker",
    "knightcube.vision.streaks.estimate",
    "sim_hal.faults.host",
    "sim_hal.rig",
)
_ROLES = {
    "knightcube.gnc.guidance.vmc": "planner",
    "knightcube.gnc.control.pointing_job": "planner",
    "knightcube.vision.frame_job": "vision",
    "knightcube.vision.horizon_camera_job": "wide",
    "hal.guardian": "guardian",
    "tests.studies.bench.busy_jobs:plan_testbed": "planner",
    "tests.studies.bench.busy_jobs:plan_orbit": "planner",
    "tests.studies.bench.busy_jobs:see ": "vision",
    "tests.studies.bench.busy_jobs:see_wide": "wide",
}
"""Role of a process, by a text that its command line contains."""


@dataclass(frozen=True)
class Load:
    """Configuration of a flight, with its duration, frame interval, plan interval and warm-up time (s)."""

    duration: float
    camera_period: float = 0.4
    replan_period: float = 0.025
    warm_up: float = 60.0
    look_period: float = 0.5
    orbit: bool = False
    busy: bool = False


@command
def main(
    *,
    minutes: Annotated[float, "of each flight"] = 10.0,
    camera_period: Annotated[float, "s"] = Load.camera_period,
    replan_period: Annotated[float, "s"] = Load.replan_period,
    warm_up: Annotated[float | None, "s not in the figures (default 60, or a fifth of a flight)"] = None,
    scheduling: Annotated[Literal["fifo", "ordinary", "both"], "of the flight"] = "both",
    orbit: Annotated[bool, "fly the satellite, not the step demonstration"] = False,
    busy: Annotated[bool, "no worker is ever idle"] = False,
    out: Annotated[Path | None, "folder for executive.json and lateness.png"] = None,
    json: Json = False,
) -> int:
    """Run the benchmark, and print required and measured values. Returns 1 if a requirement is not met."""
    duration = 60.0 * minutes
    if not 3.0 <= duration < 1e6:
        raise UsageError(f"--minutes {minutes:g}: a flight takes 0.05 minutes at least")
    warm_up = min(60.0, 0.2 * duration) if warm_up is None else warm_up
    if not 0.0 <= warm_up < duration:
        raise UsageError(f"--warm-up {warm_up:g}: must be shorter than the flight of {duration:g} s")
    for name, period in (("camera", camera_period), ("replan", replan_period)):
        if not 0.0 < period < 10.0:
            raise UsageError(f"--{name}-period {period:g}: must lie between 0 and 10 s")
    load = Load(duration, camera_period, replan_period, warm_up, orbit=orbit, busy=busy)
    flights: dict[str, Figures] = {}
    grids: dict[str, Grid] = {}
    with compiled():
        for name in _schedulings(scheduling):
            with scratch() as folder:
                flown = fly(folder, load, name == "fifo")
            flights[name] = flown.figures
            grids |= {f"flight, {name}": flown.flight, f"bare loop, {name}": flown.machine}
    facts: dict[str, object] = {"load": asdict(load), "asked": ASKED, "flights": flights}
    if out is not None:
        _write(out, facts, grids)
    if json:
        say(**facts)
    else:
        sys.stdout.write("\n".join(table(figures, name) for name, figures in flights.items()))
    return int(any(misses(figures) for figures in flights.values()))


def _schedulings(wanted: str) -> list[str]:
    """Return the scheduling policies to run: the default policy, and SCHED_FIFO if it is permitted."""
    if wanted == "ordinary" or fifo_allowed():
        return ["fifo", "ordinary"] if wanted == "both" else [wanted]
    sys.stderr.write("SCHED_FIFO is refused here: flown without it\n")
    return ["ordinary"]


def _write(folder: Path, facts: dict[str, object], grids: dict[str, Grid]) -> None:
    """Write the measured values, and the histogram if matplotlib is installed."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "executive.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    try:
        draw(grids, folder / "lateness.png")
    except ModuleNotFoundError:
        sys.stderr.write("no picture: needs matplotlib, pip install '.[plots]'\n")


def fifo_allowed() -> bool:
    """Return whether a process started from here may have SCHED_FIFO."""
    able = ctypes.CDLL(None).prctl(_PR_CAPBSET_READ, _CAP_SYS_NICE, 0, 0, 0) == 1 and os.geteuid() == 0
    return able or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] >= PRIORITY


def full_load(load: Load) -> str:
    """Return the configuration in which planner and vision work without pause.

    In the step demonstration, the strategy `receding` makes a plan in every replanning period. The goal
    strategy stops planning once a step is over.
    """
    period = load.camera_period
    if load.orbit:
        tree = yaml.safe_load(ORBIT.read_text(encoding="utf-8"))
        longest = 0.75 * period
        exposures = {"exposure": min(0.2, longest), "streak_exposure": [0.25 * longest, longest]}
        tree["camera"] |= {"period": period, "fine_period": period, **exposures}
        tree["pointing"]["replan_period"] = SHORTEST_REPLAN
        tree["targets"] = [{"at": 0.0, "point": "nadir", "roll_deg": 0.0}]
        tree["simulation"]["free_body"]["release"] = AT_NADIR
        # The simulated date differs from the host's clock, so that only the GPS receiver gives time and
        # position.
        del tree["elements"]
        return yaml.safe_dump(tree, sort_keys=False)
    tree = yaml.safe_load(TEXT)
    tree["camera"] |= {"period": period, "exposure": min(tree["camera"]["exposure"], 0.75 * period)}
    tree["guidance"] |= {"replan_period": load.replan_period, "strategy": "receding"}
    return yaml.safe_dump(tree, sort_keys=False)


@contextmanager
def compiled() -> Iterator[None]:
    """Make Python use compiled modules, as after an installation, whatever the shell's environment is."""
    with scratch() as folder:
        before = {name: os.environ.pop(name, None) for name in (_NO_BYTECODE, _BYTECODE)}
        os.environ[_BYTECODE] = str(folder)
        try:
            modules = ", ".join((*_IMPORTED, *(role for role in _ROLES if ":" not in role)))
            subprocess.run([sys.executable, "-c", f"import {modules}"], cwd=ROOT, check=True)
            yield
        finally:
            del os.environ[_BYTECODE]
            os.environ.update({name: value for name, value in before.items() if value is not None})


def fly(folder: Path, load: Load, fifo: bool) -> Flown:
    """Run the flight once in `folder` beside the bare loop, and return the measured values."""
    return watched_flight(
        folder, full_load(load), load, PRIORITY if fifo else 0, lambda _, *words: _started(fifo, load, *words)
    )


def watched_flight(
    folder: Path, text: str, load: Load, priority: int, start: Callable[..., LiveFlight]
) -> Flown:
    """Run a flight with the configuration `text` beside the bare loop, and return the measured values.

    `start` receives an exit stack and the arguments of a `LiveFlight`.
    """
    config, devices, wakes = folder / "flight.yaml", folder / "devices", folder / "wakes"
    facts = devices / "facts.json"
    config.write_text(text, encoding="utf-8")
    devices.mkdir()
    with ExitStack() as stack:
        bare = "tests.studies.bench.bare_loop", str(PERIOD_NS), str(priority), str(wakes)
        stack.enter_context(answering(*bare))
        # The devices exist before the flight process starts, as on a board.
        outputs = "--folder", str(devices), "--facts", str(facts)
        stack.enter_context(answering("sim_hal", "serve", str(config), *outputs))
        notifications = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notifications.bind(str(folder / "notify"))
        flight = start(stack, folder, config, notifications, load.duration, "--devices", str(facts))
        stack.callback(flight.end)
        ready_ns = flight.wait_for("READY=1", _PATIENCE_S)
        busy = process_watch.look({"control": flight.process.pid}).processor["control"]
        utc_offset_ns = time.time_ns() - time.monotonic_ns()
        watched = _watch(flight, notifications, load)
        error = flight.end()
    if flight.process.returncode != 0:
        raise RuntimeError(f"the flight ended with status {flight.process.returncode}: {error.strip()}")
    began = Began(flight.begun_ns, ready_ns, busy, utc_offset_ns)
    return evaluate(flight.folder, devices, wakes, began, watched, load.warm_up)


def _watch(flight: LiveFlight, notifications: socket.socket, load: Load) -> Watched:
    """Sample the flight until it ends, and read its service notifications."""
    shared: list[float] = []
    due = time.monotonic() + 0.5 * (load.duration + load.warm_up)
    with closing(ProcessWatch(lambda: members(flight), load.look_period)) as watch:
        while flight.process.poll() is None:
            if select.select([notifications], [], [], 0.5)[0]:
                notifications.recv(4096)
            if len(shared) < SHARED_LOOKS and time.monotonic() > due:
                due += load.look_period
                with suppress(OSError, LookupError, ValueError):  # a process may have just ended: try again
                    present = members(flight)
                    held = sum(process_watch.look(present).memory.values())
                    shared.append(process_watch.unshared(present) - held)
    # The median is used, because a job that begins or ends during a sample would count as shared memory.
    return Watched(watch.looks, max(0.0, median(shared)) if shared else 0.0)


def members(flight: LiveFlight) -> dict[str, int]:
    """Return the processes of the flight by their role."""
    found = {"control": flight.process.pid}
    for process in process_watch.below(flight.process.pid):
        words = process_watch.command(process)
        found |= {role: process for module, role in _ROLES.items() if module in words}
    return found


def _started(fifo: bool, load: Load, *words: Any) -> LiveFlight:
    """Start the flight on its devices, without the right to SCHED_FIFO if `fifo` is false."""
    started: list[LiveFlight] = []

    def start() -> None:
        if not fifo:
            # Only this thread and its child processes lose the capability CAP_SYS_NICE.
            ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
        started.append(LiveFlight(*words, before=_KEPT_BUSY if load.busy else ""))
        if not fifo:
            resource.prlimit(started[0].process.pid, resource.RLIMIT_RTPRIO, (0, 0))

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    return started[0]
