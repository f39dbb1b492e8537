"""Tests of UBX messages against pyubx2, an independent client, and with random bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyubx2 import UBXMessage, UBXReader

from hal.drivers.gps import CFG_MSG, NAV_PVT, SYNC, UbxParser, checksum, frame, unpack_pvt
from tests.hal.gps.fixes import PVT


def test_another_authors_client_reads_our_frame_as_it_is_meant() -> None:
    read = UBXReader.parse(frame(NAV_PVT, PVT.packed(302_096_000)))
    assert read.identity == "NAV-PVT"
    assert (read.year, read.month, read.day, read.hour, read.min, read.second) == PVT.date
    assert (read.validDate, read.validTime, read.gnssFixOk, read.fixType, read.numSV) == (1, 1, 1, 3, 9)
    assert (read.nano, read.iTOW) == (PVT.nano, 302_096_000)
    assert read.lon == pytest.approx(-123.456789)
    assert read.lat == pytest.approx(45.6789012)
    assert (read.height, read.hAcc, read.vAcc, read.sAcc) == (500_123_456, 2_500, 4_000, 55)
    assert (read.velN, read.velE, read.velD) == PVT.velocity
    assert read.gSpeed == pytest.approx(7_499_709, abs=100)


def test_our_driver_reads_what_another_author_builds() -> None:
    date = {"year": 2026, "month": 11, "day": 23, "hour": 1, "min": 2, "second": 3}
    fix = {"fixType": 3, "gnssFixOk": 1, "validDate": 1, "validTime": 1, "numSV": 7}
    place = {"lon": 12.5, "lat": -80.25, "height": 550_000_000, "velN": 100, "velE": -200, "velD": 300}
    built = UBXMessage("NAV", "NAV-PVT", 0, **date, **fix, **place)
    [(kind, payload, behind)] = UbxParser().feed(built.serialize())
    read = unpack_pvt(payload)
    assert (kind, behind) == (NAV_PVT, 0)
    assert (read.date, read.satellites) == ((2026, 11, 23, 1, 2, 3), 7)
    assert (read.longitude, read.latitude, read.height) == (125_000_000, -802_500_000, 550_000_000)
    assert read.velocity == (100, -200, 300)


def test_a_command_is_what_another_author_builds() -> None:
    built = UBXMessage("CFG", "CFG-MSG", 1, msgClass=1, msgID=7, rateUART1=1)
    ours = frame(CFG_MSG, bytes((*NAV_PVT, 1)))
    assert ours[:6] == SYNC + b"\x06\x01\x03\x00"  # short message form: class, identifier and rate
    assert built.serialize()[6:8] == ours[6:8]
    assert UBXReader.parse(ours, msgmode=1).identity == "CFG-MSG"


@given(st.binary(max_size=300), st.integers(1, 60), st.binary(max_size=40))
def test_a_good_frame_is_found_behind_any_noise_in_pieces_of_any_size(
    noise: bytes, piece: int, behind: bytes
) -> None:
    parser = UbxParser(longest=120)
    sound = frame(NAV_PVT, PVT.packed())
    # A false start of a packet waits for more bytes. The zeros complete each false packet.
    data = noise + sound + behind + bytes(140)
    found = [kind for at in range(0, len(data), piece) for kind, _, _ in parser.feed(data[at : at + piece])]
    assert NAV_PVT in found
    assert parser.bytes_received == len(data)


@given(st.integers(0, 99), st.integers(1, 255))
def test_a_frame_with_one_wrong_byte_is_never_accepted(at: int, mask: int) -> None:
    sound = frame(NAV_PVT, PVT.packed())
    broken = bytearray(sound)
    broken[at] ^= mask
    assert [kind for kind, _, _ in UbxParser().feed(bytes(broken) + bytes(300)) if kind == NAV_PVT] == []
    assert checksum(sound[2:-2]) == sound[-2:]
