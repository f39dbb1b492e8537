"""Signals of a run and the errors of its estimates.

The signals come from the simulation's truth log if the run has one, otherwise from the flight log.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from flight.link.telemetry.packets import PacketArray
from ground.telemetry import Run, text_of
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import (
    attitude_matrix,
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_rotation_vector,
)
from knightcube.gnc.guidance.plant import steady_heat, supply_power
from knightcube.vision.streaks.streak_result import StreakStatus

Object = dict[str, Any]
_TRUTH_GAP_NS = 100_000_000
"""Longest interval (ns) between two truth records over which the truth is interpolated."""


@dataclass(frozen=True)
class ThreadMotion:
    """Rotation of the testbed's body about the thread.

    Attributes:
        time: mission times (n,), s.
        q2: second quaternion component (n,), the sine of half the angle.
        rate: rates (n,), rad/s.
        source: "truth" or "estimate".
    """

    time: FloatArray
    q2: FloatArray
    rate: FloatArray
    source: str


@dataclass(frozen=True)
class PowerHistory:
    """Total power of all coils, as means over the intervals of a run.

    Attributes:
        time: start times (n,) of the intervals, s.
        end: end of the last interval, s.
        supply: mean of V |I| (n,), W, which the coils draw from their supply.
        heat: mean of R I^2 (n,), W, the ohmic heat of a constant current. The planner minimises this heat.
        source: "truth" if computed from the simulated coils, "written" if computed from the commanded
            currents.
    """

    time: FloatArray
    end: float
    supply: FloatArray
    heat: FloatArray
    source: str

    @property
    def spans(self) -> FloatArray:
        """Lengths (n,) of the intervals, s."""
        return np.diff(np.append(self.time, self.end))

    def energy(self, power: FloatArray) -> float:
        """Return the integral of the power `supply` or `heat` (n,) over the run, J."""
        return float(power @ self.spans)

    def average(self, power: FloatArray, begin: float = -np.inf, end: float = np.inf) -> float:
        """Return the mean of `supply` or `heat` over the intervals from `begin` to `end` s, W.

        Returns NaN if no interval lies between `begin` and `end`.
        """
        inside = (self.time >= begin) & (self.time < end)
        spans = self.spans[inside]
        return float(power[inside] @ spans / spans.sum()) if inside.any() else float("nan")

    def running_average(self, power: FloatArray) -> FloatArray:
        """Return the means (n,), W, of `supply` or `heat` from the start of the run to each interval end."""
        return np.asarray(np.cumsum(power * self.spans) / np.cumsum(self.spans))


def seconds(packets: PacketArray) -> FloatArray:
    """Return the mission times (n,) of packets, s."""
    return np.asarray(packets["time_ns"] / 1e9)


def last_time(run: Run) -> float:
    """Return the mission time (s) at which the flight log of a run ends, or 0 for a log without packets.

    The end is the latest time in four types of packets, because a satellite in orbit writes no packets
    `control`. The result is at least 0, even if all packets have negative mission times.
    """
    names = ("control", "attitude", "health", "event")
    return max([0.0, *(float(seconds(run[name])[-1]) for name in names if len(run[name]))])


def within_truth(truth: PacketArray, packets: PacketArray) -> PacketArray:
    """Return the packets within the time span of the truth log, whose oldest segments may be deleted."""
    if not len(truth):
        return packets[:0]
    first, last = truth["time_ns"][[0, -1]]
    inside: PacketArray = packets[(packets["time_ns"] >= first) & (packets["time_ns"] <= last)]
    return inside


def true_quaternions(truth: PacketArray, packets: PacketArray) -> FloatArray:
    """Return the true quaternion (n, 4) at the time of each packet, NaN where the truth is not known.

    In real time, packets and truth records are not written at the same times. The truth is interpolated
    between two records that are at most `_TRUTH_GAP_NS` apart.
    """
    found = np.full((len(packets), 4), np.nan)
    if not len(truth):
        return found
    times, at = truth["time_ns"], packets["time_ns"]
    after = np.minimum(np.searchsorted(times, at), len(truth) - 1)
    before = np.maximum(after - 1, 0)
    same = times[after] == at
    found[same] = truth["quaternion"][after[same]]
    span = times[after] - times[before]
    between = ~same & (times[before] < at) & (at < times[after]) & (span <= _TRUTH_GAP_NS)
    first, second = (truth["quaternion"][place[between]].astype(float) for place in (before, after))
    second *= np.where(np.sum(first * second, axis=1) < 0.0, -1.0, 1.0)[:, None]
    share = ((at - times[before])[between] / span[between])[:, None]
    found[between] = normalise((1.0 - share) * first + share * second)
    return found


def true_attitude(run: Run) -> ThreadMotion | None:
    """Return the motion of the simulated body, or None without a truth log."""
    truth = run["truth"]
    if not len(truth):
        return None
    quaternion = truth["quaternion"].astype(float)
    # The quaternions q and -q are the same attitude, and an angle in (-pi, pi) has a positive scalar part.
    q2 = quaternion[:, 1] * np.where(quaternion[:, 3] < 0.0, -1.0, 1.0)
    return ThreadMotion(seconds(truth), q2, truth["rate"][:, 1].astype(float), "truth")


def estimated_attitude(run: Run) -> ThreadMotion:
    """Return the estimated motion. Cycles without an estimate are omitted."""
    control = run["control"]
    control = control[np.isfinite(control["q2"]) & np.isfinite(control["rate"])]
    q2, rate = (control[name].astype(float) for name in ("q2", "rate"))
    return ThreadMotion(seconds(control), q2, rate, "estimate")


def coil_power(run: Run) -> PowerHistory | None:
    """Return the coil power, or None if the log has neither the truth nor currents and resistances of coils.

    Without the truth, each written current is assumed to flow until the next control cycle.
    """
    truth, control, identity = run["truth"], run["control"], run["run"]
    time = seconds(truth)
    if len(time) >= 2 and np.all(np.diff(time) > 0.0):
        spans = np.diff(time)
        supply, heat = np.diff(truth["supply_energy"]) / spans, np.diff(truth["energy"]) / spans
        return PowerHistory(time[:-1], float(time[-1]), supply, heat, "truth")
    time = seconds(control)
    if len(time) < 2 or not len(identity):
        return None
    current = control["current_written"][:-1].astype(float)
    resistance = np.nan_to_num(identity["coil_resistance"][0].astype(float))
    supply = supply_power(current, float(identity["supply_voltage"][0])).sum(axis=1)
    heat = steady_heat(current, resistance).sum(axis=1)
    return PowerHistory(time[:-1], float(time[-1]), supply, heat, "written")


def bus_power(run: Run) -> tuple[FloatArray, FloatArray]:
    """Return the times (n,), s, and the power (n,), W, measured by the monitor in the coils' supply.

    The power is the bus voltage, before the losses of the bridges, times the current of all coils. Both
    arrays are empty if there is no monitor.
    """
    packets = run["housekeeping"]
    packets = packets[np.isfinite(packets["coil_power"])]
    return seconds(packets), packets["coil_power"].astype(float)


def covariance_matrices(packed: FloatArray) -> FloatArray:
    """Return matrices (n, 3, 3) from rows (n, 6) in the order xx yy zz xy xz yz."""
    order = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
    return np.asarray(packed, dtype=float)[:, order]


def with_rate(streak: PacketArray) -> PacketArray:
    """Return the streak packets that contain a rate."""
    return streak[np.all(np.isfinite(streak["rate"]), axis=1)]


def mean_rates(truth: PacketArray, start: FloatArray, stop: FloatArray) -> FloatArray:
    """Return the mean true body rates (n, 3), rad/s, between the times `start` and `stop` (n,), s.

    Rows that the truth does not cover are NaN.
    """
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
    """Return the numbers of frames and of rates from streaks, and the errors of the rates.

    The errors are those of the camera's rate, so the true misalignment of a simulated camera does not count.
    A rate of unknown sign (status `ambiguous`) is counted, but has no error. `normalised` is the mean of e'
    P^-1 e / 3 over the rates with a positive definite covariance P. The mean `normalised` is 1 if the
    covariances are correct.
    """
    packets = run["streak"]
    rated = with_rate(packets)
    start = rated["exposure_start_ns"] / 1e9
    true = mean_rates(run["truth"], start, start + rated["exposure"])
    to_camera = attitude_matrix(from_rotation_vector(_misalignment(run)))
    error = rated["rate"] - true @ to_camera.T
    known = np.all(np.isfinite(error), axis=1) & (rated["status"] != StreakStatus.AMBIGUOUS.value.encode())
    return {
        "frames": len(packets),
        "rates": len(rated),
        "accepted": int(np.sum(packets["accepted"] == 1)),
        "status": _counts(packets["status"]),
        **_error_figures(error[known], rated["covariance"][known]),
    }


def star_attitudes(run: Run) -> Object:
    """Return the numbers of frames and of attitudes of the star tracker, and the errors of the attitudes.

    The value `rms_error` (rad) is the rms error about the body axes. The value `normalised` is the mean of e'
    P^-1 e / 3 over the attitudes with error e and covariance P. The true misalignment of a simulated camera
    is not part of the errors.
    """
    packets, truth = run["stars"], run["truth"]
    solved = packets[np.all(np.isfinite(packets["quaternion"]), axis=1)]
    time, middle = seconds(truth), solved["middle_ns"] / 1e9
    covered = (middle >= time[0]) & (middle <= time[-1]) if len(time) > 1 else np.zeros(len(solved), bool)
    error = np.zeros((0, 3))
    if covered.any():
        # The time steps of the truth log are short enough for linear interpolation of quaternions.
        columns = [np.interp(middle[covered], time, column) for column in truth["quaternion"].T]
        true = normalise(np.stack(columns, axis=-1))
        error = to_rotation_vector(multiply(solved["quaternion"][covered], conjugate(true)))
        error -= _misalignment(run)
    return {
        "frames": len(packets),
        "solved": len(solved),
        "tracked": int(np.sum(solved["tracked"] == 1)),
        "accepted": int(np.sum(packets["accepted"] == 1)),
        "status": _counts(packets["status"]),
        "matched": float(np.median(solved["matched"])) if len(solved) else None,
        **_error_figures(error, solved["covariance"][covered]),
    }


def failed_frames(run: Run) -> list[Object]:
    """Return number, time and reason of failure of each frame that gave neither a rate nor an attitude."""
    stars = run["stars"]
    solved = set(stars["sequence"][np.all(np.isfinite(stars["quaternion"]), axis=1)].tolist())
    reasons = {int(row["sequence"]): text_of(row["status"]) for row in stars}
    rated = np.all(np.isfinite(run["streak"]["rate"]), axis=1)
    return [
        {
            "sequence": int(row["sequence"]),
            "exposed_s": float(row["exposure_start_ns"]) / 1e9,
            "streaks": text_of(row["status"]),
            "stars": reasons.get(int(row["sequence"])),
        }
        for row in run["streak"][~rated]
        if int(row["sequence"]) not in solved
    ]


def estimate_errors(run: Run) -> Object | None:
    """Return the rms errors of the estimated angle and rate about the thread, or None without a truth log.

    A name that ends with `_normalised` is the rms of the error divided by the estimated standard deviation. A
    normalised value is 1 if the standard deviations are correct.
    """
    control, truth = run["control"], run["truth"]
    control = within_truth(truth, control[np.isfinite(control["angle"]) & np.isfinite(control["rate"])])
    if not len(control) or len(truth) < 2:
        return None
    quaternion, time = truth["quaternion"], seconds(truth)
    turn = np.unwrap(2.0 * np.arctan2(quaternion[:, 1], quaternion[:, 3]))
    angle = control["angle"] - np.interp(seconds(control), time, turn)
    angle = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    rate = control["rate"] - np.interp(seconds(control), time, truth["rate"][:, 1])
    found: Object = {"angle_rms_rad": _rms(angle), "rate_rms_rad_s": _rms(rate)}
    for name, error in (("angle", angle), ("rate", rate)):
        sigma = control[f"{name}_sigma"]
        usable = np.isfinite(sigma) & (sigma > 0.0)
        found[f"{name}_normalised"] = _rms(error[usable] / sigma[usable]) if usable.any() else None
    return found


def _misalignment(run: Run) -> FloatArray:
    """Return the true misalignment (3,), rad, of a simulated star camera, or zeros if it is not known."""
    true = run["true_description"]
    return true["camera"][0].astype(float) if len(true) else np.zeros(3)


def _counts(texts: PacketArray) -> dict[str, int]:
    return dict(Counter(text_of(text) for text in texts))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _error_figures(error: FloatArray, packed: FloatArray) -> Object:
    """Return count and rms of errors e (n, 3), and the mean of e' P^-1 e / 3.

    The mean is over the positive definite covariances P in `packed`.
    """
    found: Object = {"compared": len(error), "rms_error": None, "normalised": None}
    if len(error):
        found["rms_error"] = np.sqrt(np.mean(error**2, axis=0)).tolist()
    covariance = covariance_matrices(packed)
    usable = np.all(np.isfinite(covariance), axis=(1, 2))
    error, covariance = error[usable], covariance[usable]
    definite = np.linalg.eigvalsh(covariance)[:, 0] > 0.0 if len(error) else np.zeros(0, bool)
    if definite.any():
        scaled = np.linalg.solve(covariance[definite], error[definite][:, :, None])[:, :, 0]
        found["normalised"] = float(np.mean(np.sum(error[definite] * scaled, axis=1)) / 3.0)
    return found
