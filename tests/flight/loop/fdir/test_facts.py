"""Facts count after N updates in a row, latch, reset in modes without watch, and report once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flight.link import events
from flight.link.events import EventKind
from flight.link.modes import Mode
from flight.loop.fdir import facts
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import FACTS, Facts, check
from flight.loop.modes.triggers import Trigger
from flight.loop.tasks.mode_control import SAFING_REACTIONS, modes_moved_by
from knightcube.errors import FlightError


class EventRecord:
    """A sink that records events."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.log = EventLog(lambda kind, *_: self.names.append(kind.name), throttle_ns=0)
        self.facts = Facts(self.log)


def state(record: EventRecord, fact: facts.Fact, *statements: bool | None) -> None:
    for holds in statements:
        record.facts.update(fact, holds, 0, "text")


def test_the_table_that_flies_is_sound() -> None:
    check(FACTS, modes_moved_by)


def test_a_fact_counts_after_its_number_of_statements_in_a_row_and_not_before() -> None:
    record = EventRecord()
    record.facts.enter(Mode.HOLD)
    state(record, facts.TUMBLING, *[True] * 7, False, *[True] * 7)
    assert not record.facts.holds(facts.TUMBLING)
    state(record, facts.TUMBLING, True)
    assert record.facts.holds(facts.TUMBLING)
    assert record.names == ["tumbling"]


def test_a_fact_ends_after_its_number_of_statements_with_one_event_each_way() -> None:
    record = EventRecord()
    state(record, facts.IMU_POOR, *[True] * 9)
    state(record, facts.IMU_POOR, *[False] * 7, True, *[False] * 7)
    assert record.facts.holds(facts.IMU_POOR)
    state(record, facts.IMU_POOR, False)
    assert record.names == ["stream-poor", "stream-good"]


def test_what_cannot_be_known_neither_counts_nor_mends() -> None:
    record = EventRecord()
    state(record, facts.DISK_LOW, True, None, True)
    assert record.facts.holds(facts.DISK_LOW)
    state(record, facts.DISK_LOW, False, None, None, False)
    assert not record.facts.holds(facts.DISK_LOW)


def test_a_latched_fact_stays_until_it_is_cleared_by_the_name_of_its_event() -> None:
    record = EventRecord()
    state(record, facts.TOO_HOT, True, True, *[False] * 20)
    assert record.facts.held() == (facts.TOO_HOT,)
    assert not record.facts.clear("hot")
    assert record.facts.clear("too-hot")
    assert record.facts.held() == ()
    assert not record.facts.clear("too-hot"), "there is nothing left to clear"


def test_a_fact_that_is_not_latched_is_not_to_be_cleared_away() -> None:
    record = EventRecord()
    state(record, facts.IMU_SILENT, True)
    assert not record.facts.clear("imu-silent")
    assert record.facts.holds(facts.IMU_SILENT)


def test_in_a_mode_that_does_not_watch_it_a_fact_does_not_count_and_restarts_after() -> None:
    record = EventRecord()
    record.facts.enter(Mode.HOLD)
    state(record, facts.TUMBLING, *[True] * 7)
    record.facts.enter(Mode.SAFE)
    state(record, facts.TUMBLING, *[True] * 50)
    record.facts.enter(Mode.HOLD)
    state(record, facts.TUMBLING, *[True] * 7)
    assert record.names == []
    state(record, facts.TUMBLING, True)
    assert record.names == ["tumbling"]


def test_every_event_beyond_a_note_is_reacted_to_even_while_the_throttle_holds_it_back() -> None:
    reacted: list[tuple[EventKind, str]] = []
    record: list[str] = []
    log = EventLog(lambda kind, *_: record.append(kind.name))
    log.react_by(lambda kind, _, text: reacted.append((kind, text)))
    for text in ("a", "b"):
        log.report(events.CONTROL_LOST, 0, text)
        log.report(events.CYCLE_SLIP, 0, text)
    assert record == ["control-lost", "cycle-slip"]
    assert reacted == [(events.CONTROL_LOST, "a"), (events.CONTROL_LOST, "b")]


@pytest.mark.parametrize(
    ("broken", "problem"),
    [
        ((facts.BLIND, facts.BLIND), "stands twice"),
        ((replace(facts.BLIND, after=0),), "at least 1"),
        ((replace(facts.BLIND, modes=frozenset({Mode.SAFE})),), "does its reaction safe do anything"),
    ],
)
def test_a_table_that_cannot_work_is_refused(broken: tuple[facts.Fact, ...], problem: str) -> None:
    with pytest.raises(FlightError, match=problem):
        check(broken, modes_moved_by)


def test_codes_and_names_of_events_are_each_used_once() -> None:
    assert len({kind.code for kind in events.EVENTS}) == len(events.EVENTS)
    assert len({kind.name for kind in events.EVENTS}) == len(events.EVENTS)
    assert len(FACTS) <= 64, "they are bits of one field in the health packet"


def test_every_safing_event_has_a_trigger() -> None:
    assert {Trigger.REACT_SAFE, Trigger.REACT_HOLD, Trigger.REACT_DETUMBLE} == set(SAFING_REACTIONS.values())
