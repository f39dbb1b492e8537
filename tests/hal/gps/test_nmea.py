"""Tests of the NMEA driver with sentences of a real receiver, damaged sentences, and the emulator."""

from __future__ import annotations

import math
from functools import reduce
from operator import xor

import numpy as np
import pytest

from hal.drivers.gps import NmeaReceiver
from hal.interfaces.devices import GpsReading
from sim_hal.clock import SimClock

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


def test_text_instead_of_numbers_is_refused() -> None:
    readings, driver = read(rmc(), sentence("GNGGA,120000.00,north,N,01215.0,E,1,09,1.0,1.0,M,0.0,M,,"))
    assert readings == []
    assert driver.link().out_of_range == 1
