"""The link is open to its peers alone; plain UDP commands stay on the machine."""

from __future__ import annotations

import socket
from ipaddress import IPv4Network

import pytest

from flight.link.commands import CommandPacker, Ping, open_udp
from flight.schema.consistency import peer_networks
from flight.schema.document import ConfigError
from flight.schema.reader import parse
from tests.support.flights import CONFIG


def networks(lines: str, commands: str = "{socket: /run/x}") -> list[str]:
    text = CONFIG.read_text(encoding="utf-8")
    link = parse(f"{text}\ncommands: {commands}\nlink: {{keys: /k, {lines}}}\n").link
    assert link is not None
    return [str(network) for network in peer_networks(link)]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("serial: {device: /dev/ttyS0}", []),
        ("udp: '127.0.0.3:5000'", ["127.0.0.0/8"]),
        ("udp: '10.20.30.40:5000'", ["10.20.30.0/24"]),
        ("udp: '10.20.30.40:5000', peers: [10.20.30.7]", ["10.20.30.7/32"]),
        ("tcp: 'board:5000', peers: [10.20.0.0/16, 127.0.0.1]", ["10.20.0.0/16", "127.0.0.1/32"]),
    ],
)
def test_without_a_word_the_peers_are_those_around_the_address(lines: str, expected: list[str]) -> None:
    assert networks(lines) == expected


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ("udp: '0.0.0.0:5000'", r"`link.udp` 0\.0\.0\.0 is every network: say who may connect"),
        ("tcp: 'board:5000'", r"`link.tcp` board may be anywhere: say who may connect"),
        ("udp: '10.0.0.1:5000', peers: [10.0.0.5/24]", r"`link.peers` 10\.0\.0\.5/24 has host bits"),
        ("udp: '10.0.0.1:5000', peers: [10.0.0.500]", "`link.peers` .*not permitted"),
        ("udp: '10.0.0.1:5000', peers: [ground]", "`link.peers"),
        ("udp: '10.0.0.1:5000', peers: []", "`link.peers"),
        ("spacecraft: 5", "`link` has no line"),
        ("tcp: '127.0.0.1:5', telemetry_to: '127.0.0.1:6'", "`link.telemetry_to` goes with `link.udp`"),
    ],
)
def test_lines_that_make_no_sense_are_refused_with_what_would(lines: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        networks(lines)


@pytest.mark.parametrize("address", ["192.168.7.2:5000", "0.0.0.0:5000", "board:5000"])
def test_plain_commands_from_beyond_the_machine_are_refused(address: str) -> None:
    with pytest.raises(ConfigError, match=r"`commands.udp` .* is plain and open beyond this machine"):
        networks("udp: '10.0.0.1:5000'", f"{{socket: /run/x, udp: '{address}'}}")


def test_a_link_needs_the_flights_socket() -> None:
    with pytest.raises(ConfigError, match=r"`link` needs `commands.socket`"):
        networks("udp: '10.0.0.1:5000'", "{}")


def test_a_datagram_of_somebody_else_is_not_listened_to() -> None:
    ping = CommandPacker().pack(Ping(), 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for peers, heard in ((["127.0.0.0/8"], [ping]), (["192.0.2.0/24"], [])):
            channel = open_udp("127.0.0.1:0", [IPv4Network(peer) for peer in peers])
            sender.sendto(ping, channel._socket.getsockname())
            assert [data for data, _ in channel.poll()] == heard
            channel.close()
