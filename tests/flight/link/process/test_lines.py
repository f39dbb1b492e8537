"""Tests of the link's lines: floods, strangers, slow connections, and frames that a line did not send."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from ipaddress import IPv4Network
from unittest.mock import Mock

import pytest

from flight.link import coding
from flight.link.coding import LinkCodes, ReedSolomon, randomised
from flight.link.frames import SYNC, TelecommandHeader, close_frame
from flight.link.process import station
from flight.link.process.station import AT_MOST, Line, SerialLine, TcpLine, TncLine, UdpLine
from hal.buses.linux_wires import PySerialPort
from hal.buses.system import SystemClock
from hal.interfaces.errors import NotResponding
from knightcube.errors import UsageError

FRAME = close_frame(TelecommandHeader(1, 0, 0).pack(11) + b"data")
ELSEWHERE = [IPv4Network("192.0.2.0/24")]


def test_udp_telemetry_is_sent_to_authentic_senders_only_and_for_a_minute() -> None:
    line = UdpLine("127.0.0.1:0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", 0))
        ground.setblocking(False)
        for _ in range(AT_MOST + 20):
            ground.sendto(FRAME, ("127.0.0.1", line.port))
        taken = line.receive()
        assert len(taken) <= AT_MOST
        line.send([b"secret"], 0)
        with pytest.raises(BlockingIOError):
            ground.recv(100)
        line.trust(taken[0][1], 0)
        line.send([b"first"], 59 * 10**9)
        line.send([b"second"], 61 * 10**9)
        assert ground.recv(100) == b"first"
        with pytest.raises(BlockingIOError):
            ground.recv(100)
    line.close()


def test_datagrams_of_a_sender_other_than_the_peer_are_ignored() -> None:
    line = UdpLine("127.0.0.1:0", peers=ELSEWHERE)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(FRAME, ("127.0.0.1", line.port))
    assert line.receive() == []
    line.close()
    stream = TcpLine("127.0.0.1:0", peers=ELSEWHERE)
    with socket.create_connection(("127.0.0.1", stream.port), timeout=5.0) as caller:
        caller.sendall(SYNC + FRAME)
        assert stream.receive() == []
    stream.close()


def test_strangers_do_not_fill_the_buffer_of_the_peers_datagrams() -> None:
    line = UdpLine("127.0.0.1:0", peers=[IPv4Network("127.0.0.1/32"), IPv4Network("192.0.2.0/24")])
    with ExitStack() as stack:
        stranger, peer = (
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        )
        stranger.bind(("127.0.0.2", 0))
        for _ in range(10_000):  # the total size exceeds the receive buffer
            stranger.sendto(FRAME, ("127.0.0.1", line.port))
        peer.sendto(FRAME, ("127.0.0.1", line.port))
        assert [frame for frame, _ in line.receive()] == [FRAME]
    line.close()


def test_an_operator_whose_frame_is_late_is_not_displaced_by_200_strangers_a_second() -> None:
    """200 strangers a second do not displace an operator, whose frame arrives after half a second.

    The link runs only five cycles a second, as on a busy board.
    """
    line = TcpLine("127.0.0.1:0")
    with ExitStack() as stack:
        (operator,) = callers_of(line, stack, 1)
        for turn in range(5):
            if turn == 3:
                operator.sendall(SYNC + FRAME)
            for _ in range(40):
                stranger = stack.enter_context(
                    socket.create_connection(("127.0.0.1", line.port), timeout=5.0)
                )
                stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            if found := [one for one in line.receive() if one[0] == FRAME]:
                line.trust(found[0][1], 0)
        line.send([b"telemetry"], 0)
        assert operator.recv(4096).endswith(b"telemetry")
    line.close()


def callers_of(line: TcpLine, stack: ExitStack, count: int) -> list[socket.socket]:
    callers = []
    for _ in range(count):
        callers.append(stack.enter_context(socket.create_connection(("127.0.0.1", line.port), timeout=5.0)))
        line.receive()
    return callers


def received_by(line: TcpLine) -> list[tuple[bytes, object]]:
    while not (found := line.receive()):
        pass
    return found


def is_closed(caller: socket.socket) -> bool:
    caller.setblocking(False)
    try:
        return caller.recv(1) == b""
    except BlockingIOError:
        return False


def test_strangers_displace_the_oldest_stranger_and_no_connection_with_an_authentic_frame() -> None:
    line = TcpLine("127.0.0.1:0")
    with ExitStack() as stack:
        operators = callers_of(line, stack, 5)
        for operator in operators:
            operator.sendall(SYNC + FRAME)
            line.trust(received_by(line)[0][1], 0)
        assert [is_closed(operator) for operator in operators] == [True, False, False, False, False]
        strangers = callers_of(line, stack, 264)
        assert [is_closed(stranger) for stranger in strangers] == [True] * 8 + [False] * 256
        assert not any(is_closed(operator) for operator in operators[1:])
    line.close()


@contextmanager
def tcp_line() -> Iterator[tuple[TcpLine, int]]:
    line = TcpLine("127.0.0.1:0")
    with ExitStack() as stack:
        caller, _ = callers_of(line, stack, 2)
        caller.sendall(SYNC + FRAME)
        line.trust(received_by(line)[0][1], 0)
        yield line, caller.fileno()
    line.close()


@contextmanager
def tnc_line() -> Iterator[tuple[TncLine, int]]:
    with socket.create_server(("127.0.0.1", 0)) as tnc:
        line = TncLine(f"127.0.0.1:{tnc.getsockname()[1]}", LinkCodes().on_board(kiss=True))
        line.send([], 0)
        with tnc.accept()[0] as connection:
            yield line, connection.fileno()
        line.close()


@contextmanager
def serial_line() -> Iterator[tuple[SerialLine, int]]:
    near, far = os.openpty()
    line = SerialLine("radio", PySerialPort(os.ttyname(far), 115200, SystemClock(), write_timeout=0.0))
    yield line, near
    line.close()
    os.close(near)
    os.close(far)


@pytest.mark.parametrize("kind", [tcp_line, tnc_line, serial_line])
def test_frames_that_a_slow_stream_does_not_take_are_known_and_none_is_sent_in_part(
    kind: Callable[[], AbstractContextManager[tuple[Line, int]]],
) -> None:
    sent = [n.to_bytes(2, "big") * 500 for n in range(10_000)]
    with kind() as (line, far):
        stream = LinkCodes(frame_bytes=1000).on_ground(kind is tnc_line).stream()
        waiting, received, refused = list(sent), list[bytes](), 0
        while waiting or len(received) < len(sent):
            batch = waiting[:7]
            taken = line.send(batch, 0)
            assert taken is not None
            refused += taken < len(batch)
            del waiting[:taken]
            if taken < len(batch) or not waiting:
                received += stream.add(os.read(far, 1 << 16))
        assert refused > 1
        assert received == sent


def test_a_connection_that_does_not_read_delays_no_other_connection() -> None:
    line = TcpLine("127.0.0.1:0")
    assert line.send([FRAME], 0) is None, "nobody listens"
    with ExitStack() as stack:
        for caller in (callers := callers_of(line, stack, 3))[:2]:
            caller.sendall(SYNC + FRAME)
            line.trust(received_by(line)[0][1], 0)
        frame, total = bytes(1 << 14), 0
        while line.send([frame], 0):  # until all buffers are full
            pass
        callers[0].setblocking(False)
        for _ in range(100):
            with suppress(BlockingIOError):
                while data := callers[0].recv(1 << 20):
                    total += len(data)
            assert line.send([frame], 0) == 1
        callers[2].setblocking(False)
        with pytest.raises(BlockingIOError):
            callers[2].recv(1)
    line.close()


def test_a_connection_that_takes_nothing_is_closed_and_a_slow_or_unused_one_is_kept() -> None:
    frame, minute, step = bytes(1 << 14), 60 * 10**9, 10**9
    with tcp_line() as (line, far):
        assert line.send([frame], 0) == 1
        assert line.send([frame], 60 * minute) == 1, "nothing was due for an hour"
        begin = 60 * minute
        for _ in range(3):  # the peer reads every four minutes
            while line.send([frame], begin):
                pass
            assert None not in [line.send([frame], begin + n * step) for n in range(240)]
            begin += 4 * minute
            while not line.send([frame], begin):
                os.read(far, 1 << 20)
        while line.send([frame], begin):
            pass
        taken = [line.send([frame] * (n % 2), begin + n * step) for n in range(600)]
        assert taken.index(None) > 300, "times without due frames neither shorten nor extend the limit"


def test_lines_report_that_they_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [b"one", b"two", b"three"]
    with serial_line() as (serial, _), tcp_line() as (tcp, _):
        serial.close()
        assert serial.send(frames, 0) == 0
        monkeypatch.setattr(station, "_write_to", Mock(side_effect=ConnectionResetError))
        assert [tcp.send(frames, 0), tcp.send(frames, 0)] == [0, None]
    with socket.create_server(("127.0.0.1", 0)) as closed:
        address = f"127.0.0.1:{closed.getsockname()[1]}"
    tnc = TncLine(address, LinkCodes().on_board(kiss=True))
    assert [tnc.send(frames, n * 10**10) for n in range(3)] == [0, 0, 0]
    udp = UdpLine("127.0.0.1:0")
    assert udp.send(frames, 0) is None, "nobody listens"
    udp.trust(("127.0.0.1", 9), 0)
    outcomes = [3, OSError(errno.ENETUNREACH, "Network is unreachable"), 3, 5]
    udp._socket, own = Mock(sendto=Mock(side_effect=outcomes)), udp._socket
    assert udp.send(frames, 0) == 1
    assert udp.send(frames[1:], 0) == 2
    own.close()


def test_a_frame_that_is_sent_again_on_several_lines_is_encoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    encode, randomise = Mock(side_effect=bytes), Mock(side_effect=randomised)
    monkeypatch.setattr(ReedSolomon, "encode", encode)
    monkeypatch.setattr(coding, "randomised", randomise)
    codes, frames = LinkCodes(223, "long", 1), [bytes([n]) * 223 for n in range(90)]
    udp = UdpLine("127.0.0.1:0", codes=codes)
    udp.trust(("127.0.0.1", 9), 0)
    monkeypatch.setattr(udp, "_send", Mock(return_value=False))
    lost = Mock(send=Mock(side_effect=NotResponding("radio", "the port is lost")))
    lines = [udp, SerialLine("radio", lost, codes.on_board()), SerialLine("tnc", lost, codes.on_board(True))]
    for _ in range(50):
        assert [line.send(frames, 0) for line in lines] == [0, 0, 0]
    assert encode.call_count == randomise.call_count == len(frames)
    udp.close()


def test_a_tnc_line_without_a_free_file_descriptor_connects_later(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as tnc:
        line = TncLine(f"127.0.0.1:{tnc.getsockname()[1]}", LinkCodes().on_board(kiss=True))
        with monkeypatch.context() as patch:
            patch.setattr(socket, "socket", lambda *_: os.open("/dev/null/none", os.O_RDONLY))
            line.send([FRAME], 0)
        line.send([FRAME], 4 * 10**9)
        tnc.setblocking(False)
        with pytest.raises(BlockingIOError):
            tnc.accept()
        line.send([FRAME], 5 * 10**9)
        tnc.setblocking(True)
        tnc.settimeout(5.0)
        tnc.accept()[0].close()
        line.close()


@pytest.mark.parametrize("kind", [UdpLine, TcpLine])
def test_an_address_that_is_not_there_is_a_mistake_of_the_users(kind: Callable[[str], object]) -> None:
    with pytest.raises(UsageError, match="cannot listen on"):
        kind("203.0.113.7:9")
