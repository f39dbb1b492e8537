"""Tests that the link process waits for transient faults and ends only for a wrong configuration."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from flight.app.cli import link, main
from flight.app.service import SeparationInhibit
from flight.link.files.store import Incoming, Store
from flight.link.files.units import UP, Metadata, Transaction, UnitPacker, pack
from flight.link.process.commanding import Timetable
from flight.link.process.station import Station
from flight.link.security import Vault
from hal.buses.system import SystemClock
from hal.interfaces.wires import SECOND_NS
from knightcube.errors import UsageError
from tests.manual_clock import ManualClock
from tests.support.linked_board import ROOT, free_ports, write_linked_config

_LONGEST_S = 120.0


class Service:
    """A link process, and the service manager's end of its notification socket."""

    def __init__(self, place: Path, config: Path) -> None:
        self.line = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.line.bind(str(place / "notify"))
        self.line.settimeout(_LONGEST_S)
        environment = {**os.environ, "NOTIFY_SOCKET": str(place / "notify"), "WATCHDOG_USEC": "30000000"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "flight", "link", str(config), "--log", str(place)],
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=environment,
        )

    def says(self, words: str) -> str:
        """Return the next line of the standard error, which must contain the given text."""
        assert self.process.stderr is not None
        line = self.process.stderr.readline()
        assert words in line
        return line

    def notifies(self, word: str) -> None:
        """Wait until the service manager receives the given notification."""
        while word not in self.line.recv(4096).decode():
            pass

    def silent(self, seconds: float) -> bool:
        """Return whether the service manager receives no notification for the given time."""
        self.line.settimeout(0.0)
        while True:
            try:
                self.line.recv(4096)
            except BlockingIOError:
                break
        self.line.settimeout(seconds)
        try:
            self.line.recv(4096)
        except TimeoutError:
            return True
        return False

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()
        self.line.close()


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a short name, because the paths of sockets are limited."""
    return tmp_path_factory.mktemp("s")


@pytest.fixture
def start(place: Path) -> Iterator[Callable[[Path], Service]]:
    begun: list[Service] = []

    def begin(config: Path) -> Service:
        begun.append(Service(place, config))
        return begun[-1]

    yield begin
    for service in begun:
        service.close()


def test_a_port_that_is_taken_is_waited_for_and_the_service_manager_learns_of_each_step(
    place: Path, start: Callable[[Path], Service]
) -> None:
    (port,) = free_ports([socket.SOCK_DGRAM])
    config = write_linked_config(place, udp=f"127.0.0.1:{port}")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        service = start(config)
        service.says(f"cannot start yet: link.udp: cannot listen on 127.0.0.1:{port}")
        service.notifies("STATUS=waiting to start")
        service.notifies("EXTEND_TIMEOUT_USEC=")
    while "link open on UDP" not in (line := service.says("")):
        assert "cannot start yet" in line
    assert "started at attempt" in line
    service.says(f"--log {place}: no flight log yet")
    service.notifies("READY=1")
    for _ in range(2):
        service.notifies("WATCHDOG=1")
    service.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, service.process.pid, os.WSTOPPED)
    assert service.silent(3.0), "the watchdog is fed though the loop stands still"
    service.process.send_signal(signal.SIGCONT)
    service.notifies("WATCHDOG=1")
    service.process.terminate()
    service.notifies("STOPPING=1")
    assert service.process.wait(_LONGEST_S) == 0


def test_no_line_is_opened_during_the_separation_inhibit(
    place: Path, start: Callable[[Path], Service]
) -> None:
    (port,) = free_ports([socket.SOCK_DGRAM])
    config = write_linked_config(place, udp=f"127.0.0.1:{port}")
    with config.open("a", encoding="utf-8") as file:
        file.write("separation: {inhibit: 86400.0}\n")
    service = start(config)
    for _ in range(2):
        service.says("cannot start yet: separation inhibit of 86400 s")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
    service.process.terminate()
    assert service.process.wait(_LONGEST_S) == 0


def test_the_start_waits_for_configuration_keys_and_the_other_link_in_turn(
    place: Path, start: Callable[[Path], Service]
) -> None:
    """The start waits for a configuration, for unmounted keys, and for the end of another link process."""
    whole = write_linked_config(place, udp="127.0.0.1:0")
    config = place / "later.yaml"
    keys, away = place / "keys" / "satellite", place / "away"
    keys.rename(away)
    service = start(config)
    service.says("no such file")
    whole.rename(config)
    while "no such folder" not in (line := service.says("cannot start yet")):
        assert "no such file" in line
    keys.mkdir()
    while "no key can be read" not in (line := service.says("cannot start yet")):
        assert "no such folder" in line
    with Vault(away).owned():
        keys.rmdir()
        away.rename(keys)
        while "another link process uses these counters" not in (line := service.says("cannot start yet")):
            assert "no such folder" in line or "no key can be read" in line
    while "link open on UDP" not in (line := service.says("")):
        assert "cannot start yet" in line
    service.process.terminate()
    assert service.process.wait(_LONGEST_S) == 0


def test_an_address_that_is_not_there_is_waited_for_until_a_signal(
    place: Path, start: Callable[[Path], Service]
) -> None:
    config = write_linked_config(place, tcp="203.0.113.7:5010")
    service = start(config)
    service.says("link.tcp: cannot listen on 203.0.113.7:5010")
    service.says("tried again in 0.4 s")
    service.process.terminate()
    assert service.process.wait(_LONGEST_S) == 0
    assert service.process.stderr is not None
    assert "stopped before the start: link.tcp" in service.process.stderr.read()


def test_a_lost_folder_of_keys_is_rebuilt_a_minute_after_it_was_found_missing(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    judged = link._judge(write_linked_config(place, udp="127.0.0.1:0"), place)
    clock = ManualClock()
    inhibit, keys = SeparationInhibit(SystemClock()), link.KeysFolder(clock)
    with ExitStack() as stack:
        link._open(place, inhibit, keys, judged, stack)
    shutil.rmtree(place / "keys" / "satellite")
    clock.advance(3600 * SECOND_NS)  # for example a separation inhibit
    for seconds in (0, 59):
        clock.advance(seconds * SECOND_NS)
        with ExitStack() as stack, pytest.raises(UsageError, match="no such folder"):
            link._open(place, inhibit, keys, judged, stack)
    assert "was lost" not in capsys.readouterr().err
    clock.advance(SECOND_NS)
    with ExitStack() as stack:
        _, names = link._open(place, inhibit, keys, judged, stack)
    assert names == "UDP 127.0.0.1:0"
    cure = "the folder of keys was lost: set a new key for SPI 1 by a command under SPI 2"
    assert cure in capsys.readouterr().err


def test_a_folder_of_keys_that_is_mounted_late_is_read_by_a_new_start(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If the folder is mounted after the keys were rebuilt, its stored schedule and transfers continue."""
    config = write_linked_config(place, udp="127.0.0.1:0")
    keys, away = place / "keys" / "satellite", place / "away"
    opened = list[tuple[bool, int, list[str]]]()
    files, late = place / "keys" / "files", place / "late"
    Store(late).save(Incoming(2, 7, "elements/late", 5))
    run, turns = Station.run, itertools.count()

    def run_shortly(self: Station, ended: Callable[[], bool], *callbacks: Callable[..., object]) -> None:
        names = [one.name for one in self._filing.status()]
        opened.append((self._vault.rebuilt, len(self._scheduling._timetable.entries), names))
        if len(opened) == 1:  # the keys were rebuilt; now their parent folder is mounted
            metadata = pack(Transaction(2, 7, 1), Metadata(9, "elements/early", "a", 3))
            self._filing.take(UnitPacker(UP).pack(metadata, 1), 0)
            for path, other in ((keys, away), (files, late)):
                path.rename(place / f"hidden-{path.name}")
                other.rename(path)
        run(self, lambda: ended() or next(turns) >= 100, *callbacks)

    Vault(keys, place / "keys" / "witness")
    Timetable(keys).add(2**62, 1, 0, "ping 1")
    keys.rename(away)
    monkeypatch.setattr(link, "_KEYS_WAIT_NS", 0)
    monkeypatch.setattr(Station, "run", run_shortly)
    link._run(config, place, lambda: len(opened) > 1)
    assert opened == [(True, 0, []), (False, 1, ["elements/late"])]
    assert "the lost keys can be read again" in capsys.readouterr().err


def test_a_log_that_is_not_a_folder_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = write_linked_config(place)
    assert main(["link", str(config), "--log", str(config)]) == 2
    assert f"--log {config}: is not the folder of a run" in capsys.readouterr().err


def test_each_call_of_a_start_fails_once_and_the_whole_disk_for_a_while(tmp_path: Path) -> None:
    """The link starts although each of its calls fails once, or the whole disk fails for three attempts."""
    words = [sys.executable, "-m", "tests.flight.app.cli.failing_starts", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT, timeout=_LONGEST_S)
    starts = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one for one in starts if one["status"] != 0 or not one["came_up"]] == []
    for call in ("open", "os.mkdir", "os.scandir", "socket.bind"):
        assert any(call in one["fails"] for one in starts), "the starts have other calls than before"
    for word in ("EADDRINUSE", "EADDRNOTAVAIL", "satellite/owner: "):
        assert any(one["waits"] == 1 for one in starts if word in one["fails"]), word
    waits = [one["waits"] for one in starts if one["fails"].startswith("the whole disk")]
    assert waits == [3] * 5


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda text: text.replace("link:", "lnik:"), "`lnik` is an unknown key"),
        (lambda text: text.replace("127.0.0.1:0", "127.0.0.1:65536"), "expected HOST:PORT"),
        (lambda text: text.replace('"udp"', '"spacecraft": 2000, "udp"'), "`link.spacecraft`"),
        (lambda text: text[: text.index("link:")], "has no section `link`"),
        (lambda text: text + "\n]", "is not YAML"),
    ],
)
def test_a_configuration_judged_wrong_ends_the_link_with_status_2(
    place: Path, change: Callable[[str], str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_linked_config(place, udp="127.0.0.1:0")
    config.write_text(change(config.read_text(encoding="utf-8")), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "flight", "link", str(config), "--log", str(place)],
        stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False, timeout=_LONGEST_S,
    )  # fmt: skip
    assert done.returncode == 2
    assert problem in done.stderr
