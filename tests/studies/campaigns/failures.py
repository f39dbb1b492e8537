"""Campaign `failures`: results of the likelihood estimator for random frames of the real sky.

Pointings are uniform over the sky. Theta (axis to boresight) is 0 to 90 deg, the rotation 0 to 50 % of the
field (3.28), and the exposure 0.2 or 1 s. A sky with fewer than five usable stars is drawn again with the
same motion. A star is usable if its whole streak lies at least 4 px inside the frame, and its signal exceeds
eight standard deviations of the noise under its streak (`scenes.usable`).

A result is wrong if its error vector exceeds both 6 claimed standard deviations (the square root of its NEES;
probability 1 in 13 million) and 1 % of the rate. Each condition is also counted alone. An error above 6
standard deviations means that the covariance is too small. An error above 1 % may be a consistent result from
streaks of a few px. Refusals are counted by their status. If the usable stars move less than the estimator's
minimum length, the rate cannot be determined, and a refusal is correct.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from ground.campaigns.runner import Case, Result, Summary, summary
from knightcube.astro.arrays import FloatArray
from knightcube.vision.camera.lens import EXACT
from knightcube.vision.streaks.estimate import estimate_motion
from knightcube.vision.streaks.streak_result import LikelihoodSettings, MotionResult, StreakStatus
from sim_hal.star_camera import StarCameraModel
from tests.pace import warm_call
from tests.studies.campaigns.statistics import median, squared_sigmas
from tests.support.scenes import FIELD, RandomSlew, Scene, usable

WRONG_SIGMAS = 6.0
WRONG_SHARE = 0.01
RIGHT, WRONG, AT_REST = "right", "wrong", "at rest"
# Upper limits (% of the field) of rotation classes; times and errors are reported by class.
TURNS = (5, 20, 35, 50)
_FREEDOM = 3


def cases(runs: int, seed: int) -> list[Case]:
    """Return `runs` random motions; the sky of a motion is drawn when the motion is run."""
    slews = (RandomSlew.drawn(seed, run) for run in range(runs))
    return [
        Case(
            str(slew.run),
            (seed, slew.run, 1),
            {"theta": slew.theta, "percent": slew.percent, "exposure": slew.exposure},
        )
        for slew in slews
    ]


def run(case: Case) -> Result:
    """Estimate the motion of one frame, and evaluate the result."""
    camera = StarCameraModel(field_of_view=FIELD)
    scene, drawn = RandomSlew(case.seed[0], case.seed[1], **case.parameters).exposed(camera)
    settings = LikelihoodSettings(saturation=float(camera.highest_count), gain=camera.gain, knowledge=EXACT)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found, spent = warm_call(
            "failures",
            lambda: estimate_motion(scene.pixels, camera.pinhole, scene.exposure, settings, scene.rate, 0.0),
        )
    good = usable(scene, camera)
    true_length = float(np.median(_path_lengths(scene)[good]))
    return {
        **case.parameters,
        "seed": list(case.seed),
        "skies": drawn,
        "usable": len(good),
        "length": true_length,
        "status": found.status.value,
        "milliseconds": 1e3 * spent,
        "warnings": sorted({f"{Path(w.filename).name}:{w.lineno} {w.message}" for w in caught}),
        **_judge(found, scene, true_length < settings.least_length),
    }


def _path_lengths(scene: Scene) -> FloatArray:
    """Return the path lengths (n,), px, of the stars: the sums of the chords of both halves."""
    halves = (scene.middle - scene.start, scene.end - scene.middle)
    return np.asarray(sum(np.linalg.norm(half, axis=1) for half in halves))


def _judge(found: MotionResult, scene: Scene, still: bool) -> Result:
    """Return whether a result is right, wrong or refused, its errors, and reasons if it is not right."""
    size = float(np.linalg.norm(scene.rate))
    if found.status is not StreakStatus.RATE or found.rate is None or found.covariance is None:
        verdict = AT_REST if still else found.status.value
        return {"verdict": verdict, "reason": _why_refused(found), "nees": None}
    error = found.rate - scene.rate
    nees = squared_sigmas(error, found.covariance)
    vector = float(np.linalg.norm(error)) / size
    wrong = nees > WRONG_SIGMAS**2 and vector > WRONG_SHARE
    suspicious = wrong or nees > WRONG_SIGMAS**2
    return {
        "verdict": WRONG if wrong else RIGHT,
        "reason": _how_wrong(found, scene) if suspicious else "",
        "nees": nees,
        "vector": vector,
        "magnitude": float(np.linalg.norm(found.rate)) / size - 1.0,
    }


def _why_refused(found: MotionResult) -> str:
    """Return the reason for a refusal, as far as the result contains it."""
    if not found.found:
        return "no motion that the regions agree on"
    return f"{found.used_count} of {found.found} stars used, {found.length:.0f} px, misfit {found.misfit:.2f}"


def _how_wrong(found: MotionResult, scene: Scene) -> str:
    """Return the way in which a result differs from the truth."""
    if found.rate is None:
        return _why_refused(found)
    sizes = float(np.linalg.norm(found.rate)), float(np.linalg.norm(scene.rate))
    turned = np.arccos(np.clip(found.rate @ scene.rate / (sizes[0] * sizes[1]), -1.0, 1.0))
    return (
        f"{sizes[0] / sizes[1]:.4f} of the rate, axis {np.rad2deg(turned):.3f} deg off, misfit"
        f" {found.misfit:.2f}, {found.used_count} stars, PSF {found.psf_sigma:.3f} px"
    )


def summarise(results: Sequence[Result], _: Path) -> Summary:
    """Return the counts, the NEES distribution, the times, every seed that failed, and the plot."""
    facts = {
        "frames": len(results),
        "verdicts": dict(sorted(Counter(r["verdict"] for r in results).items())),
        **_counts(results),
        "nees": _nees(results),
        "milliseconds": _times(results),
        "by_turn": _by_turn(results),
        "failures": [r for r in results if _worth_a_line(r)],
    }
    return summary(facts)


def _worth_a_line(result: Result) -> bool:
    """Return whether a frame is listed: wrong, overconfident, refused although stars move, or warned."""
    if result["verdict"] == AT_REST:
        return bool(result["warnings"])
    return bool(result["reason"] or result["warnings"])


def _counts(results: Sequence[Result]) -> dict[str, Any]:
    answers = [r for r in results if r["nees"] is not None]
    return {
        "answers": len(answers),
        "wrong": sum(r["verdict"] == WRONG for r in answers),
        "beyond_sigmas": sum(r["nees"] > WRONG_SIGMAS**2 for r in answers),
        "beyond_share": sum(r["vector"] > WRONG_SHARE for r in answers),
        "refused": sum(r["nees"] is None and r["verdict"] != AT_REST for r in results),
        "at_rest": sum(r["verdict"] == AT_REST for r in results),
        "skies": sum(r["skies"] for r in results),
    }


def _nees(results: Sequence[Result]) -> dict[str, float] | None:
    """Return the mean NEES, and the fractions of results beyond quantiles of chi-square."""
    values = np.array([r["nees"] for r in results if r["nees"] is not None])
    if not len(values):
        return None
    limits = {f"beyond_{100 * p:g}%": float(np.mean(values > chi2.isf(p, _FREEDOM))) for p in (0.05, 1e-3)}
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "largest": float(values.max()),
        **limits,
    }


def _times(results: Sequence[Result]) -> dict[str, float]:
    """Return median, 95 %, 99 % and largest processor time, ms."""
    spent = np.array([r["milliseconds"] for r in results])
    quantiles = {f"p{100 * q:.0f}": float(np.quantile(spent, q)) for q in (0.5, 0.95, 0.99)}
    return {**quantiles, "largest": float(spent.max())}


def _by_turn(results: Sequence[Result]) -> list[dict[str, Any]]:
    rows = []
    for low, high in zip((0, *TURNS[:-1]), TURNS, strict=True):
        here = [r for r in results if low <= r["percent"] < high]
        if not here:
            continue
        errors = [r["vector"] for r in here if r["nees"] is not None]
        row = {"from": low, "to": high, "frames": len(here), **_counts(here), **_times(here)}
        row["vector_median"] = median(errors)
        rows.append(row)
    return rows
