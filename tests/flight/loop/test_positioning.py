"""Tests that positioning records the counters of the GPS line and reports the causes of missing fixes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flight.link.telemetry.definitions import GPS_LINK, Packet
from flight.link.telemetry.log import Recorder
from flight.loop.body import FixVerdict
from flight.loop.facts import EventLog, Facts, FlightClock, Services, Streams
from flight.loop.navigation import GPS_DELAY_NS, Positioning
from hal.interfaces.devices import GpsLink, GpsReading
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
