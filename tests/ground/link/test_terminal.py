"""Tests of the ground terminal: new keys, serial and UDP lines, and the reports on a command."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from flight.link.frames import (
    TELECOMMAND_MASK,
    TELEMETRY_HEADER,
    TELEMETRY_MASK,
    MasterCount,
    TelemetryFramer,
)
from flight.link.process.commanding import Stage
from flight.link.process.downlink import LIVE
from flight.link.process.station import parser_of
from flight.link.security import COMMAND_SPIS, OVERHEAD_BYTES, Gate, Sealer, Vault
from flight.link.telemetry.definitions import HEALTH, LINK, VERIFICATION
from flight.link.telemetry.packets import CRC_BYTES, LAYOUTS, Packer, crc16
from ground.link import terminal as terminal_module
from ground.link.terminal import DEFAULTS, Terminal, TerminalSettings, make_keys, open_terminal, report_of
from knightcube.errors import KnightCubeError, UsageError
from tests.flight.link.telemetry.samples import plain_contents


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Return the ground's keys."""
    make_keys(tmp_path / "keys")
    return tmp_path / "keys" / "ground"


def test_both_ends_get_the_same_new_keys_that_only_their_owner_can_read(tmp_path: Path) -> None:
    ends = make_keys(tmp_path / "a" / "keys")
    assert [end.name for end in ends] == ["satellite", "ground"]
    vaults = [Vault(end) for end in ends]
    for spi in (1, 2, 3, 4):
        first, second = (vault.read(spi) for vault in vaults)
        assert first is not None
        assert second is not None
        assert (first.key, first.generation, first.unused) == (second.key, 1, 0)
        assert [vault.copies(spi) for vault in vaults] == [2, 2]
    read = [vaults[0].read(spi) for spi in (1, 2, 3, 4)]
    assert len({one.key for one in read if one is not None}) == 4
    for folder in (tmp_path / "a" / "keys", *ends):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    with pytest.raises(UsageError, match="keys are never overwritten"):
        make_keys(tmp_path / "a" / "keys")


def test_the_defaults_are_those_of_the_configuration() -> None:
    assert (TerminalSettings().spacecraft, TerminalSettings().frame_bytes) == (0x1A5, 1115)
    assert (DEFAULTS.spacecraft, DEFAULTS.frame_bytes) == (0x1A5, 1115)


class SharedLine:
    """A line that several terminals share. `before` is called before each frame is sent."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.before: Callable[[], object] = lambda: None

    def fileno(self) -> int:
        raise AssertionError("nothing is received here")

    def receive(self) -> list[bytes]:
        return []

    def send(self, frame: bytes) -> None:
        self.before()
        self.frames.append(frame)

    def close(self) -> None:
        pass


def test_programs_that_share_the_keys_send_in_the_order_of_their_counters(keys: Path) -> None:
    """Frames of gateway and console are sent in the order of their counters.

    The console sends while the gateway has reserved a counter and has not yet sent its frame.
    """
    slow, line = SharedLine(), SharedLine()
    slow.frames = line.frames
    gateway, console = (Terminal(one, Vault(keys), TerminalSettings()) for one in (slow, line))
    sealer = gateway.sealer(1, 64)
    gateway.send_by(sealer, b"first")
    threads: list[threading.Thread] = []

    def overtake() -> None:
        threads.append(threading.Thread(target=console.send, args=(b"second",)))
        threads[0].start()
        threads[0].join(0.2)

    slow.before = overtake
    gateway.send_by(sealer, b"first")
    threads[0].join()
    gate = Gate(Vault(keys.parent / "satellite"), COMMAND_SPIS, parser_of(0x1A5), TELECOMMAND_MASK)
    assert [gate.admit(frame).data for frame in line.frames] == [b"first", b"first", b"second"]


def test_no_other_program_sends_between_the_portions_of_a_packet(keys: Path) -> None:
    """The satellite refuses a portion if another portion or packet of the same SPI arrived in between."""
    slow, line = SharedLine(), SharedLine()
    slow.frames = line.frames
    settings = TerminalSettings(command_frame_bytes=128)
    long, other = (Terminal(one, Vault(keys), settings) for one in (slow, line))
    threads: list[threading.Thread] = []

    def interrupt() -> None:
        if not threads:
            threads.append(threading.Thread(target=other.send, args=(b"second",)))
            threads[0].start()
        threads[0].join(0.2)

    slow.before = interrupt
    long.send(bytes(150))
    threads[0].join()
    gate = Gate(Vault(keys.parent / "satellite"), COMMAND_SPIS, parser_of(0x1A5), TELECOMMAND_MASK)
    assert [gate.admit(frame).data == b"second" for frame in line.frames] == [False] * 3 + [True]


def test_a_program_that_blocks_while_it_sends_is_not_waited_for_long(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(terminal_module, "_TURN_S", 0.05)
    slow, line = SharedLine(), SharedLine()
    blocked, other = (Terminal(one, Vault(keys), TerminalSettings()) for one in (slow, line))
    slow.before = lambda: other.send(b"second")
    blocked.send(b"first")
    assert len(line.frames) == 1


@contextlib.contextmanager
def listening() -> Iterator[socket.socket]:
    """Yield a listening TCP socket."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def test_a_tcp_line_is_opened_again_after_its_peer_has_closed_it(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss is reported once, and the next frame is sent over a new connection."""
    with listening() as server:
        terminal = open_terminal(f"tcp:127.0.0.1:{server.getsockname()[1]}", keys)
        peer, _ = server.accept()
        with contextlib.closing(terminal), peer:
            peer.sendall(b"no frame")
            assert list(terminal.take()) == []
            peer.shutdown(socket.SHUT_WR)
            file = terminal.fileno()
            with pytest.raises(KnightCubeError, match="the line was closed"):
                list(terminal.take())
            assert list(terminal.take()) == []
            with pytest.raises(KnightCubeError, match="the line was closed"):
                terminal.send(b"too early")
            assert "the line was closed" in terminal.problem
            monkeypatch.setattr(terminal_module, "_RECONNECT_S", 0.0)
            terminal.send(b"packet")
            again, _ = server.accept()
            with again:
                assert len(again.recv(4096)) > len(b"packet")
                again.sendall(b"no frame")
                assert select.select([terminal], [], [], 60.0)[0]
                assert terminal.fileno() == file
                assert list(terminal.take()) == []
                assert (terminal.problem, terminal.failing) == ("", 0.0)


def test_a_slow_attempt_to_open_a_line_is_followed_by_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """If each frame started a new attempt to connect, a peer that does not answer would block the program."""
    now = 0.0
    monkeypatch.setattr(terminal_module, "time", SimpleNamespace(monotonic=lambda: now))
    own, peer = socket.socketpair()
    attempts = 0

    def connect() -> terminal_module.Opened:
        nonlocal attempts, now
        attempts += 1
        if attempts == 1:
            return own.fileno(), own.close
        now += 5.0
        raise OSError(110, "Connection timed out")

    codes = TerminalSettings().codes()
    with contextlib.closing(terminal_module.StreamGround("tcp:x", codes.on_ground(False), connect)) as line:
        peer.close()
        with pytest.raises(KnightCubeError, match="closed"):
            line.receive()
        now += 10.0
        for _ in range(3):
            with pytest.raises(KnightCubeError, match="timed out"):
                line.send(b"frame")
        assert attempts == 2
        now += 10.0
        with pytest.raises(KnightCubeError, match="timed out"):
            line.send(b"frame")
        assert attempts == 3


@pytest.mark.parametrize(
    "address",
    [
        "nowhere",
        "tcp:1.2.3.4",
        "127.0.0.1:x",
        "127.0.0.1:0",
        "127.0.0.1:99999",
        "kiss:127.0.0.1:-1",
        ":5010",
        "/dev/null@fast",
    ],
)
def test_an_address_of_another_form_is_refused(keys: Path, address: str) -> None:
    with pytest.raises((UsageError, KnightCubeError)):
        open_terminal(address, keys)


def test_a_folder_without_keys_of_the_ground_is_refused(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys")
    with pytest.raises(UsageError, match="contains no keys: give the folder `ground`"):
        open_terminal("127.0.0.1:9", tmp_path / "keys")
    satellite = tmp_path / "keys" / "satellite"
    with (
        Vault(satellite).owned(),
        pytest.raises(UsageError, match="uses these keys of the satellite"),
    ):
        open_terminal("127.0.0.1:9", satellite)


def test_the_name_of_an_unknown_host_is_reported_as_given(keys: Path) -> None:
    with (
        contextlib.closing(open_terminal("satellite.invalid:5010", keys)) as terminal,
        pytest.raises(KnightCubeError, match=r"^satellite\.invalid:5010: cannot be reached"),
    ):
        terminal.send(b"x")


def report(counter: int, spi: int, stage: Stage, text: str = "") -> bytes:
    """Return a verification packet."""
    values: dict[str, Any] = {"name": "ping", "packet": 0x1A01, "sequence": 6, "text": text}
    return Packer().pack(VERIFICATION, 0, spi=spi, counter=counter, stage=int(stage), **values)


def test_a_report_has_the_fields_of_its_packet() -> None:
    found = report_of(report(5, 2, Stage.REFUSED, "too far"))
    assert found is not None
    assert (found.spi, found.counter, found.stage, found.name, found.text) == (
        2,
        5,
        Stage.REFUSED,
        "ping",
        "too far",
    )
    assert (found.request.packet, found.request.sequence) == (0x1A01, 6)


def of_version(packet: bytes, version: int, more: bytes) -> bytes:
    """Return a packet whose definition has another version and further bytes."""
    body = packet[:4] + (len(packet) + len(more) - 7).to_bytes(2, "big") + bytes([version]) + packet[7:-2]
    body += more
    return body + crc16(body).to_bytes(2, "big")


def test_reports_and_counters_of_newer_software_do_not_end_the_reading(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = bytearray(report(5, 1, Stage.STARTED, "queued"))
    newer[LAYOUTS[VERIFICATION.name].offsets["stage"]] = 99
    newer[-2:] = crc16(bytes(newer[:-2])).to_bytes(2, "big")
    link: dict[str, Any] = {field.name: 0 for field in LINK.fields}
    link |= {"highest": [0] * 2, "generation": [0] * 4, "copies": [0] * 4}
    old = Packer().pack(LINK, 0, link), report(5, 1, Stage.STARTED)
    sent = [bytes(newer), *(of_version(one, 9, b"more") for one in old), report(5, 1, Stage.COMPLETED)]
    settings = TerminalSettings()
    sealer = Sealer(Vault(keys.parent / "satellite"), 3, TELEMETRY_MASK, encrypted=settings.encrypted)
    room = settings.frame_bytes - TELEMETRY_HEADER.size - OVERHEAD_BYTES - CRC_BYTES
    framer = TelemetryFramer(
        settings.spacecraft, LIVE, room, MasterCount(), lambda header, data: sealer.seal(header, data)[0]
    )
    frames = [frame for packet in sent for frame in framer.add(packet)] + framer.flush()
    line = SharedLine()
    monkeypatch.setattr(line, "receive", lambda: frames)
    terminal = Terminal(line, Vault(keys), settings)
    taken = list(terminal.take())
    assert [packet for _, packet in taken if packet in sent] == sent
    monkeypatch.setattr(terminal, "packets", lambda seconds: iter(taken))
    assert [one.stage for one in terminal.follow(5, 1, 1.0)] == [Stage.COMPLETED]


def test_frames_that_exceed_the_output_buffer_of_a_serial_line_wait_until_they_are_sent(keys: Path) -> None:
    satellite, device = os.openpty()
    tty.setraw(satellite)
    failed: list[KnightCubeError] = []
    with contextlib.closing(open_terminal(f"{os.ttyname(device)}@9600", keys)) as terminal:
        sealer = terminal.sealer(1, 64)

        def send() -> None:
            try:
                for _ in range(60):
                    terminal.send_by(sealer, bytes(900))
            except KnightCubeError as error:
                failed.append(error)

        sender = threading.Thread(target=send)
        sender.start()
        sender.join(0.5)  # the output buffer of 4 to 64 KiB is full now
        received = 0
        while received < 60 * 900 and not failed:
            received += len(os.read(satellite, 1 << 16))
        sender.join()
    assert failed == []
    os.close(device)
    os.close(satellite)


def test_only_the_reports_on_the_own_command_are_followed_up_to_the_final_one(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = [
        Packer().pack(HEALTH, 1, plain_contents(HEALTH)),
        report(5, 1, Stage.ACCEPTED),
        report(6, 1, Stage.COMPLETED),
        report(5, 2, Stage.COMPLETED),
        report(5, 1, Stage.COMPLETED),
        report(5, 1, Stage.FAILED),
    ]
    monkeypatch.setattr(Terminal, "packets", lambda self, seconds: ((0, packet) for packet in received))
    with contextlib.closing(open_terminal("127.0.0.1:9", keys)) as terminal:
        assert [one.stage for one in terminal.follow(5, 1, 1.0)] == [Stage.ACCEPTED, Stage.COMPLETED]
        received[1:1] = [report(5, 1, Stage.ACCEPTED), report(5, 1, Stage.REPEATED)]
        assert [one.stage for one in terminal.follow(5, 1, 1.0)] == [Stage.ACCEPTED] * 2 + [Stage.COMPLETED]
        received[1:2] = []
        assert [one.stage for one in terminal.follow(5, 1, 1.0)] == [Stage.REPEATED]
        later = terminal.follow(5, 1, 1.0, reported=True)
        assert [one.stage for one in later] == [Stage.ACCEPTED, Stage.COMPLETED]
        assert terminal.lost_frames == 0
