"""The 40 Hz loop under full load: `python -m tests.studies.bench executive [--minutes M] [--orbit] [--busy]`.

The step demonstration flies in real time on emulated devices in separate processes. Planner and vision work
without pause, and the guardian watches. With `--orbit` the satellite of `config/orbit.yaml` flies instead. It
points to nadir from the start, its planner has the shortest period that the configuration allows (10 s), and
its horizon cameras run at their flight rate. With `--busy` each worker repeats its last job until the next
job arrives, so no worker is ever idle.

A bare sleep loop at the same rate (`tests.studies.bench.bare_loop`) runs beside the flight and measures
stalls of the machine. The kernel measures the stolen time, in which the host of a virtual machine does not
run it. A loop with work to do is affected by such stalls more often than a loop that only sleeps. If
SCHED_FIFO is permitted, the flight runs twice, with and without it. Run the benchmark alone on two cores. The
slope of memory needs flights of 16 minutes or longer.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import resource
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import yaml

from tests.hal.guardian.live_flight import ROOT, LiveFlight
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
"""Priority of the bare loop under SCHED_FIFO, equal to that of the flight's control thread."""

ORBIT = ROOT / "config" / "orbit.yaml"
SHARED_LOOKS = 9
"""Number of samples of the memory that the flight shares with other processes."""
SHORTEST_REPLAN = 10.0
"""Shortest interval (s) between pointing plans that the schema permits."""
AT_NADIR = {"attitude": [0.096, 0.701, 0.185, -0.682], "rate": [0.0, -1.1e-3, 0.0]}
"""Release state along the flight direction, with the star camera pointing to the sky.

All tasks can work at once.
"""

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


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark, and print required and measured values. Returns 1 if a requirement is not met."""
    load, options = _load(arguments)
    flights: dict[str, Figures] = {}
    grids: dict[str, Grid] = {}
    with _compiled():
        for name in _schedulings(options.scheduling):
            with tempfile.TemporaryDirectory() as folder:
                flown = fly(Path(folder), load, name == "fifo")
            flights[name] = flown.figures
            grids |= {f"flight, {name}": flown.flight, f"bare loop, {name}": flown.machine}
    if options.out is not None:
        _write(options.out, load, flights, grids)
    if options.json:
        sys.stdout.write(json.dumps({"load": asdict(load), "asked": ASKED, "flights": flights}) + "\n")
    else:
        sys.stdout.write("\n".join(table(figures, name) for name, figures in flights.items()))
    return int(any(misses(figures) for figures in flights.values()))


def _load(arguments: Sequence[str]) -> tuple[Load, argparse.Namespace]:
    """Return the load and all options of a command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--minutes", type=float, default=10.0, metavar="M", help="of each flight (default 10)"
    )
    parser.add_argument(
        "--camera-period", type=float, default=Load.camera_period, metavar="S", help="default %(default)s"
    )
    parser.add_argument(
        "--replan-period", type=float, default=Load.replan_period, metavar="S", help="default %(default)s"
    )
    parser.add_argument(
        "--warm-up", type=float, metavar="S", help="not in the figures (default 60, or a fifth of a flight)"
    )
    parser.add_argument(
        "--scheduling", choices=["fifo", "ordinary", "both"], default="both", help="default %(default)s"
    )
    parser.add_argument("--orbit", action="store_true", help="fly the satellite, not the step demonstration")
    parser.add_argument("--busy", action="store_true", help="no worker is ever idle")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write executive.json and lateness.png")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    duration = 60.0 * options.minutes
    if not 3.0 <= duration < 1e6:
        parser.error(f"--minutes {options.minutes:g}: a flight takes 0.05 minutes at least")
    warm_up = min(60.0, 0.2 * duration) if options.warm_up is None else options.warm_up
    if not 0.0 <= warm_up < duration:
        parser.error(f"--warm-up {warm_up:g}: must be shorter than the flight of {duration:g} s")
    for name, period in (("camera", options.camera_period), ("replan", options.replan_period)):
        if not 0.0 < period < 10.0:
            parser.error(f"--{name}-period {period:g}: must lie between 0 and 10 s")
    periods = options.camera_period, options.replan_period
    return Load(duration, *periods, warm_up, orbit=options.orbit, busy=options.busy), options


def _schedulings(wanted: str) -> list[str]:
    """Return the scheduling policies to run: the ordinary one, and SCHED_FIFO if it is permitted."""
    if wanted == "ordinary" or fifo_allowed():
        return ["fifo", "ordinary"] if wanted == "both" else [wanted]
    sys.stderr.write("SCHED_FIFO is refused here: flown without it\n")
    return ["ordinary"]


def _write(folder: Path, load: Load, flights: dict[str, Figures], grids: dict[str, Grid]) -> None:
    """Write the measured values, and the histogram if matplotlib is installed."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"load": asdict(load), "asked": ASKED, "flights": flights}, indent=2)
    (folder / "executive.json").write_text(text + "\n", encoding="utf-8")
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

    In the step demonstration the receding strategy plans at every replanning. The goal strategy stops
    planning once a step is over.
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
def _compiled() -> Iterator[None]:
    """Make Python use compiled modules, as after an installation, whatever the shell's environment is."""
    with tempfile.TemporaryDirectory() as folder:
        before = {name: os.environ.pop(name, None) for name in (_NO_BYTECODE, _BYTECODE)}
        os.environ[_BYTECODE] = folder
        try:
            modules = ", ".join((*_IMPORTED, *(role for role in _ROLES if ":" not in role)))
            subprocess.run([sys.executable, "-c", f"import {modules}"], cwd=ROOT, check=True)
            yield
        finally:
            del os.environ[_BYTECODE]
            os.environ.update({name: value for name, value in before.items() if value is not None})


def fly(folder: Path, load: Load, fifo: bool) -> Flown:
    """Run the flight once in `folder` beside the bare loop, and return the measured values."""
    config, devices, wakes = folder / "flight.yaml", folder / "devices", folder / "wakes"
    facts = devices / "facts.json"
    config.write_text(full_load(load), encoding="utf-8")
    devices.mkdir()
    with ExitStack() as stack:
        stack.enter_context(
            answering(
                "tests.studies.bench.bare_loop", str(PERIOD_NS), str(PRIORITY if fifo else 0), str(wakes)
            )
        )
        # The devices exist before the flight process starts, as on a board.
        outputs = "--folder", str(devices), "--facts", str(facts)
        stack.enter_context(answering("sim_hal", "serve", str(config), *outputs))
        notifications = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        notifications.bind(str(folder / "notify"))
        flight = _started(folder, config, notifications, load, facts, fifo)
        stack.callback(flight.end)
        ready_ns = flight.wait_for("READY=1")
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


def _started(
    folder: Path, config: Path, notifications: socket.socket, load: Load, facts: Path, fifo: bool
) -> LiveFlight:
    """Start the flight on its devices, without the right to SCHED_FIFO if `fifo` is false."""
    started: list[LiveFlight] = []

    def start() -> None:
        if not fifo:
            # Only this thread and its child processes lose the capability CAP_SYS_NICE.
            ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
        words = folder, config, notifications, load.duration, "--devices", str(facts)
        started.append(LiveFlight(*words, before=_KEPT_BUSY if load.busy else ""))
        if not fifo:
            resource.prlimit(started[0].process.pid, resource.RLIMIT_RTPRIO, (0, 0))

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    return started[0]
