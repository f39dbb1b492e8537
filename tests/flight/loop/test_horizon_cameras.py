"""Tests of the horizon camera task: intervals of the images, missing frames, and lost cameras."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

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

EPOCH = SECOND_NS // 2


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
        self.texts: list[str] = []
        self.false: list[bool] = []
        self.denied: dict[int, str] | None = {}
        self.cameras = [Camera(self), Camera(self)]
        recorder = SimpleNamespace(epoch_ns=EPOCH, record=lambda *_, **fields: self.records.append(fields))
        services = SimpleNamespace(
            jobs=SimpleNamespace(submit=lambda worker, _: worker == HORIZON_WORKER and not self.busy),
            recorder=recorder,
            events=SimpleNamespace(report=self._report),
            facts=SimpleNamespace(update=self._update),
        )
        self.task = HorizonCameraTask(self.cameras, self, SETTINGS, cast(Services, services))
        self.task.begin(0)

    def _report(self, kind: events.EventKind, _: int, text: str) -> None:
        self.reports.append(kind)
        self.texts.append(text)

    def _update(self, fact: object, holds: bool, _: int, text: str) -> None:
        assert fact in {facts.WIDE_LOST, facts.WIDE_FALSE}
        if holds:
            self.texts.append(text)
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


def test_a_dead_camera_does_not_delay_the_others_and_is_reported_until_its_recovery() -> None:
    bench = Bench()
    bench.cameras[1].dead = True
    bench.fly(130)
    assert {tuple(frames) for frames in bench.jobs} == {(0,)}
    assert bench.said.index(True) > 120, "a pause of one minute is not reported as a loss"
    bench.cameras[1].dead = False
    bench.fly(10)
    assert not bench.said[-1]


def test_an_unavailable_worker_is_reported_and_the_next_round_comes() -> None:
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


def test_images_that_contradict_a_known_attitude_are_reported() -> None:
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


def test_a_record_has_the_measured_directions_with_their_cameras_and_uncertainties() -> None:
    bench = Bench()
    bench.now_ns = 10 * SECOND_NS
    sun = MeasuredDirection(np.array([0.6, 0.0, 0.8]), 4e-6 * np.eye(3), (0,))
    nadir = MeasuredDirection(np.array([0.0, -1.0, 0.0]), 9e-6 * np.eye(3), (0, 1))
    bench.task.run(bench.now_ns)
    bench.now_ns += SECOND_NS
    bench.task.run(bench.now_ns)
    assert bench.task.busy_since_ns() == 11 * SECOND_NS
    bench.accept = lambda *_: (False, True)  # type: ignore[method-assign]
    result = JobResult(HORIZON_WORKER, "done", HorizonCameraResult(sun, nadir), "", 0, 0, 0)
    bench.task.finish(result, bench.now_ns)
    assert bench.task.busy_since_ns() is None
    bench.task.finish(result, bench.now_ns)
    (record,) = bench.records  # a second result of the same job is ignored
    assert record["middle_ns"] == 10 * SECOND_NS + 2_500_000 - EPOCH
    assert record["frames"] == 3
    assert (record["sun"], record["nadir"]) == ([0.6, 0.0, 0.8], [0.0, -1.0, 0.0])
    assert (record["sun_sigma"], record["nadir_sigma"]) == (sun.sigma, nadir.sigma)
    assert (record["sun_cameras"], record["nadir_cameras"]) == (1, 3)
    assert (record["sun_used"], record["nadir_used"]) == (0, 1)


def test_a_result_without_directions_is_recorded_as_such() -> None:
    bench = Bench()
    bench.task.run(0)
    bench.now_ns = SECOND_NS
    bench.task.run(SECOND_NS)
    result = JobResult(HORIZON_WORKER, "done", HorizonCameraResult(None, None), "", 0, 0, 0)
    bench.task.finish(result, SECOND_NS)
    (record,) = bench.records
    numbers = [*record["sun"], *record["nadir"], record["sun_sigma"], record["nadir_sigma"]]
    assert np.isnan(numbers).all()
    assert (record["sun_cameras"], record["nadir_cameras"], record["sun_used"]) == (0, 0, 0)


def test_a_failed_job_is_reported_and_gives_no_directions() -> None:
    bench = Bench()
    bench.task.run(0)
    bench.now_ns = SECOND_NS
    bench.task.run(SECOND_NS)
    bench.task.finish(JobResult(HORIZON_WORKER, "died", None, "signal 9", 0, 0, 0), SECOND_NS)
    assert bench.reports == [events.VISION_FAILED]
    assert bench.texts == ["wide cameras: died: signal 9"]
    assert bench.accepted == []
    assert bench.task.busy_since_ns() is None


def test_a_trigger_waits_for_its_frames_until_they_are_late_and_no_other_follows_meanwhile() -> None:
    bench = Bench()
    bench.cameras[1].dead = True
    bench.task.run(0)
    bench.now_ns = 1 * SECOND_NS
    bench.task.run(bench.now_ns)
    bench.now_ns = 2 * SECOND_NS - 1
    bench.task.run(bench.now_ns)
    assert bench.jobs == [], "the second camera may still deliver"
    bench.now_ns += 1
    bench.task.run(bench.now_ns)
    assert [set(frames) for frames in bench.jobs] == [{0}]
    bench.now_ns = 20 * SECOND_NS
    bench.task.run(bench.now_ns)
    assert bench.cameras[0].triggers == 1, "the worker is still busy"


@pytest.mark.parametrize(("needed", "period"), [(True, 5 * SECOND_NS), (False, 60 * SECOND_NS)])
def test_the_next_trigger_comes_exactly_after_its_period(needed: bool, period: int) -> None:
    bench = Bench()
    bench.needed = needed
    bench.fly(3)
    bench.now_ns = period - 1
    bench.task.run(bench.now_ns)
    assert bench.cameras[0].triggers == 1
    bench.now_ns += 1
    bench.task.run(bench.now_ns)
    assert bench.cameras[0].triggers == 2


def test_a_lost_camera_is_reported_with_its_age_and_its_error() -> None:
    bench = Bench()
    bench.cameras[1].dead = True
    bench.task.run(0)
    bench.task.run(120 * SECOND_NS)
    assert not any(bench.said), "at the limit"
    bench.cameras[0].dead = True
    bench.task.run(121 * SECOND_NS)
    assert bench.said[-1]
    assert bench.texts[-1].startswith("no frame of camera 1, 2 for 121 s: ")
    assert "is off" in bench.texts[-1]


def test_a_frame_of_an_earlier_trigger_is_not_used() -> None:
    bench = Bench()
    first, second = bench.cameras
    second.poll = lambda: None  # type: ignore[method-assign]
    bench.fly(3)
    late = Frame(9, 0, 5_000_000, 0, np.full((4, 4), 99, np.uint8))
    bench.now_ns = 5 * SECOND_NS
    bench.task.finish(JobResult(HORIZON_WORKER, "done", HorizonCameraResult(None, None), "", 0, 0, 0), 0)
    bench.task.run(bench.now_ns)
    assert first.triggers == 2
    second.poll = lambda: late  # type: ignore[method-assign]
    bench.now_ns += SECOND_NS
    bench.task.run(bench.now_ns)
    bench.now_ns += SECOND_NS
    bench.task.run(bench.now_ns)
    assert [set(frames) for frames in bench.jobs] == [{0}, {0}]
