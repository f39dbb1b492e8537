"""The vision worker's job: one frame in, one streak result out."""

from __future__ import annotations

from dataclasses import dataclass

from flight.arrays import FloatArray, Image
from flight.pinhole import Pinhole
from flight.vision.likelihood.estimate import estimate_motion
from flight.vision.likelihood.result import MotionResult
from flight.vision.likelihood.settings import LikelihoodSettings
from flight.vision.settings import StreakSettings
from flight.vision.streak_rate import StreakResult, estimate_rate

Found = StreakResult | MotionResult


@dataclass(frozen=True, slots=True)
class StreakJob:
    """The arguments of both estimators; the kind of the settings says which is meant."""

    pixels: Image
    pinhole: Pinhole
    exposure: float
    settings: StreakSettings | LikelihoodSettings
    prior_rate: FloatArray | None
    prior_sigma: float
    previous_checksum: int | None


def run(job: StreakJob) -> Found:
    """Estimate the rate; at the top level of a module, so that a worker process can import it."""
    frame = job.pixels, job.pinhole, job.exposure
    prior = job.prior_rate, job.prior_sigma, job.previous_checksum
    if isinstance(job.settings, LikelihoodSettings):
        return estimate_motion(*frame, job.settings, *prior)
    return estimate_rate(*frame, job.settings, *prior)
