"""Tests of the gateway with authorised clients, clients without the token, and a web page."""

from __future__ import annotations

import contextlib
import errno
import re
import select
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast
from unittest.mock import Mock

import pytest

from flight.link.commands import ChangeMode, CommandPacker, Ping
from flight.link.events import Mode
from flight.link.files.units import UP, UnitPacker
from flight.link.process.commanding import Stage
from flight.link.telemetry.definitions import HEALTH, VERIFICATION
from flight.link.telemetry.packets import Packer
from ground.link import gateway as module
from ground.link.gateway import Gateway, new_token, token_file, token_path
from ground.link.terminal import Terminal, make_keys
from knightcube.errors import KnightCubeError
from tests.flight.link.telemetry.samples import plain_contents

ROOT = Path(__file__).resolve().parents[3]
SAFE = CommandPacker().pack(ChangeMode(Mode.SAFE, "end of pass"), 1)
TELEMETRY = Packer().pack(HEALTH, 1, plain_contents(HEALTH))
PATIENCE_S = 60.0


class Satellite:
    """A test double of the terminal, which stores uplinked frames and returns downlinked frames."""

    packet_bytes = 987

    def __init__(self) -> None:
        self.up: list[bytes] = []
        self._ours, self._theirs = socket.socketpair()

    def fileno(self) -> int:
        return self._ours.fileno()

    def sealer(self, spi: int, block: int) -> None:
        pass

    def send_by(self, sealer: object, packet: bytes) -> int:
        self.up.append(packet)
        return len(self.up)

    def say(self, packet: bytes) -> None:
        self._theirs.send(packet)

    def take(self) -> list[tuple[int, bytes]]:
        return [(0, self._ours.recv(4096))]

    def close(self) -> None:
        self._ours.close()
        self._theirs.close()

    @property
    def commands(self) -> list[bytes]:
        """Uplinked packets, without the pings that the gateway sends."""
        ping = CommandPacker().pack(Ping(), 1)[:2]
        return [packet for packet in self.up if packet[:2] != ping]


@dataclass
class Station:
    """A gateway with its token, a test double of the satellite, and the errors that the gateway reports."""

    gateway: Gateway
    token: str
    satellite: Satellite
    complaints: list[str]
    stack: contextlib.ExitStack

    def connect(self, data: bytes = b"") -> socket.socket:
        address = ("127.0.0.1", self.gateway.port)
        line = self.stack.enter_context(socket.create_connection(address, PATIENCE_S))
        line.sendall(data)
        self.turn()
        return line

    @property
    def line(self) -> bytes:
        return f"{self.token}\n".encode()

    def turn(self) -> None:
        for _ in range(5):
            self.gateway.turn(0.01)


@pytest.fixture
def station() -> Iterator[Station]:
    token, complaints = new_token(), list[str]()
    with contextlib.ExitStack() as stack:
        satellite = Satellite()
        stack.callback(satellite.close)
        gateway = Gateway(cast(Terminal, satellite), "127.0.0.1:0", token, complaints.append)
        stack.callback(gateway.close)
        yield Station(gateway, token, satellite, complaints, stack)


def test_a_packet_for_a_longer_frame_closes_its_connection_alone(
    station: Station,
) -> None:
    station.satellite.packet_bytes = 700
    ping, unit = CommandPacker().pack(Ping(1), 1), UnitPacker(UP).pack(bytes(783), 1)
    line = station.connect(station.line + unit)
    station.turn()
    assert closed(line)
    assert "800 bytes; the link carries 700" in station.complaints[-1]
    station.connect(station.line + ping)
    station.turn()
    assert station.satellite.up[-1][:2] == ping[:2]


def test_a_network_that_fails_for_a_while_is_reported_once_and_each_lost_command_by_name(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PING_PERIOD_S", 0.0)
    problem = "192.0.2.7:5010: cannot be reached: Network is unreachable"

    def fail(sealer: object, packet: bytes) -> int:
        raise KnightCubeError(problem)

    with monkeypatch.context() as broken:
        broken.setattr(station.satellite, "send_by", fail)
        broken.setattr(module, "_RETRY_S", 0.0)
        # The satellite acknowledges packets of a file transfer, so the ground station repeats them.
        line = station.connect(station.line + SAFE + UnitPacker(UP).pack(bytes(20), 1) + SAFE)
        station.satellite.say(TELEMETRY)
        station.turn()
        assert line.recv(4096) == TELEMETRY
    name, count = "safe", int.from_bytes(SAFE[2:4], "big") & 0x3FFF
    lost = f"command {name} with sequence count {count} was not sent: {problem}; send it again"
    assert station.complaints == [f"commands and pings are not sent: {problem}", lost, lost]
    assert (station.satellite.commands, station.gateway.up) == ([], 0)
    line.sendall(SAFE)
    station.turn()
    assert [packet[:2] for packet in station.satellite.commands] == [SAFE[:2]]


def test_a_connection_that_cannot_be_accepted_is_not_polled_without_a_pause(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = station.gateway._listener
    exhausted = Mock(
        fileno=listener.fileno,
        getsockname=listener.getsockname,
        accept=Mock(side_effect=OSError(errno.EMFILE, "Too many open files")),
    )
    with monkeypatch.context() as broken:
        broken.setattr(station.gateway, "_listener", exhausted)
        broken.setattr(module, "_ACCEPT_PAUSE_S", 1e6)
        line = station.connect(station.line)
        station.turn()
        assert exhausted.accept.call_count == 1
    (complaint,) = station.complaints
    assert complaint.startswith("connections cannot be accepted: Too many open files")
    station.gateway._accept_at = time.monotonic()
    station.turn()
    station.satellite.say(TELEMETRY)
    station.turn()
    assert line.recv(4096) == TELEMETRY


def test_a_line_that_is_lost_is_reported_and_pinged_again(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> list[tuple[int, bytes]]:
        station.satellite._ours.recv(4096)
        raise KnightCubeError("tcp:192.0.2.7:5010: the line was closed")

    known = station.connect(station.line)
    pings = len(station.satellite.up)
    with monkeypatch.context() as broken:
        broken.setattr(station.satellite, "take", fail)
        for _ in range(2):
            station.satellite.say(TELEMETRY)
            station.turn()
    assert station.complaints == ["tcp:192.0.2.7:5010: the line was closed"]
    assert len(station.satellite.up) == pings
    monkeypatch.setattr(module, "_RETRY_S", 0.0)
    station.gateway._note_failure("tcp:192.0.2.7:5010: the line was closed")
    station.satellite.say(TELEMETRY)
    station.turn()
    assert len(station.satellite.up) == pings + 1
    assert known.recv(4096) == TELEMETRY


def test_the_gateway_keeps_the_counters_of_its_newest_pings_only(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PING_PERIOD_S", 0.0)
    for _ in range(200):
        station.gateway.turn(0.0)
    assert len(station.satellite.up) >= 200
    assert len(station.gateway._own) < 100
    assert station.gateway._own[-1] == len(station.satellite.up)


def closed(line: socket.socket) -> bool:
    """Return whether the gateway has closed a connection without sending any byte."""
    try:
        return line.recv(1) == b""
    except ConnectionResetError:
        return True


def open_still(line: socket.socket) -> bool:
    """Return whether a connection is open and has received no byte."""
    return not select.select([line], [], [], 0.0)[0]


def test_a_connection_without_the_token_neither_commands_nor_receives_telemetry(station: Station) -> None:
    silent, wrong = station.connect(), station.connect(new_token().encode() + b"\n" + SAFE)
    plain, web = station.connect(SAFE), station.connect(b"POST / HTTP/1.1\r\n\r\n" + SAFE)
    known = station.connect(station.line)
    station.satellite.say(TELEMETRY)
    station.turn()
    assert known.recv(4096) == TELEMETRY
    assert open_still(silent)
    assert closed(wrong)
    assert closed(plain)
    assert closed(web)
    assert station.satellite.commands == []
    assert station.gateway.refused == 3
    assert len(station.complaints) == 1, "strangers are reported once a second"
    known.sendall(SAFE[:9])
    station.turn()
    known.sendall(SAFE[9:])
    station.turn()
    assert [packet[15:-2] for packet in station.satellite.commands] == [SAFE[15:-2]]


def test_only_reports_on_the_pings_of_the_gateway_are_withheld(station: Station) -> None:
    """A counter identifies a command only together with its SPI and the present key."""

    def report(spi: int) -> bytes:
        values = plain_contents(VERIFICATION) | {"spi": spi, "counter": 1, "stage": int(Stage.COMPLETED)}
        return Packer().pack(VERIFICATION, 1, values)

    known = station.connect(station.line)
    assert len(station.satellite.up) == 1, "the ping has the counter 1"
    for spi in (1, 2):
        station.satellite.say(report(spi))
        station.turn()
    assert known.recv(4096) == report(2)
    station.satellite.up.clear()  # another program changes the key
    known.sendall(SAFE)
    station.turn()
    station.satellite.say(report(1))
    station.turn()
    assert known.recv(4096) == report(1)


def test_a_byte_that_no_command_has_closes_a_known_connection_and_is_reported(station: Station) -> None:
    known = station.connect(station.line + SAFE + b"\x08\x00" + SAFE)
    station.turn()
    assert closed(known)
    assert len(station.satellite.commands) == 1
    assert station.gateway.refused == 1
    assert station.complaints == [
        "connection closed: no command packet has 0x08 as its byte 1 (closed so far: 1)"
    ]


def test_a_connection_that_does_not_send_the_token_in_time_is_closed(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    known, slow = station.connect(station.line), station.connect(station.line[:-1])
    monkeypatch.setattr(module, "_TOKEN_S", 0.0)
    station.turn()
    assert closed(slow)
    assert open_still(known)
    assert "did not send the token within" in station.complaints[0]


def test_strangers_do_not_keep_a_ground_station_out(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MOST_WITHOUT_TOKEN", 16)
    strangers = [station.connect() for _ in range(module._MOST_WITHOUT_TOKEN + 1)]
    assert closed(strangers[0])
    assert all(open_still(line) for line in strangers[1:])
    known = station.connect(station.line + SAFE)
    assert closed(strangers[1])
    assert len(station.satellite.commands) == 1
    assert open_still(known)


def test_the_token_file_is_private_to_its_user_and_deleted_with_the_gateway(tmp_path: Path) -> None:
    path = token_path(tmp_path, 5013)
    path.write_text("of a gateway that was killed\n")
    path.chmod(0o644)
    with token_file(path, "abc"):
        assert path.read_text() == "abc\n"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert list(tmp_path.iterdir()) == []
    with (
        pytest.raises(KnightCubeError, match="the token cannot be written"),
        token_file(tmp_path / "no" / "x", "a"),
    ):
        pytest.fail("no such folder")


@dataclass
class Opened:
    """A separate process of `knightcube gateway`, and the frames that it uplinks."""

    process: subprocess.Popen[str]
    port: int
    keys: Path
    frames: socket.socket
    ping_bytes: int
    errors: Path

    def command(self) -> int | None:
        """Return the length of the next frame that is not a ping of the gateway, or None after 3 s."""
        until = time.monotonic() + 3.0
        while (left := until - time.monotonic()) > 0.0:
            self.frames.settimeout(left)
            with contextlib.suppress(TimeoutError):
                if (size := len(self.frames.recv(4096))) != self.ping_bytes:
                    return size
        return None


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Opened]:
    _, ground = make_keys(tmp_path / "keys")
    errors = tmp_path / "errors"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as frames, errors.open("w") as out:
        frames.bind(("127.0.0.1", 0))
        frames.settimeout(PATIENCE_S)
        link = f"127.0.0.1:{frames.getsockname()[1]}"
        words = [sys.executable, "-m", "flight", "gateway", "--link", link, "--keys", str(ground)]
        words += ["--serve", "127.0.0.1:0"]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=out, text=True, cwd=ROOT) as process:
            try:
                assert process.stdout is not None
                found = re.search(r"127\.0\.0\.1:(\d+)", process.stdout.readline())
                assert found is not None
                yield Opened(process, int(found[1]), ground, frames, len(frames.recv(4096)), errors)
            finally:
                process.terminate()
                process.wait(PATIENCE_S)


def test_the_gateway_obeys_only_clients_that_have_read_the_token_file(opened: Opened) -> None:
    with socket.create_connection(("127.0.0.1", opened.port), PATIENCE_S) as stranger:
        head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9000\r\n\r\n"
        skipped = 7 + int.from_bytes(head[4:6], "big")  # packet length that a reader would find in this text
        with contextlib.suppress(ConnectionError):
            stranger.sendall(head.ljust(skipped, b"\0") + SAFE)
        assert opened.command() is None
        assert closed(stranger)
    path = token_path(opened.keys, opened.port)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with socket.create_connection(("127.0.0.1", opened.port), PATIENCE_S) as known:
        known.sendall(path.read_bytes() + SAFE)
        assert opened.command() is not None
    opened.process.terminate()
    assert opened.process.wait(PATIENCE_S) == 0
    reason = "connection closed: the first bytes of the connection are not the token (closed so far: 1)"
    assert opened.errors.read_text() == f"knightcube: gateway: {reason}\n"
    assert not path.exists()
