"""Processor time of a flight in orbit: `python -m tests.studies.bench orbit_cost`.

Flies the first seconds of config/orbit.yaml by `python -m flight run` in lock-step, from the tip-off to
pointing, and reads from its log what a control cycle and the workers' jobs took. A cycle includes the
emulated side of the coils' wire, without the jobs. The median over the cycles is reported, because other
work on the machine lengthens some of them.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flight.link.modes import Mode
from flight.link.telemetry.packets import to_text
from ground.telemetry import Run, read_run
from tests.pace import ORDINARY_PACE_S, pace_s

ROOT = Path(__file__).resolve().parents[3]
WANTED_CYCLE_MS = 0.5
WHOLE_S = 6000.0
MODES = (Mode.DETUMBLE, Mode.ACQUIRE, Mode.POINT)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the costs; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.bench orbit_cost", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="of flight, %(default)s by default")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        words = ("config/orbit.yaml", "--duration", str(options.seconds), "--out", str(folder))
        begun = command_s(
            "run", "config/orbit.yaml", "--duration", "1", "--out", str(folder.with_name("one"))
        )
        spent = command_s("run", *words) - begun
        text = figures(read_run(folder))
    whole = begun + spent * WHOLE_S / options.seconds
    sys.stdout.write(
        f"{text}start {begun:.1f} s, {options.seconds:g} s of flight {spent:.1f} s of an ordinary "
    )
    sys.stdout.write(f"core: {whole / 60.0:.1f} min for {WHOLE_S / 60.0:g} min\n")
    return 0


def figures(run: Run) -> str:
    """Return what a cycle took in each mode, and the jobs' time for each second of flight."""
    cycles, modes, jobs = run["cycle_timing"], run["mode"], run["job_timing"]
    place = np.searchsorted(modes["time_ns"], cycles["time_ns"], side="right") - 1
    mode = modes["mode"][np.maximum(place, 0)]
    lines = []
    for wanted in MODES:
        mine = 1e3 * cycles["execution"][mode == int(wanted)]
        if len(mine):
            lines.append(
                f"control cycle in {wanted.label:9}{np.median(mine):6.2f} ms of {WANTED_CYCLE_MS:g} wanted"
            )
    span = float(cycles["time_ns"][-1]) * 1e-9
    for worker in ("vision", "planner"):
        taken = jobs["execution"][np.array([to_text(name) == worker for name in jobs["name"]], dtype=bool)]
        lines.append(
            f"{worker:8}{len(taken):5} jobs, {1e3 * float(taken.sum()) / span:6.1f} ms a second of flight"
        )
    return "\n".join(lines) + "\n"


def command_s(*arguments: str) -> float:
    """Return the processor time of a command with its child processes, s of an ordinary machine."""
    begun, paces = _children_s(), [pace_s()]
    words = [sys.executable, "-m", "flight", *arguments]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            try:
                process.wait(timeout=2.0)
            except subprocess.TimeoutExpired:
                paces.append(pace_s())
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)}: exit status {process.returncode}")
    pace = sum(paces) / len(paces)
    return (_children_s() - begun) / max(1.0, pace / ORDINARY_PACE_S)


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
