"""Estimators of the rate from streaks that a configuration may select instead of maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

from flight.schema.devices import Camera
from knightcube.astro.arrays import FloatArray, Image
from knightcube.vision.camera.lens import CameraModel, Pinhole
from knightcube.vision.frame_job import StreakEstimator
from knightcube.vision.startracker.index import SkyIndex
from knightcube.vision.startracker.solve import AttitudePrior, FrameSolution, SolveSettings
from knightcube.vision.streaks.streak_result import FrameMotion

if TYPE_CHECKING:
    from knightcube.reference.corner_streaks import StreakResult, StreakSettings


@dataclass(frozen=True, slots=True)
class CornerEstimator:
    """Streak estimator based on corner detectors.

    The class implements `StreakEstimator`. The methods import scipy when they are called, so that a process
    that only forwards the estimator does not load scipy.
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
        """Return the mean body rate over the exposure. The arguments are those of `estimate_rate`."""
        from knightcube.reference.corner_streak_rate import estimate_rate  # noqa: PLC0415 - see above

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
        """Return attitude and rate from identified streaks. The arguments are those of `solve_ends`."""
        from knightcube.reference.corner_streak_rate import solve_ends  # noqa: PLC0415 - see above

        return solve_ends(cast("StreakResult", found), camera, scale, sky, settings, prior)


def corner_estimator(camera: Camera) -> StreakEstimator:
    """Return the streak estimator with the corner detector that the configuration of a camera names.

    Args:
        camera: configuration of a camera whose `estimator` is the name of a corner detector.
    """
    from knightcube.reference.corner_streaks import StreakSettings  # noqa: PLC0415 - seldom needed

    assert camera.estimator != "likelihood"
    saturation = camera.saturation or float(2**camera.bits - 1)
    bias = {} if camera.endpoint_bias is None else {"endpoint_bias": camera.endpoint_bias}
    settings = StreakSettings.of(camera.estimator, saturation=saturation, gain=camera.gain, **bias)
    return CornerEstimator(settings)
