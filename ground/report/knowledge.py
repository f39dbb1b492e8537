"""How well a satellite knew its attitude: knowledge over time, errors against the truth, and its claims."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ground.report.signals import seconds, true_rows
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector

Object = dict[str, Any]
LOST, COARSE, FINE = 0, 1, 2
"""The knowledge as the navigation packet has it."""
WITH_STARS = 10.0
"""s after an accepted attitude of the stars for which the estimate is one with stars."""

LIT, JUDGED, LEAST_DIPOLE = 0.99, 600, 1e-9
"""Share of the Sun's disc from which the satellite is in sunlight; navigation packets, one a second, in which
the residual dipole is judged; A m^2, below which there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeErrors:
    """Errors (n, 3) rad about the body's axes at times (n,) s, and the standard deviations claimed (n, 3)."""

    times: FloatArray
    error: FloatArray
    sigma: FloatArray


def attitude_errors(run: Run) -> AttitudeErrors:
    """Return the errors of the attitude packets that have an estimate; empty without a truth."""
    packets, truth = run["attitude"], run["truth"]
    known = packets[np.isfinite(packets["quaternion"][:, 0])]
    if not len(known) or not len(truth):
        return AttitudeErrors(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    place = true_rows(truth, known)
    known, place = known[place >= 0], place[place >= 0]
    true = truth["quaternion"][place].astype(float)
    error = to_rotation_vector(multiply(true, conjugate(known["quaternion"].astype(float))))
    return AttitudeErrors(seconds(known), error, known["angle_sigma"].astype(float))


def knowledge(run: Run) -> Object | None:
    """Return the shares of time by knowledge, and the errors of what was called fine; None without packets.

    With stars: at most `WITH_STARS` s after one of their attitudes was used.
    """
    packets = run["navigation"]
    if not len(packets):
        return None
    level = packets["knowledge"].astype(int)
    errors = attitude_errors(run)
    at = np.searchsorted(seconds(packets), errors.times, side="right") - 1
    fine = level[np.maximum(at, 0)] == FINE
    error, sigma = errors.error[fine], errors.sigma[fine]
    starry = errors.error[fine & (_since_stars(run, errors.times) < WITH_STARS)]
    last = packets[-1]
    return {
        "share": {name: float(np.mean(level == k)) for k, name in enumerate(("lost", "coarse", "fine"))},
        "fine_after_s": float(seconds(packets)[level == FINE][0]) if (level == FINE).any() else math.nan,
        "fine_error_rms_rad": _rms(error),
        "with_stars_error_rms_rad": _rms(starry),
        "fine_error_worst_rad": float(np.linalg.norm(error, axis=1).max()) if len(error) else math.nan,
        "worst_sigmas": float((np.abs(error) / sigma).max()) if len(error) else math.nan,
        "nees_per_axis": float(np.mean((error / sigma) ** 2)) if len(error) else math.nan,
        "refused": int(last["refused"]),
        "fixes_refused": int(last["fixes_refused"]),
        "restarts": int(last["restarts"]),
        "dipole_error_share": dipole_errors(run),
    }


def dipole_errors(run: Run) -> dict[str, float]:
    """Return the error of the residual dipole over its size, rms, in sunlight and in shadow.

    Of the last ten minutes in either; NaN without an estimate or a truth of it.
    """
    packets, truth = run["navigation"], run["orbit_truth"]
    packets = packets[np.isfinite(packets["residual_dipole"][:, 0])]
    found = {"sunlight": math.nan, "shadow": math.nan}
    if not len(packets) or not len(truth):
        return found
    at = np.clip(np.searchsorted(seconds(truth), seconds(packets)), 0, len(truth) - 1)
    true, lit = truth["residual_dipole"][at].astype(float), truth["sunlit"][at]
    off = packets["residual_dipole"].astype(float) - true
    for name, inside in (("sunlight", lit > LIT), ("shadow", lit < 1.0 - LIT)):
        last = np.flatnonzero(inside)[-JUDGED:]
        if len(last):
            found[name] = _size(off[last]) / max(_size(true[last]), LEAST_DIPOLE)
    return found


def _since_stars(run: Run, times: FloatArray) -> FloatArray:
    """Return for each of the times (n,) s how long ago an attitude of the stars was used; infinite before."""
    stars = run["stars"]
    used = np.concatenate([[-math.inf], seconds(stars[stars["accepted"] == 1])])
    return np.asarray(times - used[np.searchsorted(used, times, side="right") - 1])


def _size(vectors: FloatArray) -> float:
    """Return the root of the sum of the squares of vectors (n, 3)."""
    return float(np.sqrt(np.sum(vectors**2)))


def _rms(error: FloatArray) -> float:
    """Return the rms of the length of errors (n, 3); NaN without one."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) if len(error) else math.nan
