"""Tests that positioning records the counters of the GPS line and reports the causes of missing fixes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flight.link.telemetry.definitions import FIX, GPS_LINK, Packet
from flight.link.telemetry.log import Recorder
from flight.loop.body import FixVerdict
from flight.loop.facts import EventLog, Facts, FlightClock, Services, Streams
from flight.loop.navigation import GPS_DELAY_NS, Positioning
from hal.interfaces.devices import GpsLink, GpsReading
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS
from sim_hal.clock import SimClock

UTC_NS = 1_800_000_000 * SECOND_NS
LINK = GpsLink(1000, 10, 2, 0, 50, 0, 0, 0, 0, 0, 0, "", 18.0, "", 0)


class Sink:
    def write(self, packet: bytes) -> None:
        pass


class KeepingRecorder(Recorder):
    """Recorder that keeps the values of each packet which the packer accepts."""

    def __init__(self) -> None:
        super().__init__(Sink(), Sink())
        self.kept: list[dict[str, Any]] = []

    def record(self, packet: Packet, time_ns: int, **values: Any) -> bytes | None:
        if packet is GPS_LINK:
            self.kept.append(values)
        return super().record(packet, time_ns, **values)


class Receiver:
    """Receiver with given counters, which delivers no reading or one reading each second."""

    def __init__(self) -> None:
        self.counters = LINK
        self.readings: list[GpsReading] = []

    def poll(self) -> list[GpsReading]:
        return self.readings

    def link(self) -> GpsLink:
        return self.counters

    def close(self) -> None:
        pass


class Bench:
    def __init__(self) -> None:
        self.texts: dict[str, list[str]] = {}
        self.receiver = Receiver()
        self.recorder = KeepingRecorder()
        events = EventLog(lambda kind, _1, _2, text: self.texts.setdefault(kind.name, []).append(text), 0)
        self.clock = FlightClock(SimClock(UTC_NS))
        services = Services(self.clock, None, self.recorder, events, Facts(events), Streams(()))  # type: ignore[arg-type]  # no jobs
        self.verdict = FixVerdict()
        self.positioning = Positioning(self.receiver, lambda _: self.verdict, 60 * SECOND_NS, services)
        self.positioning.begin(0)
        self._now_ns = 0

    def run(self, seconds: int, **changes: object) -> None:
        """Run the task once a second. From the present time on, the counters have the values `changes`."""
        self.receiver.counters = replace(self.receiver.counters, **changes)  # type: ignore[arg-type]
        for _ in range(seconds):
            self._now_ns += SECOND_NS
            self.positioning.run(self._now_ns)


def test_refusals_damage_and_moved_dates_are_events() -> None:
    bench = Bench()
    bench.run(2)
    assert bench.texts == {}
    bench.run(2, refused=1, refusal="the receiver refused CFG-MSG")
    assert bench.texts == {"gps-set-up": ["the receiver refused CFG-MSG"]}
    bench.run(1, bad_checksum=5, out_of_range=1, condition="latitude = 91")
    bench.run(1, rolled_over=1, condition="")
    bench.run(1, rolled_over=2)
    assert bench.texts["gps-link"] == [
        "5 frames with a wrong checksum, 1 solutions out of range: latitude = 91",
        "1 dates moved by 1024 weeks",
    ]


def test_the_event_of_a_lost_receiver_names_the_cause() -> None:
    bench = Bench()
    bench.run(70, condition="bytes but neither UBX frames nor NMEA sentences at 9600 baud")
    assert bench.texts["gps-lost"][0].startswith("no usable fix for 61 s: bytes but neither UBX")


def test_the_counters_are_recorded_every_ten_seconds() -> None:
    bench = Bench()
    bench.run(1, sentences=7, no_fix=3)
    bench.run(9, sentences=8)
    [first] = bench.recorder.kept
    assert (first["sentences"], first["no_fix"], first["frames"], first["protocol"]) == (7, 3, 10, 18.0)
    bench.run(1)
    assert bench.recorder.kept[1]["sentences"] == 8
    assert bench.recorder.lost == 0


def test_a_fix_that_is_not_valid_is_not_offered_to_the_body() -> None:
    bench = Bench()
    zero = np.zeros(3)
    bench.receiver.readings = [GpsReading(0, 0, 0, zero, zero, 1.0, 1.0, 9, False)]
    bench.verdict = FixVerdict(refusal="offered")
    bench.run(3)
    assert "gps-refused" not in bench.texts


def test_only_a_refused_fix_is_an_event_which_names_the_reason() -> None:
    bench = Bench()
    velocity = np.array([7e3, 0.0, 0.0])
    bench.receiver.readings = [GpsReading(0, 0, UTC_NS, np.zeros(3), velocity, 1.0, 1.0, 9, True)]
    bench.run(3)
    assert "gps-refused" not in bench.texts, "the fix waits for further fixes"
    bench.verdict = FixVerdict(refusal="the fix contradicts the orbit elements")
    bench.run(1)
    assert bench.texts["gps-refused"] == ["the fix contradicts the orbit elements; 9 satellites"]


@pytest.mark.parametrize("off", [-86_400.0, -1.5, -0.4, 0.9, 3600.0])
def test_the_receiver_corrects_a_clock_that_is_more_than_a_second_off(off: float) -> None:
    bench, zero = Bench(), np.zeros(3)
    assert bench.clock.utc_ns() == UTC_NS
    true_ns = UTC_NS - round(off * SECOND_NS)
    bench.receiver.readings = [
        GpsReading(GPS_DELAY_NS, GPS_DELAY_NS, true_ns, zero, np.array([7e3, 0.0, 0.0]), 1.0, 1.0, 9, True)
    ]
    bench.run(2)
    assert bench.clock.utc_ns() == UTC_NS, "the body does not use the fix"
    bench.verdict = FixVerdict(used=True)
    bench.run(2)
    assert bench.clock.utc_ns() == (true_ns if abs(off) > 1.0 else UTC_NS)
    assert ("clock-off" in bench.texts) is (abs(off) > 1.0)
    bench.receiver.readings = []
    bench.clock.sleep_until_ns(100 * SECOND_NS)
    assert bench.clock.utc_ns() - 100 * SECOND_NS == (true_ns if abs(off) > 1.0 else UTC_NS)


def fix(time_ns: int, **changes: object) -> GpsReading:
    """Return a valid fix of a satellite, with its time in ns."""
    position, velocity = np.array([7e6, 1e5, 2e5]), np.array([10.0, 7e3, 3e3])
    made = GpsReading(time_ns, time_ns, UTC_NS + time_ns, position, velocity, 3.0, 0.2, 9, True)
    return replace(made, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(("seconds", "lost"), [(60, False), (61, True)])
def test_a_receiver_is_lost_after_its_age_limit_without_a_usable_fix(seconds: int, lost: bool) -> None:
    bench = Bench()
    bench.run(seconds)
    assert ("gps-lost" in bench.texts) is lost
    later = Bench()
    later.verdict = FixVerdict(used=True)
    later.receiver.readings = [fix(5 * SECOND_NS)]
    later.run(5)
    later.receiver.readings = []
    later.run(seconds)
    assert ("gps-lost" in later.texts) is lost
    refused = Bench()
    refused.receiver.readings = [fix(5 * SECOND_NS)]
    refused.run(seconds)
    assert ("gps-lost" in refused.texts) is lost, "a fix that is not used does not count"


def test_a_receiver_that_does_not_respond_is_lost_at_once() -> None:
    bench = Bench()

    def gone() -> list[GpsReading]:
        raise NotResponding("gps", "unplugged")

    bench.receiver.poll = gone  # type: ignore[method-assign]
    bench.run(1)
    assert "unplugged" in bench.texts["gps-lost"][0]


def test_a_fix_is_recorded_every_ten_seconds_with_its_values_and_the_clock_error() -> None:
    bench = Bench()
    records: list[tuple[int, dict[str, Any]]] = []
    packer = bench.recorder.record

    def record(packet: Packet, time_ns: int, **values: Any) -> bytes | None:
        if packet is FIX:
            records.append((time_ns, values))
        return packer(packet, time_ns, **values)

    bench.recorder.record = record  # type: ignore[method-assign]
    bench.receiver.readings = [fix(1 * SECOND_NS)]
    bench.run(1)
    ((at, first),) = records
    assert at == SECOND_NS
    assert first["utc_ns"] == UTC_NS + SECOND_NS
    assert (first["sigma"], first["velocity_sigma"], first["satellites"], first["used"]) == (
        3.0,
        0.2,
        9,
        False,
    )
    np.testing.assert_array_equal(first["position"], [7e6, 1e5, 2e5])
    np.testing.assert_array_equal(first["velocity"], [10.0, 7e3, 3e3])
    assert np.isnan(first["clock_off"]), "no fix was used yet"
    bench.verdict = FixVerdict(used=True)
    bench.clock.sleep_until_ns(11 * SECOND_NS)
    bench.receiver.readings = [fix(11 * SECOND_NS - 1)]
    bench.run(1)
    assert len(records) == 1
    early = UTC_NS + 11 * SECOND_NS - GPS_DELAY_NS - 400_000_000
    bench.receiver.readings = [fix(11 * SECOND_NS, utc_ns=early)]
    bench.run(1)
    assert len(records) == 2
    assert records[1][1]["used"] is True
    assert abs(records[1][1]["clock_off"]) == pytest.approx(0.4)
    assert bench.recorder.lost == 0
