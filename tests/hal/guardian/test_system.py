"""Tests of the services of systemd and Linux: messages by sd_notify(3), and requested privileges."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from flight.app import service as watchers
from hal.buses import system
from hal.buses.system import ServiceManager
from hal.drivers.coils import DEVICE as COILS

OWN = 4711


@pytest.fixture(params=["path", "abstract"])
def manager_end(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@{tmp_path.name}-knightcube"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(name.replace("@", "\0", 1))
        end.settimeout(5.0)
        yield end, name


def test_every_message_arrives_in_its_own_datagram(manager_end: tuple[socket.socket, str]) -> None:
    end, name = manager_end
    service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}, OWN)
    service.ready("flying")
    service.status("slewing")
    service.feed_watchdog()
    service.stopping()
    service.close()
    words = [end.recv(100) for _ in range(4)]
    assert words == [b"READY=1\nSTATUS=flying", b"STATUS=slewing", b"WATCHDOG=1", b"STOPPING=1"]


@pytest.mark.parametrize(
    ("environment", "period_ns"),
    [
        ({"WATCHDOG_USEC": "2000000"}, 2_000_000_000),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(OWN)}, 2_000_000_000),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, 0),
        ({"WATCHDOG_USEC": "soon"}, 0),
        ({}, 0),
    ],
)
def test_the_watchdog_applies_only_if_its_variables_name_this_process(
    environment: dict[str, str], period_ns: int
) -> None:
    assert ServiceManager(environment, OWN).watchdog_ns == period_ns


def test_a_watchdog_of_another_process_is_not_fed(manager_end: tuple[socket.socket, str]) -> None:
    end, name = manager_end
    service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}, OWN)
    service.feed_watchdog()
    service.stopping()
    service.close()
    assert end.recv(100) == b"STOPPING=1"


def test_messages_to_a_missing_or_dead_manager_raise_no_exception(tmp_path: Path) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "nobody")}):
        service = ServiceManager({**environment, "WATCHDOG_USEC": "2000000"}, OWN)
        service.ready("flying")
        service.feed_watchdog()
        service.close()
        service.close()
        service.stopping()


def test_a_manager_that_does_not_read_is_not_waited_for(manager_end: tuple[socket.socket, str]) -> None:
    _, name = manager_end
    service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}, OWN)
    for _ in range(2000):
        service.feed_watchdog()
    service.close()


def test_a_ready_that_a_full_queue_refused_is_repeated_until_it_is_delivered_once(
    manager_end: tuple[socket.socket, str],
) -> None:
    end, name = manager_end
    service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "2000000"}, OWN)
    for _ in range(2000):
        service.feed_watchdog()
    service.ready("flying")
    end.setblocking(False)
    taken = set()
    with suppress(BlockingIOError):
        while True:
            taken.add(end.recv(100))
    assert taken == {b"WATCHDOG=1"}
    service.feed_watchdog()
    service.feed_watchdog()
    assert [end.recv(100) for _ in range(3)] == [b"READY=1\nSTATUS=flying", b"WATCHDOG=1", b"WATCHDOG=1"]
    service.close()


def test_a_ready_is_repeated_without_a_watchdog_but_not_after_stopping(tmp_path: Path) -> None:
    name = tmp_path / "late"
    service = ServiceManager({"NOTIFY_SOCKET": str(name)}, OWN)
    service.ready("flying")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(name))
        end.setblocking(False)
        service.feed_watchdog()
        assert end.recv(100) == b"READY=1\nSTATUS=flying"
    name.unlink()
    service.ready("again")
    service.stopping()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(name))
        end.setblocking(False)
        service.feed_watchdog()
        with pytest.raises(BlockingIOError):
            end.recv(100)
    service.close()


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


def test_the_real_time_priority_is_requested_for_each_thread(monkeypatch: pytest.MonkeyPatch) -> None:
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
