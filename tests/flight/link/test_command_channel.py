"""Tests of commands over real sockets, with clients that flood, disappear or send garbage."""

from __future__ import annotations

import json
import os
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from ipaddress import IPv4Network
from pathlib import Path

import pytest

from flight.app.cli import main
from flight.link.commands import (
    AT_MOST,
    IDENTIFIERS,
    LONGEST,
    ChangeMode,
    Channel,
    Command,
    CommandPacker,
    DatagramChannel,
    Ping,
    Slew,
    open_udp,
    open_unix,
    unpack,
)
from flight.link.events import Mode
from flight.link.telemetry.definitions import COMMAND
from flight.link.telemetry.packets import Packer
from ground.link.commanding import exchange
from knightcube.errors import KnightCubeError, UsageError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "commands"


def answer_once(
    channel: Channel, taken: list[Command], obeyed: bool = True, mode: int = Mode.HOLD
) -> threading.Thread:
    """Reply to the next command in a thread, as the flight software would."""

    def serve() -> None:
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            for data, sender in channel.poll():
                taken.append(unpack(data))
                fields = {"obeyed": int(obeyed), "name": "x", "source": channel.name, "count": 1}
                fields |= {"mode": int(mode), "text": "as commanded"}
                channel.answer(Packer().pack(COMMAND, 0, fields), sender)
                return
            time.sleep(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    return thread


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["safe", "smoke"], ChangeMode(Mode.SAFE, "smoke")),
        (["mode", "hold"], ChangeMode(Mode.HOLD)),
        (["slew", "-0.25"], Slew(-0.25)),
    ],
)
def test_the_command_line_sends_what_was_typed_and_prints_the_answer(
    place: Path, words: list[str], command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    channel = open_unix(place)
    taken: list[Command] = []
    thread = answer_once(channel, taken)
    status = main(["command", "--to", str(place), *words])
    thread.join()
    channel.close()
    assert status == 0
    assert taken == [command]
    assert capsys.readouterr().out == "executed: as commanded; mode hold\n"


def test_over_udp_a_refusal_is_exit_status_1_and_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    channel = open_udp("127.0.0.1:0")
    port = channel._socket.getsockname()[1]
    thread = answer_once(channel, [], obeyed=False)
    status = main(["command", "--to", f"127.0.0.1:{port}", "--json", "ping"])
    thread.join()
    channel.close()
    assert status == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"obeyed": False, "mode": "hold", "text": "as commanded", "count": 1}


@pytest.mark.parametrize(
    ("words", "status", "problem"),
    [
        (["slew", "0.9"], 2, "q2 = 0.9 must lie within"),
        (["slew", "nan"], 2, "must lie within"),
        (["ping"], 1, "no flight listens there"),
    ],
)
def test_commands_that_cannot_be_sent_are_refused_in_one_line(
    place: Path, words: list[str], status: int, problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["command", "--to", str(place), *words]) == status
    line = capsys.readouterr().err
    assert problem in line
    assert line.count("\n") == 1


def test_a_flight_that_does_not_answer_is_reported(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    channel = open_unix(place)
    assert main(["command", "--to", str(place), "--timeout", "0.05", "ping"]) == 1
    channel.close()
    assert "no answer within 0.05 s" in capsys.readouterr().err


def test_an_answer_with_an_unknown_mode_is_invalid(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    channel = open_unix(place)
    thread = answer_once(channel, [], mode=200)
    status = main(["command", "--to", str(place), "ping"])
    thread.join()
    channel.close()
    assert status == 1
    assert capsys.readouterr().err.endswith("bytes is invalid\n")


BEGINS = IDENTIFIERS[0].to_bytes(2, "big")
"""First two bytes of a command. The kernel drops all datagrams that do not begin with these bytes."""


def flood(to: Path, count: int, data: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.setblocking(False)
        for _ in range(count):
            try:
                line.sendto(data, str(to))
            except BlockingIOError:
                return


def test_a_flood_is_taken_in_small_portions_and_a_long_datagram_is_cut(place: Path) -> None:
    channel = open_unix(place)
    flood(place, 200, BEGINS + b"x" * 5000)
    taken = channel.poll()
    assert len(taken) <= AT_MOST
    assert {len(data) for data, _ in taken} == {LONGEST + 1}
    channel.close()


def test_a_sender_without_an_address_or_with_a_closed_socket_gets_no_answer_and_does_no_harm(
    place: Path, tmp_path: Path
) -> None:
    channel = open_unix(place)
    flood(place, 1, BEGINS)
    ((_, nobody),) = channel.poll()
    channel.answer(b"y", nobody)
    channel.answer(b"y", str(tmp_path / "gone"))
    assert channel.poll() == []
    channel.close()
    channel.close()
    assert channel.poll() == []
    assert not place.exists()


def test_only_commands_of_a_peer_take_a_place_in_the_queue(place: Path) -> None:
    """Datagrams from unknown addresses, and datagrams without a command, do not fill the command queue."""
    ping = CommandPacker().pack(Ping(5), 1)
    channels = [open_udp("127.0.0.1:0", [IPv4Network("127.0.0.9"), IPv4Network("127.1.0.0/16")])]
    to = channels[0]._socket.getsockname()
    with ExitStack() as stack:
        senders = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)]
        for sender, host in zip(senders, ("127.0.0.2", "127.0.0.9", "127.1.2.3"), strict=True):
            sender.bind((host, 0))
        for _ in range(1000):
            senders[0].sendto(ping, to)
            senders[1].sendto(b"no command", to)
        senders[1].sendto(ping, to)
        senders[2].sendto(ping, to)
    channels.append(open_unix(place))
    flood(place, 1000, b"no command")
    flood(place, 1, ping)
    assert [[data for data, _ in channel.poll()] for channel in channels] == [[ping, ping], [ping]]
    for channel in channels:
        channel.close()


def test_a_socket_whose_file_was_removed_is_bound_again_and_reported(place: Path) -> None:
    channel = open_unix(place)
    place.unlink()
    ping = CommandPacker().pack(Ping(5), 1)
    assert [channel.poll() for _ in range(10)] == [[]] * 10
    assert "bound again" in channel.news()
    assert channel.news() == ""
    flood(place, 1, ping)
    assert [data for data, _ in channel.poll()] == [ping]
    place.unlink()
    place.mkdir()
    for _ in range(30):
        channel.poll()
    assert "cannot be bound again" in channel.news()
    place.rmdir()
    for _ in range(10):
        channel.poll()
    assert place.is_socket()
    channel.close()
    assert not place.exists()


def test_the_socket_is_for_owner_and_group_only(place: Path) -> None:
    channel = open_unix(place)
    assert stat.S_IMODE(os.stat(place).st_mode) == 0o660
    channel.close()


@pytest.mark.skipif(not os.access("/run", os.W_OK), reason="/run may not be written to: be root")
def test_a_service_is_answered_where_it_can_see_the_socket() -> None:
    """A service with a private /tmp gets its answer at a socket that the flight can reach."""
    with tempfile.TemporaryDirectory(dir="/run", prefix="knightcube-test-") as folder:
        channel = open_unix(Path(folder) / "commands")
        senders: list[str] = []

        def serve() -> None:
            while not senders:
                senders.extend(sender for _, sender in channel.poll())

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(KnightCubeError, match="no answer"):
            exchange(f"{folder}/commands", BEGINS, 0.2)
        thread.join()
        channel.close()
        assert senders[0].startswith(folder)


def test_a_stale_socket_is_replaced_but_no_other_file(place: Path) -> None:
    open_unix(place)._socket.close()  # as after a kill, the socket file remains
    second = open_unix(place)
    with pytest.raises(UsageError, match="another flight listens there"):
        open_unix(place)
    second.close()
    place.write_text("precious")
    with pytest.raises(UsageError, match="a file that is not a socket has this path"):
        open_unix(place)
    assert place.read_text() == "precious"


@pytest.mark.parametrize(
    ("listen", "problem"),
    [
        (lambda: open_unix(Path("/nowhere/at/all")), "commands.socket"),
        (lambda: open_udp("127.0.0.1:70000"), "commands.udp"),
        (lambda: open_udp("203.0.113.7:9"), "commands.udp"),
    ],
)
def test_an_address_that_cannot_be_opened_is_a_mistake_of_the_users(
    listen: Callable[[], DatagramChannel], problem: str
) -> None:
    with pytest.raises(UsageError, match=problem):
        listen()
