"""Records the results of a frame: packets of rate and stars, and events for rejected measurements."""

from __future__ import annotations

import math

import numpy as np

from flight.link import events
from flight.link.telemetry.definitions import STARS, STREAK
from flight.loop.body import BodyView
from flight.loop.services import Services
from flight.loop.tasks.frame_measurements import FrameMeasurer, middle_ns
from hal.interfaces.readings import Frame
from knightcube.astro.arrays import FloatArray
from knightcube.gnc.estimation.measurements import AttitudeMeasurement, MeanRateMeasurement
from knightcube.vision.frame_job import Found, FrameFound
from knightcube.vision.startracker.solution import FrameSolution, SolveStatus
from knightcube.vision.streaks.streak_result import StreakStatus

_MANY_STARS = 12
"""A frame with at least this many unmatched detections does not show the sky: its pixels are invalid."""
_NAMED_ELSEWHERE = {
    StreakStatus.TOO_SHORT,  # no motion
    StreakStatus.BLACK,
    StreakStatus.SATURATED,
    StreakStatus.FROZEN,
}
"""States of a frame without motion, or with an event of their own."""
_NAN4, _NAN33 = np.full(4, np.nan), np.full((3, 3), np.nan)


class FrameReport:
    """Records frames; `accepted` counts the rates from streaks that entered the estimate."""

    def __init__(self, measurer: FrameMeasurer, view: BodyView, services: Services) -> None:
        self._measurer = measurer
        self._view = view
        self._recorder = services.recorder
        self._events = services.events
        self.accepted = 0

    def rate(
        self, frame: Frame, motion: Found, rate: MeanRateMeasurement | None, now_ns: int, accepted: bool
    ) -> None:
        """Record the rate from the streaks, and report a rejected rate."""
        self.accepted += accepted
        if rate is not None and not accepted:
            text = f"frame {frame.sequence}: {self._view.rate_text(rate)}"
            self._events.report(events.STREAK_REFUSED, now_ns, text)
        self.record(frame, motion.status.value, motion, now_ns, accepted)

    def unused(self, frame: Frame, found: FrameFound, now_ns: int) -> None:
        """Report a frame of a body in motion that gave no rate and no attitude."""
        if found.motion.status in _NAMED_ELSEWHERE:
            return
        stars = f", stars {found.solution.status.value}" if found.solution is not None else ""
        text = f"frame {frame.sequence}: streaks {found.motion.status.value}{stars}"
        self._events.report(events.FRAME_UNUSED, now_ns, text)

    def stars(
        self,
        frame: Frame,
        solution: FrameSolution,
        attitude: AttitudeMeasurement | None,
        now_ns: int,
        accepted: bool | None,
    ) -> None:
        """Record the attitude from the stars; `accepted` is None when not offered to the filter."""
        if is_strange(solution):
            text = f"frame {frame.sequence}: {len(solution.points)} stars that are nowhere in the sky"
            self._events.report(events.CAMERA_STRANGE, now_ns, text)
        if accepted is False:
            text = f"frame {frame.sequence}: {len(solution.matched)} stars"
            self._events.report(events.STARS_REFUSED, now_ns, text)
        quaternion = _NAN4 if attitude is None else attitude.quaternion
        covariance = _NAN33 if attitude is None else attitude.covariance
        self._recorder.record(
            STARS,
            now_ns,
            sequence=frame.sequence,
            middle_ns=middle_ns(frame) - self._recorder.epoch_ns,
            status=solution.status.value,
            tracked=int(solution.tracked),
            found=len(solution.points),
            matched=len(solution.matched),
            quaternion=quaternion.tolist(),
            covariance=_packed(covariance),
            log10_false_alarm=solution.log10_false_alarm,
            accepted=int(bool(accepted)),
        )

    def record(self, frame: Frame, status: str, found: Found | None, now_ns: int, accepted: bool) -> None:
        """Record the streak packet."""
        rate, covariance = self._measurer.rate_in_body(found)
        self._recorder.record(
            STREAK,
            now_ns,
            sequence=frame.sequence,
            exposure_start_ns=frame.exposure_start_ns - self._recorder.epoch_ns,
            exposure=frame.exposure_ns * 1e-9,
            status=status,
            streaks=found.found if found else 0,
            used=found.used_count if found else 0,
            length=found.length if found else math.nan,
            rate=rate.tolist(),
            covariance=_packed(covariance),
            residual=found.residual if found else math.nan,
            accepted=int(accepted),
        )


def is_strange(solution: FrameSolution | None) -> bool:
    """Return whether a frame shows many stars but matches no part of the sky."""
    if solution is None or solution.status is not SolveStatus.NO_MATCH:
        return False
    return len(solution.points) >= _MANY_STARS


def _packed(c: FloatArray) -> list[float]:
    """Return xx yy zz xy xz yz of a symmetric matrix (3, 3)."""
    return [float(c[0, 0]), float(c[1, 1]), float(c[2, 2]), float(c[0, 1]), float(c[0, 2]), float(c[1, 2])]
