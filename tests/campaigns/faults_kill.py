"""Campaign `faults-kill`: kill -9 of the flight process at random moments of a real-time run.

The emulated devices live in a process of their own and outlive the flight: their log of the truth tells when
the coils came to zero. What is measured is late by no more than a sample of the truth and a turn of the
server's loop, 45 ms together; that is added.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flight.errors import FlightError
from flight.telemetry.reader import read_run
from tests.campaigns.campaign import Campaign, Case, Result, Summary
from tests.scenario.flights import CONFIG, TEXT

ROOT = CONFIG.parents[1]
LIMIT_S = 0.5
_UNCERTAIN_S = 0.045
_START_S = 60.0
_WATCH_S = 1.2
_SLEEP_S = 0.01
_FLOWN_BYTES = 30_000


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` kills."""
    return [Case(str(number), (seed, number), {}) for number in range(runs)]


def run(case: Case) -> Result:
    """Fly in real time, kill, look at what the coils do."""
    rng = np.random.default_rng(case.seed)
    wait = float(rng.uniform(0.0, 3.0))
    with tempfile.TemporaryDirectory() as place:
        config = Path(place) / "kill.yaml"
        tree = yaml.safe_load(TEXT)
        tree["camera"] = "none"
        tree["duration"] = 60.0
        tree["steps"] = [{"at": 0.0, "q2": -0.3}]
        config.write_text(yaml.safe_dump(tree), encoding="utf-8")
        folder = Path(place) / "run"
        words = [sys.executable, "-m", "flight", "run", str(config), "--realtime", "--out", str(folder)]
        words += ["--seed", str(int(rng.integers(1, 2**31)))]
        flight = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            _wait_until_flying(flight, folder)
            time.sleep(wait)
            devices = _devices_of(flight.pid)
            flight.kill()
            killed_ns = time.monotonic_ns()
            time.sleep(_WATCH_S)
            ended_ns = time.monotonic_ns()
            os.kill(devices, signal.SIGTERM)
            _wait_until_gone(devices)
        finally:
            flight.kill()
            flight.wait()
        return {"waited_s": wait, **_judge(folder, killed_ns, ended_ns)}


def _judge(folder: Path, killed_ns: int, ended_ns: int) -> Result:
    flown = read_run(folder)
    truth = flown["truth"]
    times = truth["time_ns"] * 1e-9
    # The truth ends when its recorder does: that ties its mission time to the machine's clock.
    kill = float(times[-1]) - (ended_ns - killed_ns) * 1e-9
    current = np.abs(truth["current"]).max(axis=1)
    driven = times[current > 0.0]
    after = float(driven[-1]) - kill + _UNCERTAIN_S if len(driven) else -1.0
    before = current[(times > kill - 0.1) & (times <= kill)]
    return {
        "zero_after_s": max(after, 0.0),
        "current_before_a": float(before.max()) if len(before) else 0.0,
        "current_after_a": float(current[times > kill + LIMIT_S].max(initial=0.0)),
        "log_intact": flown.logs["flight"].intact or len(flown["control"]) > 10,
        "flown_s": float(flown["control"]["time_ns"][-1]) * 1e-9,
    }


def _wait_until_flying(flight: subprocess.Popen[bytes], folder: Path) -> None:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if any(log.stat().st_size > _FLOWN_BYTES for log in folder.glob("flight-*")):
            return
        if flight.poll() is not None:
            break
        time.sleep(_SLEEP_S)
    raise FlightError("faults-kill: the flight did not begin")


def _devices_of(parent: int) -> int:
    """Return the process of the emulated devices."""
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        for child in task.read_text(encoding="ascii").split():
            words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            if b"sim_hal" in words and b"serve" in words:
                return int(child)
    raise FlightError("faults-kill: no devices beside the flight")


def _wait_until_gone(process: int) -> None:
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline and Path(f"/proc/{process}/cmdline").exists():
        try:
            if not Path(f"/proc/{process}/cmdline").read_bytes():
                return  # a zombie: its new parent has not looked yet
        except OSError:
            return
        time.sleep(_SLEEP_S)


def summarise(results: Sequence[Result], folder: Path) -> Summary:
    """Return how long the coils stayed on, over those runs in which they were."""
    del folder
    driven = [result for result in results if result["current_before_a"] > 0.0]
    after = np.array([result["zero_after_s"] for result in driven] or [0.0])
    facts: dict[str, Any] = {
        "runs": len(results),
        "driven": len(driven),
        "zero_after_s": {
            "median": float(np.median(after)),
            "p99": float(np.quantile(after, 0.99)),
            "worst": float(after.max()),
        },
        "beyond_limit": int((after > LIMIT_S).sum()),
        "current_after_a": max(result["current_after_a"] for result in results),
        "logs_readable": sum(result["log_intact"] for result in results),
    }
    spread = facts["zero_after_s"]
    text = (
        f"{facts['runs']} kills, in {facts['driven']} the coils carried current\n"
        f"coils at zero after: median {spread['median']:.3f} s, 99 % {spread['p99']:.3f} s, "
        f"worst {spread['worst']:.3f} s (limit {LIMIT_S:g} s, beyond it {facts['beyond_limit']})\n"
        f"largest current later than that: {1e3 * facts['current_after_a']:.1f} mA\n"
        f"flight log readable: {facts['logs_readable']} of {facts['runs']}\n"
    )
    return Summary(text, facts)


FAULTS_KILL = Campaign(
    "faults-kill",
    "kill -9 of the flight process at random moments, in real time (use --workers 1)",
    cases,
    run,
    summarise,
    default_runs=1000,
)
