"""Tests of the horizon camera task: intervals of the images, missing frames, and lost cameras."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from flight.link import events
from flight.loop import facts
from flight.loop.executive import JobResult
from flight.loop.facts import Services
from flight.loop.navigation import HORIZON_WORKER, HorizonCameraSettings, HorizonCameraTask
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from hal.interfaces.wires import SECOND_NS
from knightcube.vision.horizon_camera_job import HorizonCameraJob, HorizonCameraResult, MeasuredDirection

SETTINGS = HorizonCameraSettings(
    (5_000_000, 5_000_000), 5 * SECOND_NS, 60 * SECOND_NS, 2 * SECOND_NS, 120 * SECOND_NS
)


class Camera:
    """A camera that delivers a frame one second after its trigger, or no frame."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.triggers, self.dead, self.pending = bench, 0, False, False
        self.frozen = False

    def trigger(self, _: int) -> None:
        if self.dead:
            raise NotResponding("wide", "is off")
        self.triggers, self.pending, self.begun_ns = self.triggers + 1, True, self.bench.now_ns

    def poll(self) -> Frame | None:
        if not self.pending or self.bench.now_ns == self.begun_ns:
            return None
        self.pending = False
        pixels = np.full((4, 4), 7 if self.frozen else self.triggers % 256, np.uint8)
        return Frame(self.triggers, self.begun_ns, 5_000_000, self.bench.now_ns, pixels)

    def close(self) -> None:
        pass


class Bench:
    """Two cameras, a body that may need their images, a worker that finds the Sun, and reported events."""

    def __init__(self) -> None:
        self.now_ns, self.needed, self.busy = 0, True, False
        self.jobs: list[Mapping[int, Frame]] = []
        self.accepted: list[int] = []
        self.records: list[dict[str, Any]] = []
        self.reports: list[events.EventKind] = []
        self.said: list[bool] = []
        self.false: list[bool] = []
        self.denied: dict[int, str] | None = {}
        self.cameras = [Camera(self), Camera(self)]
        recorder = SimpleNamespace(epoch_ns=0, record=lambda *_, **fields: self.records.append(fields))
        services = SimpleNamespace(
            jobs=SimpleNamespace(submit=lambda worker, _: worker == HORIZON_WORKER and not self.busy),
            recorder=recorder,
            events=SimpleNamespace(report=lambda kind, *_: self.reports.append(kind)),
            facts=SimpleNamespace(update=self._update),
        )
        self.task = HorizonCameraTask(self.cameras, self, SETTINGS, cast(Services, services))
        self.task.begin(0)

    def _update(self, fact: object, holds: bool, *_: object) -> None:
        assert fact in {facts.WIDE_LOST, facts.WIDE_FALSE}
        (self.said if fact is facts.WIDE_LOST else self.false).append(holds)

    def job(self, frames: Mapping[int, Frame]) -> HorizonCameraJob:
        self.jobs.append(frames)
        return cast(HorizonCameraJob, None)

    def accept(self, time_ns: int, found: HorizonCameraResult) -> tuple[bool, bool]:
        self.accepted.append(time_ns)
        return found.sun is not None, False

    def fly(self, seconds: int) -> None:
        """Run the task once a second. The worker returns each result within a second."""
        sun = MeasuredDirection(np.array([1.0, 0.0, 0.0]), 1e-6 * np.eye(3), (1,))
        found = HorizonCameraResult(sun, None, false=self.denied)
        for _ in range(seconds):
            if self.task.busy_since_ns() is not None:
                self.task.finish(JobResult(HORIZON_WORKER, "done", found, "", 0, 0, 0), self.now_ns)
            self.task.run(self.now_ns)
            self.now_ns += SECOND_NS


def test_rounds_come_often_while_they_are_needed_and_seldom_otherwise() -> None:
    bench = Bench()
    bench.fly(60)
    assert bench.cameras[0].triggers == 12
    bench.needed = False
    bench.fly(120)
    assert 13 <= bench.cameras[0].triggers <= 15
    assert all(len(frames) == 2 for frames in bench.jobs)
    assert bench.accepted[0] == 2_500_000, "the middle of the exposure, not when the frame came"
    record = bench.records[0]
    assert (record["frames"], record["sun_cameras"], record["sun_used"], record["nadir_used"]) == (3, 2, 1, 0)


def test_a_dead_camera_does_not_keep_the_others_and_is_reported_until_it_is_back() -> None:
    bench = Bench()
    bench.cameras[1].dead = True
    bench.fly(130)
    assert {tuple(frames) for frames in bench.jobs} == {(0,)}
    assert bench.said.index(True) > 120, "a pause of one minute is not reported as a loss"
    bench.cameras[1].dead = False
    bench.fly(10)
    assert not bench.said[-1]


def test_a_worker_that_is_not_there_is_reported_and_the_next_round_comes() -> None:
    bench = Bench()
    bench.busy = True
    bench.fly(4)
    assert bench.reports == [events.VISION_FAILED]
    bench.busy = False
    bench.fly(10)
    assert bench.accepted


def test_a_camera_that_repeats_its_picture_gives_no_frames() -> None:
    bench = Bench()
    bench.fly(10)
    bench.cameras[1].frozen = True
    bench.fly(150)
    assert set(bench.jobs[-1]) == {0}
    assert bench.said[-1]


def test_pictures_that_an_attitude_denies_are_reported_where_one_judges_them() -> None:
    bench = Bench()
    bench.denied = None
    bench.fly(11)
    assert bench.false == []
    bench.denied = {1: "the image is dark where the sunlit Earth should be"}
    bench.fly(11)
    assert bench.false
    assert all(bench.false)
    bench.denied = {}
    bench.fly(6)
    assert not bench.false[-1]
