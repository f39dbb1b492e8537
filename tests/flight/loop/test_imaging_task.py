"""Tests of the imaging task with test doubles: triggers, camera monitoring, jobs and their results."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flight.link import events
from flight.link.telemetry.definitions import LENS, MOST_SIGHTINGS, SIGHTINGS, STARS, STREAK, TRACK
from flight.loop import facts
from flight.loop.executive import JobResult
from flight.loop.imaging import FrameMeasurer, Imaging, ImagingSettings, ObjectTracks, _packed
from hal.interfaces.devices import Frame
from hal.interfaces.errors import NotResponding
from knightcube.astro.attitude.wahba import AttitudeFix
from knightcube.astro.quaternion import attitude_matrix, conjugate, from_rotation_vector, multiply
from knightcube.gnc.estimation.estimate import AttitudeMeasurement, Knowledge, MeanRateMeasurement
from knightcube.gnc.tracker import TrackSettings
from knightcube.vision.camera.images import KeptFrames
from knightcube.vision.camera.lens import CameraKnowledge, Exposures, Pinhole
from knightcube.vision.frame_job import FrameFound, FrameJob, TrackerSettings
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.objects.settings import MeasuredObjects, ObjectMeasurementSettings
from knightcube.vision.startracker.solve import FrameSolution, SolveSettings, SolveStatus
from knightcube.vision.startracker.survey import FrameKind
from knightcube.vision.streaks.streak_result import FrameMotion, LikelihoodSettings, StreakStatus

S = 1_000_000_000
MS = 1_000_000
MOUNTING = from_rotation_vector(np.array([0.3, -0.5, 0.8]))
TO_CAMERA = attitude_matrix(MOUNTING)
CAMERA = Pinhole(320, 240, 400.0)
EPOCH = 7 * S
RNG = np.random.default_rng(3)
COVARIANCE = np.diag([4e-6, 9e-6, 1e-6, 1e-4, 4e-4, 2.5e-5])


class Bench:
    """An imaging task with test doubles that record the received calls."""

    def __init__(self, **changes: Any) -> None:
        self.frames: list[Frame | Exception] = []
        self.triggers: list[int] = []
        self.jobs: list[FrameJob] = []
        self.records: list[tuple[Any, dict[str, Any]]] = []
        self.reports: list[Any] = []
        self.texts: list[str] = []
        self.facts: dict[Any, list[bool]] = {}
        self.fact_texts: dict[Any, str] = {}
        self.notes: list[tuple[str, int]] = []
        self.late: list[list[Any]] = []
        self.accepts = True
        self.takes = True
        self.broken = False
        self.estimate: Any = None
        self.begins = False
        self.tracks: list[Any] = []
        self.navigation = SimpleNamespace(
            speed=0.0,
            estimate=lambda _: self.estimate,
            past=lambda at: None if self.estimate is None else self.past(at),
            rates=lambda *_: None,
            begin_from=lambda _: self.begins,
            ingest_late=self._ingest,
        )
        services = SimpleNamespace(
            recorder=SimpleNamespace(
                epoch_ns=EPOCH, record=lambda packet, _, **values: self.records.append((packet, values))
            ),
            events=SimpleNamespace(report=self._report),
            facts=SimpleNamespace(update=self._update),
            streams=SimpleNamespace(note=lambda name, at: self.notes.append((name, at))),
            jobs=SimpleNamespace(submit=self._submit),
        )
        self.services = cast(Any, services)
        plain: dict[str, Any] = {
            "camera": CAMERA,
            "exposures": Exposures(0.2, 0.1, 1.0, CAMERA.focal_length),
            "fine_rest_ns": 10 * S,
            "max_age_ns": 30 * S,
            "late_ns": 1 * S,
            "slow_ns": 2 * S,
            "max_rate": 0.5,
            "mounting": MOUNTING,
            "estimator": LikelihoodSettings(),
            "tracker": TrackerSettings(SolveSettings(), (1.0, 1.0)),
            "angular_acceleration_psd": lambda _: 1e-8 * np.eye(3),
            "velocity": lambda _: None,
            "knowledge": lambda: Knowledge.COARSE,
            "seeks": lambda: False,
            "calm": lambda now, _: now,
        }
        self.settings = ImagingSettings(**{**plain, **changes})
        self.view = SimpleNamespace(rate_text=lambda rate: f"{len(rate.rate)} rates")
        self.body = cast(
            Any,
            SimpleNamespace(
                estimation=SimpleNamespace(orbit=lambda _: None),
                control=SimpleNamespace(accept_tracks=lambda tracks, _: self.tracks.append(list(tracks))),
            ),
        )
        objects = ObjectTracks(TrackSettings(needed=3, within=5, coast=4.0), self.body, self.services)
        camera = SimpleNamespace(trigger=self._trigger, poll=self._poll)
        navigation, view = cast(Any, self.navigation), cast(Any, self.view)
        self.task = Imaging(cast(Any, camera), self.settings, navigation, view, self.services, objects)
        self.task.begin(0)

    @staticmethod
    def past(at: int) -> Any:
        """Return the past estimate of a body that rotates about x at 0.01 rad/s."""
        quaternion = from_rotation_vector(np.array([0.01 * at * 1e-9, 0.0, 0.0]))
        return SimpleNamespace(quaternion=quaternion, rate=np.array([0.01, 0.0, 0.0]), covariance=COVARIANCE)

    def _update(self, fact: Any, is_so: bool, _: int, text: str) -> None:
        self.facts.setdefault(fact, []).append(is_so)
        self.fact_texts[fact] = text

    def _report(self, kind: Any, _: int, text: str) -> None:
        self.reports.append(kind)
        self.texts.append(text)

    def _trigger(self, exposure_ns: int) -> None:
        if self.broken:
            raise NotResponding("camera", "no such device")
        self.triggers.append(exposure_ns)

    def _poll(self) -> Frame | None:
        if not self.frames:
            return None
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame

    def _submit(self, worker: str, job: Any) -> bool:
        assert worker == "vision"
        self.jobs.append(job)
        return self.takes

    def _ingest(self, late: list[Any], report: Callable[[list[bool]], None]) -> None:
        self.late.append(late)
        report([self.accepts] * len(late))

    def cycle(self, at: int) -> Any:
        """Return a control cycle that starts at a time in ns."""
        return cast(Any, SimpleNamespace(start_ns=at))

    def take(self, sequence: int, start: int, now: int) -> None:
        """Deliver a frame that was exposed for 0.2 s from `start`."""
        self.frames.append(frame(sequence, start))
        self.task.serve(now)

    def finish(self, value: Any, now: int, outcome: str = "done") -> None:
        """Make the worker return a result."""
        result = SimpleNamespace(worker="vision", outcome=outcome, error="why", value=value)
        self.task.finish(cast(JobResult, result), now)

    def only(self, packet: Any) -> dict[str, Any]:
        """Return the values of the only recorded packet of a type."""
        (values,) = [values for kind, values in self.records if kind is packet]
        return values


def frame(sequence: int, start: int) -> Frame:
    """Return a frame of noise that was exposed for 0.2 s from `start`."""
    pixels = RNG.integers(90, 130, (64, 80)).astype(np.uint16)
    return Frame(sequence, start, 200 * MS, start + 250 * MS, pixels)


def motion(status: StreakStatus = StreakStatus.RATE) -> FrameMotion:
    """Return a motion from 12 streaks, of which 10 were used."""
    if status is not StreakStatus.RATE:
        return FrameMotion(status, 98, 0.2)
    return FrameMotion(
        status,
        99,
        0.2,
        length=21.5,
        endpoints=np.zeros((12, 2, 2)),
        used=np.arange(12) < 10,
        rate=np.array([0.01, 0.02, 0.03]),
        covariance=np.diag([1e-6, 2e-6, 3e-6]),
        residual=2e-5,
    )


def test_an_exposure_is_ordered_and_awaited() -> None:
    bench = Bench()
    bench.task.trigger(bench.cycle(1 * S))
    assert bench.triggers == [200 * MS], "the usual exposure without an estimate"
    bench.task.serve(1 * S + 1400 * MS)
    assert facts.CAMERA_LATE not in bench.facts, "due two exposures and late_ns after the trigger"
    bench.task.serve(1 * S + 1400 * MS + 1)
    assert bench.facts[facts.CAMERA_LATE] == [True]


def test_the_exposure_follows_the_rate_across_the_boresight() -> None:
    bench = Bench()
    rate = TO_CAMERA.T @ np.array([0.12, -0.16, 5.0])
    bench.estimate = SimpleNamespace(rate=rate)
    exposures = bench.settings.exposures
    assert exposures.at(0.2) != exposures.at(0.12)
    found = FrameMeasurer(bench.settings, cast(Any, bench.navigation)).exposure_ns(0)
    assert found == pytest.approx(exposures.at(0.2) * S, abs=1.0)


def test_no_exposure_begins_while_the_body_rotates_too_fast() -> None:
    bench = Bench()
    bench.navigation.speed = 0.5
    bench.task.trigger(bench.cycle(1 * S))
    assert len(bench.triggers) == 1, "at the limit"
    bench.navigation.speed = 0.51
    bench.task.trigger(bench.cycle(20 * S))
    assert len(bench.triggers) == 1
    assert bench.notes == [("camera", 20 * S)], "the pause counts as a good stream"
    bench.task.serve(50 * S)
    assert not any(bench.facts.get(facts.CAMERA_LOST, [])), "the age counts from the pause"


@pytest.mark.parametrize(
    ("knowledge", "seeks", "speed", "at", "exposed"),
    [
        (Knowledge.FINE, False, 0.019, 10 * S - 1, 1),
        (Knowledge.FINE, False, 0.019, 10 * S, 2),
        (Knowledge.FINE, True, 0.019, 5 * S, 2),
        (Knowledge.FINE, False, 0.1, 5 * S, 2),
        (Knowledge.COARSE, False, 0.019, 5 * S, 2),
    ],
)
def test_while_the_attitude_is_fine_and_the_body_slow_exposures_rest(
    knowledge: Knowledge, seeks: bool, speed: float, at: int, exposed: int
) -> None:
    bench = Bench(knowledge=lambda: knowledge, seeks=lambda: seeks)
    bench.navigation.speed = speed
    bench.task.trigger(bench.cycle(0))
    assert len(bench.triggers) == 1, "the first frame needs no rest"
    bench.task.trigger(bench.cycle(at))
    assert len(bench.triggers) == exposed


def test_an_exposure_waits_for_constant_coil_currents() -> None:
    asked: list[tuple[int, int]] = []

    def calm(now: int, exposure: int) -> int:
        asked.append((now, exposure))
        return now + 300 * MS

    bench = Bench(calm=calm)
    bench.task.trigger(bench.cycle(1 * S))
    assert asked == [(1 * S, 200 * MS)]
    bench.task.serve(1300 * MS - 1)
    assert bench.triggers == []
    bench.task.serve(1300 * MS)
    bench.task.serve(1400 * MS)
    assert bench.triggers == [200 * MS], "once"
    bench.task.serve(2700 * MS)
    assert facts.CAMERA_LATE not in bench.facts, "due from the trigger on"
    bench.task.serve(2700 * MS + 1)
    assert bench.facts[facts.CAMERA_LATE] == [True]


def test_a_camera_that_does_not_respond_is_lost() -> None:
    bench = Bench()
    bench.broken = True
    bench.task.trigger(bench.cycle(1 * S))
    assert bench.facts == {facts.CAMERA_LOST: [True]}
    bench.task.serve(10 * S)
    assert facts.CAMERA_LATE not in bench.facts, "no frame is due after a trigger that failed"
    other = Bench()
    other.frames.append(NotResponding("camera", "unplugged"))
    other.task.serve(1 * S)
    assert other.facts == {facts.CAMERA_LOST: [True]}


def test_a_camera_without_frames_is_lost_after_its_age_limit() -> None:
    bench = Bench()
    bench.task.serve(30 * S)
    assert bench.facts == {}
    bench.task.serve(30 * S + 1)
    assert bench.facts == {facts.CAMERA_LOST: [True]}


def test_a_frame_goes_to_the_worker_with_its_facts() -> None:
    bench = Bench(objects=ObjectMeasurementSettings(faintest=5.0))
    bench.take(3, 1 * S, 1300 * MS)
    (job,) = bench.jobs
    assert (job.exposure, job.camera, job.previous_checksum) == (0.2, CAMERA, None)
    assert (job.rate_prior, job.attitude_prior, job.kept) == (None, None, None)
    assert job.objects == bench.settings.objects
    assert cast(LikelihoodSettings, job.estimator).rate_model == "accelerating", "without an estimate"
    assert job.pixels.shape == (64, 80)
    assert bench.task.counts() == (1, 0)
    assert bench.task.busy_since_ns() == 1300 * MS
    assert bench.notes == [("camera", 1300 * MS)]
    assert bench.facts == {facts.CAMERA_LOST: [False], facts.CAMERA_LATE: [False]}
    bench.finish(FrameFound(motion(), None), 1400 * MS)
    assert bench.task.busy_since_ns() is None
    bench.take(4, 2 * S, 2300 * MS)
    assert bench.jobs[1].previous_checksum == 99
    assert bench.task.counts()[0] == 2


@pytest.mark.parametrize(
    ("now", "late", "lost", "noted"),
    [
        (2200 * MS, False, False, True),
        (2200 * MS + 1, True, False, True),
        (31_200 * MS, True, False, True),
        (31_200 * MS + 1, True, True, False),
    ],
)
def test_a_frame_is_judged_by_its_age_since_the_end_of_its_exposure(
    now: int, late: bool, lost: bool, noted: bool
) -> None:
    bench = Bench()
    bench.take(1, 1 * S, now)
    assert bench.facts == {facts.CAMERA_LOST: [lost], facts.CAMERA_LATE: [late]}
    assert bool(bench.notes) is noted
    assert len(bench.jobs) == 1


def test_a_frame_ends_the_wait_for_it_and_its_age_counts_from_its_exposure() -> None:
    bench = Bench()
    bench.task.trigger(bench.cycle(1 * S))
    bench.take(1, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(), None), 1400 * MS)
    bench.task.serve(20 * S)
    assert bench.facts[facts.CAMERA_LATE] == [False]
    bench.task.serve(31_200 * MS)
    assert bench.facts[facts.CAMERA_LOST] == [False]
    bench.task.serve(31_200 * MS + 1)
    assert bench.facts[facts.CAMERA_LOST] == [False, True]


def test_a_repeated_frame_is_frozen_and_does_not_count() -> None:
    bench = Bench()
    bench.take(5, 1 * S, 1300 * MS)
    bench.take(5, 1 * S, 1400 * MS)
    assert bench.reports == [events.CAMERA_FROZEN]
    assert (len(bench.jobs), bench.task.counts()[0]) == (1, 1)
    values = bench.only(STREAK)
    assert (values["status"], values["sequence"], values["accepted"]) == ("frozen", 5, 0)
    assert (values["exposure_start_ns"], values["exposure"]) == (1 * S - EPOCH, 0.2)
    assert (values["streaks"], values["used"]) == (0, 0)
    assert np.isnan([values["length"], values["residual"], *values["rate"], *values["covariance"]]).all()


def test_a_repeated_frame_does_not_hide_that_no_new_frame_arrives() -> None:
    bench = Bench()
    bench.take(5, 1 * S, 1300 * MS)
    bench.take(5, 1 * S, 31_200 * MS)
    assert bench.facts[facts.CAMERA_LOST] == [False]
    bench.take(5, 1 * S, 31_200 * MS + 1)
    assert bench.facts[facts.CAMERA_LOST] == [False, True]


def test_a_torn_frame_is_counted_but_not_processed() -> None:
    bench = Bench()
    before, between, now = frame(1, 1 * S), frame(2, 2 * S), frame(3, 3 * S)
    torn = replace(now, pixels=np.concatenate([now.pixels[:20], before.pixels[20:]]))
    bench.frames += [before, between, torn]
    for at in (1300, 2300, 3300):
        bench.task.serve(at * MS)
        bench.finish(FrameFound(motion(StreakStatus.TOO_SHORT), None), (at + 100) * MS)
    assert bench.reports == [events.CAMERA_TORN]
    assert (len(bench.jobs), bench.task.counts()[0]) == (2, 3)
    assert [
        (values["status"], values["sequence"], values["accepted"])
        for packet, values in bench.records
        if packet is STREAK
    ] == [("too-short", 1, 0), ("too-short", 2, 0), ("failed", 3, 0)]


def test_a_busy_worker_is_reported() -> None:
    bench = Bench()
    bench.takes = False
    bench.take(1, 1 * S, 1300 * MS)
    assert bench.reports == [events.VISION_FAILED]
    assert bench.task.busy_since_ns() is None
    bench.finish(FrameFound(motion(), None), 1400 * MS)
    assert bench.records == [], "a result without a frame is ignored"


def test_slow_vision_is_reported_and_leaves_no_time_for_objects() -> None:
    bench = Bench(objects=ObjectMeasurementSettings())
    bench.take(1, 1 * S, 2 * S)
    bench.task.serve(4 * S)
    assert facts.VISION_SLOW not in bench.facts
    bench.task.serve(4 * S + 1)
    assert bench.facts[facts.VISION_SLOW] == [True]
    bench.finish(FrameFound(motion(), None), 5 * S)
    assert bench.facts[facts.VISION_SLOW] == [True, True]
    bench.take(2, 6 * S, 7 * S)
    assert bench.jobs[-1].objects is None
    bench.finish(FrameFound(motion(), None), 9 * S)
    assert bench.facts[facts.VISION_SLOW][-1] is False, "at the limit"
    bench.take(3, 9 * S, 10 * S)
    assert bench.jobs[-1].objects is not None


def test_a_failed_job_is_reported_and_recorded() -> None:
    bench = Bench()
    bench.take(1, 1 * S, 1300 * MS)
    bench.finish(None, 1400 * MS, "died")
    assert bench.reports == [events.VISION_FAILED]
    values = bench.only(STREAK)
    assert (values["status"], values["sequence"], values["accepted"]) == ("failed", 1, 0)


@pytest.mark.parametrize(
    ("status", "reported"),
    [
        (StreakStatus.FROZEN, [events.CAMERA_FROZEN]),
        (StreakStatus.BLACK, [events.CAMERA_BLACK]),
        (StreakStatus.SATURATED, [events.CAMERA_SATURATED]),
        (StreakStatus.TOO_SHORT, []),
        (StreakStatus.TOO_FEW, [events.FRAME_UNUSED]),
    ],
)
def test_a_frame_without_a_rate_is_reported_by_its_reason(status: StreakStatus, reported: list[Any]) -> None:
    bench = Bench()
    bench.take(1, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(status), None), 1400 * MS)
    assert bench.reports == reported
    assert (bench.only(STREAK)["status"], bench.late) == (status.value, [])


@pytest.mark.parametrize("accepts", [True, False])
def test_a_rate_from_streaks_reaches_the_filter_in_body_axes(accepts: bool) -> None:
    bench = Bench()
    bench.estimate = bench.past(0)
    bench.accepts = accepts
    bench.take(2, 8 * S, 8300 * MS)
    bench.finish(FrameFound(motion(), None), 8400 * MS)
    ((rate,),) = bench.late
    assert isinstance(rate, MeanRateMeasurement)
    assert (rate.since_ns, rate.time_ns) == (8 * S, 8200 * MS)
    np.testing.assert_allclose(rate.rate, TO_CAMERA.T @ [0.01, 0.02, 0.03])
    np.testing.assert_allclose(rate.covariance, TO_CAMERA.T @ np.diag([1e-6, 2e-6, 3e-6]) @ TO_CAMERA)
    values = bench.only(STREAK)
    np.testing.assert_allclose(values["rate"], rate.rate)
    c = rate.covariance
    np.testing.assert_allclose(values["covariance"], [c[0, 0], c[1, 1], c[2, 2], c[0, 1], c[0, 2], c[1, 2]])
    assert (values["streaks"], values["used"], values["length"], values["residual"]) == (12, 10, 21.5, 2e-5)
    assert (values["exposure_start_ns"], values["accepted"]) == (1 * S, int(accepts))
    assert bench.reports == ([] if accepts else [events.STREAK_REFUSED])
    assert bench.task.counts() == (1, int(accepts))


def test_the_priors_of_a_job_are_those_of_mid_exposure_in_camera_axes() -> None:
    velocity = np.array([1e3, -2e3, 3e4])
    bench = Bench(velocity=lambda _: velocity, kept=KeptFrames(cast(Any, "folder"), 5))
    bench.estimate = bench.past(0)
    times = np.array([950, 1050, 1150, 1250]) * MS
    spin = np.array([[0.01, 0.0, 0.02 * k] for k in range(4)])
    bench.navigation.rates = lambda *_: (times, spin)
    bench.take(7, 1 * S, 1300 * MS)
    (job,) = bench.jobs
    rate, attitude = job.rate_prior, job.attitude_prior
    assert rate is not None
    assert attitude is not None
    np.testing.assert_allclose(rate.rate, TO_CAMERA @ [0.01, 0.0, 0.0])
    assert rate.sigma == pytest.approx(0.02), "the largest of 1e-4, 4e-4 and 2.5e-5"
    np.testing.assert_allclose(attitude.quaternion, multiply(MOUNTING, bench.past(1100 * MS).quaternion))
    assert attitude.sigma == pytest.approx(math.sqrt(9e-6 + 5e-4**2))
    assert cast(LikelihoodSettings, job.estimator).rate_model != "accelerating"
    assert job.tracker is not None
    np.testing.assert_array_equal(job.tracker.solve.velocity, velocity)
    assert job.kept is not None
    assert job.kept.name == "frame-00000007"
    assert rate.course is not None


def solved(count: int = 14, status: SolveStatus = SolveStatus.SOLVED) -> FrameSolution:
    """Return a solution of the star tracker, which contains a star fix only for the status SOLVED."""
    found = FrameSolution(
        status, "", FrameKind.POINTS, CAMERA, points=np.zeros((count, 2)), star=np.arange(count) - 2
    )
    if status is SolveStatus.SOLVED:
        attitude = multiply(MOUNTING, Bench.past(1100 * MS).quaternion)
        found = replace(found, fix=AttitudeFix(attitude, np.diag([1e-8, 4e-8, 9e-8]), 0.0))
    return found


def test_a_star_fix_reaches_the_filter_in_body_axes() -> None:
    bench = Bench()
    bench.estimate = bench.past(0)
    bench.take(3, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(StreakStatus.TOO_SHORT), solved()), 1400 * MS)
    ((attitude,),) = bench.late
    assert isinstance(attitude, AttitudeMeasurement)
    assert attitude.time_ns == 1100 * MS
    np.testing.assert_allclose(attitude.quaternion, bench.past(1100 * MS).quaternion, atol=1e-12)
    least = TO_CAMERA.T @ np.diag([1e-8, 4e-8, 9e-8]) @ TO_CAMERA
    added = attitude.covariance - least
    assert np.linalg.eigvalsh(added)[0] >= 0.0
    assert 0.0 < np.trace(added) < 1e-8
    values = bench.only(STARS)
    assert (values["sequence"], values["status"], values["found"], values["matched"]) == (3, "solved", 14, 12)
    assert (values["middle_ns"], values["accepted"]) == (1100 * MS - EPOCH, 1)
    np.testing.assert_allclose(values["covariance"], _packed(attitude.covariance))


def test_a_first_star_fix_begins_the_estimate() -> None:
    bench = Bench()
    bench.begins = True
    bench.take(3, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(), solved()), 1400 * MS)
    assert bench.late == [], "without an estimate there is no late measurement"
    assert bench.only(STARS)["accepted"] == 1
    assert bench.reports == []


def test_many_unmatched_stars_make_the_rate_invalid() -> None:
    bench = Bench()
    bench.estimate = bench.past(0)
    bench.take(3, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(), solved(12, SolveStatus.NO_MATCH)), 1400 * MS)
    assert bench.late == []
    assert events.CAMERA_STRANGE in bench.reports
    assert events.FRAME_UNUSED in bench.reports


def sighted(at: float, count: int = 1) -> MeasuredObjects:
    """Return objects that move by 1 mrad/s along y."""
    place = 1e-3 * at
    directions = np.array([[1.0, place + 0.1 * k, 0.02] for k in range(count)])
    return MeasuredObjects(
        points=np.array([[10.0 + k, 20.0 + k] for k in range(count)]),
        directions=directions.reshape(-1, 3)
        / np.linalg.norm(directions.reshape(-1, 3), axis=1, keepdims=True),
        covariance=np.array([1e-10 * np.eye(3)] * count).reshape(-1, 3, 3),
        magnitudes=np.array([4.0 + k for k in range(count)]),
        attitude=1e-12 * np.eye(3),
    )


def test_objects_are_recorded_tracked_and_reported() -> None:
    bench = Bench(objects=ObjectMeasurementSettings())
    for number in range(1, 4):
        bench.take(number, number * S, (number * 1000 + 300) * MS)
        bench.finish(
            FrameFound(motion(StreakStatus.TOO_SHORT), None, sighted(float(number))),
            (number * 1000 + 400) * MS,
        )
    seen = [values for packet, values in bench.records if packet is SIGHTINGS]
    assert [values["found"] for values in seen] == [1, 1, 1]
    assert seen[0]["middle_ns"] == 1100 * MS - EPOCH
    assert (seen[0]["x"][0], seen[0]["y"][0], seen[0]["magnitude"][0]) == (10.0, 20.0, 4.0)
    assert len(seen[0]["x"]) == MOST_SIGHTINGS
    assert np.isnan(seen[0]["x"][1:]).all()
    values = bench.only(TRACK)
    assert (values["number"], values["seen"], values["sightings"]) == (1, 1, 3)
    assert values["middle_ns"] == 3100 * MS - EPOCH
    assert values["magnitude"] == pytest.approx(4.0)
    assert np.linalg.norm(values["rate"]) == pytest.approx(1e-3, rel=0.01)
    assert np.isnan([*values["place"], *values["velocity"], values["place_sigma"]]).all()
    assert bench.reports == [events.OBJECT_FOUND]
    assert [len(tracks) for tracks in bench.tracks] == [0, 0, 1]
    nothing = sighted(0.0, 0)
    for number in range(4, 10):
        bench.take(number, number * S, (number * 1000 + 300) * MS)
        bench.finish(FrameFound(motion(StreakStatus.TOO_SHORT), None, nothing), (number * 1000 + 400) * MS)
    assert bench.reports[-1] is events.OBJECT_LOST


def test_the_packed_covariance_is_in_the_order_of_the_table() -> None:
    matrix = np.array([[1.0, 4.0, 5.0], [4.0, 2.0, 6.0], [5.0, 6.0, 3.0]])
    assert _packed(matrix) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert multiply(conjugate(MOUNTING), MOUNTING) == pytest.approx([0.0, 0.0, 0.0, 1.0])


def test_the_learned_lens_goes_from_frame_to_frame_and_to_the_next_boot() -> None:
    begun = LensKnowledge.of(CAMERA, CameraKnowledge(), psf_sigma=1.2)
    bench = Bench(lens=begun)
    assert bench.task.learned() == {}
    bench.take(1, 10 * S, 11 * S)
    assert bench.jobs[-1].lens == (begun, 0.0)
    better = replace(begun, values=begun.values + 0.5, covariance=begun.covariance / 4.0, frames=3)
    bench.finish(FrameFound(motion(), None, lens=better), 12 * S)
    values = bench.only(LENS)
    assert (values["frames"], values["contradictions"], values["sequence"]) == (3, 0, 1)
    # The image centre is (159.5, 119.5), and the optical axis is 0.5 px off in x and in y.
    assert values["centre"] == [160.0, 120.0]
    assert np.allclose(values["sigma"], better.sigma[[0, 1, 2, 3, 4, 9, 10]])
    stored = bench.task.learned()["lens"]
    assert np.array_equal(stored.arrays()[0], better.learned[0])
    bench.take(2, 15 * S, 16 * S)
    assert bench.jobs[-1].lens == (better, 5.0)
    bench.finish(FrameFound(motion(), None, lens=better), 17 * S)
    bench.only(LENS)  # this frame leaves the lens unchanged, so no second packet is recorded
    assert events.LENS_CHANGED not in bench.reports
    bench.take(3, 35 * S, 36 * S)
    assert bench.jobs[-1].lens == (better, 25.0), "the lens may have changed since the last frame that taught"
    again = replace(begun, frames=1, contradictions=1)
    bench.finish(FrameFound(motion(), None, lens=again), 37 * S)
    assert bench.reports.count(events.LENS_CHANGED) == 1
    bench.take(4, 40 * S, 41 * S)
    # The number of frames is one before and after this frame, but the number of contradictions increases.
    third = replace(again, contradictions=2)
    bench.finish(FrameFound(motion(), None, lens=third), 42 * S)
    assert bench.reports.count(events.LENS_CHANGED) == 2
    bench.take(5, 45 * S, 46 * S)
    assert bench.jobs[-1].lens == (third, 5.0)


def test_a_camera_whose_lens_is_not_learned_has_jobs_without_a_lens() -> None:
    bench = Bench()
    bench.take(1, 10 * S, 11 * S)
    assert bench.jobs[-1].lens is None
    bench.finish(FrameFound(motion(), None), 12 * S)
    assert bench.task.learned() == {}


def test_a_low_battery_leaves_nearly_the_given_time_between_two_exposures() -> None:
    bench = Bench()
    bench.task.trigger(bench.cycle(1 * S))
    bench.task.rest(60.0)
    bench.task.trigger(bench.cycle(60_500 * MS - 1))
    assert len(bench.triggers) == 1
    assert bench.notes == [("camera", 60_500 * MS - 1)], "the pause counts as a good stream"
    bench.task.serve(90 * S)
    assert not any(bench.facts.get(facts.CAMERA_LOST, [])), "the age counts from the pause"
    bench.task.trigger(bench.cycle(60_500 * MS))
    assert len(bench.triggers) == 2, "half a second early, so that a late trigger skips none"
    bench.task.rest(0.0)
    bench.task.trigger(bench.cycle(60_600 * MS))
    assert len(bench.triggers) == 3


@pytest.mark.parametrize(("every", "made"), [(1, 16), (3, 5), (4, 4), (8, 2), (99, 2), (0, 16)])
def test_under_overload_every_nth_exposure_is_made_up_to_a_limit(every: int, made: int) -> None:
    """The camera makes every n-th of the due exposures, but at least every eighth."""
    bench = Bench(most_every=8)
    bench.task.reduce(True, every)
    for second in range(1, 17):
        bench.task.trigger(bench.cycle(second * S))
    assert len(bench.triggers) == made
    assert bench.task.workload() == (16 - made, 0)
    assert len(bench.notes) == 16 - made, "the camera is not silent if an exposure is left out"
    bench.frames.clear()
    bench.task.serve(16 * S + 1)
    assert facts.CAMERA_LOST not in bench.facts


def test_objects_are_not_searched_under_overload() -> None:
    bench = Bench(objects=ObjectMeasurementSettings())
    for number, search in enumerate((False, True), start=1):
        bench.task.reduce(search, 1)
        bench.take(number, number * S, number * S + 300 * MS)
        assert (bench.jobs[-1].objects is not None) is search
        bench.finish(FrameFound(motion(), None), number * S + 400 * MS)


def test_late_frames_are_those_that_meet_a_busy_worker_or_take_too_long() -> None:
    bench = Bench()
    bench.takes = False
    bench.take(1, 1 * S, 1300 * MS)
    assert bench.task.workload() == (0, 0), "the worker does not run"
    bench.takes = True
    bench.take(2, 2 * S, 2300 * MS)
    bench.takes = False
    bench.take(3, 3 * S, 3300 * MS)
    assert bench.task.workload() == (0, 1)
    bench.finish(FrameFound(motion(), None), 4300 * MS)
    assert bench.task.workload() == (0, 1), "at the limit of two seconds"
    bench.takes = True
    bench.take(4, 5 * S, 5300 * MS)
    bench.finish(FrameFound(motion(), None), 7300 * MS + 1)
    assert bench.task.workload() == (0, 2)
    bench.take(5, 15 * S, 15300 * MS)
    bench.finish(FrameFound(motion(), None), 20300 * MS)
    assert bench.task.workload() == (0, 2), "the worker is busy half of the time between two frames"
    bench.take(6, 25 * S, 25300 * MS)
    bench.finish(FrameFound(motion(), None), 30300 * MS + 1)
    assert bench.task.workload() == (0, 3)
    bench.task.reduce(True, 2)
    bench.task.trigger(bench.cycle(30_310 * MS))
    bench.take(7, 35 * S, 35300 * MS)
    bench.finish(FrameFound(motion(), None), 40300 * MS)
    assert bench.task.workload() == (1, 3), "an omitted exposure does not shorten the time between two frames"


def test_a_problem_of_the_worker_is_reported() -> None:
    bench = Bench()
    bench.take(1, 1 * S, 1300 * MS)
    bench.finish(FrameFound(motion(StreakStatus.TOO_SHORT), None, problem="no disk space"), 1400 * MS)
    assert (events.VISION_FAILED, "no disk space") in zip(bench.reports, bench.texts, strict=True)


@pytest.mark.parametrize("known", [True, False])
def test_points_among_unknown_stars_go_to_the_tracks_with_the_attitude_of_mid_exposure(known: bool) -> None:
    bench = Bench(objects=ObjectMeasurementSettings())
    taken: list[tuple[Any, ...]] = []
    cast(Any, bench.task)._objects = SimpleNamespace(ingest_field=lambda *values: taken.append(values))
    bench.estimate = bench.past(0) if known else None
    bench.take(7, 1 * S, 1300 * MS)
    field, seen = cast(Any, object()), motion(StreakStatus.TOO_SHORT)
    bench.finish(FrameFound(seen, None, field=field), 1400 * MS)
    ((sequence, middle, points, streaks, attitude, now_ns),) = taken
    assert (sequence, middle, now_ns) == (7, 1100 * MS, 1400 * MS)
    assert points is field
    assert streaks is seen
    if not known:
        assert attitude is None
        return
    past = bench.past(1100 * MS)
    np.testing.assert_allclose(attitude.quaternion, multiply(MOUNTING, past.quaternion))
    turn = attitude_matrix(past.quaternion)
    np.testing.assert_allclose(attitude.covariance, turn.T @ np.diag([4e-6, 9e-6, 1e-6]) @ turn)


def test_the_course_of_a_job_has_the_rates_of_the_exposure_in_camera_axes() -> None:
    """The rate increases linearly during the exposure, and the mean of the course is the mean rate."""
    bench = Bench()
    bench.estimate = bench.past(0)
    times = np.array([900, 1000, 1200, 1300]) * MS
    spin = np.array([[0.01, 0.0, 0.1 * (at - 1000 * MS) / (200 * MS)] for at in times.tolist()])
    bench.navigation.rates = lambda *_: (times, spin)
    bench.take(7, 1 * S, 1300 * MS)
    rate = bench.jobs[0].rate_prior
    assert rate is not None
    assert rate.course is not None
    # The rotation vector is the integral of the rate, with time in units of the exposure of 0.2 s.
    np.testing.assert_allclose(rate.course.terms[0], 0.2 * TO_CAMERA @ [0.01, 0.0, 0.05], atol=1e-12)
    np.testing.assert_allclose(rate.course.terms[1], 0.2 * TO_CAMERA @ [0.0, 0.0, 0.05], atol=1e-12)
    np.testing.assert_allclose(rate.course.terms[2:], 0.0, atol=1e-12)
    assert rate.course.sigma == pytest.approx(0.2 * 0.02)
