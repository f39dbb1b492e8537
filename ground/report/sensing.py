"""How good the estimate, the rates and the stars' attitudes were, against the truth of the simulation."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from flight.link.telemetry.packets import PacketArray, to_text
from ground.report.signals import seconds
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply, normalise, to_rotation_vector

Object = dict[str, Any]


def covariance_matrices(packed: FloatArray) -> FloatArray:
    """Return matrices (n, 3, 3) of the table's order xx yy zz xy xz yz, (n, 6)."""
    order = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
    return np.asarray(packed, dtype=float)[:, order]


def with_rate(streak: PacketArray) -> PacketArray:
    """Return those streak packets that hold a rate."""
    return streak[np.all(np.isfinite(streak["rate"]), axis=1)]


def mean_rates(truth: PacketArray, start: FloatArray, stop: FloatArray) -> FloatArray:
    """Return the true mean body rates (n, 3) between times start and stop (n,) s; NaN where not covered."""
    time = seconds(truth)
    means = np.full((len(start), 3), np.nan)
    if len(time) < 2:
        return means
    rate = truth["rate"].astype(float)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    covered = (start >= time[0]) & (stop <= time[-1]) & (stop > start)
    for axis in range(3):
        angle = np.interp(stop, time, turned[:, axis]) - np.interp(start, time, turned[:, axis])
        means[covered, axis] = angle[covered] / (stop - start)[covered]
    return means


def streaks(run: Run) -> Object:
    """Return what vision made of the frames, and how far its rates were from the truth.

    `normalised` is the mean of e' P^-1 e / 3 over the rates with a positive definite covariance P: 1 when the
    covariances are right.
    """
    packets = run["streak"]
    rated = with_rate(packets)
    found: Object = {
        "frames": len(packets),
        "rates": len(rated),
        "accepted": int(np.sum(packets["accepted"] == 1)),
        "status": dict(Counter(to_text(status) for status in packets["status"])),
        "compared": 0,
        "rms_error": None,
        "normalised": None,
    }
    start = rated["exposure_start_ns"] / 1e9
    error = rated["rate"] - mean_rates(run["truth"], start, start + rated["exposure"])
    known = np.all(np.isfinite(error), axis=1)
    if known.any():
        found["compared"] = int(known.sum())
        found["rms_error"] = np.sqrt(np.mean(error[known] ** 2, axis=0)).tolist()
        found["normalised"] = _normalised(error[known], covariance_matrices(rated["covariance"][known]))
    return found


def failed_frames(run: Run) -> list[Object]:
    """Return the frames that gave neither a rate nor an attitude: which, when, and why."""
    solved = set(run["stars"]["sequence"][np.all(np.isfinite(run["stars"]["quaternion"]), axis=1)].tolist())
    starry = {int(row["sequence"]): to_text(row["status"]) for row in run["stars"]}
    rated = np.all(np.isfinite(run["streak"]["rate"]), axis=1)
    return [
        {
            "sequence": int(row["sequence"]),
            "exposed_s": float(row["exposure_start_ns"]) / 1e9,
            "streaks": to_text(row["status"]),
            "stars": starry.get(int(row["sequence"])),
        }
        for row in run["streak"][~rated]
        if int(row["sequence"]) not in solved
    ]


def star_attitudes(run: Run) -> Object:
    """Return what the star tracker made of the frames, and how far its attitudes were from the truth.

    `rms_error` is about the body's axes in rad, `normalised` the mean of e' P^-1 e / 3, as for the streaks.
    """
    packets, truth = run["stars"], run["truth"]
    solved = packets[np.all(np.isfinite(packets["quaternion"]), axis=1)]
    found: Object = {
        "frames": len(packets),
        "solved": len(solved),
        "tracked": int(np.sum(solved["tracked"] == 1)),
        "accepted": int(np.sum(packets["accepted"] == 1)),
        "status": dict(Counter(to_text(status) for status in packets["status"])),
        "matched": float(np.median(solved["matched"])) if len(solved) else None,
        "compared": 0,
        "rms_error": None,
        "normalised": None,
    }
    time, middle = seconds(truth), solved["middle_ns"] / 1e9
    covered = (middle >= time[0]) & (middle <= time[-1]) if len(time) > 1 else np.zeros(len(solved), bool)
    if covered.any():
        # Over the truth's short steps a straight line and the great circle are the same.
        columns = [np.interp(middle[covered], time, column) for column in truth["quaternion"].T]
        true = normalise(np.stack(columns, axis=-1))
        error = to_rotation_vector(multiply(solved["quaternion"][covered], conjugate(true)))
        found["compared"] = int(covered.sum())
        found["rms_error"] = np.sqrt(np.mean(error**2, axis=0)).tolist()
        found["normalised"] = _normalised(error, covariance_matrices(solved["covariance"][covered]))
    return found


def _normalised(error: FloatArray, covariance: FloatArray) -> float | None:
    """Return the mean of e' P^-1 e / 3, None when no P is positive definite."""
    usable = np.all(np.isfinite(covariance), axis=(1, 2))
    error, covariance = error[usable], covariance[usable]
    if not len(error):
        return None
    definite = np.linalg.eigvalsh(covariance)[:, 0] > 0.0
    if not definite.any():
        return None
    solved = np.linalg.solve(covariance[definite], error[definite][:, :, None])[:, :, 0]
    return float(np.mean(np.sum(error[definite] * solved, axis=1)) / 3.0)


def estimate_errors(run: Run) -> Object | None:
    """Return rms errors of the estimated turn and rate about the thread; None where no truth is known.

    `*_normalised` is the rms of error over the estimate's own standard deviation: 1 when that is honest.
    """
    control, truth = run["control"], run["truth"]
    control = control[np.isfinite(control["angle"]) & np.isfinite(control["rate"])]
    if not len(control) or len(truth) < 2:
        return None
    quaternion, time = truth["quaternion"], seconds(truth)
    turn = np.unwrap(2.0 * np.arctan2(quaternion[:, 1], quaternion[:, 3]))
    angle = control["angle"] - np.interp(seconds(control), time, turn)
    angle = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    rate = control["rate"] - np.interp(seconds(control), time, truth["rate"][:, 1])
    return {
        "angle_rms_rad": _rms(angle),
        "rate_rms_rad_s": _rms(rate),
        "angle_normalised": _rms_ratio(angle, control["angle_sigma"]),
        "rate_normalised": _rms_ratio(rate, control["rate_sigma"]),
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rms_ratio(error: FloatArray, sigma: FloatArray) -> float | None:
    usable = np.isfinite(sigma) & (sigma > 0.0)
    return _rms(error[usable] / sigma[usable]) if usable.any() else None
