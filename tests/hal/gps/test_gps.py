"""Tests of the GPS drivers with an independent client, damaged messages, and emulated receivers in orbit."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import reduce
from operator import xor
from typing import Any

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st
from pyubx2 import UBXMessage, UBXReader

from hal.buses.system import SystemClock
from hal.drivers.gps import (
    CFG_MSG,
    NAV_PVT,
    SYNC,
    NmeaReceiver,
    Pvt,
    UbloxReceiver,
    UbxParser,
    checksum,
    frame,
    legacy_set_up,
    reading_of,
    unpack_pvt,
)
from hal.interfaces.devices import GpsReading
from hal.interfaces.errors import NotResponding, OutOfRange
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.earth.orbit_knowledge import GpsFix
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from sim_hal.clock import SimClock
from sim_hal.emulators.gps import EmulatedGps, GpsErrors
from sim_hal.emulators.serial_line import LineFaults, PtyLine
from sim_hal.settings import FreeBodySection
from sim_hal.worlds.free_body import FreeBody
from tests.hal.gps.bench_line import EXACT, PVT, bench


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


def test_a_fix_is_where_the_satellite_was_at_the_epoch() -> None:
    """A fix gives the satellite's position at its epoch, within centimetres (protocol resolution).

    The flight software propagates fixes to later times.
    """
    gps = bench()
    reading = [reading for reading in gps.fly(12.0) if reading.valid][-1]
    fix = GpsFix(UNIX_EPOCH + reading.utc_ns * 1e-9 / DAY, reading.position, reading.velocity)
    gps.body.advance_to(gps.clock.now_ns())
    around = gps.body.surroundings()
    state = fix.at(UNIX_EPOCH + gps.body.utc_ns() * 1e-9 / DAY)
    # A Julian date is resolved to 40 us, which is 0.3 m along the orbit.
    np.testing.assert_allclose(state.position, around.position, atol=1.0)
    np.testing.assert_allclose(state.velocity, around.velocity, atol=5e-3)
    assert reading.utc_ns % SECOND_NS == 0


def test_the_receivers_claims_cover_its_errors() -> None:
    noisy, exact = bench(GpsErrors()), bench()
    pairs = zip(noisy.fly(120.0), exact.fly(120.0), strict=True)
    off = [(one.position - two.position, one.velocity - two.velocity, one) for one, two in pairs if one.valid]
    assert len(off) > 110
    assert np.std([place for place, _, _ in off]) < 3.0 * off[0][2].sigma
    assert np.std([speed for _, speed, _ in off]) == pytest.approx(0.03, rel=0.2)


def test_a_receiver_that_lost_its_power_is_set_up_again() -> None:
    gps = bench(replace(EXACT, start=5.0))
    assert gps.fly(5.0)
    gps.gps.switch_off()
    assert len(gps.fly(4.0)) <= 1
    gps.gps.switch_on(gps.clock.now_ns())
    readings = gps.fly(12.0)
    assert next(reading.valid for reading in readings) is False
    assert readings[-1].valid
    assert gps.driver.link().refused == 0


@pytest.mark.parametrize(
    "faults", [LineFaults(flip_probability=2e-3), LineFaults(garbage=True), LineFaults(cut_probability=0.5)]
)
def test_a_broken_line_gives_no_false_fix(faults: LineFaults) -> None:
    gps, sound = bench(), bench()
    gps.line.to_host.faults = faults
    expected = {reading.utc_ns: reading.position for reading in sound.fly(60.0)}
    readings = gps.fly(60.0)
    assert len(readings) < 55
    assert gps.driver.link().discarded_bytes > 0
    for reading in readings:
        np.testing.assert_array_equal(reading.position, expected[reading.utc_ns])


def test_a_receiver_that_already_sends_fixes_is_set_to_the_configured_period() -> None:
    """A receiver keeps the period of an earlier flight, and its fixes arrive before the driver begins."""
    gps = bench()
    gps.fly(3.0)
    gps.clock.sleep_until_ns(gps.clock.now_ns() + 2 * SECOND_NS)
    gps.driver = UbloxReceiver(gps.line.host, gps.clock, 5 * SECOND_NS)
    assert gps.fly(0.1), "fixes lie in the port"
    epochs = [reading.utc_ns for reading in gps.fly(21.0)][1:]
    assert set(np.diff(epochs)) == {5 * SECOND_NS}


def test_a_fix_is_read_although_the_request_for_the_next_fixes_cannot_be_sent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gps = bench()
    gps.fly(3.0)

    def full(_: bytes) -> None:
        raise NotResponding("line", "the output queue is full")

    monkeypatch.setattr(gps.line.host, "send", full)
    gps.driver._is_due = True
    assert len(gps.fly(1.0)) == 1
    gps.driver._is_due = True
    with pytest.raises(NotResponding, match="queue is full"):
        gps.driver.poll()


def test_each_baud_rate_is_tried_although_the_port_rejects_one() -> None:
    gps, tried = bench(), set[int]()
    gps.line.host.rejected_rate = 9600
    gps.line.to_host.faults = LineFaults(garbage=True)
    for _ in range(600):
        with suppress(NotResponding):
            gps.fly(0.1)
        tried.add(gps.line.host.baud_rate)
    assert {9600, 38400, 57600} <= tried


def test_a_lost_port_is_reported() -> None:
    gps = bench()
    gps.line.host.unplugged = True
    with pytest.raises(NotResponding):
        gps.fly(1.0)


def test_false_place_wrong_clock_and_no_satellites_look_as_they_do_on_a_receiver() -> None:
    gps, sound = bench(), bench()
    gps.gps.shift = np.array([3e3, 0.0, 0.0])
    gps.gps.clock_ns = 120 * SECOND_NS
    false, true = gps.fly(3.0)[-1], sound.fly(3.0)[-1]
    assert false.valid
    assert np.linalg.norm(false.position - true.position) == pytest.approx(3e3, abs=0.1)
    assert false.utc_ns - true.utc_ns == 120 * SECOND_NS
    gps.gps.blind = True
    assert not gps.fly(2.0)[-1].valid


@pytest.mark.parametrize(
    "change",
    [
        {"latitude": 900_000_001},
        {"longitude": -1_800_000_001},
        {"height": -20_000_000},
        {"velocity": (12_000_000, 1_000_000, 0)},
        {"date": (2026, 2, 30, 0, 0, 0)},
    ],
)
def test_an_impossible_epoch_is_refused(change: dict[str, Any]) -> None:
    assert reading_of(PVT, 0, 115200).valid
    broken: Pvt = replace(PVT, **change)
    with pytest.raises(OutOfRange):
        reading_of(broken, 0, 115200)


def test_periods_that_the_receiver_does_not_take_are_refused() -> None:
    with pytest.raises(OutOfRange, match="period"):
        UbloxReceiver(bench().line.host, bench().clock, 50_000_000)


def test_another_authors_client_reads_the_emulated_receiver_on_a_pseudo_terminal() -> None:
    clock = SystemClock()
    start_ns = clock.now_ns()
    body = FreeBody(FreeBodySection(), lambda: np.zeros(3), start_ns=start_ns)
    line = PtyLine(115200, np.random.default_rng(1))
    gps = EmulatedGps(body, line, np.random.default_rng(2), EXACT, start_ns)
    with serial.Serial(line.name, 115200, timeout=0.05) as port:
        port.write(legacy_set_up(115200, SECOND_NS))
        data, deadline = b"", start_ns + 8 * SECOND_NS
        while clock.now_ns() < deadline and data.count(b"\xb5\x62\x01\x07") < 2:
            line.exchange(clock.now_ns())
            body.advance_to(clock.now_ns())
            gps.advance(clock.now_ns())
            data += port.read(4096)
    line.close()
    at = data.index(b"\xb5\x62\x01\x07")
    read = UBXReader.parse(data[at : at + 100])
    assert (read.identity, read.fixType, read.gnssFixOk) == ("NAV-PVT", 3, 1)
    assert 4.5e8 < read.height < 5.5e8
    assert 7.2e6 < np.hypot(read.gSpeed, read.velD) < 8.2e6


DATE = "261126"


def sentence(body: str) -> bytes:
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


def rmc(clock: str = "120000.00", status: str = "A", speed: str = "10.0", course: str = "90.0") -> bytes:
    return sentence(f"GNRMC,{clock},{status},4530.000,N,01215.000,E,{speed},{course},{DATE},,,A")


def gga(clock: str = "120000.00", quality: str = "1", altitude: str = "100.0") -> bytes:
    return sentence(f"GNGGA,{clock},4530.000,N,01215.000,E,{quality},09,1.0,{altitude},M,40.0,M,,")


class Line:
    """A serial port that delivers the bytes which a test gives."""

    baud_rate = 9600

    def __init__(self) -> None:
        self.chunks: list[tuple[int, bytes]] = []

    def receive(self) -> list[tuple[int, bytes]]:
        chunks, self.chunks = self.chunks, []
        return chunks

    def send(self, data: bytes) -> None:
        raise AssertionError("the driver only listens")

    def set_baud_rate(self, baud_rate: int) -> None:
        raise AssertionError("the driver only listens")

    def close(self) -> None:
        """Do nothing, because no file is open."""


def read(*chunks: bytes) -> tuple[list[GpsReading], NmeaReceiver]:
    line = Line()
    driver = NmeaReceiver(line, SimClock())
    line.chunks = [(n * 100_000_000, chunk) for n, chunk in enumerate(chunks, start=1)]
    return driver.poll(), driver


@pytest.mark.parametrize("swapped", [False, True])
def test_two_sentences_of_one_time_make_one_reading_in_any_order(swapped: bool) -> None:
    pair = (gga(), rmc()) if swapped else (rmc(), gga())
    whole = b"noise" + b"".join(pair) + sentence("GNGSV,1,1,00")
    (reading,), driver = read(whole[:20], whole[20:75], whole[75:])
    assert reading.valid
    assert reading.satellites == 9
    assert reading.sigma == pytest.approx(3.0 * math.sqrt(2.0) * math.sqrt(2.0 / 3.0), rel=0.01)
    radius = float(np.linalg.norm(reading.position))
    assert radius == pytest.approx(6_367_500.0 + 140.0, abs=1500.0)
    longitude = math.degrees(math.atan2(reading.position[1], reading.position[0]))
    assert longitude == pytest.approx(12.25, abs=1e-7)
    east = np.array([-math.sin(math.radians(12.25)), math.cos(math.radians(12.25)), 0.0])
    np.testing.assert_allclose(reading.velocity, 5.1444 * east, atol=1e-3)
    assert (driver.link().sentences, driver.link().discarded_bytes) == (3, 5)


def test_the_vertical_velocity_is_the_change_of_the_altitude() -> None:
    second = rmc("120001.00", speed="0.0"), gga("120001.00", altitude="93.0")
    readings, _ = read(rmc(), gga(), *second)
    up = readings[1].position / np.linalg.norm(readings[1].position)
    assert readings[1].velocity @ up == pytest.approx(-7.0, abs=0.05)


def test_the_vertical_velocity_is_uncertain_until_the_second_fix() -> None:
    (first, second), _ = read(rmc(), gga(), rmc("120001.00"), gga("120001.00"))
    assert first.velocity_sigma == pytest.approx(50.0, rel=1e-3)
    assert second.velocity_sigma < 2.0


def test_the_vertical_velocity_is_known_across_midnight() -> None:
    later = rmc("000000.00", speed="0.0"), gga("000000.00", altitude="93.0")
    readings, _ = read(rmc("235959.00"), gga("235959.00"), *later)
    up = readings[1].position / np.linalg.norm(readings[1].position)
    assert readings[1].velocity @ up == pytest.approx(-7.0, abs=0.05)


@pytest.mark.parametrize("behind", [0, 50])
def test_a_reading_has_the_time_at_which_its_first_sentence_began(behind: int) -> None:
    others = sentence("GNGSA,A,3,80,71,73,79,69,,,,,,,,1.83,1.09,1.47") * 5
    driver = NmeaReceiver(line := Line(), SimClock())
    line.chunks.append((SECOND_NS, gga() + others + rmc() + others[:behind]))
    (reading,) = driver.poll()
    sent = len(gga() + others + rmc()) + behind
    assert reading.time_ns == pytest.approx(SECOND_NS - sent * 10 * SECOND_NS // 9600, abs=1)


@pytest.mark.parametrize("quality", ["6", "7", "8"])
def test_a_position_that_was_not_measured_is_not_valid(quality: str) -> None:
    (reading,), driver = read(rmc(), gga(quality=quality))
    assert not reading.valid
    assert driver.link().no_fix == 1


def test_sentences_of_different_times_are_not_combined() -> None:
    readings, _ = read(rmc("120000.00"), gga("120001.00"))
    assert readings == []


def test_a_receiver_without_a_fix_gives_no_valid_reading_and_a_reason() -> None:
    empty = sentence(f"GNRMC,120000.00,V,,,,,,,{DATE},,,N"), sentence("GNGGA,120000.00,,,,,0,00,,,M,,M,,")
    (reading,), driver = read(*empty)
    assert not reading.valid
    assert driver.link().no_fix == 1
    assert "antenna" in driver.link().condition


@pytest.mark.parametrize("index", [1, 10, 30, 60])
def test_a_damaged_sentence_is_counted_and_not_used(index: int) -> None:
    damaged = bytearray(gga())
    damaged[index] ^= 1
    readings, driver = read(rmc(), bytes(damaged), rmc("120001.00"), gga("120001.00"))
    assert len(readings) == 1
    assert driver.link().bad_checksum == 1


def test_a_proprietary_sentence_is_ignored() -> None:
    proprietary = sentence("PGRMC,A,218.8,100,6378137.000,298.257223563,0.0,0.0,0.0,A,3,1,1,4,30")
    readings, _ = read(rmc(), proprietary, gga())
    assert len(readings) == 1


def test_a_sentence_that_lacks_fields_is_not_used() -> None:
    short = sentence("GNGGA,120000.00,4530.000,N,01215.000,E,1,09,1.0,100.0,M")
    readings, _ = read(rmc(), short, rmc("120001.00"), gga("120001.00"))
    assert len(readings) == 1


@pytest.mark.parametrize("latitude", ["north", "inf", "nan", "1e999"])
def test_text_instead_of_numbers_is_refused(latitude: str) -> None:
    readings, driver = read(rmc(), sentence(f"GNGGA,120000.00,{latitude},N,01215.0,E,1,09,1.0,1.0,M,0.0,M,,"))
    assert readings == []
    assert driver.link().out_of_range == 1
