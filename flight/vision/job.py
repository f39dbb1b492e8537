"""The vision worker's job: one frame in, one streak result out."""

from __future__ import annotations

from dataclasses import dataclass

from flight.arrays import FloatArray, Image
from flight.pinhole import Pinhole
from flight.vision.settings import StreakSettings
from flight.vision.streak_rate import StreakResult, estimate_rate


@dataclass(frozen=True, slots=True)
class StreakJob:
    """The arguments of `flight.vision.streak_rate.estimate_rate`."""

    pixels: Image
    pinhole: Pinhole
    exposure: float
    settings: StreakSettings
    prior_rate: FloatArray | None
    prior_sigma: float
    previous_checksum: int | None


def run(job: StreakJob) -> StreakResult:
    """Estimate the rate; at the top level of a module, so that a worker process can import it."""
    return estimate_rate(
        job.pixels,
        job.pinhole,
        job.exposure,
        job.settings,
        job.prior_rate,
        job.prior_sigma,
        job.previous_checksum,
    )
