"""Tests that real-time privileges are requested, and that the report states which were granted."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from flight.app import service as watchers
from hal.buses import system
from hal.drivers.coils import DEVICE as COILS


def test_a_refusal_is_reported_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(system, "lock_memory", lambda: "locked memory refused (x): allow it with y")
    obtained = system.obtain([0], 50)
    assert (obtained.priority, obtained.locked) == (0, False)
    assert str(obtained) == (
        "ordinary scheduling, memory not locked; SCHED_FIFO 50 refused (Operation not permitted): "
        "allow it with LimitRTPRIO; locked memory refused (x): allow it with y"
    )


def test_what_is_granted_is_asked_for_each_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int, int]] = []
    monkeypatch.setattr(
        os,
        "sched_setscheduler",
        lambda thread, policy, value: asked.append((thread, policy, value.sched_priority)),
    )
    monkeypatch.setattr(system, "lock_memory", lambda: "")
    assert str(system.obtain([0, 77], 50)) == "SCHED_FIFO 50, memory locked"
    assert asked == [(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 50) for thread in (0, 77)]


def test_the_kernel_reports_locked_memory_or_the_refusal_is_explained() -> None:
    """Memory is locked when a page is first used, so unused address space takes no memory.

    If the kernel refuses the lock, the refusal is explained.
    """
    script = (
        "import mmap; from hal.buses import system\n"
        "said = system.lock_memory(); reserved = mmap.mmap(-1, 1 << 30)\n"
        "status = open('/proc/self/status').read()\n"
        "field = lambda name: int(status.split(name)[1].split()[0])\n"
        "print(said or (field('VmLck:') > 1 << 20 and field('VmRSS:') < 100_000))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True" or done.stdout.startswith("locked memory refused")


def test_the_threads_beside_the_control_thread_are_served_next(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[int, int] = {}

    def note(thread_id: int, priority: int) -> str:
        asked[thread_id] = priority
        return ""

    monkeypatch.setattr(system, "prioritise", note)
    done = threading.Event()
    beside, coils = (threading.Thread(target=done.wait, name=name) for name in ("log", COILS))
    for thread in (beside, coils):
        thread.start()
    try:
        watchers.prioritise_other_threads()
    finally:
        done.set()
        beside.join()
        coils.join()
    assert asked[beside.native_id or 0] == watchers.NEXT_PRIORITY < watchers.CONTROL_PRIORITY
    assert threading.main_thread().native_id not in asked, "it is served first"
    assert coils.native_id not in asked, "they are served first"
