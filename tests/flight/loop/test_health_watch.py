"""Tests of the health and housekeeping tasks: checks, the trigger of the watchdog, and recorded values."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link.events import Mode
from flight.link.telemetry.definitions import HEALTH, HOUSEKEEPING
from flight.loop import facts
from flight.loop.body import SteeringState
from flight.loop.executive import WorkerChange, WorkerNews
from flight.loop.facts import FACTS, EventLog, Facts
from flight.loop.health import HealthWatch, Housekeeping, ResourceSample, WorkerWatch
from flight.schema.sections import Health
from hal.interfaces.devices import ImuLink

S = 1_000_000_000


class Group:
    """A rate group whose counters the test sets."""

    def __init__(self, name: str) -> None:
        self.name, self.period_ns = name, 25_000_000
        self.cycles = self.completed = self.slips = 0


class Bench:
    """The health task with test doubles that record the calls. All cycles of the groups are completed."""

    def __init__(self, power: bool = True) -> None:
        self.reports: list[tuple[str, str]] = []
        self.records: list[dict[str, Any]] = []
        self.notes: list[tuple[Any, ...]] = []
        self.said: dict[str, tuple[bool | None, str]] = {}
        self.fed = 0
        self.news: list[WorkerNews] = []
        self.poor: list[tuple[Any, bool | None, str]] = []
        self.wall_ns = 1_700_000_000 * S
        self.sampled: Any = None
        self.ended = 0
        self.power: Any = SimpleNamespace(
            said="", reading=None, error=lambda: self.power.said, latest=lambda: self.power.reading
        )
        self.now_ns = 0
        self.since_ns: int | None = None
        log = EventLog(lambda kind, _, __, text: self.reports.append((kind.name, text)), throttle_ns=0)
        self.facts = Facts(log)
        self.facts.enter(Mode.SAFE)
        update = self.facts.update

        def noted(fact: Any, holds: bool | None, now_ns: int, text: str | Callable[[], str]) -> None:
            self.said[fact.name] = holds, text if isinstance(text, str) else text()
            update(fact, holds, now_ns, text)

        self.facts.update = noted  # type: ignore[method-assign]
        host = SimpleNamespace(now_ns=lambda: self.now_ns, utc_ns=lambda: self.wall_ns + self.now_ns)
        self.ticker = SimpleNamespace(name="log", error="", served_ns=0, period_ns=S)
        clock = SimpleNamespace(
            host=host, now_ns=lambda: self.now_ns, tickers=[self.ticker], ticker=self._begin_ticker
        )
        recorder = SimpleNamespace(record=self._record, event=self._event)
        streams = SimpleNamespace(
            note=lambda *note: self.notes.append(note),
            look=lambda now: self.poor,
            state=lambda name, now: len(name),
        )
        services = SimpleNamespace(
            facts=self.facts,
            events=log,
            recorder=recorder,
            streams=streams,
            clock=clock,
            jobs=SimpleNamespace(news=self._take_news),
        )
        drive = SimpleNamespace(available=np.array([True, False, True]))
        modes = SimpleNamespace(mode=Mode.SAFE, since_ns=3 * S)
        self.task = HealthWatch(
            cast(Any, modes),
            cast(Any, drive),
            cast(Any, self.power) if power else None,
            [WorkerWatch("vision", lambda: self.since_ns, 9 * S)],
            Health(warm_up=0.0),
            self._feed,
            cast(Any, services),
        )
        self.control, self.other = Group("control"), Group("health")
        self.task.watch(cast(Any, [self.control, self.other]))
        self.task.begin(0)

    def _feed(self) -> None:
        self.fed += 1

    def _event(self, kind: Any, now_ns: int, held_back: int, text: str) -> None:
        self.reports.append((kind.name, text))

    def _record(self, packet: Any, now_ns: int, **values: Any) -> None:
        self.records.append({"packet": packet, "now_ns": now_ns, **values})

    def _take_news(self) -> list[WorkerNews]:
        news, self.news = self.news, []
        return news

    def _begin_ticker(self, name: str, period_ns: int, job: Any) -> Any:
        self.sampled = (name, period_ns, job)
        return SimpleNamespace(stop=self._stop)

    def _stop(self) -> None:
        self.ended += 1

    def run(self, seconds: float = 0.25, slot: int = 1, done: bool = True) -> None:
        """Run the task after some seconds, in which all control cycles have failed if `done` is false."""
        self.now_ns += round(seconds * S)
        self.control.cycles += 10
        self.control.completed += 10 * done
        self.other.completed += 1
        self.ticker.served_ns = self.now_ns
        self.task.run(cast(Any, SimpleNamespace(start_ns=self.now_ns, slot=slot)))


def test_the_watchdog_is_triggered_while_all_groups_and_workers_progress() -> None:
    bench = Bench()
    for _ in range(3):
        bench.run()
    assert bench.fed == 3
    assert bench.said["no-progress"][0] is False
    bench.since_ns = bench.now_ns
    bench.run(9.0)
    assert bench.fed == 4
    bench.run(0.25)
    assert bench.fed == 4
    assert bench.said["no-progress"] == (True, "no progress: vision")
    bench.since_ns = None
    bench.run()
    assert bench.fed == 5


def test_a_control_group_without_completed_cycles_stops_the_trigger() -> None:
    bench = Bench()
    bench.run()
    bench.run(2.25, done=False)
    assert bench.fed == 1
    assert bench.said["no-progress"] == (True, "no progress: control")


@pytest.mark.parametrize(("failed", "holds"), [(5, False), (6, True)])
def test_control_cycles_that_fail_in_a_row_are_counted(failed: int, holds: bool) -> None:
    """Sixty failed cycles in a row count as a failing task. A completed cycle resets the count."""
    bench = Bench()
    bench.run(0.1, done=False)
    bench.run(0.1)
    for _ in range(failed):
        bench.run(0.1, done=False)
    assert bench.said["task-failing"] == (holds, f"{10 * failed} control cycles in a row have failed")


def test_a_job_on_a_ticker_that_fails_is_reported_and_does_not_stop_the_trigger() -> None:
    bench = Bench()
    bench.run()
    assert bench.said["service-failing"] == (False, "all jobs run")
    bench.ticker.error = "disk full"
    bench.run()
    assert bench.said["service-failing"] == (True, "log: disk full")
    assert bench.fed == 2


@pytest.mark.parametrize(
    ("change", "event"),
    [
        (WorkerChange.DIED, "worker-died"),
        (WorkerChange.READY, "worker-ready"),
        (WorkerChange.SPENT, "worker-rests"),
    ],
)
def test_changes_of_workers_are_events(change: WorkerChange, event: str) -> None:
    bench = Bench()
    bench.news = [WorkerNews("vision", change, "status 3")]
    bench.run()
    bench.run()
    assert bench.reports == [(event, "vision: status 3")]


def test_a_step_of_the_wall_clock_is_an_event_with_its_sign() -> None:
    bench = Bench()
    bench.run()
    bench.wall_ns -= 2 * S
    bench.run()
    bench.run()
    assert bench.reports == [("clock-step", "by -2.000 s")]


def test_readings_of_the_current_monitor_are_noted_once_and_its_errors_reported() -> None:
    bench = Bench()
    bench.run()
    assert bench.notes == []
    bench.power.reading = SimpleNamespace(time_ns=5 * S, current=0.25)
    bench.run()
    bench.run()
    assert bench.notes == [("power", 5 * S, 0.25)]
    assert bench.said["power-fault"] == (False, "readings arrive again")
    bench.power.said = "no acknowledge"
    bench.run()
    assert bench.said["power-fault"] == (True, "no acknowledge")
    without = Bench(power=False)
    without.run()
    assert without.said["power-fault"][0] is False
    assert without.notes == []


def test_poor_streams_are_reported() -> None:
    bench = Bench()
    bench.poor = [(SimpleNamespace(poor=facts.CAMERA_LATE), True, "slow")]
    bench.run()
    assert bench.said[facts.CAMERA_LATE.name] == (True, "slow")


def test_resources_are_sampled_on_a_ticker_and_each_sample_is_checked_once() -> None:
    bench = Bench()
    sample = ResourceSample(0, 1.0, 8e7, 1.5e8, 1e10, 99.0)
    bench.task.read_resources(lambda now: sample if now else None, 5 * S)  # type: ignore[arg-type,return-value]
    name, period_ns, job = bench.sampled
    assert (name, period_ns) == ("resources", 5 * S)
    bench.run()
    assert facts.HOT.name not in bench.said, "no sample yet"
    job()
    bench.run()
    assert bench.said[facts.HOT.name][0] is True
    bench.said.clear()
    bench.run()
    assert facts.HOT.name not in bench.said
    bench.task.adopt(Health(temperature=120.0, hottest=130.0))
    job()
    bench.run()
    assert bench.said[facts.HOT.name][0] is False
    bench.task.close()
    bench.task.close()
    assert bench.ended == 1


def test_the_health_packet_has_the_state_of_the_flight() -> None:
    bench = Bench()
    bench.control.slips = 4
    bench.run(1.0, slot=1)
    assert bench.records == []
    bench.facts.update(facts.CAMERA_LATE, True, 0, "late")
    held = [fact for fact in FACTS if bench.facts.holds(fact)]
    assert held
    bench.run(4.0, slot=4)
    (record,) = bench.records
    assert (record["packet"], record["now_ns"]) == (HEALTH, 5 * S)
    assert (record["mode"], record["mode_age"]) == (int(Mode.SAFE), pytest.approx(2.0))
    assert record["facts"] == sum(1 << FACTS.index(fact) for fact in held)
    assert record["coils_in_use"] == 0b101
    assert (record["fed"], record["slips"], record["clock_steps"]) == (1 + (bench.fed == 2), 4, 0)
    assert math.isnan(record["cpu_share"])
    assert math.isnan(record["memory_slope"])
    assert math.isnan(record["temperature"])
    assert {name: record[name] for name in ("imu", "field", "coils", "power", "camera")} == {
        "imu": 3, "field": 5, "coils": 5, "power": 5, "camera": 6,
    }  # fmt: skip
    bench.task._sample = ResourceSample(bench.now_ns, 1.0, 8e7, 1.5e8, 1e10, 51.0)
    bench.run(0.25, slot=8)
    found = bench.records[-1]
    values = [found[name] for name in ("resident", "proportional", "disk_free", "temperature")]
    assert values == [8e7, 1.5e8, 1e10, 51.0]
    assert set(found) - {"packet", "now_ns"} == {field.name for field in HEALTH.fields}


class Devices:
    """Test doubles of the tasks and devices whose counters the housekeeping packet contains."""

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []
        self.said: list[tuple[str, bool, str]] = []
        self.log_error = ""
        self.power: Any = SimpleNamespace(
            said="",
            error=lambda: self.power.said,
            latest=lambda: SimpleNamespace(voltage=5.1, current=0.2, power=1.02),
        )
        self.services = SimpleNamespace(
            recorder=SimpleNamespace(
                lost=2, lost_text="", record=lambda packet, _, **values: self._record(packet, values)
            ),
            events=SimpleNamespace(count=17, report=lambda *_: None),
            facts=SimpleNamespace(
                update=lambda fact, holds, _, text: self.said.append((fact.name, holds, text))
            ),
        )

    def _record(self, packet: Any, values: dict[str, Any]) -> None:
        assert packet is HOUSEKEEPING
        assert set(values) == {field.name for field in HOUSEKEEPING.fields}
        self.records.append(values)

    def housekeeping(self, imaging: bool = True, power: bool = True) -> Housekeeping:
        """Return the task with or without a star camera and a current monitor."""
        return Housekeeping(
            cast(Any, SimpleNamespace(link=lambda: ImuLink(99, 1, 2, 3, 4, 5, 0))),
            cast(Any, SimpleNamespace(counts=lambda: (6, 7))),
            cast(Any, SimpleNamespace(counts=lambda: (8, 9))) if imaging else None,
            cast(Any, SimpleNamespace(state=lambda: SimpleNamespace(faults=11))),
            cast(Any, self.power) if power else None,
            lambda: self.log_error,
            cast(Any, self.services),
        )


def test_the_housekeeping_packet_has_the_counters_of_tasks_and_devices() -> None:
    devices = Devices()
    cycle = cast(Any, SimpleNamespace(start_ns=5 * S))
    devices.housekeeping().run(cycle, SteeringState.BRAKING)
    assert devices.records == [
        {
            "state": int(SteeringState.BRAKING),
            "imu_packets": 1, "imu_bad_checksum": 2, "imu_discarded_bytes": 3, "imu_out_of_range": 4,
            "imu_not_finite": 5, "plans_accepted": 6, "plans_refused": 7, "frames": 8, "streak_rates": 9,
            "coil_faults": 11, "coil_voltage": 5.1, "coil_current": 0.2, "coil_power": 1.02, "events": 17,
            "records_lost": 2,
        }
    ]  # fmt: skip
    assert devices.said == [("log-fault", False, "packets reach the disk again")]


@pytest.mark.parametrize(("power", "said"), [(False, ""), (True, "no acknowledge")])
def test_without_camera_and_current_monitor_their_values_are_zero_or_unknown(power: bool, said: str) -> None:
    devices = Devices()
    devices.power.said, devices.log_error = said, "disk full"
    devices.housekeeping(imaging=False, power=power).run(
        cast(Any, SimpleNamespace(start_ns=5 * S)), SteeringState.OFF
    )
    (values,) = devices.records
    assert (values["frames"], values["streak_rates"]) == (0, 0)
    assert np.isnan([values["coil_voltage"], values["coil_current"], values["coil_power"]]).all()
    assert devices.said == [("log-fault", True, "disk full")]
