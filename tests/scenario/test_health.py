"""Tests of health monitoring in flight: watchdog, guardian heartbeat, device streams, resources, restarts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flight.link.events import Mode
from flight.loop.facts import FACTS, IMU_POOR, TASK_FAILING, StreamState
from flight.loop.health import ResourceSample
from ground.telemetry import Run
from sim_hal.emulators.serial_line import SOUND, LineFaults
from tests.scenario.mode_flights import commanded, modes_of
from tests.support.flights import Rigged, demo_config, event_names, fly

SECOND = 1_000_000_000


class Signs:
    """Recorder of the mission times (s) of the heartbeats of a flight."""

    def __init__(self) -> None:
        self.fed: list[float] = []
        self.beats: list[float] = []

    def watch(self, rigged: Rigged) -> None:
        def now() -> float:
            return (rigged.lock.clock.now_ns() - rigged.epoch_ns) / SECOND

        rigged.loop._tasks.health._feed = lambda: self.fed.append(now())
        rigged.loop._supervisors = replace(rigged.loop._supervisors, beat=lambda: self.beats.append(now()))


def failing(rigged: Rigged, since: float, until: float) -> None:
    """Make the control task raise an exception in each cycle from one mission time (s) to another."""
    host = rigged.lock.line.host
    receive = host.receive

    def fail() -> list[tuple[int, bytes]]:
        if since <= (rigged.lock.clock.now_ns() - rigged.epoch_ns) / SECOND < until:
            raise ZeroDivisionError("a defect")
        return receive()

    host.receive = fail  # type: ignore[method-assign]  # a replaced method


def last(run: Run, field: str) -> float:
    return float(run["health"][field][-1])


def test_a_healthy_flight_feeds_the_watchdog_four_times_a_second_and_beats_every_cycle(
    tmp_path: Path,
) -> None:
    signs = Signs()
    run = fly(demo_config(5.0, camera=False), tmp_path, signs.watch)
    assert len(signs.fed) == 20
    assert len(signs.beats) == 200
    assert run["health"]["fed"].tolist() == [1, 5, 9, 13, 17]
    assert run["health"]["mode"].tolist() == [Mode.BOOT] + [Mode.TESTBED_DEMO] * 4
    for stream in ("imu", "field", "coils", "power"):
        states = run["health"][stream]
        assert states[0] in (StreamState.NO_READING_YET, StreamState.GOOD), stream
        assert (states[1:] == StreamState.GOOD).all(), stream
    assert run["health"]["imu"][0] == StreamState.NO_READING_YET, "the first packet precedes the readings"
    assert (run["health"]["camera"] == StreamState.NOT_FITTED).all()
    assert not run["health"]["facts"].any()
    assert math.isnan(last(run, "cpu_share")), "in lock-step the board says nothing of the flight"


def test_a_control_task_that_only_fails_sends_no_heartbeat_and_does_not_feed_the_watchdog(
    tmp_path: Path,
) -> None:
    signs = Signs()

    def prepare(rigged: Rigged) -> None:
        signs.watch(rigged)
        failing(rigged, 2.0, 60.0)

    run = fly(demo_config(8.0, camera=False), tmp_path, prepare)
    assert max(signs.beats) < 2.0
    assert 3.5 < max(signs.fed) < 4.5, "two seconds are its patience"
    names = event_names(run)
    assert names.index("task-failed") < names.index("task-failing") < names.index("no-progress")
    assert modes_of(run)[-1] is Mode.SAFE
    assert int(last(run, "facts")) >> FACTS.index(TASK_FAILING) & 1


def test_heartbeats_and_feeding_resume_when_the_task_runs_again(tmp_path: Path) -> None:
    signs = Signs()

    def prepare(rigged: Rigged) -> None:
        signs.watch(rigged)
        failing(rigged, 2.0, 5.0)

    fly(demo_config(8.0, camera=False), tmp_path, prepare)
    assert not [at for at in signs.beats if 2.0 <= at < 5.0]
    assert min(at for at in signs.beats if at >= 5.0) < 5.05
    assert min(at for at in signs.fed if at > 4.6) < 5.3


def test_a_unit_that_sends_half_its_packets_is_slow(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        wire = rigged.lock.line.to_host
        rigged.at(3.0, lambda: setattr(wire, "faults", LineFaults(cut_probability=0.4)))
        rigged.at(9.0, lambda: setattr(wire, "faults", SOUND))

    run = fly(demo_config(15.0, camera=False), tmp_path, prepare)
    states = run["health"]["imu"]
    assert (states[5:9] == StreamState.SLOW).any()
    assert states[-1] == StreamState.GOOD
    names = event_names(run)
    assert names.index("stream-poor") < names.index("stream-good")
    poor = run["health"]["facts"].astype(np.uint64) >> np.uint64(FACTS.index(IMU_POOR)) & np.uint64(1)
    assert poor.max() == 1
    assert poor[-1] == 0


def reading(memory: Callable[[float], float], rigged: Rigged) -> None:
    """Let the flight check its resources every 0.5 s, as if its processes used `memory` bytes."""

    def look(now_ns: int) -> ResourceSample:
        seconds = (now_ns - rigged.epoch_ns) / SECOND
        return ResourceSample(now_ns, 0.3 * seconds, 5e7, memory(seconds), 1e10, 50.0)

    rigged.loop._tasks.health.read_resources(look, SECOND // 2)


def test_too_much_memory_ends_the_flight_in_order_and_requests_a_restart(tmp_path: Path) -> None:
    loops = []

    def prepare(rigged: Rigged) -> None:
        loops.append(rigged.loop)
        reading(lambda seconds: 2e9 if seconds > 3.0 else 1e8, rigged)

    run = fly(demo_config(20.0, camera=False), tmp_path, prepare)
    assert run["control"]["time_ns"][-1] < 6 * SECOND
    assert loops[0].restart.startswith("memory-high: 2e+09 bytes")
    assert run["event"]["text"][-1].startswith(b"restart requested: memory-high")
    assert last(run, "cpu_share") == pytest.approx(0.3)
    for log in run.logs.values():
        assert log.intact


def test_a_step_of_the_wall_clock_is_reported_and_has_no_effect(tmp_path: Path) -> None:
    def prepare(rigged: Rigged) -> None:
        clock = rigged.lock.clock
        rigged.at(2.0, lambda: setattr(clock, "_utc_start_ns", clock._utc_start_ns - 3600 * SECOND))

    run = fly(demo_config(5.0, camera=False), tmp_path / "stepped", prepare)
    sound = fly(demo_config(5.0, camera=False), tmp_path / "sound")
    assert event_names(run) == ["started", "target", "clock-step", "stopped"]
    assert last(run, "clock_steps") == 1
    assert run["control"].tobytes() == sound["control"].tobytes()


def test_in_safe_heartbeats_continue_and_the_watchdog_is_fed(tmp_path: Path) -> None:
    signs = Signs()
    fly(commanded(3.0, initial="safe"), tmp_path, signs.watch)
    assert len(signs.fed) == 12
    assert len(signs.beats) == 120
