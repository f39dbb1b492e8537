"""Processor time of the demonstration and its report: `python -m tests.studies.bench demonstration`.

Flies config/step_demo.yaml whole by `python -m flight run` and draws its report with all figures.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.pace import ORDINARY_PACE_S, pace_s

LIMIT = 60.0
ROOT = Path(__file__).resolve().parents[3]


def main() -> int:
    """Print both times, s of an ordinary machine; fail when their sum exceeds the limit."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        flown = command_s("run", "config/step_demo.yaml", "--out", str(folder / "run"))
        reported = command_s("report", str(folder / "run"), "--figures", str(folder / "figures"))
    total = flown + reported
    sys.stdout.write(f"flight {flown:.1f} s, report {reported:.1f} s: {total:.1f} s of {LIMIT:g} s\n")
    return int(total > LIMIT)


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
