"""Tests of the navigation task with test doubles: readings, silence, corruption, and late measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link.telemetry.definitions import IMU
from flight.loop import facts
from flight.loop.coil_response import CoilCorrection
from flight.loop.facts import EventLog, Facts
from flight.loop.navigation import CurrentValidity, Navigation, NavigationSettings, SunSensing
from hal.interfaces.devices import CoilState, ImuLink, ImuReading, StringReading
from hal.interfaces.errors import NotResponding

MS = 1_000_000
S = 1000 * MS
EPOCH = 2 * S
BEGIN = 10 * S
QUIET = ImuLink(0, 0, 0, 0, 0, 0, BEGIN)
SETTINGS = NavigationSettings(max_age_ns=200 * MS, coast_ns=3 * S, period_ns=25 * MS)
FIELD = np.array([2e-5, -1e-5, 3e-5])
GYRO_BIAS = np.array([0.02, 0.0, 0.01])


def reading(time_ns: int, rate: tuple[float, float, float] = (0.02, 0.06, 0.09)) -> ImuReading:
    """Return a reading that arrives 3 ms after its sample, of a body that rotates at 0.11 rad/s."""
    values = np.array([0.1, 0.2, 0.3, 0.9]), np.array(rate), FIELD, np.array([0.0, 0.0, 9.8])
    return ImuReading(time_ns, time_ns + 3 * MS, time_ns + 77, *values)


class Unit:
    """An inertial unit or a magnetometer, which delivers the given readings once or raises an exception."""

    def __init__(self) -> None:
        self.readings: list[ImuReading] = []
        self.counters = QUIET
        self.error = ""

    def poll(self) -> list[ImuReading]:
        if self.error:
            raise NotResponding("imu", self.error)
        readings, self.readings = self.readings, []
        return readings

    def link(self) -> ImuLink:
        return self.counters


class Bench:
    """The navigation task with a test double of the filter, which records the calls."""

    def __init__(self, magnetometer: bool = False, **changes: Any) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.caught: list[int] = []
        self.reports: list[tuple[str, int, str]] = []
        self.records: list[tuple[int, dict[str, Any]]] = []
        self.notes: list[tuple[Any, ...]] = []
        self.said: dict[str, list[tuple[bool, str]]] = {}
        self.agreement = SimpleNamespace(holds=True, objection="")
        self.unit, self.magnetometer = Unit(), Unit()
        self.filter = SimpleNamespace(
            started=True,
            measured_ns=BEGIN,
            doubts_commands=False,
            catch_up=self.caught.append,
            at=lambda now: SimpleNamespace(time_ns=now, rate=np.array([0.3, 0.0, 0.4]), bias=GYRO_BIAS),
            past=lambda at: ("past", at),
            rates=lambda begin, end: ("rates", begin, end),
            measure_late=lambda late, report: report([True] * len(late)),
            mark_unknown=self._note("unknown"),
            command=lambda at, currents, known: self.calls.append(("command", at, currents.tolist(), known)),
        )
        self.monitor = SimpleNamespace(
            correction=CoilCorrection(), available=np.ones(3, dtype=bool), test_soon=self._note("test soon")
        )
        self.estimation = SimpleNamespace(
            filter=self.filter,
            feed=SimpleNamespace(accept=self._accept, begin=lambda attitude: attitude == "good"),
            coil_monitor=self.monitor,
            uses_readings_without_rate=True,
            is_accurate=lambda estimate: False,
            fastest_by_field=lambda: 0.7,
            magnetometer_changed=self._note("magnetometer changed"),
            coils_used=lambda used: self.calls.append(("used", used.tolist())),
            coils_corrected=lambda change, sigma: self.calls.append(("corrected", change.tolist(), sigma)),
        )
        log = EventLog(lambda kind, at, _, text: self.reports.append((kind.name, at, text)), throttle_ns=0)
        self.facts = Facts(log)
        update = self.facts.update

        def noted(fact: Any, holds: bool | None, now_ns: int, text: str | Callable[[], str]) -> None:
            said = text if isinstance(text, str) else text()
            self.said.setdefault(fact.name, []).append((bool(holds), said))
            update(fact, holds, now_ns, text)

        self.facts.update = noted  # type: ignore[method-assign]
        services = SimpleNamespace(
            facts=self.facts,
            events=log,
            recorder=SimpleNamespace(
                epoch_ns=EPOCH,
                record=lambda packet, at, **values: self.records.append((at, {"packet": packet, **values})),
            ),
            streams=SimpleNamespace(note=lambda *note: self.notes.append(note)),
        )
        self.task = Navigation(
            cast(Any, self.unit),
            cast(Any, self.estimation),
            replace(SETTINGS, **changes),
            cast(Any, services),
            cast(Any, self.magnetometer) if magnetometer else None,
        )
        self.task.begin(BEGIN)

    def _accept(self, one: ImuReading) -> Any:
        self.calls.append(("accept", one.time_ns))
        return self.agreement

    def _note(self, name: str) -> Any:
        return lambda *values: self.calls.append((name, *values))

    def update(self, now_ns: int, *readings: ImuReading, **counters: Any) -> tuple[ImuReading, ...]:
        """Run a cycle with new readings, of which the last byte arrived in this cycle."""
        self.unit.readings = list(readings)
        if readings:
            counters.setdefault("last_byte_ns", now_ns)
        self.unit.counters = self.unit.counters._replace(**counters)
        self.calls.clear()
        return self.task.update(now_ns)

    def holds(self, fact: facts.Fact) -> bool:
        """Return the last value with which a condition was updated."""
        return self.said[fact.name][-1][0]


def test_readings_go_to_the_filter_in_their_order_and_into_the_record() -> None:
    bench = Bench()
    first, second = reading(BEGIN + 5 * MS), reading(BEGIN + 15 * MS, (0.0, -0.3, 0.4))
    assert bench.update(BEGIN + 20 * MS, first, second) == (first, second)
    assert bench.calls == [("accept", first.time_ns), ("accept", second.time_ns)]
    at, values = bench.records[0]
    assert (at, values["packet"]) == (first.arrival_ns, IMU)
    assert values["sample_time_ns"] == first.time_ns - EPOCH
    assert values["device_time_ns"] == first.device_time_ns
    for name in ("quaternion", "rate", "field", "acceleration"):
        assert values[name] == getattr(first, name).tolist()
    assert bench.task.speed == pytest.approx(0.5), "the rate of the newest reading"
    strength = pytest.approx(float(np.linalg.norm(FIELD)))
    assert bench.notes == [
        note for one in (first, second) for note in (("imu", one.time_ns), ("field", one.time_ns, strength))
    ]
    assert bench.reports == []
    assert len(bench.caught) == 1
    assert bench.caught[0] > 0, "late measurements are applied over several cycles"


def test_under_overload_only_the_newest_reading_is_used_but_all_are_noted() -> None:
    bench = Bench()
    bench.task.thin(True)
    first, second = reading(BEGIN + 5 * MS), reading(BEGIN + 15 * MS)
    assert bench.update(BEGIN + 20 * MS, first, second) == (second,)
    assert bench.calls == [("accept", second.time_ns)]
    assert len(bench.notes) == 4
    assert bench.update(BEGIN + 40 * MS) == ()
    bench.task.thin(False)
    third, fourth = reading(BEGIN + 45 * MS), reading(BEGIN + 55 * MS)
    assert bench.update(BEGIN + 60 * MS, third, fourth) == (third, fourth)


@pytest.mark.parametrize(("time_ns", "used"), [(BEGIN - 1, False), (BEGIN, True)])
def test_readings_from_before_the_release_are_ignored(time_ns: int, used: bool) -> None:
    bench = Bench()
    assert len(bench.update(BEGIN + 20 * MS, reading(time_ns))) == int(used)


def test_a_reading_that_contradicts_the_estimate_is_reported() -> None:
    bench = Bench()
    one = reading(BEGIN + 5 * MS)
    bench.agreement = SimpleNamespace(holds=False, objection="the rate")
    bench.update(BEGIN + 10 * MS, one)
    assert bench.reports == [("imu-refused", one.arrival_ns, "the rate disagrees with the estimate")]
    estimate = cast(Any, object())
    assert bench.task.is_current(BEGIN + 100 * MS)
    late = BEGIN + 174 * MS
    assert bench.task.is_measured(estimate, late), "readings agreed until the release"
    assert not bench.task.is_measured(estimate, late + MS), "the last one that agreed is too old"
    assert bench.task.is_current(late + MS), "although a reading has come"


def test_a_reading_serves_control_until_the_cycle_before_its_age_limit() -> None:
    """A reading must still be younger than the age limit at the end of the cycle of 25 ms."""
    bench = Bench()
    one = reading(BEGIN + 50 * MS)
    bench.update(BEGIN + 55 * MS, one)
    estimate = cast(Any, object())
    last = one.time_ns + 175 * MS - 1
    for now_ns, fresh in ((last, True), (last + 1, False)):
        assert bench.task.is_current(now_ns) is fresh
        assert bench.task.is_measured(estimate, now_ns) is fresh
    assert not bench.task.is_measured(None, BEGIN + 55 * MS)


def test_without_a_rate_the_estimate_must_be_accurate() -> None:
    bench = Bench(has_gyro=False)
    estimate = cast(Any, object())
    bench.update(BEGIN + 10 * MS, reading(BEGIN + 5 * MS))
    assert bench.task.is_accurate(estimate)
    bench.update(BEGIN + 20 * MS, reading(BEGIN + 15 * MS, (np.nan, np.nan, np.nan)))
    assert not bench.task.is_accurate(estimate)
    bench.estimation.is_accurate = lambda _: True
    assert bench.task.is_accurate(estimate)
    assert not bench.task.is_accurate(None)
    assert not bench.holds(facts.GYRO_LOST), "the unit has no gyro"


@pytest.mark.parametrize("uses", [True, False])
def test_a_reading_without_a_rate_is_a_fault_of_the_gyro(uses: bool) -> None:
    bench = Bench()
    bench.estimation.uses_readings_without_rate = uses
    bench.update(BEGIN + 10 * MS, reading(BEGIN + 5 * MS))
    assert bench.said["gyro-lost"] == [(False, "the rate is valid again")]
    nothing = reading(BEGIN + 15 * MS, (np.nan, np.nan, np.nan))
    used = bench.update(BEGIN + 20 * MS, nothing, rejection="rate 99 rad/s")
    assert len(used) == int(uses)
    assert bench.said["gyro-lost"][-1] == (True, "invalid: rate 99 rad/s")
    assert bench.task.speed == pytest.approx(0.11), "the last valid rate"


def test_the_speed_without_a_gyro_is_that_of_the_estimate_or_of_the_field() -> None:
    bench = Bench(has_gyro=False)
    bench.update(BEGIN + 20 * MS, reading(BEGIN + 15 * MS, (np.nan, np.nan, np.nan)))
    found = bench.task.estimate(BEGIN + 3 * S)
    assert found is not None
    assert found.time_ns == BEGIN + 3 * S
    assert bench.task.speed == pytest.approx(0.5)
    assert bench.task.estimate(BEGIN + 3 * S + 1) is None, "propagated for too long"
    assert bench.task.speed == 0.7, "the largest likely rate from the magnetometer"
    bench.filter.started = False
    assert bench.task.estimate(BEGIN) is None


def test_with_a_gyro_the_speed_is_that_of_the_newest_reading_without_the_estimated_bias() -> None:
    """An estimated gyro bias does not delay the end of detumbling, and is not mistaken for a spin."""
    bench = Bench()
    bench.update(BEGIN + 20 * MS, reading(BEGIN + 15 * MS))
    assert bench.task.speed == pytest.approx(0.11)
    bench.task.estimate(BEGIN + 1 * S)
    assert bench.task.speed == pytest.approx(0.1)
    bench.task.estimate(BEGIN + 4 * S)
    assert bench.task.speed == pytest.approx(0.1), "the last speed, because there is no estimate"


@pytest.mark.parametrize(
    ("quiet", "silent", "text"),
    [(200 * MS, False, "bytes arrive again"), (200 * MS + 1, True, "no byte for 0.20 s")],
)
def test_a_line_without_a_byte_for_longer_than_the_age_limit_is_silent(
    quiet: int, silent: bool, text: str
) -> None:
    bench = Bench()
    bench.update(BEGIN + quiet)
    assert bench.said["imu-silent"][-1] == (silent, text)
    assert not bench.holds(facts.IMU_UNUSABLE), "a silent line is not reported twice"
    other = Bench()
    other.update(BEGIN + 1 * S, last_byte_ns=BEGIN + 1 * S)
    other.update(BEGIN + 1 * S + quiet)
    assert other.holds(facts.IMU_SILENT) is silent


def test_bytes_without_a_valid_reading_are_unusable() -> None:
    bench = Bench()
    bench.update(BEGIN + 200 * MS, last_byte_ns=BEGIN + 200 * MS)
    assert bench.said["imu-unusable"][-1] == (False, "readings arrive again")
    bench.update(BEGIN + 200 * MS + 1, last_byte_ns=BEGIN + 200 * MS)
    holds, text = bench.said["imu-unusable"][-1]
    assert (holds, text.startswith("bytes but no reading for 0.20 s")) == (True, True)
    bench.update(BEGIN + 250 * MS, reading(BEGIN + 249 * MS))
    assert not bench.holds(facts.IMU_UNUSABLE)


def test_after_a_silence_bytes_without_readings_count_from_its_end() -> None:
    bench = Bench()
    bench.update(BEGIN + 500 * MS)
    assert bench.holds(facts.IMU_SILENT)
    bench.update(BEGIN + 700 * MS, last_byte_ns=BEGIN + 690 * MS)
    assert not bench.holds(facts.IMU_UNUSABLE)
    bench.update(BEGIN + 701 * MS, last_byte_ns=BEGIN + 701 * MS)
    assert bench.holds(facts.IMU_UNUSABLE)


def test_damaged_packets_are_counted_since_the_last_cycle() -> None:
    bench = Bench()
    bench.update(BEGIN + 10 * MS, bad_checksum=3, discarded_bytes=40)
    bench.update(BEGIN + 20 * MS, bad_checksum=5, discarded_bytes=41)
    bench.update(BEGIN + 30 * MS, discarded_bytes=45)
    bench.update(BEGIN + 40 * MS)
    assert bench.reports == [
        ("imu-corrupt", BEGIN + 10 * MS, "3 packets with a wrong checksum, 40 bytes outside packets"),
        ("imu-corrupt", BEGIN + 20 * MS, "2 packets with a wrong checksum, 1 bytes outside packets"),
        ("imu-corrupt", BEGIN + 30 * MS, "0 packets with a wrong checksum, 4 bytes outside packets"),
    ]


def test_a_unit_that_needs_to_be_configured_again_is_reported_with_the_cause() -> None:
    bench = Bench()
    bench.update(BEGIN + 10 * MS, upsets=1, upset="the unit sends samples at a wrong rate")
    bench.update(BEGIN + 20 * MS, upsets=1, upset="the unit sends samples at a wrong rate")
    assert bench.reports == [("imu-upset", BEGIN + 10 * MS, "the unit sends samples at a wrong rate")]


def test_impossible_values_are_counted_unless_the_gyro_is_known_to_be_lost() -> None:
    bench = Bench()
    bench.update(BEGIN + 10 * MS, out_of_range=2, not_finite=1, rejection="field 3 T")
    bench.update(BEGIN + 20 * MS, not_finite=4)
    bench.update(BEGIN + 30 * MS)
    assert bench.reports == [
        ("imu-implausible", BEGIN + 10 * MS, "2 packets out of range, 1 not finite: field 3 T"),
        ("imu-implausible", BEGIN + 20 * MS, "0 packets out of range, 3 not finite: field 3 T"),
    ]
    bench.facts.holds = lambda fact: fact is facts.GYRO_LOST  # type: ignore[method-assign]
    bench.update(BEGIN + 40 * MS, out_of_range=9)
    assert len(bench.reports) == 2


def test_a_port_that_is_gone_is_reported_and_no_reading_is_used() -> None:
    bench = Bench()
    bench.unit.error = "unplugged"
    assert bench.update(BEGIN + 10 * MS) == ()
    assert bench.holds(facts.IMU_LINE_LOST)
    bench.unit.error = ""
    bench.update(BEGIN + 20 * MS)
    assert bench.said["imu-line-lost"][-1] == (False, "the serial port is back")


NAN3 = (np.nan, np.nan, np.nan)


def test_the_magnetometer_replaces_a_unit_that_is_silent_for_longer_than_the_age_limit() -> None:
    bench = Bench(magnetometer=True)
    last = reading(BEGIN + 5 * MS)
    bench.update(BEGIN + 10 * MS, last)
    bench.magnetometer.readings = [reading(BEGIN + 200 * MS, NAN3)]
    assert bench.update(BEGIN + 205 * MS) == (), "at the limit"
    assert bench.calls == []
    old, new = reading(last.time_ns, NAN3), reading(BEGIN + 206 * MS, NAN3)
    bench.magnetometer.readings = [old, new]
    assert bench.update(BEGIN + 205 * MS + 1) == (new,), "only readings after the unit's newest reading"
    assert bench.calls[0] == ("magnetometer changed",)
    assert bench.said["gyro-lost"][-1] == (True, "the magnetometer replaces the silent inertial unit")
    back = reading(BEGIN + 250 * MS)
    bench.magnetometer.readings = [reading(BEGIN + 251 * MS, NAN3)]
    assert bench.update(BEGIN + 255 * MS, back) == (back,)
    assert bench.calls[0] == ("magnetometer changed",)


def test_a_dead_port_or_a_dead_magnetometer_does_not_keep_the_other_from_being_used() -> None:
    bench = Bench(magnetometer=True)
    bench.unit.error = "unplugged"
    new = reading(BEGIN + 206 * MS, NAN3)
    bench.magnetometer.readings = [new]
    assert bench.update(BEGIN + 207 * MS) == (new,)
    assert bench.holds(facts.IMU_LINE_LOST)
    other = Bench(magnetometer=True)
    other.magnetometer.error = "no such device"
    one = reading(BEGIN + 5 * MS)
    assert other.update(BEGIN + 10 * MS, one) == (one,)


def test_when_the_body_contradicts_the_commands_the_coils_are_tested_once() -> None:
    bench = Bench()
    bench.update(BEGIN + 10 * MS)
    assert bench.said["commands-doubted"][-1] == (False, "the body rate agrees with the commands again")
    bench.filter.doubts_commands = True
    bench.update(BEGIN + 20 * MS)
    assert bench.calls == [("test soon",)]
    bench.update(BEGIN + 30 * MS)
    assert bench.calls == []
    assert bench.said["commands-doubted"][-1] == (True, "the body rate contradicts the commands")
    bench.filter.doubts_commands = False
    bench.update(BEGIN + 40 * MS)
    bench.filter.doubts_commands = True
    bench.update(BEGIN + 50 * MS)
    assert bench.calls == [("test soon",)]


@pytest.mark.parametrize(
    ("known", "calls"),
    [
        (CurrentValidity(True, True, -1, None), [("command", 90, [1.0, 2.0, 3.0], True)]),
        (CurrentValidity(True, False, 95, None), [("command", 95, [1.0, 2.0, 3.0], True)]),
        (CurrentValidity(False, False, -1, 40), [("unknown", 40), ("command", 90, [1.0, 2.0, 3.0], False)]),
    ],
)
def test_the_filter_gets_the_currents_from_when_they_are_known(
    known: CurrentValidity, calls: list[tuple[Any, ...]]
) -> None:
    bench = Bench()
    in_force = CoilState(np.zeros(3), np.zeros(3), 90, False, 80, False, 0, "")
    bench.task.commanded(in_force, np.array([1.0, 2.0, 3.0]), known)
    assert bench.calls == calls


def test_the_estimation_gets_each_change_of_coils_once() -> None:
    bench = Bench()
    correction, available = bench.monitor.correction, bench.monitor.available
    bench.task.correct_coils(correction, available)
    assert bench.calls == []
    bench.task.correct_coils(correction, available.copy())
    assert bench.calls == [], "the same coils"
    without = np.array([True, False, True])
    bench.task.correct_coils(correction, without)
    bench.task.correct_coils(correction, without)
    assert bench.calls == [("used", [True, False, True])]
    bench.calls.clear()
    changed = SimpleNamespace(
        factors=correction.factors * np.array([1.0, -1.0, 0.5]), deviations="deviations"
    )
    bench.task.correct_coils(cast(Any, changed), without)
    again = SimpleNamespace(factors=changed.factors * np.array([2.0, 1.0, 1.0]), deviations="smaller")
    bench.task.correct_coils(cast(Any, again), without)
    bench.task.correct_coils(cast(Any, again), without)
    assert bench.calls == [
        ("corrected", [1.0, -1.0, 0.5], "deviations"),
        ("corrected", [2.0, 1.0, 1.0], "smaller"),
    ]


def test_past_estimates_and_late_measurements_need_a_started_filter() -> None:
    bench = Bench()
    reported: list[list[bool]] = []
    assert cast(Any, bench.task.past(5)) == ("past", 5)
    assert cast(Any, bench.task.rates(5, 9)) == ("rates", 5, 9)
    assert not bench.task.begin_from(cast(Any, "good")), "there is an estimate"
    bench.task.ingest_late(cast(Any, [1, 2]), reported.append)
    bench.filter.started = False
    assert bench.task.past(5) is None
    assert bench.task.rates(5, 9) is None
    assert bench.task.begin_from(cast(Any, "good"))
    assert not bench.task.begin_from(cast(Any, "bad"))
    bench.task.ingest_late(cast(Any, [1, 2]), reported.append)
    assert reported == [[True, True], [False, False]]


class Cells:
    """Solar cells that return the given reading."""

    def __init__(self) -> None:
        self.reading: StringReading | None = None
        self.said = ""

    def latest(self) -> StringReading | None:
        return self.reading

    def error(self) -> str:
        return self.said


def test_a_new_reading_of_the_solar_cells_is_accepted_once_unless_it_is_old() -> None:
    cells, accepted, said = Cells(), list[int](), list[tuple[str, bool, str]]()
    answer: list[str | None] = [None]

    def accept(one: StringReading) -> str | None:
        accepted.append(one.time_ns)
        return answer[0]

    update = SimpleNamespace(update=lambda fact, holds, _, text: said.append((fact.name, holds, text)))
    task = SunSensing(cast(Any, cells), accept, 3 * S, cast(Any, SimpleNamespace(facts=update)))
    task.begin(BEGIN)
    task.run(BEGIN + 3 * S)
    assert said == [("strings-lost", False, "readings arrive again")]
    task.run(BEGIN + 3 * S + 1)
    assert said[-1] == ("strings-lost", True, "no reading for 3 s")
    cells.said = "the converter is gone"
    task.run(BEGIN + 3 * S + 1)
    assert said[-1] == ("strings-lost", True, "the converter is gone")
    cells.reading = StringReading(BEGIN, np.zeros(3))
    task.run(BEGIN + 1 * S)
    assert accepted == [], "not newer than the start"
    cells.reading = StringReading(BEGIN + 5 * S, np.zeros(3))
    for _ in range(2):
        task.run(BEGIN + 8 * S)
    assert accepted == [BEGIN + 5 * S]
    assert [name for name, *_ in said[-2:]] == ["strings-lost"] * 2, "without a judgement"
    cells.reading = StringReading(BEGIN + 6 * S, np.zeros(3))
    task.run(BEGIN + 9 * S + 1)
    assert accepted == [BEGIN + 5 * S], "too old"
    cells.reading = StringReading(BEGIN + 9 * S, np.array([0.0, np.nan, 0.0]))
    task.run(BEGIN + 9 * S + 1)
    assert accepted == [BEGIN + 5 * S], "not finite"
    for number, (wrong, expected) in enumerate(
        (("", (False, "the Sun is detected")), ("dim", (True, "dim")))
    ):
        answer[0] = wrong
        cells.reading = StringReading(BEGIN + (20 + number) * S, np.zeros(3))
        task.run(BEGIN + (20 + number) * S)
        assert said[-2] == ("sun-unclear", *expected)
