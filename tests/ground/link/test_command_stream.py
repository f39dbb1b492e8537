"""Tests of the bytes that a client may send to the gateway: its token, and then command packets."""

from __future__ import annotations

import itertools
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flight.link.commands import ChangeMode, CommandPacker, Ping
from flight.link.events import Mode
from flight.link.files.units import DOWN, SEGMENT_BYTES, UP, UnitPacker
from flight.link.telemetry.definitions import HEALTH
from flight.link.telemetry.packets import HEADER_BYTES, Packer
from ground.link.gateway import CommandStream, StreamError, new_token
from tests.flight.link.telemetry.samples import plain_contents

TOKEN = "0123456789abcdef" * 4
PING, SAFE = CommandPacker().pack(Ping(3), 1), CommandPacker().pack(ChangeMode(Mode.SAFE, "end of pass"), 1)
UNIT = UnitPacker(UP).pack(b"u" * SEGMENT_BYTES, 1)
LINE = TOKEN.encode() + b"\n"


def opened() -> CommandStream:
    stream = CommandStream(TOKEN)
    assert list(stream.packets(LINE)) == []
    assert stream.authenticated
    return stream


@given(st.lists(st.integers(0, 2000), max_size=6))
def test_the_packets_behind_the_token_come_whole_however_the_bytes_arrive(cuts: list[int]) -> None:
    data = LINE + PING + UNIT + SAFE + PING
    stream, found = CommandStream(TOKEN), list[bytes]()
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for begin, end in itertools.pairwise(edges):
        found += stream.packets(data[begin:end])
    assert found == [PING, UNIT, SAFE, PING]


@pytest.mark.parametrize("data", [b"G", b"POST / HTTP/1.1\r\n", b"\x18", b"\n", b"\x00", b"A", b"abcx", PING])
def test_a_byte_that_no_token_has_is_refused_at_once(data: bytes) -> None:
    with pytest.raises(StreamError, match="not the token"):
        list(CommandStream(TOKEN).packets(data))


def test_the_number_of_correct_characters_of_a_token_is_not_disclosed() -> None:
    """A wrong token is refused only when its line is complete, whichever of its characters is wrong."""
    for right in range(len(TOKEN)):
        wrong = TOKEN[:right] + ("1" if TOKEN[right] == "0" else "0") + TOKEN[right + 1 :]
        stream = CommandStream(TOKEN)
        assert list(stream.packets(wrong.encode())) == []
        with pytest.raises(StreamError, match="not the token"):
            list(stream.packets(b"\n"))
        assert not stream.authenticated
    with pytest.raises(StreamError, match="not the token"):
        list(CommandStream(TOKEN).packets(TOKEN.encode() + b" " + PING))


def test_tokens_are_long_and_differ() -> None:
    assert len({new_token() for _ in range(100)}) == 100
    assert len(new_token()) == len(TOKEN)


def changed(packet: bytes, at: int, value: int) -> bytes:
    return packet[:at] + bytes((value,)) + packet[at + 1 :]


@pytest.mark.parametrize(
    ("packet", "wrong"),
    [
        (changed(PING, 0, PING[0] | 0x20), 0),  # a packet of version 1
        (changed(PING, 0, PING[0] & ~0x10), 0),  # a telemetry packet
        (changed(PING, 0, PING[0] & ~0x08), 0),  # packet without a secondary header
        (changed(PING, 1, 0xFF), 1),  # a packet with the APID of another application
        (changed(PING, 2, 0x40), 2),  # a packet that is a segment of a sequence
        (changed(PING, 4, 1), 4),  # a length that exceeds the length of any ping
        (changed(PING, 5, PING[5] + 1), 5),
        (changed(PING, 5, PING[5] - 1), 5),
        (changed(PING, 6, PING[6] + 1), 6),  # packet of an unknown version of the definition
        (changed(UNIT, 4, 0xFF), 4),  # a length that exceeds the length of any frame
        (changed(UNIT, 4, 0)[:5] + b"\x00", 5),  # a length shorter than the headers
        (UnitPacker(DOWN).pack(b"unit", 1), 0),
        (Packer().pack(HEALTH, 1, plain_contents(HEALTH)), 0),
        (b"POST / HTTP/1.1\r\n", 0),
    ],
)
def test_the_first_byte_that_no_command_has_ends_the_connection_at_that_byte(
    packet: bytes, wrong: int
) -> None:
    for before in (b"", SAFE):
        stream = opened()
        for byte in before + packet[:wrong]:
            list(stream.packets(bytes((byte,))))
        with pytest.raises(StreamError, match=rf"0x{packet[wrong]:02x} as its byte {wrong + 1}$"):
            list(stream.packets(packet[wrong : wrong + 1]))


def test_commands_before_the_wrong_byte_are_returned_and_none_behind_it() -> None:
    stream = opened()
    packets = stream.packets(PING + SAFE + b"GET " + PING)
    assert [next(packets), next(packets)] == [PING, SAFE]
    with pytest.raises(StreamError):
        next(packets)


packets = st.sampled_from((PING, SAFE, UNIT))
damaged = st.tuples(packets, st.integers(0, HEADER_BYTES - 1), st.integers(0, 255)).map(
    lambda drawn: drawn[0][: drawn[1]] + bytes((drawn[2],)) + drawn[0][drawn[1] + 1 :]
)


@given(st.lists(packets, max_size=3), st.lists(packets | damaged | st.binary(max_size=20), max_size=3))
def test_only_packets_with_the_header_of_a_command_are_returned(sent: list[bytes], more: list[bytes]) -> None:
    stream, found = opened(), list[bytes]()
    with suppress(StreamError):
        for packet in stream.packets(b"".join((*sent, *more))):
            found.append(packet)
    assert found[: len(sent)] == sent
    for packet in found:
        assert packet[:2] in {PING[:2], SAFE[:2], UNIT[:2]}
        assert int.from_bytes(packet[4:HEADER_BYTES], "big") == len(packet) - HEADER_BYTES - 1
