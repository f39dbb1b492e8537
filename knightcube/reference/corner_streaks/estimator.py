"""Streak estimator based on corner detectors, in the form of a class that a configuration can select."""

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
    """Streak estimator based on corner detectors.

    The class implements `knightcube.vision.frame_job.StreakEstimator`. The methods import scipy when they are
    called, so that a process that only forwards the estimator does not load scipy.
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
        """Return the mean body rate over the exposure. The arguments are those of `rate.estimate_rate`."""
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
        """Return attitude and rate from identified streaks.

        The arguments are those of `two_ends.solve_ends`.
        """
        from knightcube.reference.corner_streaks.two_ends import solve_ends  # noqa: PLC0415

        assert isinstance(found, StreakResult)
        return solve_ends(found, camera, scale, sky, settings, prior)
