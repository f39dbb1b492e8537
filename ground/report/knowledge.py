"""How well a satellite knew its attitude: knowledge over time, errors against the truth, and its claims."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from flight.gnc.math.arrays import FloatArray
from flight.gnc.math.quaternion import conjugate, multiply, to_rotation_vector
from ground.report.signals import seconds, true_rows
from ground.telemetry.reader import Run

Object = dict[str, Any]
LOST, COARSE, FINE = 0, 1, 2
"""The knowledge as the navigation packet has it."""
WITH_STARS = 10.0
"""s after an accepted attitude of the stars for which the estimate is one with stars."""


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
    }


def _since_stars(run: Run, times: FloatArray) -> FloatArray:
    """Return for each of the times (n,) s how long ago an attitude of the stars was used; infinite before."""
    stars = run["stars"]
    used = np.concatenate([[-math.inf], seconds(stars[stars["accepted"] == 1])])
    return np.asarray(times - used[np.searchsorted(used, times, side="right") - 1])


def _rms(error: FloatArray) -> float:
    """Return the rms of the length of errors (n, 3); NaN without one."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) if len(error) else math.nan
