"""Campaign `self-calibration`: a lens estimated from frames of a rotating camera, and its uncertainty.

Each run has one unknown lens and FRAMES frames of random fields, at rotations of 5 to 30 % of the field in
0.2 s. The lens differs from its description by its stated standard deviations: 2 px along each axis, 0.5 % of
distortion and 30 us of line time. In the row `field`, the field of view is up to 5 % wrong. In the row
`distortion`, the distortion is known to 2 %. In the row `shift`, another lens of the same distribution
replaces the lens after half of the frames. The frames are drawn by `supersampled`, not by the estimator's
model. The prior of the rate is the true rate; it gives the sense of rotation, which streaks do not show. The
bound is that of an exactly known camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray, Image
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.camera.lens import CameraKnowledge, Pinhole
from knightcube.vision.frame_job import FrameFound, FrameJob, TrackerSettings, run_with_lens
from knightcube.vision.lens_knowledge import LensKnowledge
from knightcube.vision.startracker.index.build import default_index
from knightcube.vision.startracker.lost_in_space import IdentificationSettings
from knightcube.vision.startracker.solve import RatePrior, SolveSettings
from knightcube.vision.startracker.survey import DetectionSettings
from knightcube.vision.streaks.streak_result import LikelihoodSettings, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.studies.campaigns.imperfections import IMPERFECTIONS
from tests.studies.campaigns.mismatch import detected, mean_rate, usable_sky
from tests.studies.campaigns.statistics import mean, squared_sigmas
from tests.support.scenes import FIELD, noise_floor
from tests.support.streak_bound import rate_bound
from tests.support.supersampled import Optics, gaussian, light, through_lens

ROWS = ("default", "field", "distortion", "shift")
FRAMES = 14
SHIFTED = 24
"""Number of frames of a run in the row `shift` of the result table."""
LEARNED = 10
"""Number of frames after which a lens counts as estimated."""
SIZE, EXPOSURE, BOUND_STARS, WRONG_SIGMAS = 512, 0.2, 30, 6.0
_CAMERA = StarCameraModel(columns=SIZE, rows=SIZE, field_of_view=FIELD)


@dataclass(frozen=True, slots=True)
class TrueLens:
    """A lens that differs from its description.

    Attributes:
        pinhole: pinhole of the true focal length.
        optics: point spread, optical axis and distortion.
        line_time: time (s) between rows.
    """

    pinhole: Pinhole
    optics: Optics
    line_time: float

    @classmethod
    def drawn(cls, row: str, known: CameraKnowledge, rng: np.random.Generator) -> TrueLens:
        """Return a random lens within the stated standard deviations."""
        scale = 1.0 + (rng.uniform(-0.05, 0.05) if row == "field" else 0.0)
        pinhole = _CAMERA.pinhole.rescaled(scale)
        sigma = float(rng.uniform(0.9, 1.3))
        distortion, (x, y) = float(rng.normal(0.0, known.distortion)), rng.normal(0.0, known.centre, 2)
        line_time = float(rng.choice([0.0, 1.0]) * rng.uniform(0.0, 30e-6))
        optics = Optics((gaussian(sigma),), distortion=distortion, offset=(float(x), float(y)))
        return cls(pinhole, optics, line_time)

    def parameters(self) -> FloatArray:
        """Return focal length, centre, k1, k2 and line time (6,)."""
        square = math.tan(self.pinhole.half_diagonal) ** 2
        centre = np.array(self.pinhole.centre) + np.array(self.optics.offset)
        k1 = self.optics.distortion / square
        return np.array([self.pinhole.focal_length, *centre, k1, 0.0, self.line_time])


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` lenses of each row."""
    return [
        Case(f"{row} {run}", (seed, number, run), {"row": row})
        for number, row in enumerate(ROWS)
        for run in range(runs)
    ]


def expose(lens: TrueLens, rng: np.random.Generator) -> tuple[Image, FloatArray, FloatArray]:
    """Return a frame of a random field, the true rate (3,), rad/s, and its bound (3, 3)."""
    given, attitudes, chosen = usable_sky(
        _CAMERA,
        EXPOSURE,
        lambda: {
            "theta": float(rng.uniform(0.0, 90.0)),
            "percent": float(rng.uniform(5.0, 30.0)),
            "exposure": EXPOSURE,
        },
        rng,
    )
    rate, middle = mean_rate(attitudes, EXPOSURE), attitude_matrix(attitudes(np.zeros(1)))[0]
    length = 1.3 * given["percent"] / 100.0 * SIZE
    delay = lens.line_time / EXPOSURE
    electrons = light(lens.pinhole, lens.optics, chosen, attitudes, length, delay, rng)
    pixels = detected(electrons, IMPERFECTIONS["none"], _CAMERA, EXPOSURE, rng)
    places = through_lens(lens.pinhole, lens.optics, chosen.directions @ middle.T)
    inside = np.flatnonzero(lens.pinhole.contains(places))
    bright = inside[np.argsort(-chosen.electrons[inside])][:BOUND_STARS]
    floor = noise_floor(_CAMERA, EXPOSURE)
    bound = rate_bound(
        lens.pinhole, places[bright], chosen.electrons[bright], rate, EXPOSURE, _CAMERA.psf_sigma, floor
    )
    return pixels, rate, bound.covariance


def described(row: str) -> tuple[FrameJob, LensKnowledge]:
    """Return the job (without a frame) and the lens knowledge for a row of the table."""
    known = CameraKnowledge(distortion=0.02 if row == "distortion" else 0.005)
    spread = 0.05 if row == "field" else 0.0
    solve = SolveSettings(
        detection=DetectionSettings(psf_sigma=1.0, saturation=4095.0),
        identification=IdentificationSettings(mirror=False, hint_error=1.0),
        lens=known,
    )
    estimator = LikelihoodSettings(saturation=4095.0, knowledge=known)
    tracker = TrackerSettings(solve, (1.0 / (1.0 + spread), 1.0 + spread))
    lens = LensKnowledge.of(_CAMERA.pinhole, known, scale_error=spread)
    empty = np.zeros((SIZE, SIZE), dtype=np.uint16)
    job = FrameJob(empty, _CAMERA.pinhole, EXPOSURE, estimator, tracker, None, None)
    return job, lens


def run(case: Case) -> Result:
    """Estimate one lens; evaluate each frame, and the lens after each frame."""
    rng, row = np.random.default_rng(case.seed), case.parameters["row"]
    job, lens = described(row)
    known = job.tracker.solve.lens if job.tracker is not None else None
    assert known is not None
    true, frames = TrueLens.drawn(row, known, rng), []
    for number in range(SHIFTED if row == "shift" else FRAMES):
        if row == "shift" and number == SHIFTED // 2:
            true = TrueLens.drawn(row, known, rng)
        pixels, rate, bound = expose(true, rng)
        one = replace(job, pixels=pixels, rate_prior=RatePrior(rate, 0.0), lens=(lens, 5.0))
        assert one.tracker is not None
        found = run_with_lens(one, one.tracker, default_index())
        assert found.lens is not None
        # A frame that contradicts the estimated lens is solved again with the configured lens.
        before = lens.frames if found.lens.contradictions == lens.contradictions else 0
        frames.append({**_judged(found, rate, bound), **_lens_error(found.lens, true), "before": before})
        lens = found.lens
    return {"row": row, "frames": frames}


def _judged(found: FrameFound, rate: FloatArray, bound: FloatArray) -> dict[str, Any]:
    """Return status, NEES, and the ratio of the claimed uncertainty to the bound."""
    motion, solved = found.motion, found.solution is not None and found.solution.fix is not None
    if motion.status is not StreakStatus.RATE or motion.rate is None or motion.covariance is None:
        return {"status": motion.status.value, "solved": solved}
    error = motion.rate - rate
    return {
        "status": motion.status.value,
        "solved": solved,
        "nees": squared_sigmas(error, motion.covariance),
        "claim": math.sqrt(float(np.trace(motion.covariance) / np.trace(bound))),
        "error": math.sqrt(float(error @ error / np.trace(bound))),
    }


def _lens_error(lens: LensKnowledge, true: TrueLens) -> dict[str, Any]:
    """Return errors, sigmas and NEES of the estimated lens, and how many frames contradicted it."""
    values, covariance = lens.learned
    error, unit = values[:6] - true.parameters(), np.sqrt(np.diag(covariance)[:6])
    scaled = error / unit
    nees = squared_sigmas(scaled, covariance[:6, :6] / np.outer(unit, unit))
    return {
        "lens_nees": nees,
        "lens_sigma": unit.tolist(),
        "lens_error": error.tolist(),
        "psf": float(values[6]),
        "contradictions": lens.contradictions,
    }


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return claimed uncertainties and NEES by row, before and after the lens is estimated."""
    facts: dict[str, dict[str, Any]] = {}
    for row in (row for row in ROWS if any(r["row"] == row for r in results)):
        frames = [f for r in results if r["row"] == row for f in r["frames"]]
        stages = {"first": (0, 1), "learning": (1, LEARNED), "learned": (LEARNED, SHIFTED)}
        facts[row] = {
            name: _row([f for f in frames if least <= f["before"] < most])
            for name, (least, most) in stages.items()
        }
        last = [r["frames"][-1] for r in results if r["row"] == row]
        facts[row]["lens_nees"] = mean([f["lens_nees"] for f in last])
        facts[row]["contradictions"] = [f["contradictions"] for f in last]
    return summary(facts)


def _row(frames: Sequence[Result]) -> dict[str, Any]:
    answers = [one for one in frames if "nees" in one]
    nees, claim, error = (
        np.array([one[key] for one in answers] or [np.nan]) for key in ("nees", "claim", "error")
    )
    return {
        "frames": len(frames),
        "solved": sum(one["solved"] for one in frames),
        "rates": len(answers),
        "nees": float(np.mean(nees)),
        "beyond_sigmas": int(np.count_nonzero(nees > WRONG_SIGMAS**2)),
        "claim_over_bound": float(np.median(claim)),
        "error_over_bound": float(np.sqrt(np.mean(error**2))),
    }
