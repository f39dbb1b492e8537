"""The estimator by corner detectors, as an object that a configuration selects and a job carries."""

from __future__ import annotations

from dataclasses import dataclass

from knightcube.astro.arrays import FloatArray, Image
from knightcube.reference.corner_streaks.settings import StreakResult, StreakSettings
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.startracker.index.sky_index import SkyIndex
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, SolveSettings
from knightcube.vision.streaks.streak_result import FrameMotion


@dataclass(frozen=True, slots=True)
class CornerEstimator:
    """Implements `knightcube.vision.frame_job.StreakEstimator` by corner detectors.

    The methods import scipy, which a process that only passes the estimator on does not need.
    """

    settings: StreakSettings

    def motion(
        self,
        pixels: Image,
        pinhole: Pinhole,
        exposure: float,
        prior_rate: FloatArray | None,
        prior_sigma: float,
        previous_checksum: int | None,
    ) -> StreakResult:
        """Return the motion over the exposure, see `rate.estimate_rate`."""
        from knightcube.reference.corner_streaks.rate import estimate_rate  # noqa: PLC0415

        return estimate_rate(
            pixels, pinhole, exposure, self.settings, prior_rate, prior_sigma, previous_checksum
        )

    def solve(
        self,
        found: FrameMotion,
        camera: CameraModel,
        scale: tuple[float, float],
        sky: SkyIndex,
        settings: SolveSettings,
        prior: AttitudePrior | None,
    ) -> tuple[FrameSolution, FrameMotion]:
        """Return attitude and rate from identified streaks, see `two_ends.solve_ends`."""
        from knightcube.reference.corner_streaks.two_ends import solve_ends  # noqa: PLC0415

        assert isinstance(found, StreakResult)
        return solve_ends(found, camera, scale, sky, settings, prior)
