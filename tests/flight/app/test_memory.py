"""Tests of the memory settings of a process, each in a separate process."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

_LIGHT = """
import sys
import flight.app.flight, flight.app.cli.run, flight.link.commands
import flight.bodies.orbit.body, flight.bodies.testbed.body
import sim_hal.faults.host, sim_hal.rig
sys.stdout.write(" ".join(sorted(name for name in sys.modules if name.partition(".")[0] == "scipy")))
"""
_WORKING = """
import sys
from knightcube.vision import frame_job
before = "knightcube.vision.streaks.estimate" in sys.modules
frame_job.prepare()
sys.stdout.write(f"{before} {'knightcube.vision.streaks.estimate' in sys.modules}")
"""
_WORKERS = """
import sys
from flight.loop.worker import lean_imports
if sys.argv[1] == "lean":
    lean_imports()
import numpy as np, scipy.ndimage, scipy.linalg, scipy.sparse.csgraph, scipy.special
held = [name for name in ("numpy.f2py", "numpy.ma", "numpy.testing") if name in sys.modules]
assert scipy.ndimage.label(np.ones(3))[1] == 1 and np.ma.ones(3).sum() == 3.0
assert scipy.special.ndtr(0.0) == 0.5 and scipy.linalg.inv(2.0 * np.eye(2))[0, 0] == 0.5
if "JAX" in scipy.ndimage.label.__doc__ or "JAX" in (scipy.special.ndtr.__doc__ or ""):
    held.append("tables")
sys.stdout.write(" ".join(held))
"""
_FRAMES = """
import gc, sys
from array import array
from pathlib import Path
from flight.app import service

def heap():
    lines = iter(Path("/proc/self/smaps").read_text().splitlines())
    for line in lines:
        if line.endswith("[heap]"):
            return next(int(line.split()[1]) for line in lines if line.startswith("Rss:"))

def frames():  # the threshold has moved up; now each frame is followed by something small that stays
    kept, grown = [], heap()
    for number in range(20):
        frame = array("B", bytes(2 << 20))
        kept.append(bytes(4096))
        del frame
        kept.append(array("B", bytes(3 << 19)))
    return heap() - grown

for _ in range(3):
    array("B", bytes(8 << 20))
assert gc.get_freeze_count() == 0
if sys.argv[1] == "settled":
    service.settle_memory()
    assert gc.get_freeze_count() > 1000 and not gc.isenabled()
sys.stdout.write(str(frames()))
"""


_LOOPS = """
import gc, sys, weakref
from flight.app import service

class Loop:
    def __init__(self):
        self.me = self

service.settle_memory()
collect = service.Collector()
kept = [Loop() for _ in range(1000)]
collect()
frozen = gc.get_freeze_count()
lost = weakref.ref(Loop())
collect()
sys.stdout.write(f"{frozen > 1000} {lost() is None} {gc.get_count()[0] < 100} {gc.isenabled()}")
"""

_LOCK_STEP = """
import gc, sys
from pathlib import Path
from flight.app.flight import fly
from flight.app.run import RunRequest

counts = []
request = RunRequest(Path("config/step_demo.yaml"), Path(sys.argv[1]), duration=2.0)
usual = gc.get_threshold()
fly(request, lambda _: counts.append(gc.get_freeze_count() if gc.get_threshold() > usual else 0))
sys.stdout.write(f"{min(counts) > 1000} {gc.get_freeze_count()} {gc.get_threshold() == usual}")
"""


def _said(code: str, *words: str) -> str:
    done = subprocess.run([sys.executable, "-c", code, *words], check=True, capture_output=True, text=True)
    return done.stdout


def test_the_control_process_names_the_workers_jobs_without_scipy() -> None:
    assert _said(_LIGHT) == ""


def test_a_worker_leaves_out_the_parts_of_numpy_and_the_tables_of_docstrings_that_scipy_would_add() -> None:
    usual = _said(_WORKERS, "as it comes").split()
    assert {"numpy.f2py", "tables"} <= {*usual}
    assert _said(_WORKERS, "lean") == ""


def test_a_worker_holds_the_estimators_before_its_first_job() -> None:
    assert _said(_WORKING) == "False True"


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="this libc has no mallopt")
def test_arrays_of_megabytes_do_not_stretch_the_heap_of_a_settled_process() -> None:
    assert int(_said(_FRAMES, "as it comes")) > 10_000
    assert int(_said(_FRAMES, "settled")) < 1_000


def test_garbage_of_a_failure_is_collected_and_remaining_objects_are_examined_once() -> None:
    assert _said(_LOOPS) == "True True True False"


def test_a_flight_in_lock_step_examines_the_objects_of_its_start_only_after_its_end(tmp_path: Path) -> None:
    assert _said(_LOCK_STEP, str(tmp_path / "run")) == "True 0 True"
