"""Tests of the messages by sd_notify(3), which must never block a flight process."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from hal.buses.system import ServiceManager

OWN = 4711


@pytest.fixture(params=["path", "abstract"])
def manager_end(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    name = str(tmp_path / "notify") if request.param == "path" else f"@{tmp_path.name}-knightcube"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(name.replace("@", "\0", 1))
        end.settimeout(5.0)
        yield end, name


def test_every_word_arrives_as_a_datagram_of_its_own(manager_end: tuple[socket.socket, str]) -> None:
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
def test_the_watchdog_is_ours_only_when_it_says_so(environment: dict[str, str], period_ns: int) -> None:
    assert ServiceManager(environment, OWN).watchdog_ns == period_ns


def test_a_watchdog_of_another_process_is_not_fed(manager_end: tuple[socket.socket, str]) -> None:
    end, name = manager_end
    service = ServiceManager({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1"}, OWN)
    service.feed_watchdog()
    service.stopping()
    service.close()
    assert end.recv(100) == b"STOPPING=1"


def test_without_a_manager_or_with_a_dead_one_nothing_happens(tmp_path: Path) -> None:
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
