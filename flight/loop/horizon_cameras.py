"""Task of the horizon cameras: passes frames to a worker, and directions of Sun and nadir to the body.

All horizon cameras are triggered together, more often while the body needs their frames. A camera is reported
if it delivers no frame, repeats an image, or delivers images that contradict a fine attitude. The task runs
once a second, or ten times a second for cameras with a period below 2 s, independently of the control cycle.
A frame is a measurement at the time of its exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flight.link import events
from flight.link.telemetry.definitions import DIRECTIONS
from flight.loop import facts
from flight.loop.body import HorizonCameraUse
from flight.loop.executive import JobResult
from flight.loop.facts import Services
from hal.interfaces.devices import Frame, FrameSource
from hal.interfaces.errors import DeviceError
from knightcube.vision.horizon_camera_job import HorizonCameraResult

WORKER = "wide"
_SPARSE = 8
"""Spacing (px) of the pixels that are compared with the last image to detect repeated images."""
_NONE = [float("nan")] * 3


@dataclass(frozen=True, slots=True)
class HorizonCameraSettings:
    """Durations that the task of the horizon cameras uses, in ns.

    Attributes:
        exposures_ns: exposure time (ns) of each camera.
        period_ns: time (ns) between triggers while the body needs frames often.
        fine_period_ns: time (ns) between triggers while the attitude estimate is accurate (`Knowledge.FINE`).
        late_ns: longest time (ns) from a trigger to the arrival of a frame.
        max_age_ns: time (ns) without a frame after which a camera is reported as lost.
    """

    exposures_ns: Sequence[int]
    period_ns: int
    fine_period_ns: int
    late_ns: int
    max_age_ns: int


class HorizonCameraTask:
    """Triggers and monitors the horizon cameras, and collects the frames of a trigger."""

    def __init__(
        self,
        cameras: Sequence[FrameSource],
        sight: HorizonCameraUse,
        settings: HorizonCameraSettings,
        services: Services,
    ) -> None:
        self._cameras = cameras
        self._sight = sight
        self._settings = settings
        self._services = services
        self._triggered_ns = 0
        self._waits = False
        self._frames: dict[int, Frame] = {}
        self._seen_ns = [0] * len(cameras)
        self._sequences = [-1] * len(cameras)
        self._errors = [""] * len(cameras)
        self._pictures = [b""] * len(cameras)
        # The tuple of a job holds the time (ns) at which its exposures began, the bit mask of its cameras,
        # and the time (ns) of its submission.
        self._job: tuple[int, int, int] | None = None

    def begin(self, time_ns: int) -> None:
        """Count the ages of frames from `time_ns`, when the first trigger is due, until frames arrive."""
        self._triggered_ns = time_ns - self._settings.fine_period_ns
        self._seen_ns = [time_ns] * len(self._cameras)

    def busy_since_ns(self) -> int | None:
        """Return the time (ns) at which the worker received its frames, or None while it is idle."""
        return None if self._job is None else self._job[2]

    def run(self, now_ns: int) -> None:
        """Collect the frames of the last trigger, submit them to the worker, and trigger when it is due."""
        if self._waits:
            self._collect(now_ns)
        period_ns = self._settings.period_ns if self._sight.needed else self._settings.fine_period_ns
        if not self._waits and self._job is None and now_ns - self._triggered_ns >= period_ns:
            self._triggered_ns, self._waits = now_ns, True
            self._frames = {}
            for number, camera in enumerate(self._cameras):
                try:
                    camera.trigger(self._settings.exposures_ns[number])
                except DeviceError as error:
                    self._errors[number] = str(error)
        self._watch(now_ns)

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Accept the worker's result, and pass the directions to the body."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            text = f"wide cameras: {result.outcome}: {result.error}"
            self._services.events.report(events.VISION_FAILED, now_ns, text)
            return
        found: HorizonCameraResult = result.value
        if found.false is not None:
            # The attitude was known well enough to check the images against it.
            text = "all images agree with the attitude"
            if found.false:
                names = ", ".join(str(number + 1) for number in found.false)
                text = f"images of camera {names} contradict the attitude: {next(iter(found.false.values()))}"
            self._services.facts.update(facts.WIDE_FALSE, bool(found.false), now_ns, text)
        used = self._sight.accept(job[0], found)
        self._record(now_ns, job, found, used)

    def _collect(self, now_ns: int) -> None:
        for number, camera in enumerate(self._cameras):
            if number in self._frames:
                continue
            try:
                frame = camera.poll()
            except DeviceError as error:
                self._errors[number] = str(error)
                continue
            if frame is None or frame.sequence <= self._sequences[number]:
                continue  # a repeated frame does not count as a new frame
            self._sequences[number] = frame.sequence
            before = self._pictures[number]
            self._pictures[number] = frame.pixels[::_SPARSE, ::_SPARSE].tobytes()
            if self._pictures[number] == before:
                self._errors[number] = "it repeats its last image"
                continue
            if frame.exposure_start_ns < self._triggered_ns:
                continue  # the frame belongs to an earlier trigger
            self._frames[number], self._seen_ns[number], self._errors[number] = frame, now_ns, ""
        if len(self._frames) == len(self._cameras) or now_ns - self._triggered_ns >= self._settings.late_ns:
            self._waits = False
            frames, self._frames = self._frames, {}
            middles = [frame.exposure_start_ns + frame.exposure_ns // 2 for frame in frames.values()]
            if frames and self._services.jobs.submit(WORKER, self._sight.job(frames)):
                self._job = sum(middles) // len(middles), sum(1 << number for number in frames), now_ns
            elif frames:
                text = "wide cameras: the worker is busy or not running"
                self._services.events.report(events.VISION_FAILED, now_ns, text)

    def _watch(self, now_ns: int) -> None:
        """Report the cameras that have delivered no frame for longer than the limit."""
        limit_ns = self._settings.max_age_ns
        old = [number for number, seen in enumerate(self._seen_ns) if now_ns - seen > limit_ns]
        text = "frames come again"
        if old:
            error = next((self._errors[number] for number in old if self._errors[number]), "")
            names = ", ".join(str(number + 1) for number in old)
            text = f"no frame of camera {names} for {(now_ns - self._seen_ns[old[0]]) * 1e-9:.0f} s"
            text = f"{text}: {error}" if error else text
        self._services.facts.update(facts.WIDE_LOST, bool(old), now_ns, text)

    def _record(
        self, now_ns: int, job: tuple[int, int, int], found: HorizonCameraResult, used: tuple[bool, bool]
    ) -> None:
        sun, nadir, recorder = found.sun, found.nadir, self._services.recorder
        recorder.record(
            DIRECTIONS,
            now_ns,
            middle_ns=job[0] - recorder.epoch_ns,
            frames=job[1],
            sun=_NONE if sun is None else sun.direction.tolist(),
            sun_sigma=float("nan") if sun is None else sun.sigma,
            sun_cameras=0 if sun is None else sum(1 << number for number in sun.cameras),
            sun_used=int(used[0]),
            nadir=_NONE if nadir is None else nadir.direction.tolist(),
            nadir_sigma=float("nan") if nadir is None else nadir.sigma,
            nadir_cameras=0 if nadir is None else sum(1 << number for number in nadir.cameras),
            nadir_used=int(used[1]),
        )
