"""Tests of the GPS receiver in orbit with driver, emulator and line, and tests with an independent client."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import serial
from pyubx2 import UBXReader

from hal.buses.system import SystemClock
from hal.drivers.gps import CFG_MSG, NAV_PVT, Pvt, UbloxReceiver, frame, reading_of
from hal.interfaces.errors import NotResponding, OutOfRange
from hal.interfaces.wires import SECOND_NS
from knightcube.astro.earth.orbit_knowledge import GpsFix
from knightcube.astro.earth.sun import DAY, UNIX_EPOCH
from sim_hal.emulators.gps import EmulatedGps, GpsErrors
from sim_hal.emulators.serial_line import LineFaults, PtyLine
from sim_hal.settings import FreeBodySection
from sim_hal.worlds.free_body import FreeBody
from tests.hal.gps.bench_line import EXACT, bench
from tests.hal.gps.fixes import PVT


def test_a_fix_is_where_the_satellite_was_at_the_epoch() -> None:
    """The position of a fix is that of the satellite at its epoch, within centimetres (protocol resolution).

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
        port.write(frame(CFG_MSG, bytes((*NAV_PVT, 1))))
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
