"""Tests of facts, which are monitored conditions such as a silent sensor.

A fact becomes true after N consecutive updates, and is reported once. A fact is reset in modes in which it is
not monitored. Some facts latch.

Age, rate and validity of a stream are checked separately. A stream whose data are too old is never good.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from flight.link import events
from flight.link.events import EventKind, Mode
from flight.loop import facts
from flight.loop.facts import (
    FACTS,
    IMU_POOR,
    POWER_POOR,
    EventLog,
    StreamLimits,
    Streams,
    StreamState,
    StreamWatch,
    check,
    streams_of,
)
from flight.loop.modes import SAFING_REACTIONS, Trigger, modes_moved_by
from knightcube.errors import KnightCubeError
from tests.flight.loop.records import EventRecord
from tests.support.flights import demo_config


def state(record: EventRecord, fact: facts.Fact, *statements: bool | None) -> None:
    for holds in statements:
        record.facts.update(fact, holds, 0, "text")


def test_the_table_of_facts_is_valid() -> None:
    check(FACTS, modes_moved_by)


DRIVEN = "detumble hold slew testbed-demo sun point"
PERSISTENCE = {
    "boot-waits": (1, 1, "boot"),
    "task-failing": (1, None, ""),
    "blind": (1, 1, f"{DRIVEN} acquire"),
    "tumbling": (8, 1, "hold slew testbed-demo acquire sun point"),
    "hold-impossible": (1, 1, "hold testbed-demo"),
    "slew-late": (1, 1, "slew"),
    "holding": (1, 1, "slew testbed-demo"),
    "coil-x-broken": (1, None, ""),
    "coil-y-broken": (1, None, ""),
    "coil-z-broken": (1, None, ""),
    **{f"coil-{number}-broken": (1, None, "") for number in (4, 5, 6)},
    "cpu-high": (3, 3, ""),
    "memory-grows": (3, 3, ""),
    "memory-high": (3, 1, ""),
    "disk-low": (2, 2, ""),
    "hot": (2, 2, ""),
    "too-hot": (2, None, ""),
    "sun-unclear": (3, 3, ""),
    "clock-off": (2, 1, ""),
    "wide-false": (3, 1, ""),
    "gyro-lost": (4, 4, ""),
    **{f"battery-{level}": (3, 3, "") for level in ("low", "very-low", "critical")},
    **{f"{rail}-monitor-lost": (3, 3, "") for rail in ("battery", "bus")},
} | {f"{stream}-poor": (4, 8, "") for stream in ("imu", "field", "coils", "power", "camera", "gps")}
"""For each fact (a monitored condition): numbers of updates until it becomes true and until it ends, and
modes.

The second number is None if the fact, once true, never ends. `modes` are the modes in which the fact is
monitored; an empty string means all modes.

All other facts become true and end immediately, and are monitored in all modes.
"""

EVENTS_OF = {
    "imu-silent": ("imu-silent", "imu-recovered"),
    "imu-unusable": ("imu-unusable", "imu-recovered"),
    "imu-line-lost": ("imu-line-lost", "imu-recovered"),
    "control-lost": ("control-lost", "control-regained"),
    "coil-fault": ("coil-fault", "coil-recovered"),
    "commands-doubted": ("commands-doubted", "commands-trusted"),
    "power-fault": ("power-fault", "power-recovered"),
    "camera-lost": ("camera-lost", "camera-recovered"),
    "camera-late": ("camera-late", "camera-recovered"),
    "log-fault": ("log-fault", "log-recovered"),
    "service-failing": ("service-failing", "service-recovered"),
    "gps-lost": ("gps-lost", "gps-recovered"),
    "strings-lost": ("strings-lost", "strings-recovered"),
    "sun-unclear": ("sun-unclear", "sun-clear"),
    "field-refused": ("field-refused", "field-trusted"),
    "wide-lost": ("wide-lost", "wide-recovered"),
    "wide-false": ("wide-false", "wide-trusted"),
    "gyro-lost": ("gyro-lost", "gyro-recovered"),
    "battery-low": ("battery-low", "battery-recovered"),
    "battery-very-low": ("battery-very-low", "battery-recovered"),
    "battery-critical": ("battery-critical", "battery-charged"),
    **{
        f"{rail}-monitor-lost": ("power-sensor-lost", "power-sensor-recovered") for rail in ("battery", "bus")
    },
    **{f"coil-{axis}-broken": ("coil-broken", None) for axis in "xyz456"},
    **{name: (name, "resource-normal") for name in ("cpu-high", "memory-grows", "disk-low", "hot")},
    **{
        f"{stream}-poor": ("stream-poor", "stream-good")
        for stream in ("imu", "field", "coils", "power", "camera", "gps")
    },
}
"""Events that report the start and the end of a fact (a monitored condition).

All other facts report their start by the event with their name, and do not report their end.
"""


@pytest.mark.parametrize("fact", FACTS, ids=lambda fact: str(fact.name))
def test_a_fact_has_the_persistence_modes_and_events_of_the_design(fact: facts.Fact) -> None:
    after, mended_after, modes = PERSISTENCE.get(fact.name, (1, 1, ""))
    assert fact.after == after
    assert fact.latching is (mended_after is None)
    assert fact.mended_after == (mended_after or 1)
    assert {mode.label for mode in fact.modes} == set(modes.split() or [mode.label for mode in Mode])
    ends = None if fact.ends is None else fact.ends.name
    assert (fact.begins.name, ends) == EVENTS_OF.get(fact.name, (fact.name, None))


def test_the_tables_of_the_design_name_facts() -> None:
    assert {*PERSISTENCE, *EVENTS_OF} <= {fact.name for fact in FACTS}


def test_a_fact_becomes_true_after_its_number_of_consecutive_updates() -> None:
    record = EventRecord()
    record.facts.enter(Mode.HOLD)
    state(record, facts.TUMBLING, *[True] * 7, False, *[True] * 7)
    assert not record.facts.holds(facts.TUMBLING)
    state(record, facts.TUMBLING, True)
    assert record.facts.holds(facts.TUMBLING)
    assert record.names == ["tumbling"]


def test_a_fact_ends_after_its_number_of_consecutive_updates_with_one_event_each_way() -> None:
    record = EventRecord()
    state(record, facts.IMU_POOR, *[True] * 9)
    state(record, facts.IMU_POOR, *[False] * 7, True, *[False] * 7)
    assert record.facts.holds(facts.IMU_POOR)
    state(record, facts.IMU_POOR, False)
    assert record.names == ["stream-poor", "stream-good"]


def test_an_unknown_condition_neither_begins_nor_ends_a_fact() -> None:
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


def test_a_fact_that_is_not_latched_cannot_be_cleared() -> None:
    record = EventRecord()
    state(record, facts.IMU_SILENT, True)
    assert not record.facts.clear("imu-silent")
    assert record.facts.holds(facts.IMU_SILENT)


def test_a_fact_is_reset_in_a_mode_that_does_not_monitor_it() -> None:
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
        ((facts.BLIND, facts.BLIND), "is listed twice"),
        ((replace(facts.BLIND, after=0),), "at least 1"),
        ((replace(facts.BLIND, modes=frozenset({Mode.SAFE})),), "its reaction safe has no effect"),
    ],
)
def test_a_table_that_cannot_work_is_refused(broken: tuple[facts.Fact, ...], problem: str) -> None:
    with pytest.raises(KnightCubeError, match=problem):
        check(broken, modes_moved_by)


def test_codes_and_names_of_events_are_each_used_once() -> None:
    assert len({kind.code for kind in events.EVENTS}) == len(events.EVENTS)
    assert len({kind.name for kind in events.EVENTS}) == len(events.EVENTS)
    assert len(FACTS) <= 64, "they are bits of one field in the health packet"


def test_every_safing_event_has_a_trigger() -> None:
    assert {Trigger.REACT_SAFE, Trigger.REACT_HOLD, Trigger.REACT_DETUMBLE} == set(SAFING_REACTIONS.values())


ROW = StreamLimits("imu", 40.0, 0.1, IMU_POOR, 0.0, 1.0)
PERIOD = 25_000_000


def fed(
    seconds: float, every: int = 1, value: float = 0.5, row: StreamLimits = ROW
) -> tuple[StreamWatch, int]:
    """Return a watch that has received every n-th sample for some seconds, and the last sample's time."""
    watch = StreamWatch(row, 0)
    count = round(seconds * 40)
    for k in range(0, count, every):
        watch.note(k * PERIOD, value)
    return watch, (count - 1) * PERIOD


def test_a_stream_without_a_reading_is_awaited_for_its_age_limit_after_the_start() -> None:
    watch = StreamWatch(ROW, 0)
    watch.begin(5_000_000_000)
    assert watch.age(5_000_000_000) == math.inf
    for wait_ns, state in ((0, StreamState.NO_READING_YET), (100_000_000, StreamState.NO_READING_YET)):
        assert watch.state(5_000_000_000 + wait_ns) is state
    assert watch.state(5_100_000_001) is StreamState.NEVER
    assert watch.poor(5_000_000_000) == watch.poor(5_100_000_001) == (None, "")
    watch.note(5_200_000_000, 0.5)
    assert watch.state(5_200_000_000) is StreamState.GOOD


def test_a_stream_is_good_at_its_rate_and_stale_beyond_its_age_limit() -> None:
    watch, now = fed(3.0)
    assert watch.state(now) is StreamState.GOOD
    assert watch.rate(now) == pytest.approx(40.0, abs=0.5)
    assert watch.state(now + 100_000_000) is StreamState.GOOD
    assert watch.state(now + 100_000_001) is StreamState.STALE


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, math.inf])
def test_a_value_out_of_its_range_is_invalid_however_fresh(value: float) -> None:
    watch, now = fed(3.0, value=value)
    assert watch.state(now) is StreamState.INVALID


def test_a_stream_at_half_its_rate_is_slow_after_a_whole_window() -> None:
    early, now = fed(1.5, every=2)
    assert early.state(now) is StreamState.GOOD, "not known yet"
    late, now = fed(4.0, every=2)
    assert late.state(now) is StreamState.SLOW


def test_after_a_silence_the_rate_is_counted_again() -> None:
    watch, now = fed(4.0)
    for k in range(40):
        watch.note(now + 5_000_000_000 + k * PERIOD, 0.5)
    assert watch.state(now + 6_000_000_000) is StreamState.GOOD


def test_a_stream_of_a_device_that_is_not_fitted_ignores_readings() -> None:
    streams = Streams((ROW,))
    streams.note("camera", 1)
    assert streams.state("camera", 2) is StreamState.NOT_FITTED
    assert streams.state("imu", 2) is StreamState.NO_READING_YET


def test_silence_that_another_alarm_reports_is_not_reported_twice_and_any_other_is() -> None:
    quiet = StreamLimits("power", 4.0, 3.0, POWER_POOR, has_silence_alarm=False)
    streams = Streams((ROW, quiet))
    for name in ("imu", "power"):
        streams.note(name, 0, 0.5)
    imu, power = streams.look(10_000_000_000)
    assert imu[1:] == (None, "")
    assert power[1:] == (True, "power: stale, 10.00 s old, 3 s allowed")


def test_the_streams_of_a_configuration_are_those_of_its_devices() -> None:
    assert [row.name for row in streams_of(demo_config(10.0))] == ["imu", "field", "coils", "power", "camera"]
    assert "camera" not in [row.name for row in streams_of(demo_config(10.0, camera=False))]


def test_the_streams_have_the_rates_limits_and_ranges_of_their_devices() -> None:
    config = demo_config(10.0)
    rows = {row.name: row for row in streams_of(config)}
    assert rows["imu"].rate_hz == config.inertial_unit.rate_hz
    assert (rows["coils"].rate_hz, rows["coils"].max_age) == (40.0, config.coils.stale_after)
    low, high = config.field_range()
    assert (rows["field"].low, rows["field"].high) == (low, high)
    largest = sum(config.coils.supply_voltage / ohm for ohm in config.coils.resistance)
    power = rows["power"]
    assert (power.rate_hz, power.max_age) == (1.0, 3.0)
    assert (power.low, power.high) == pytest.approx((-0.15 * largest, 1.5 * largest))
    assert all(row.has_silence_alarm for row in rows.values())


def test_the_window_has_two_seconds_or_five_periods() -> None:
    """The rate of a stream is unknown until two seconds or five periods have passed."""
    for rate_hz, window in ((40.0, 2.0), (2.5, 2.0), (0.1, 50.0)):
        watch = StreamWatch(replace(ROW, rate_hz=rate_hz), 0)
        assert math.isnan(watch.rate(round(window * 1e9) - 1))
        assert watch.rate(round(window * 1e9)) == 0.0


def test_a_stream_is_slow_below_80_percent_of_its_rate() -> None:
    for count, state in ((64, StreamState.GOOD), (63, StreamState.SLOW)):  # of 80 samples in two seconds
        watch = StreamWatch(ROW, 0)
        for k in range(count):
            watch.note(2_000_000_002 + k * 1_999_999_999 // (count - 1), 0.5)
        now = 4_000_000_001
        assert watch.rate(now) == count / 2.0
        assert watch.state(now) is state


@pytest.mark.parametrize("period_s", [1.0, 2.0, 2.5, 3.0, 5.0, 6.0, 10.0, 20.0, 30.0])
def test_four_readings_in_five_periods_are_80_percent_for_every_period(period_s: float) -> None:
    row = replace(ROW, rate_hz=1.0 / period_s, max_age=10.0 * period_s)
    for missing, state in (((2,), StreamState.GOOD), ((2, 4), StreamState.SLOW)):
        watch = StreamWatch(row, 0)
        for k in range(1, 6):
            if k not in missing:
                watch.note(round(k * period_s * 1e9), 0.5)
        assert watch.state(round(5.0 * period_s * 1e9)) is state


def test_the_values_at_the_ends_of_the_range_are_valid() -> None:
    for value, state in ((0.0, StreamState.GOOD), (1.0, StreamState.GOOD), (1.0001, StreamState.INVALID)):
        watch, now = fed(3.0, value=value)
        assert watch.state(now) is state


def test_the_throttle_writes_one_event_of_a_kind_in_its_time_with_the_number_held_back() -> None:
    written: list[tuple[str, int, int, str]] = []
    log = EventLog(lambda kind, time_ns, held, text: written.append((kind.name, time_ns, held, text)), 100)
    for time_ns in (0, 1, 99, 100, 150):
        log.report(events.CYCLE_SLIP, time_ns, f"slip at {time_ns}")
    log.report(events.BLIND, 150, "blind")
    assert written == [
        ("cycle-slip", 0, 0, "slip at 0"),
        ("cycle-slip", 100, 2, "slip at 100"),
        ("blind", 150, 0, "blind"),
    ]
    assert log.count == 6
    assert log.counts == {events.CYCLE_SLIP: 5, events.BLIND: 1}
    # The last event that is held back keeps its time and text.
    log.report(events.CYCLE_SLIP, 160, "slip at 160")
    log.flush(170)
    assert written[3:] == [("cycle-slip", 160, 1, "slip at 160")]
    log.flush(300)
    assert len(written) == 4


def test_an_event_held_back_is_written_as_soon_as_the_throttle_permits() -> None:
    written: list[tuple[int, int, str]] = []
    log = EventLog(lambda _, time_ns, held, text: written.append((time_ns, held, text)), 100)
    for time_ns, text in ((0, "doubted"), (20, "trusted"), (40, "doubted again")):
        log.report(events.COMMANDS_DOUBTED, time_ns, text)
    log.release(99)
    assert written == [(0, 0, "doubted")]
    log.release(100)
    assert written[1:] == [(40, 1, "doubted again")]
    # The minimum interval between two events begins when the first event is written.
    log.report(events.COMMANDS_DOUBTED, 150, "once more")
    log.release(199)
    assert len(written) == 2
    log.release(200)
    assert written[2:] == [(150, 0, "once more")]
