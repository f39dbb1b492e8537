"""Facts count after N updates in a row, latch, reset in modes without watch, and report once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flight.gnc.errors import FlightError
from flight.link import events
from flight.link.events import EventKind
from flight.link.modes import Mode
from flight.loop.fdir import facts
from flight.loop.fdir.event_log import EventLog
from flight.loop.fdir.facts import FACTS, Facts, check
from flight.loop.modes.triggers import Trigger
from flight.loop.tasks.mode_control import SAFING_REACTIONS, modes_moved_by


class Told:
    """A sink that records events."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.log = EventLog(lambda kind, *_: self.names.append(kind.name), throttle_ns=0)
        self.facts = Facts(self.log)


def state(told: Told, fact: facts.Fact, *statements: bool | None) -> None:
    for holds in statements:
        told.facts.update(fact, holds, 0, "text")


def test_the_table_that_flies_is_sound() -> None:
    check(FACTS, modes_moved_by)


def test_a_fact_counts_after_its_number_of_statements_in_a_row_and_not_before() -> None:
    told = Told()
    told.facts.enter(Mode.HOLD)
    state(told, facts.TUMBLING, *[True] * 7, False, *[True] * 7)
    assert not told.facts.holds(facts.TUMBLING)
    state(told, facts.TUMBLING, True)
    assert told.facts.holds(facts.TUMBLING)
    assert told.names == ["tumbling"]


def test_it_is_over_after_its_number_of_statements_and_told_once_each_way() -> None:
    told = Told()
    state(told, facts.IMU_POOR, *[True] * 9)
    state(told, facts.IMU_POOR, *[False] * 7, True, *[False] * 7)
    assert told.facts.holds(facts.IMU_POOR)
    state(told, facts.IMU_POOR, False)
    assert told.names == ["stream-poor", "stream-good"]


def test_what_cannot_be_known_neither_counts_nor_mends() -> None:
    told = Told()
    state(told, facts.DISK_LOW, True, None, True)
    assert told.facts.holds(facts.DISK_LOW)
    state(told, facts.DISK_LOW, False, None, None, False)
    assert not told.facts.holds(facts.DISK_LOW)


def test_a_latched_fact_stays_until_it_is_cleared_by_the_name_of_its_event() -> None:
    told = Told()
    state(told, facts.TOO_HOT, True, True, *[False] * 20)
    assert told.facts.held() == (facts.TOO_HOT,)
    assert not told.facts.clear("hot")
    assert told.facts.clear("too-hot")
    assert told.facts.held() == ()
    assert not told.facts.clear("too-hot"), "there is nothing left to clear"


def test_a_fact_that_is_not_latched_is_not_to_be_cleared_away() -> None:
    told = Told()
    state(told, facts.IMU_SILENT, True)
    assert not told.facts.clear("imu-silent")
    assert told.facts.holds(facts.IMU_SILENT)


def test_in_a_mode_that_does_not_watch_it_a_fact_does_not_count_and_begins_anew_after() -> None:
    told = Told()
    told.facts.enter(Mode.HOLD)
    state(told, facts.TUMBLING, *[True] * 7)
    told.facts.enter(Mode.SAFE)
    state(told, facts.TUMBLING, *[True] * 50)
    told.facts.enter(Mode.HOLD)
    state(told, facts.TUMBLING, *[True] * 7)
    assert told.names == []
    state(told, facts.TUMBLING, True)
    assert told.names == ["tumbling"]


def test_every_event_beyond_a_note_is_reacted_to_even_while_the_throttle_holds_it_back() -> None:
    reacted: list[tuple[EventKind, str]] = []
    told: list[str] = []
    log = EventLog(lambda kind, *_: told.append(kind.name))
    log.react_by(lambda kind, _, text: reacted.append((kind, text)))
    for text in ("a", "b"):
        log.report(events.CONTROL_LOST, 0, text)
        log.report(events.CYCLE_SLIP, 0, text)
    assert told == ["control-lost", "cycle-slip"]
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
