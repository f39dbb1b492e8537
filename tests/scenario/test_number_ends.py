"""Tests that no telemetry value can end a run: counters wrap around, and values out of range are reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flight.link.telemetry.definitions import PACKETS, Field, Packet
from flight.link.telemetry.log import Recorder
from flight.link.telemetry.packets import to_text
from flight.loop.executive import RateGroup
from flight.loop.facts import FACTS
from flight.schema import reader as configuration
from flight.schema.sections import Commands, CommandStep
from ground.telemetry import Run
from tests.scenario.object_flights import flight_with_objects, two_objects
from tests.scenario.orbit_flights import orbit_config, world
from tests.support.flights import Rigged, demo_config, event_names, fly

NEAR = (1 << 32) - 30
"""Initial value of counters that exceed 32 bits within one second of control cycles."""
FEW_LEFT = (1 << 32) - 3
"""Initial value of counters that count slowly and exceed 32 bits during the run."""
SLEWS = 64_535
"""Initial number of commanded slews, close to the end of its 16-bit range."""

_OF_OBJECTS = {"sightings", "track"}
"""Packets of a flight with objects in its field of view."""

Driven = dict[tuple[str, str], bool]


def end_of(field: Field) -> int:
    """Return one more than the largest number of an integer field."""
    return int(np.iinfo(field.kind).max) + 1


def whole(packet: Packet) -> list[Field]:
    return [field for field in packet.fields if field.kind[0] in "ui"]


def drive(monkeypatch: pytest.MonkeyPatch) -> Driven:
    """Make the log write an additional record for each integer field, in which this field is out of range."""
    driven: Driven = {}
    for name in ("record", "time"):
        plain = getattr(Recorder, name)

        def both(
            self: Recorder, packet: Packet, time_ns: int, plain: Any = plain, **values: Any
        ) -> bytes | None:
            for field in whole(packet):
                if (packet.name, field.name) not in driven:
                    before = self.lost
                    past = {field.name: end_of(field) + values[field.name]}
                    plain(self, packet, time_ns, **{**values, **past})
                    driven[packet.name, field.name] = self.lost == before
            result: bytes | None = plain(self, packet, time_ns, **values)
            return result

        monkeypatch.setattr(Recorder, name, both)
    return driven


def assert_survived(run: Run, driven: Driven, written: set[str]) -> None:
    """Assert that values out of range ended no task, and that all of them were counted and reported."""
    due = {(p.name, f.name): f.wraps for p in PACKETS if p.name in written for f in whole(p)}
    assert {key: kept for key, kept in driven.items() if key[0] in written} == due
    assert "task-failed" not in event_names(run)
    assert "record-lost" in event_names(run)
    lost = sum(not kept for kept in driven.values())
    assert run["housekeeping"]["records_lost"][-1] == lost


def test_every_integer_of_the_testbed_may_exceed_its_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = drive(monkeypatch)
    config = configuration.replace(
        demo_config(7.0), commands=Commands(timeline=(CommandStep(at=1.0, slew=0.1),))
    )
    run = fly(config, tmp_path)
    elsewhere = {
        "spin",
        "navigation",
        "fix",
        "gps_link",
        "directions",
        "separate_attitudes",
        "lens",
        "power",
        "true_power",
        "truth",
        "orbit_truth",
        "link",
        "verification",
        "transfer",
        "workload",
        *_OF_OBJECTS,
    }
    assert_survived(run, driven, {packet.name for packet in PACKETS} - elsewhere)


def test_every_integer_of_the_track_of_an_object_may_exceed_its_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = drive(monkeypatch)
    run = flight_with_objects(tmp_path, two_objects(), duration=5.5)
    assert_survived(run, driven, _OF_OBJECTS)


def test_every_integer_of_an_orbit_may_exceed_its_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = drive(monkeypatch)
    run = fly(configuration.replace(orbit_config(4.0), camera=None), tmp_path, section=world(0.1))
    assert_survived(run, driven, {"spin", "navigation"})


def test_counts_of_ten_years_neither_end_the_flight_nor_its_slews(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counters with the values of ten years of flight do not end the flight or its slews.

    In three seconds each counter exceeds 32 bits, and slew numbers reach 65,535 or more.
    """
    begin = RateGroup.begin

    def late(group: RateGroup, epoch_ns: int) -> None:
        begin(group, epoch_ns - NEAR * group.period_ns)
        group.claim(epoch_ns - 1)
        group.cycles = group.completed = group.slips = group.overruns = NEAR

    def count(rigged: Rigged) -> None:
        services = rigged.loop._services
        services.events.count = FEW_LEFT
        monkeypatch.setattr(rigged.loop._tasks.modes, "_commands", SLEWS - 1)
        rigged.loop._tasks.health._fed = FEW_LEFT

    monkeypatch.setattr(RateGroup, "begin", late)
    slews = (CommandStep(at=1.0, slew=0.1), CommandStep(at=2.0, slew=0.2))
    config = configuration.replace(demo_config(3.2, camera=False), commands=Commands(timeline=slews))
    run = fly(config, tmp_path, prepare=count)
    assert not {"task-failed", "record-lost", "no-progress"} & set(event_names(run))
    assert run["target"]["index"].tolist()[1:] == [1000 + SLEWS, 1001 + SLEWS]
    assert run["plan"]["target_q2"].tolist()[-1] == 0.2
    cycles = run["control"]["cycle"].astype(np.int64)
    assert cycles[0] < 1 << 32 <= cycles[-1]
    assert (np.diff(cycles) == 1).all()
    assert run["rate_group"]["cycles"].min() < 1000, "documented to wrap"
    assert run["health"]["fed"][-1] < 1000
    assert run["housekeeping"]["events"][-1] < 1000
    assert np.diff(run["housekeeping"]["time_ns"]).max() == 1_000_000_000
    assert to_text(run["event"]["name"][-1]) == "stopped"


def test_facts_fit_their_field() -> None:
    assert len(FACTS) <= 64
