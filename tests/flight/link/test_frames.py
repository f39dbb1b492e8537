"""Tests that frames contain their packets, and that bytes of any other kind are refused or skipped."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flight.link.frames import (
    SYNC,
    FrameError,
    FrameStream,
    MasterCount,
    PacketAssembler,
    TelecommandHeader,
    TelemetryFramer,
    close_frame,
    idle_packet,
    open_telecommand,
    open_telemetry,
)

SPACECRAFT = 0x1A5


def test_each_bit_of_the_header_is_at_its_place_in_the_standard() -> None:
    header = TelecommandHeader(spacecraft=SPACECRAFT, channel=0b10_1101, sequence=0x7E).pack(0x123 + 1)
    version, bypass, control, reserved = "00", "1", "0", "00"
    bits = (
        version + bypass + control + reserved + f"{SPACECRAFT:010b}" + "101101" + f"{0x123:010b}" + "01111110"
    )
    assert header == int(bits, 2).to_bytes(5, "big")


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: frame + b"x",
        lambda frame: frame[:-1],
        lambda frame: frame[:3],
        lambda frame: bytes([frame[0] ^ 0x10]) + frame[1:],  # a control frame
        lambda frame: frame[:1] + bytes([frame[1] ^ 1]) + frame[2:],  # the identifier of another spacecraft
    ],
)
def test_only_whole_frames_of_this_spacecraft_are_opened(change: object) -> None:
    frame = close_frame(TelecommandHeader(SPACECRAFT, 0, 0).pack(11) + b"data")
    assert open_telecommand(frame, SPACECRAFT) == frame[:-2]
    with pytest.raises(FrameError):
        open_telecommand(change(frame), SPACECRAFT)  # type: ignore[operator]  # a lambda of the table above


SPACECRAFT, ROOM = 0x1A5, 97
FRAME = 6 + ROOM + 2


def framer(channel: int = 3) -> TelemetryFramer:
    return TelemetryFramer(SPACECRAFT, channel, ROOM, MasterCount(), lambda header, data: header + data)


def packet(number: int, size: int) -> bytes:
    return (
        (0x0100 + number % 256).to_bytes(2, "big") + b"\xc0\0" + (size - 1).to_bytes(2, "big") + bytes(size)
    )


def assembled(frames: list[bytes], assembler: PacketAssembler) -> list[bytes]:
    found = []
    for frame in frames:
        header, data, channel = open_telemetry(frame, SPACECRAFT)
        assert channel == 3
        found += assembler.add(header, data)
    return found


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(1, 300), st.booleans()), max_size=30))
def test_packets_of_all_sizes_come_out_as_they_went_in(sizes: list[tuple[int, bool]]) -> None:
    made, frames, sent = framer(), [], []
    for number, (size, flush) in enumerate(sizes):
        sent.append(packet(number, size))
        frames += made.add(sent[-1])
        if flush:
            frames += made.flush()
            assert not made.waits
    frames += made.flush()
    assert {len(frame) for frame in frames} == {FRAME}
    assert assembled(frames, PacketAssembler()) == sent


def test_a_lost_frame_costs_the_packets_that_it_touched_and_no_others() -> None:
    draw = random.Random(5)
    sent = [packet(n, draw.randrange(1, 200)) for n in range(400)]
    made = framer()
    frames = [frame for one in sent for frame in made.add(one)] + made.flush()
    lost = set(draw.sample(range(len(frames)), len(frames) // 10))
    assembler = PacketAssembler()
    found = assembled([frame for n, frame in enumerate(frames) if n not in lost], assembler)
    begin, whole = 0, []
    for one in sent:
        end = begin + len(one)
        if not lost & set(range(begin // ROOM, (end - 1) // ROOM + 1)):
            whole.append(one)
        begin = end
    assert found == whole


@pytest.mark.parametrize("gap", [1, 2, 255, 256, 257, 511, 512, 513, 1024])
@pytest.mark.parametrize("size", [60, 300])
def test_a_gap_of_any_length_costs_only_the_packets_that_it_cut(gap: int, size: int) -> None:
    made = framer()
    sent = [packet(n, size) for n in range(3 * (gap + 8) * ROOM // size)]
    frames = [frame for one in sent for frame in made.add(one)]
    begins = [n * len(sent[0]) for n in range(len(sent) + 1)]
    whole = [
        one
        for one, begin, end in zip(sent, begins, begins[1:], strict=False)
        if (end <= 3 * ROOM or begin >= (3 + gap) * ROOM) and end <= len(frames) * ROOM
    ]
    assembler, found = PacketAssembler(), []
    for n, frame in enumerate(frames):
        if not 3 <= n < 3 + gap:
            header, data, _ = open_telemetry(frame, SPACECRAFT)
            found += assembler.add(header, data, gap if n > 3 else 0)
    assert found == whole


def test_frames_of_other_channels_that_were_received_do_not_interrupt_a_packet() -> None:
    made, assembler = framer(), PacketAssembler()
    first, second = made.add(packet(0, 2 * ROOM - 6))
    found = []
    for frame, missing in ((first, 0), (second, 255)):
        header, data, _ = open_telemetry(frame, SPACECRAFT)
        found += assembler.add(header, data, missing)
    assert found == [packet(0, 2 * ROOM - 6)]


def test_a_packet_is_not_continued_if_the_pointer_marks_the_begin_of_another() -> None:
    made, assembler = framer(), PacketAssembler()
    frames = made.add(packet(0, ROOM)) + made.add(packet(1, 2 * ROOM))
    header, data, _ = open_telemetry(frames[0], SPACECRAFT)
    assert assembler.add(header, data) == []
    header, data, _ = open_telemetry(frames[1], SPACECRAFT)
    displaced = header[:4] + (int.from_bytes(header[4:], "big") + 1).to_bytes(2, "big")
    assert assembler.add(displaced, data) == []


def test_the_header_is_that_of_the_standard() -> None:
    (frame,) = framer(channel=5).add(packet(0, ROOM - 6))
    bits = "00" + f"{SPACECRAFT:010b}" + "101" + "0" + "00000000" * 2 + "0" + "0" + "0" + "11" + f"{0:011b}"
    assert frame[:6] == int(bits, 2).to_bytes(6, "big")
    assert idle_packet(9) == bytes.fromhex("07ffc0000002000000")


@settings(max_examples=25)
@given(st.binary(max_size=12), st.lists(st.integers(1, 60), min_size=1), st.randoms(use_true_random=False))
def test_frames_are_found_in_a_stream_however_it_is_cut(
    noise: bytes, cuts: list[int], draw: random.Random
) -> None:
    made = framer()
    frames = [frame for n in range(4) for frame in made.add(packet(n, 80))]
    stream = noise.join([b"", *(SYNC + frame for frame in frames)])
    finder, found, position = FrameStream(lambda _: FRAME, 0), [], 0
    while position < len(stream):
        step = draw.choice(cuts)
        found += finder.add(stream[position : position + step])
        position += step
    assert found == frames


def test_a_false_marker_hides_no_frame() -> None:
    (frame,) = framer().add(packet(0, ROOM - 6))
    found = FrameStream(lambda _: FRAME, 0).add(SYNC + b"\x1a\xcf" + SYNC + frame + SYNC)
    assert found[-1] == frame
