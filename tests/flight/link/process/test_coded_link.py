"""Tests of commands and telemetry over a bare radio: codes, noise, short frames and idle frames."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
import pytest

from flight.link.coding import LinkCodes, kiss_frame
from flight.link.commands import CommandPacker, LoadParameters, Ping, unpack
from flight.link.files.units import UP, Metadata, Transaction, UnitPacker, pack
from flight.link.frames import IDLE_CHANNEL, TELEMETRY_HEADER, TelecommandHeader, close_frame, is_idle
from flight.link.process import directives
from flight.link.process.commanding import Stage, request_of
from flight.link.process.directives import (
    Activate,
    DeleteFile,
    Directive,
    Portion,
    Scheduled,
    Stop,
    UseFile,
)
from flight.link.process.station import TcpLine, TncLine, UdpLine
from flight.link.security import Refusal
from flight.link.telemetry.definitions import LINK, PARAMETER_FIELDS
from flight.link.telemetry.packets import LAYOUTS
from flight.schema.sections import LinkCoding
from ground.link.terminal import StreamGround, TerminalSettings, UdpGround
from knightcube.errors import KnightCubeError
from tests.flight.link.process.both_ends import BothEnds
from tests.flight.link.process.filed_ends import FiledEnds

S = 1_000_000_000


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def ping(number: int) -> bytes:
    """Return the packet of a ping."""
    return CommandPacker().pack(Ping(number), 1)


class Noise:
    """A channel that inverts single bits, on average one in 200 bytes."""

    def __call__(self, data: bytes) -> bytes:
        bits = np.unpackbits(np.frombuffer(data, np.uint8))
        bits[64::1600] ^= 1
        return np.packbits(bits).tobytes()


@pytest.mark.parametrize(
    ("frame_bytes", "coding"),
    [
        (1115, LinkCoding(randomiser="long", reed_solomon=5, cltu="randomised")),
        (128, LinkCoding(randomiser="short", reed_solomon=1, cltu="plain")),
        (384, LinkCoding(reed_solomon=3, cltu="randomised")),
    ],
)
def test_commands_and_reports_pass_a_channel_with_wrong_bits(
    stack: ExitStack, tmp_path: Path, frame_bytes: int, coding: LinkCoding
) -> None:
    settings = TerminalSettings(frame_bytes=frame_bytes, coding=coding)
    link = stack.enter_context(
        closing(BothEnds(tmp_path, 1e5, settings, codes=settings.codes(), noise=Noise()))
    )
    counters = [link.terminal.send(ping(number)) for number in range(5)]
    link.turn(2.5)
    assert [unpack(data) for data in link.obeyed] == [Ping(number) for number in range(5)]
    assert [link.stages(counter)[-1] for counter in counters] == ["completed"] * 5
    assert link.status()["corrected"] == 5, "one wrong bit in each telecommand"
    assert link.status()["refused_crc"] == 0
    text = link.terminal.reception()
    assert " 0 refused, 0 lost" in text
    assert "; 0 symbols" not in text
    assert ", 0 codewords" in text


def test_without_code_the_same_channel_carries_nothing(stack: ExitStack, tmp_path: Path) -> None:
    settings = TerminalSettings(frame_bytes=1115)
    link = stack.enter_context(
        closing(BothEnds(tmp_path, 1e5, settings, codes=settings.codes(), noise=Noise()))
    )
    link.terminal.send(ping(1))
    link.turn(1.5)
    assert link.packets == []


@pytest.mark.parametrize("encrypted", [True, False])
def test_telemetry_can_be_readable_for_everybody_and_still_cannot_be_forged(
    stack: ExitStack, tmp_path: Path, encrypted: bool
) -> None:
    link = stack.enter_context(
        closing(BothEnds(tmp_path, settings=TerminalSettings(frame_bytes=512, encrypted=encrypted)))
    )
    link.collect = lambda: None  # type: ignore[method-assign]
    link.turn(1.5)
    seen = list(link.wire.down)
    packets = [packet for _, packet in link.terminal.take()]
    # Sixteen bytes are compared. Two bytes would be equal by chance in one of a hundred encrypted downlinks.
    starts = [
        packet[:16] for packet in packets if packet[:2] == LAYOUTS[LINK.name].identifier.to_bytes(2, "big")
    ]
    assert starts
    assert any(start in frame for start in starts for frame in seen) is not encrypted
    link.turn(1.1)
    genuine = link.wire.down.pop()
    link.wire.down.clear()
    for changed in (2, 8, 12, 20, 100, 480, 500):
        forged = bytearray(genuine)
        forged[changed] ^= 1
        link.wire.down.append(close_frame(bytes(forged[:-2])))
    list(link.terminal.take())
    assert sum(link.terminal.gate.refused.values()) >= 5, "counts of the header and the salt may differ"
    assert link.terminal.gate.refused[Refusal.MAC] >= 4


@pytest.mark.parametrize("idle_rate", [0.0, 4000.0, 20_000.0])
def test_idle_frames_keep_the_configured_rate_and_no_telemetry_waits_for_them(
    stack: ExitStack, tmp_path: Path, idle_rate: float
) -> None:
    settings = TerminalSettings(frame_bytes=200)
    link = stack.enter_context(closing(BothEnds(tmp_path, 1e5, settings, idle_rate)))
    link.collect = lambda: None  # type: ignore[method-assign]
    link.turn(10.0)
    frames, counts = link.wire.down[:], [frame[2] for frame in link.wire.down]
    idle = [frame for frame in frames if is_idle(frame)]
    assert {len(frame) for frame in frames} == {200}
    assert all(TELEMETRY_HEADER.unpack_from(frame)[0] >> 1 & 7 == IDLE_CHANNEL for frame in idle)
    assert [frame[3] for frame in idle] == [i % 256 for i in range(len(idle))], "their own count"
    assert counts == [i % 256 for i in range(len(frames))], "all frames share the master channel count"
    if idle_rate:
        assert sum(map(len, frames)) == pytest.approx(10.0 * idle_rate, rel=0.03)
    else:
        assert idle == []
    packets = list(link.terminal.take())
    assert len(packets) >= 10
    assert (link.terminal.idle_frames, link.terminal.lost_frames) == (len(idle), 0)
    assert sum(link.terminal.gate.refused.values()) == 0


@pytest.fixture
def short(stack: ExitStack, tmp_path: Path) -> BothEnds:
    settings = TerminalSettings(frame_bytes=128, command_frame_bytes=128)
    return stack.enter_context(closing(BothEnds(tmp_path, settings=settings)))


TABLE = LoadParameters(7, tuple((parameter.valid or (0.0, 0.0))[1] for parameter in PARAMETER_FIELDS))
LONG = (
    Activate(f"received/release/{'n' * 78}", bytes(range(32)), 24.0, 1),
    UseFile("received/elements/a.txt", bytes(32)),
    Scheduled("2026-11-27T00:00:00", f"safe {'r' * 60}"),
    DeleteFile(f"received/elements/{'n' * 77}"),
)


def test_a_table_of_parameters_passes_frames_of_128_bytes_in_portions(short: BothEnds) -> None:
    packet = CommandPacker().pack(TABLE, 1)
    counter = short.terminal.send(packet)
    assert all(len(frame) <= 128 for frame in short.wire.up)
    short.turn()
    assert short.obeyed == [packet]
    assert short.stages(counter) == ["accepted", "started", "completed"]
    for portion in range(1, len(range(0, len(packet), 72))):
        assert short.stages(counter - portion) == ["accepted", "completed"]


@pytest.mark.parametrize("directive", LONG, ids=lambda directive: type(directive).__name__)
def test_a_long_directive_passes_frames_of_128_bytes(short: BothEnds, directive: Directive) -> None:
    counter = short.terminal.send(directives.pack(directive, 1))
    short.turn()
    assert "accepted" in short.stages(counter)
    (accepted,) = (r for r in short.reports() if (r.counter, r.stage) == (counter, Stage.ACCEPTED))
    assert accepted.text == str(directive)[: len(accepted.text)]
    assert accepted.request == request_of(directives.pack(directive, 1))


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_packet_with_a_lost_portion_is_refused_and_the_next_is_obeyed(short: BothEnds, lost: int) -> None:
    packet = CommandPacker().pack(TABLE, 1)
    counter = short.terminal.send(packet)
    del short.wire.up[lost]
    short.turn()
    assert short.obeyed == []
    assert short.stages(counter) == ([] if lost == 2 else ["refused"])
    short.terminal.send(ping(1))
    short.terminal.send(packet)
    short.turn()
    assert short.obeyed == [ping(1), packet]


@pytest.mark.parametrize(
    "portion",
    [Portion(0, 1, bytes(72)), Portion(1, 1, bytes(72)), Portion(9, 1, bytes(72)), Portion(3, 2, bytes(72))],
)
def test_a_portion_without_the_portion_before_it_is_refused(short: BothEnds, portion: Portion) -> None:
    counter = short.terminal.send(directives.pack(portion, 1))
    short.turn()
    assert short.stages(counter) == ["refused"]
    with pytest.raises(KnightCubeError, match="600 bytes exceed the longest command"):
        short.terminal.send(bytes(600))


@pytest.mark.parametrize("command_bytes", [128, 300])
def test_files_pass_short_frames_in_both_directions(
    stack: ExitStack, tmp_path: Path, command_bytes: int
) -> None:
    link = stack.enter_context(closing(FiledEnds(tmp_path, loss=0.1, up_rate=1e5)))
    link.settings = TerminalSettings(frame_bytes=128, command_frame_bytes=command_bytes)
    link.restart()
    longest: list[int] = []
    taken = link._left

    def recorded(frames: list[bytes]) -> list[bytes]:
        longest.extend(map(len, frames))
        return taken(frames)

    link._left = recorded  # type: ignore[method-assign]
    data = np.random.default_rng(1).bytes(20_000)
    (tmp_path / "up").write_bytes(data)
    link.session.put(tmp_path / "up", "configuration/a.yaml", link.clock.now_ns())
    link.until_closed()
    assert max(longest) <= max(command_bytes, 128)
    assert (tmp_path / "keys" / "files" / "received" / "configuration" / "a.yaml").read_bytes() == data


def test_a_tnc_is_connected_again_when_it_was_away() -> None:
    codes = LinkCodes(128, call_signs=("OK0GND", "OK0SAT"))
    with socket.create_server(("127.0.0.1", 0)) as first:
        port = first.getsockname()[1]
        line = TncLine(f"127.0.0.1:{port}", codes.on_board(kiss=True))
        line.send([b"lost or not"], 0)
        tnc, _ = first.accept()
    with tnc:
        line.send([b"down"], 1)
        received = b""
        while received.count(b"\xc0") < 4:
            received += tnc.recv(1000)
        found = codes.on_ground(kiss=True).stream().add(received)
        assert found[-1] == b"down"
        command = ping(1)
        tnc.sendall(codes.on_ground(kiss=True).wrap(command) + kiss_frame(b"other traffic"))
        while not (taken := line.receive()):
            pass
        assert taken == [(command, None)]
    while line._socket is not None:
        line.receive()
    for second in range(7):
        line.send([b"nobody"], second * S)
        line.receive()
    with socket.create_server(("127.0.0.1", port)) as again:
        again.settimeout(10.0)
        line.send([b"x"], 20 * S)
        tnc, _ = again.accept()
        with tnc:
            tnc.settimeout(10.0)
            line.send([b"back"], 21 * S)
            received = b""
            while b"back" not in received:
                received += tnc.recv(1000)
    line.close()
    assert line.receive() == []


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_datagrams_and_streams_of_both_ends_are_coded_alike(stack: ExitStack, kind: str) -> None:
    settings = TerminalSettings(
        frame_bytes=300, coding=LinkCoding(randomiser="long", reed_solomon=2, cltu="randomised")
    )
    codes, far = settings.codes(), settings.codes()
    command, telemetry = close_frame(TelecommandHeader(1, 0, 0).pack(40) + bytes(33)), close_frame(bytes(298))
    line: UdpLine | TcpLine
    ground: UdpGround | StreamGround
    if kind == "udp":
        line = UdpLine("127.0.0.1:0", codes=codes)
        ground = UdpGround(f"127.0.0.1:{line.port}", far)
    else:
        line = TcpLine("127.0.0.1:0", framing=codes.on_board())
        caller = stack.enter_context(socket.create_connection(("127.0.0.1", line.port), timeout=10.0))
        ground = StreamGround("tcp", far.on_ground(), lambda: (caller.fileno(), lambda: None))
    stack.callback(line.close)
    stack.callback(ground.close)
    ground.send(command)
    while not (taken := line.receive()):
        pass
    assert [frame for frame, _ in taken] == [command]
    line.trust(taken[0][1], 0)
    line.send([telemetry, telemetry], 1)
    found: list[bytes] = []
    while len(found) < 2:
        found += ground.receive()
    assert found == [telemetry] * 2
    if kind == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(command, ("127.0.0.1", line.port))  # a frame without channel coding
            while not (taken := line.receive()):
                pass
        assert [frame for frame, _ in taken] == [b""]


PACKETS = {
    "command": ping(7),
    "directive": directives.pack(Stop(), 1),
    "unit": UnitPacker(UP).pack(pack(Transaction(2, 1, 1), Metadata(1, "a", "configuration/a", 0)), 1),
}


@pytest.mark.parametrize("second", PACKETS)
@pytest.mark.parametrize("first", PACKETS)
def test_a_frame_with_two_packets_is_not_obeyed(
    stack: ExitStack, tmp_path: Path, first: str, second: str
) -> None:
    link = stack.enter_context(closing(BothEnds(tmp_path)))
    link.terminal.send(PACKETS[first] + PACKETS[second])
    link.turn(1.1)
    assert link.obeyed == []
    assert link.station.transfers == 0
    assert not {"completed", "started"} & {report.stage.name.lower() for report in link.reports()}
    link.terminal.send(PACKETS["command"])
    link.turn()
    assert link.obeyed == [PACKETS["command"]]
