"""Processor time of a flight in lock-step.

The command simulates the first seconds of config/orbit.yaml (from the tip-off to pointing) or of another
configuration. It reads the processor time of a control cycle and of the workers' jobs from the log. The time
of a cycle includes the emulated devices on the coils' bus, but not the jobs. On a slow machine, times are
scaled to those of a standard machine.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import yaml

from flight.link.events import Mode
from flight.link.telemetry.packets import to_text
from ground.telemetry import Run, read_run
from tests.pace import ORDINARY_PACE_S, pace_s
from tests.studies.command import command, scratch

ROOT = Path(__file__).resolve().parents[3]
WANTED_CYCLE_MS = 0.6
BY_PROCESSOR = """
import runpy, time
time.perf_counter_ns = time.thread_time_ns
runpy.run_module("flight", run_name="__main__", alter_sys=True)
"""
"""Source of a program that runs the flight application and logs processor times instead of elapsed times."""
MODES = (Mode.DETUMBLE, Mode.ACQUIRE, Mode.POINT, Mode.TESTBED_DEMO)


@command
def main(
    *,
    seconds: Annotated[float, "of flight"] = 600.0,
    config: Annotated[str, "the configuration"] = "config/orbit.yaml",
) -> int:
    """Print the costs; return the exit status."""
    with scratch() as folder:
        begun, _ = command_s("run", config, "--duration", "1", "--out", str(folder / "one"))
        flown, slowness = command_s("run", config, "--duration", str(seconds), "--out", str(folder / "run"))
        text = figures(read_run(folder / "run"), slowness)
    spent = flown - begun
    duration = float(yaml.safe_load((ROOT / config).read_text(encoding="utf-8"))["duration"])
    whole = begun + spent * duration / seconds
    sys.stdout.write(
        f"{text}start {begun:.1f} s, {seconds:g} s of flight {spent:.1f} s of an ordinary "
        f"core: {whole:.0f} s for {duration:g} s\n"
    )
    return 0


def figures(run: Run, slowness: float) -> str:
    """Return the time of a cycle in each mode, and the time of the jobs per second of flight.

    The times are divided by the `slowness` of the machine.
    """
    cycles, modes, jobs = run["cycle_timing"], run["mode"], run["job_timing"]
    place = np.searchsorted(modes["time_ns"], cycles["time_ns"], side="right") - 1
    mode = modes["mode"][np.maximum(place, 0)]
    lines = []
    for wanted in MODES:
        mine = 1e3 / slowness * cycles["execution"][mode == int(wanted)]
        if len(mine):
            times = (
                f"mean {np.mean(mine):.2f} ms of {WANTED_CYCLE_MS:g} wanted, median {np.median(mine):.2f} ms"
            )
            lines.append(f"control cycle in {wanted.label:9}{times}, {len(mine)} cycles")
    whole = 1e3 / slowness * float(np.mean(cycles["execution"]))
    lines.append(f"control cycle          mean {whole:.2f} ms, {len(cycles)} cycles")
    span = float(cycles["time_ns"][-1]) * 1e-9
    for worker in ("vision", "planner"):
        taken = jobs["execution"][np.array([to_text(name) == worker for name in jobs["name"]], dtype=bool)]
        each_second = 1e3 / slowness * float(taken.sum()) / span
        lines.append(f"{worker:8}{len(taken):5} jobs, {each_second:6.1f} ms a second of flight")
    return "\n".join(lines) + "\n"


def command_s(*arguments: str) -> tuple[float, float]:
    """Return the processor time (s) of a command of the flight application, and the slowness of this machine.

    The time includes child processes and is scaled to a standard machine.
    """
    begun, paces = _children_s(), [pace_s()]
    words = [sys.executable, "-c", BY_PROCESSOR, *arguments]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            try:
                process.wait(timeout=2.0)
            except subprocess.TimeoutExpired:
                paces.append(pace_s())
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)}: exit status {process.returncode}")
    slowness = max(1.0, sum(paces) / len(paces) / ORDINARY_PACE_S)
    return (_children_s() - begun) / slowness, slowness


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
