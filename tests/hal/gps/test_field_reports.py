"""Tests with the output of real receivers: unresolved time, week rollover, refusals, other protocols."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyubx2 import UBXReader

from hal.drivers.gps import (
    ACK_NAK,
    AIRBORNE_4G,
    CFG_MSG,
    CFG_PRT,
    CFG_VALSET,
    NAV_PVT,
    ROLLOVER_NS,
    UART1,
    UART2,
    USB,
    Kind,
    Pvt,
    UbloxReceiver,
    UbxParser,
    frame,
    legacy_set_up,
    reading_of,
    unpack_pvt,
    valset,
)
from hal.interfaces.devices import GpsReading
from hal.interfaces.errors import OutOfRange
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock
from tests.hal.gps.bench_line import PVT, bench

INPUTS = Path(__file__).resolve().parents[4] / "shared/data/inputs"
needs_inputs = pytest.mark.skipif(
    not INPUTS.is_dir(), reason="the inputs of ../shared/data/inputs are missing"
)
NAV_SAT: Kind = (0x01, 0x35)


class OneWayPort:
    """Serial port that delivers one portion of the given bytes per poll, and stores the bytes sent to it."""

    def __init__(self, pieces: Iterable[bytes], clock: SimClock) -> None:
        self.baud_rate = 115200
        self.sent = b""
        self._pieces, self._clock = iter(pieces), clock

    def receive(self) -> list[tuple[int, bytes]]:
        data = next(self._pieces, b"")
        return [(self._clock.now_ns(), data)] if data else []

    def send(self, data: bytes) -> None:
        self.sent += data

    def set_baud_rate(self, baud_rate: int) -> None:
        self.baud_rate = baud_rate

    def close(self) -> None:
        pass


def received(pieces: list[bytes], step: float = 0.1) -> tuple[list[GpsReading], UbloxReceiver, OneWayPort]:
    """Return the readings of a driver that polls once per portion, the driver itself, and its port."""
    clock = SimClock()
    port = OneWayPort(pieces, clock)
    driver = UbloxReceiver(port, clock)
    readings = []
    for _ in pieces:
        clock.sleep_until_ns(clock.now_ns() + round(step * SECOND_NS))
        readings += driver.poll()
    return readings, driver, port


def utc(reading: GpsReading) -> datetime:
    return datetime.fromtimestamp(reading.utc_ns / SECOND_NS, UTC)


@needs_inputs
def test_the_solutions_of_the_reports_are_read_as_they_should() -> None:
    def only(name: str) -> tuple[GpsReading, UbloxReceiver]:
        [reading], driver, _ = received([(INPUTS / f"{name}.ubx").read_bytes()])
        return reading, driver

    reading, driver = only("pvt-unresolved")
    assert (reading.valid, driver.link().unresolved) == (False, 1)
    assert "leap seconds" in driver.link().condition
    reading, driver = only("pvt-invalidllh")
    assert (reading.valid, driver.link().no_fix) == (False, 1)
    assert "flags3 0x0001" in driver.link().condition
    reading, driver = only("pvt-rollover")
    assert (reading.valid, reading.rolled_over, utc(reading)) == (
        True,
        True,
        datetime(2026, 11, 17, 12, tzinfo=UTC),
    )
    assert driver.link().rolled_over == 1
    reading, driver = only("pvt-84")
    assert (reading.valid, utc(reading)) == (True, datetime(2026, 11, 17, 12, tzinfo=UTC))
    assert (driver.link().condition, driver.link().bad_checksum) == ("", 0)


@needs_inputs
def test_a_refused_message_leads_to_the_other_configuration() -> None:
    _, driver, port = received([b"", (INPUTS / "m10-nak.ubx").read_bytes()])
    assert frame(CFG_MSG, bytes((*NAV_PVT, 1))) in port.sent
    assert port.sent.endswith(frame((0x0A, 0x04)))
    assert valset(115200, SECOND_NS) in port.sent
    assert driver.link().refused == 1
    assert (
        "refused CFG-MSG (ACK-NAK, protocol version unknown): versions from 27 on need CFG-VALSET"
        in driver.link().refusal
    )


@needs_inputs
@pytest.mark.parametrize("piece", [1, 13, 64, 5000])
def test_long_frames_are_skipped_whole(piece: int) -> None:
    long, sound = (INPUTS / "ubx-long.ubx").read_bytes(), frame(NAV_PVT, PVT.packed())
    data = sound + long + sound + long
    readings, driver, _ = received([data[at : at + piece] for at in range(0, len(data), piece)], 1e-4)
    link = driver.link()
    assert len(readings) == 2
    assert (link.frames, link.long_frames, link.bad_checksum, link.discarded_bytes) == (4, 2, 0, 0)


@pytest.mark.parametrize("length", [257, 1500, 4000])
def test_a_long_frame_may_hold_the_sync_bytes(length: int) -> None:
    payload = (b"\xb5\x62" * length)[:length]
    parser, sound = UbxParser(), frame(NAV_PVT, PVT.packed())
    data = frame(NAV_SAT, payload) + sound
    kinds = [kind for at in range(0, len(data), 50) for kind, _, _ in parser.feed(data[at : at + 50])]
    assert kinds == [NAV_SAT, NAV_PVT]
    assert parser.discarded_bytes == 0


def test_a_false_length_delays_no_frame_by_more_than_a_frame() -> None:
    parser, sound = UbxParser(), frame(NAV_PVT, PVT.packed())
    broken = sound[:4] + (6000).to_bytes(2, "little") + sound[6:]
    assert parser.feed(broken) == []
    assert [kind for kind, _, _ in parser.feed(sound)] == [NAV_PVT]
    assert parser.discarded_bytes == len(broken)


@pytest.mark.parametrize(
    ("change", "valid"),
    [
        ({}, True),
        ({"valid": 0b110}, False),
        ({"valid": 0b101}, False),
        ({"valid": 0b011}, False),
        ({"valid": 0b1111}, True),
        ({"flags": 0b1000_0010}, False),
        ({"flags": 0b1100_0001}, True),
        ({"flags3": 0x0001}, False),
        ({"flags3": 0x4000}, True),
        *(({"fix": kind}, False) for kind in (0, 1, 2, 4, 5)),
    ],
)
def test_every_validity_flag_counts(change: dict[str, Any], valid: bool) -> None:
    assert reading_of(unpack_pvt(replace(PVT, **change).packed()), 0, 115200).valid is valid


@pytest.mark.parametrize("accuracy", [0, 0xFFFF_FFFF])
def test_an_unknown_accuracy_is_not_a_perfect_one(accuracy: int) -> None:
    assert math.isnan(reading_of(replace(PVT, horizontal=accuracy), 0, 115200).sigma)
    assert math.isnan(reading_of(replace(PVT, vertical=accuracy), 0, 115200).sigma)
    assert math.isnan(reading_of(replace(PVT, speed_accuracy=accuracy), 0, 115200).velocity_sigma)
    assert reading_of(PVT, 0, 115200).sigma == pytest.approx(math.hypot(2.5, 4.0) / 3**0.5)


@pytest.mark.parametrize("when", [datetime(2026, 11, 26, 10), datetime(2038, 11, 25), datetime(2045, 1, 1)])
def test_a_date_of_the_former_epoch_is_moved(when: datetime) -> None:
    old = when - timedelta(weeks=1024)
    date = (old.year, old.month, old.day, old.hour, old.minute, old.second)
    reading = reading_of(replace(PVT, date=date, nano=0), 0, 115200)
    assert utc(reading) == when.replace(tzinfo=UTC)
    now = (when.year, when.month, when.day, when.hour, when.minute, when.second)
    assert reading_of(replace(PVT, date=now, nano=0), 0, 115200).utc_ns == reading.utc_ns
    earliest_ns = reading.utc_ns - SECOND_NS
    assert reading_of(replace(PVT, date=now, nano=0), 0, 115200, earliest_ns).rolled_over is False


@pytest.mark.parametrize("year", [1980, 1999, 2046, 2099])
def test_a_date_that_no_rollover_explains_is_refused(year: int) -> None:
    with pytest.raises(OutOfRange, match=rf"year = {year}.*2026.*2045"):
        reading_of(replace(PVT, date=(year, 3, 1, 0, 0, 0)), 0, 115200)
    assert ROLLOVER_NS == 1024 * 7 * 86_400 * SECOND_NS


@pytest.mark.parametrize(
    ("date", "name"),
    [
        ((0, 1, 1, 0, 0, 0), "year = 0"),
        ((2026, 13, 1, 0, 0, 0), "month = 13"),
        ((2026, 2, 29, 0, 0, 0), "day = 29"),
        ((2028, 2, 30, 0, 0, 0), "day = 30"),
        ((2026, 3, 1, 24, 0, 0), "hour = 24"),
        ((2026, 3, 1, 23, 60, 0), "minute = 60"),
        ((2026, 3, 1, 23, 59, 61), "second = 61"),
    ],
)
def test_the_impossible_part_of_a_date_is_named(date: tuple[int, int, int, int, int, int], name: str) -> None:
    with pytest.raises(OutOfRange, match=name):
        reading_of(replace(PVT, date=date), 0, 115200)


def test_a_leap_second_is_the_first_second_of_the_next_minute() -> None:
    leap = reading_of(replace(PVT, date=(2035, 6, 30, 23, 59, 60), nano=0), 0, 115200)
    assert utc(leap) == datetime(2035, 7, 1, tzinfo=UTC)


@pytest.mark.parametrize("protocol", [14.0, 18.0, 27.12, 32.0, 34.1])
def test_each_generation_is_set_up_at_once(protocol: float) -> None:
    gps = bench()
    gps.gps.protocol = protocol
    assert sum(reading.valid for reading in gps.fly(4.0)) >= 2
    link = gps.driver.link()
    assert link.protocol == pytest.approx(protocol)
    assert (link.refused > 0) is (protocol >= 27.0)
    gps.gps.switch_off()
    gps.gps.switch_on(gps.clock.now_ns())
    refused = link.refused
    gps.fly(60.0)
    assert gps.fly(2.0)[-1].valid
    assert gps.driver.link().refused == refused, "the version is known by now"


@pytest.mark.parametrize(("port", "name"), [(UART1, "UART1"), (UART2, "UART2"), (USB, "USB")])
def test_the_configuration_by_values_is_what_another_author_reads(port: int, name: str) -> None:
    data = valset(38400, 2 * SECOND_NS, port)
    values, model = (
        UBXReader.parse(frame(kind, body), msgmode=1) for kind, body, _ in UbxParser().feed(data)
    )
    for read in (values, model):
        assert (read.identity, read.version, read.ram, read.bbr, read.flash) == ("CFG-VALSET", 0, 1, 0, 0)
    expected = {
        f"CFG_{name}INPROT_UBX": 1, f"CFG_{name}OUTPROT_UBX": 1, f"CFG_{name}OUTPROT_NMEA": 0,
        f"CFG_MSGOUT_UBX_NAV_PVT_{name}": 1, "CFG_RATE_MEAS": 2000, "CFG_RATE_NAV": 1, "CFG_RATE_TIMEREF": 1,
    } | ({} if port == USB else {f"CFG_{name}_BAUDRATE": 38400})  # fmt: skip
    assert settings_of(values) == expected
    assert settings_of(model) == {"CFG_NAVSPG_DYNMODEL": 8}


def settings_of(message: Any) -> dict[str, Any]:
    """Return the settings of a CFG-VALSET message, named as in the interface description."""
    return {name: value for name, value in vars(message).items() if name.startswith("CFG_")}


@pytest.mark.parametrize(("port", "mode"), [(UART1, (38400, 3, 4)), (USB, (0, 0, 0))])
def test_the_older_configuration_is_what_another_author_reads(port: int, mode: tuple[int, ...]) -> None:
    found = UbxParser().feed(legacy_set_up(38400, 2 * SECOND_NS, port))
    uart, rate, message, model = (UBXReader.parse(frame(kind, body), msgmode=1) for kind, body, _ in found)
    assert uart.portID == port
    if port != USB:
        assert (uart.baudRate, uart.charLen, uart.parity) == mode
    assert (uart.inUBX, uart.inNMEA, uart.outUBX, uart.outNMEA) == (1, 0, 1, 0)
    assert (rate.measRate, rate.navRate, rate.timeRef) == (2000, 1, 1)
    assert (message.msgClass, message.msgID) == NAV_PVT
    assert (model.dyn, model.minEl, model.posFixMode, model.dynModel) == (1, 0, 0, 8)


@pytest.mark.parametrize("protocol", [18.0, 32.0, 34.0])
@pytest.mark.parametrize("ports", [(UART1,), (UART2, UART1), (USB, UART1, UART2)])
def test_fixes_are_enabled_on_the_port_in_use(protocol: float, ports: tuple[int, ...]) -> None:
    """Only an M10 does not report its port, and an M10 has only UART 1."""
    gps = bench()
    gps.gps.protocol, gps.gps.ports = protocol, ports if protocol < 34.0 else (UART1,)
    assert sum(reading.valid for reading in gps.fly(10.0)) >= 8
    gps.gps.switch_off()
    gps.gps.switch_on(gps.clock.now_ns())
    refused = gps.driver.link().refused
    gps.fly(35.0)
    assert sum(reading.valid for reading in gps.fly(5.0)) >= 4
    assert gps.driver.link().refused == refused


def test_a_receiver_whose_dynamic_model_does_not_suit_an_orbit_has_no_fix() -> None:
    gps = bench()
    assert gps.fly(4.0)[-1].valid
    gps.gps._model = 0
    assert not gps.fly(2.0)[-1].valid


def sentence(text: str) -> bytes:
    total = 0
    for byte in text.encode("ascii"):
        total ^= byte
    return f"${text}*{total:02X}\r\n".encode("ascii")


@pytest.mark.parametrize(
    ("piece", "named"),
    [
        (b"", "no byte received: check power"),
        (sentence("GNRMC,120000.00,A,5122.7,S,07409.4,W,0.0,,171126,,,A"), "NMEA sentences but no UBX frame"),
        (bytes(range(0x80, 0xF0)), "bytes but neither UBX frames nor NMEA sentences at 115200 baud"),
        (frame(NAV_SAT, bytes(20)), "UBX frames but no NAV-PVT: the request was not answered"),
        (frame(ACK_NAK, bytes(CFG_MSG)), "UBX frames but no NAV-PVT: the receiver refused CFG-MSG"),
        (
            frame(NAV_PVT, replace(PVT, fix=2).packed()),
            "no valid fix (fixType 2, flags 0x01, flags3 0x0000, 9",
        ),
        (frame(NAV_PVT, replace(PVT, latitude=910_000_000).packed()), "latitude = 91"),
        (frame(NAV_PVT, PVT.packed()), ""),
    ],
)
def test_the_cause_of_missing_fixes_is_named(piece: bytes, named: str) -> None:
    _, driver, _ = received([piece] * 50)
    condition = driver.link().condition
    assert named in condition
    assert (condition == "") is (named == "")
    assert driver.link().sentences == (50 if piece.startswith(b"$") else 0)


def test_a_receiver_that_does_not_obey_is_named_on_the_wire() -> None:
    gps = bench()
    gps.gps.obeys = False
    assert gps.fly(10.0) == []
    assert "NMEA sentences but no UBX frame" in gps.driver.link().condition


@pytest.mark.parametrize("protocol", [18.0, 32.0])
@pytest.mark.parametrize("factory", [9600, 38400])
def test_a_receiver_at_its_factory_baud_rate_is_found_and_set_to_the_configured_one(
    protocol: float, factory: int
) -> None:
    gps = bench()
    gps.gps.protocol, gps.line.device.baud_rate = protocol, factory
    gps.fly(9.0)
    assert "neither UBX frames nor NMEA sentences at 115200 baud" in gps.driver.link().condition
    gps.fly(30.0)
    assert (gps.line.device.baud_rate, gps.line.host.baud_rate) == (115200, 115200)
    assert sum(reading.valid for reading in gps.fly(5.0)) >= 4
    assert gps.driver.link().condition == ""


@pytest.mark.parametrize("protocol", [18.0, 23.0, 27.0, 32.0])
@pytest.mark.parametrize("ports", [(UART2, UART1), (UART2,)])
def test_a_receiver_at_another_baud_rate_is_changed_on_the_port_in_use(
    protocol: float, ports: tuple[int, ...]
) -> None:
    gps = bench()
    gps.gps.protocol, gps.gps.ports, gps.line.device.baud_rate = protocol, ports, 9600
    gps.fly(60.0)
    assert (gps.line.device.baud_rate, gps.line.host.baud_rate) == (115200, 115200)
    assert sum(reading.valid for reading in gps.fly(4.0)) >= 3


def test_a_receiver_that_does_not_obey_is_named_with_its_baud_rate() -> None:
    gps = bench()
    gps.gps.obeys, gps.line.device.baud_rate = False, 9600
    gps.fly(12.5)
    assert gps.driver.link().sentences > 0
    gps.fly(8.0)
    assert "the receiver sends at 9600 baud and does not change to 115200 baud" in gps.driver.link().condition


@pytest.mark.parametrize("fixes", [False, True])
def test_a_receiver_that_refuses_each_command_is_named_and_used_at_its_own_baud_rate(
    fixes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    gps, commands = bench(), list[Kind]()

    def refuse(kind: Kind, payload: bytes, now_ns: int) -> None:
        commands.append(kind)
        gps.line.device.write(frame(ACK_NAK, bytes(kind)), now_ns)

    monkeypatch.setattr(gps.gps, "_execute", refuse)
    gps.line.device.baud_rate, gps.gps._enabled, gps.gps._model = 9600, fixes, AIRBORNE_4G
    readings = gps.fly(90.0)
    link = gps.driver.link()
    problem = "the receiver sends at 9600 baud and does not change to 115200 baud: set `gps.baud_rate: 9600`"
    assert problem in link.condition
    assert problem in link.refusal
    assert {CFG_PRT, CFG_VALSET} == set(commands)
    assert len(commands) <= 9, "a refused baud rate is not commanded again at once"
    assert sum(reading.valid for reading in readings) == (80 if fixes else 0)
    gps.gps._enabled = False
    gps.fly(4.0)
    assert gps.line.host.baud_rate != 9600, "without fixes the driver listens at the configured baud rate"


def test_noise_on_the_line_does_not_lose_the_receiver() -> None:
    gps = bench()
    assert gps.fly(4.0)[-1].valid
    faults = gps.line.to_host.faults
    gps.line.to_host.faults = replace(faults, garbage=True)
    gps.fly(47.0)
    gps.line.to_host.faults = faults
    gps.fly(8.0)
    assert sum(reading.valid for reading in gps.fly(5.0)) >= 4
    assert gps.line.host.baud_rate == gps.line.device.baud_rate == 115200


@given(st.binary(min_size=84, max_size=92).filter(lambda data: len(data) in {84, 92}))
def test_any_solution_is_read_or_refused_by_name(payload: bytes) -> None:
    readings, driver, _ = received([frame(NAV_PVT, payload)])
    link = driver.link()
    assert len(readings) + link.out_of_range == 1
    if readings:
        assert np.all(np.isfinite(readings[0].position))
        assert np.all(np.isfinite(readings[0].velocity))
    else:
        assert "range" in link.condition or "=" in link.condition


@given(st.integers(0, 27), st.integers(0, 2**32 - 1))
def test_one_changed_field_of_a_solution_never_gives_an_impossible_reading(which: int, value: int) -> None:
    payload = bytearray(PVT.packed())
    at = min(4 * which, 88)
    payload[at : at + 4] = value.to_bytes(4, "little")
    pvt: Pvt = unpack_pvt(bytes(payload))
    try:
        reading = reading_of(pvt, 0, 115200)
    except OutOfRange:
        return
    assert 6.3e6 < np.linalg.norm(reading.position) < 9.4e6
    assert np.linalg.norm(reading.velocity) <= 12_000.0
    assert not reading.valid or 2026 <= utc(reading).year <= 2045
