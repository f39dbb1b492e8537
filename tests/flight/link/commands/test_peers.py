"""UDP commands come from the configured peers alone; the defaults without `peers` are reported or refused."""

from __future__ import annotations

import socket
from ipaddress import IPv4Network

import pytest

from flight.link.commands.channel import open_udp
from flight.link.commands.codec import CommandPacker, Ping
from flight.schema.errors import ConfigError
from flight.schema.peers import peer_networks
from flight.schema.reader import parse
from tests.scenario.flights import CONFIG


def networks(commands: str) -> list[str]:
    text = CONFIG.read_text(encoding="utf-8")
    return [str(network) for network in peer_networks(parse(f"{text}\ncommands: {commands}\n").commands)]


@pytest.mark.parametrize(
    ("commands", "expected"),
    [
        ("{}", []),
        ("{udp: '127.0.0.3:5000'}", ["127.0.0.0/8"]),
        ("{udp: '10.20.30.40:5000'}", ["10.20.30.0/24"]),
        ("{udp: '10.20.30.40:5000', peers: [10.20.30.7]}", ["10.20.30.7/32"]),
        ("{udp: 'board:5000', peers: [10.20.0.0/16, 127.0.0.1]}", ["10.20.0.0/16", "127.0.0.1/32"]),
    ],
)
def test_without_a_word_the_peers_are_those_around_the_address(commands: str, expected: list[str]) -> None:
    assert networks(commands) == expected


@pytest.mark.parametrize(
    ("commands", "problem"),
    [
        ("{udp: '0.0.0.0:5000'}", r"`commands.udp` 0\.0\.0\.0 is every network: say who may command"),
        ("{udp: 'board:5000'}", r"`commands.udp` board may be anywhere: say who may command"),
        (
            "{udp: '10.0.0.1:5000', peers: [10.0.0.5/24]}",
            r"`commands.peers` 10\.0\.0\.5/24 has host bits",
        ),
        ("{udp: '10.0.0.1:5000', peers: [10.0.0.500]}", "`commands.peers` .*not permitted"),
        ("{udp: '10.0.0.1:5000', peers: [ground]}", "`commands.peers"),
        ("{udp: '10.0.0.1:5000', peers: []}", "`commands.peers"),
    ],
)
def test_peers_that_make_no_sense_are_refused_with_what_would(commands: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        networks(commands)


def test_a_datagram_of_somebody_else_is_not_listened_to() -> None:
    ping = CommandPacker().pack(Ping(), 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for peers, heard in ((["127.0.0.0/8"], [ping]), (["192.0.2.0/24"], [])):
            channel = open_udp("127.0.0.1:0", [IPv4Network(peer) for peer in peers])
            sender.sendto(ping, channel._socket.getsockname())
            assert [data for data, _ in channel.poll()] == heard
            channel.close()
