"""Tests of `knightcube link` and `knightcube command --link` over UDP, TCP and serial lines, and of keys."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from flight.app.cli import link as link_process
from flight.app.cli import main
from flight.app.cli.link import self_test
from flight.app.service import FlownRelease
from flight.link.coding import LinkCodes
from flight.link.commands import PING, CommandPacker, Ping, open_unix
from flight.link.events import Mode
from flight.link.process.commanding import Report, Request, Stage
from flight.link.security import Vault
from flight.link.telemetry.definitions import COMMAND, VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, Packer, walk
from ground.link.gateway import Gateway, new_token
from ground.link.terminal import (
    DEFAULTS,
    StreamGround,
    Terminal,
    TerminalSettings,
    open_terminal,
    report_of,
)
from ground.xtce import TELECOMMANDS
from hal.buses.system import SystemClock
from knightcube.errors import KnightCubeError, UsageError
from tests.flight.link.vaults import frame_with
from tests.support.flights import CONFIG
from tests.support.linked_board import ROOT, free_ports, write_linked_config


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Run a link process and a flight that executes every command; return addresses and folder of the link.

    The link has a UDP address, a TCP address and a serial line.
    """
    place = tmp_path_factory.mktemp("link")
    udp, tcp = free_ports([socket.SOCK_DGRAM, socket.SOCK_STREAM])
    radio, device = pty.openpty()
    for end in (radio, device):
        tty.setraw(end)
    serial = {"device": os.ttyname(device)}
    config = write_linked_config(place, udp=f"127.0.0.1:{udp}", tcp=f"127.0.0.1:{tcp}", serial=serial)
    flight, ended = open_unix(place / "commands"), threading.Event()

    def obey() -> None:
        packer = Packer()
        while not ended.wait(0.01):
            for _, sender in flight.poll():
                fields = {"obeyed": 1, "name": "x", "source": "socket", "count": 1, "text": "as commanded"}
                flight.answer(packer.pack(COMMAND, 0, {**fields, "mode": int(Mode.SAFE)}), sender)

    thread = threading.Thread(target=obey)
    thread.start()
    words = [sys.executable, "-m", "flight", "link", str(config), "--log", str(place)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, cwd=ROOT) as link:
        assert link.stderr is not None
        try:
            assert "link open on" in link.stderr.readline()
            yield {
                "udp": f"127.0.0.1:{udp}",
                "tcp": f"tcp:127.0.0.1:{tcp}",
                "radio": str(radio),
                "place": str(place),
            }
        finally:
            link.terminate()
            ended.set()
            thread.join()
    assert link.returncode == 0
    flight.close()
    os.close(radio)
    os.close(device)


def command(lines: dict[str, str], kind: str, *words: str) -> int:
    way = ["--link", lines[kind], "--keys", f"{lines['place']}/keys/ground", "--timeout", "10"]
    return main(["command", *way, *words])


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_a_command_goes_by_each_line_and_each_stage_is_shown(
    lines: dict[str, str], kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(lines, kind, "safe", "end of pass") == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in shown] == ["accepted", "started", "completed"]
    assert command(lines, kind, "--json", "ping") == 0
    facts = json.loads(capsys.readouterr().out)
    assert [stage["stage"] for stage in facts["stages"]] == ["accepted", "started", "completed"]


def test_authentic_frames_with_any_counter_end_no_process(
    lines: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Authentic frames with any counter do not end the link.

    If a stored frame could end the link, it would end the link again after each restart. The highest counters
    are sent first, because the link reports only four refusals a second.
    """
    assert command(lines, "udp", "ping") == 0  # this command uses counter 0
    vault = Vault(Path(lines["place"]) / "keys" / "ground")
    host, _, port = lines["udp"].partition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        for counter in (2**96 - 1, 2**95, 2**63, 2**63 - 1, 2**48, 2**41, 0):
            ground.sendto(frame_with(vault, counter, CommandPacker().pack(Ping(3), 1)), (host, int(port)))
    assert command(lines, "udp", "ping") == 0
    assert "completed" in capsys.readouterr().out


def test_a_command_is_scheduled_listed_and_deleted(
    lines: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(lines, "udp", "schedule", "2099-01-01T00:00:00", "safe", "end", "of", "pass") == 0
    assert command(lines, "udp", "list-schedule") == 0
    shown = capsys.readouterr().out
    assert "started: 1: 2099-01-01T00:00:00Z mode safe: end of pass\ncompleted: 1 scheduled" in shown
    assert command(lines, "udp", "unschedule", "1") == 0
    assert command(lines, "udp", "schedule", "1999-01-01T00:00:00", "ping") == 1
    assert "1999-01-01T00:00:00 has passed" in capsys.readouterr().out


def test_a_command_goes_by_a_serial_line_with_a_marker_before_each_frame(lines: dict[str, str]) -> None:
    radio = int(lines["radio"])
    line = StreamGround("radio", LinkCodes(DEFAULTS.frame_bytes).on_ground(), lambda: (radio, lambda: None))
    terminal = Terminal(line, Vault(Path(lines["place"]) / "keys" / "ground"), TerminalSettings())
    counter = terminal.send(CommandPacker().pack(Ping(3), 1))
    stages = [report.stage for report in terminal.follow(counter, 1, 10.0)]
    assert stages == [Stage.ACCEPTED, Stage.STARTED, Stage.COMPLETED]


def test_a_key_is_changed_at_both_ends_also_when_the_answer_was_lost(
    lines: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(lines, "udp", "new-key", "1") == 0
    assert command(lines, "udp", "ping") == 0
    vault = Vault(Path(lines["place"]) / "keys" / "ground")
    new, old = vault.read(1), vault.read(2)
    assert new is not None
    assert old is not None
    assert new.generation == old.generation + 1
    # Emulate the state before the satellite's reply: the old key is active on the ground, and the new key is
    # stored as the next key.
    vault.write(new, "1-next")
    vault.write(replace(new, generation=1, key=bytes(32)))
    assert command(lines, "udp", "new-key", "1") == 0
    assert vault.read("1-next") is None
    assert command(lines, "udp", "ping") == 0
    assert command(lines, "udp", "new-key", "2") == 2
    assert vault.read("2-next") is None
    text = capsys.readouterr()
    assert "only the reserve SPI may change its own key: add --spi 2" in text.err
    assert new.key.hex() not in text.out + text.err


def test_a_ground_station_without_keys_commands_by_the_gateway_and_knows_its_commands_by_their_sequence(
    lines: dict[str, str],
) -> None:
    terminal = open_terminal(lines["tcp"], Path(lines["place"]) / "keys" / "ground")
    complaints: list[str] = []
    token = new_token()
    gateway = Gateway(terminal, "127.0.0.1:0", token, complaints.append)
    layout = TELECOMMANDS[PING.name]
    raw = bytearray(CommandPacker().pack(Ping(3), 1))
    raw[2:4] = (0xC000 | 77).to_bytes(2, "big")
    raw[7:15], raw[-CRC_BYTES:] = (
        bytes(8),
        bytes(CRC_BYTES),
    )  # time and CRC are zero, as in packets of XTCE clients
    reports: list[Report] = []
    came = b""
    with socket.create_connection(("127.0.0.1", gateway.port)) as station:
        station.sendall(f"{token}\n".encode() + raw)
        until = time.monotonic() + 300.0
        while len(reports) < 3 and time.monotonic() < until:
            gateway.turn(0.05)
            with contextlib.suppress(BlockingIOError):
                came += station.recv(1 << 16, socket.MSG_DONTWAIT)
            packets = [came[begin:end] for at, begin, end in walk(came) if at.packet is VERIFICATION]
            found = list(filter(None, map(report_of, packets)))
            reports = [report for report in found if report.request == Request(layout.identifier, 77)]
    assert [report.stage for report in reports] == [Stage.ACCEPTED, Stage.STARTED, Stage.COMPLETED]
    assert len(found) == 3, "the gateway's own ping is nobody's command"
    assert complaints == []
    gateway.close()
    terminal.close()
    with pytest.raises(UsageError, match="loopback only"):
        Gateway(terminal, "0.0.0.0:0", token, complaints.append)


def test_one_link_at_a_time_has_the_counters(lines: dict[str, str]) -> None:
    with (
        pytest.raises(UsageError, match="another link process uses these counters"),
        Vault(Path(lines["place"]) / "keys" / "satellite").owned(),
    ):
        pytest.fail("two at a time")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["command", "--link", "127.0.0.1:5", "ping"], "--link needs --keys"),
        (["command", "--to", "x", "play", "0", "1"], "send it with --link"),
        (["command", "--link", "nowhere", "--keys", "{keys}", "ping"], "give HOST:PORT"),
        (["command", "--link", "127.0.0.1:5", "--keys", "/nowhere", "ping"], "no such folder"),
        (["link", str(CONFIG), "--log", "."], "has no section `link`"),
    ],
)
def test_wrong_use_is_one_line(
    lines: dict[str, str],
    words: list[str],
    problem: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "nice", int)  # the tests that follow need the normal priority of this process
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    keys = f"{lines['place']}/keys/ground"
    assert main([word.format(keys=keys) for word in words]) == 2
    assert problem in capsys.readouterr().err


def test_keys_are_never_overwritten(lines: dict[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keys", f"{lines['place']}/keys"]) == 2
    assert "never overwritten" in capsys.readouterr().err
    modes = {path.stat().st_mode & 0o777 for path in Path(lines["place"], "keys").rglob("spi-*")}
    assert modes == {0o600}


def test_a_release_tests_its_link_without_a_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """The self-test of a release opens only sockets of AF_UNIX, which its sandbox permits."""
    opened = socket.socket.__init__

    def refusing(self: socket.socket, family: int = -1, *words: Any, **named: Any) -> None:
        if family != socket.AF_UNIX:
            raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))
        opened(self, family, *words, **named)

    monkeypatch.setattr(socket.socket, "__init__", refusing)
    self_test()


def test_a_release_whose_link_obeys_nothing_fails_its_test(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flight.app.cli.link.close_frame", lambda frame: frame + b"\0\0")
    monkeypatch.setattr(SystemClock, "sleep_until_ns", lambda *_: None)
    with pytest.raises(KnightCubeError, match="executed no command"):
        self_test()


def test_a_link_that_runs_for_the_required_time_proves_its_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flight.app.service.PROVEN_NS", 10_000_000)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    monkeypatch.setenv("KNIGHTCUBE_RELEASE", "newest")
    proven = threading.Event()
    monkeypatch.setattr(FlownRelease, "prove", lambda _: proven.set())
    station = Mock()
    station.run = lambda *_: proven.wait(60.0)
    monkeypatch.setattr(link_process, "retried_start", lambda *_: (station, "udp"))
    link_process._run(tmp_path / "config.yaml", tmp_path, proven.is_set)
    assert proven.is_set()
