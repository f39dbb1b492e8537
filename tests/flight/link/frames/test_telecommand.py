"""Telecommand frames are laid out as CCSDS 232.0-B says."""

from __future__ import annotations

import pytest

from flight.link.frames.telecommand import FrameError, TelecommandHeader, close_frame, open_frame

SPACECRAFT = 0x1A5


def test_each_bit_of_the_header_stands_where_the_standard_puts_it() -> None:
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
        lambda frame: frame[:1] + bytes([frame[1] ^ 1]) + frame[2:],  # another spacecraft
    ],
)
def test_only_whole_frames_of_this_spacecraft_are_opened(change: object) -> None:
    frame = close_frame(TelecommandHeader(SPACECRAFT, 0, 0).pack(11) + b"data")
    assert open_frame(frame, SPACECRAFT) == frame[:-2]
    with pytest.raises(FrameError):
        open_frame(change(frame), SPACECRAFT)  # type: ignore[operator]  # a lambda of the table above
