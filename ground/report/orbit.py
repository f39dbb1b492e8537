"""Performance of a flight in orbit: detumbling, attitude knowledge, pointing, objects and star camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link import events
from flight.link.events import POINTING, Mode
from flight.link.telemetry.packets import PacketArray
from flight.schema.bodies import OrbitConfig
from flight.schema.devices import FAST, Camera
from ground.report.signals import PowerHistory, seconds, true_quaternions, within_truth
from ground.report.steps import judge
from ground.telemetry import Run, text_of
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.quaternion import attitude_matrix, conjugate, multiply, to_rotation_vector
from knightcube.vision.streaks.streak_result import StreakStatus

Object = dict[str, Any]
LOST, COARSE, FINE = 0, 1, 2
"""Levels of attitude knowledge in the navigation packet: 0 is lost, 1 is coarse, 2 is fine."""
WITH_STARS_S = 10.0
"""Time (s) after an accepted star attitude during which the estimate counts as based on stars."""
SUNLIT = 0.99
"""Visible fraction of the solar disc above which the satellite is in sunlight."""
JUDGED = 600
"""Number of navigation packets (one per second) from which the error of the residual dipole is computed."""
MIN_DIPOLE = 1e-9
"""Smallest residual dipole (A m^2) by which the dipole error is divided."""
SETTLED_AFTER_S = 600.0
"""Time (s) from the start of pointing at a target until its pointing error is evaluated."""
_SAME_CYCLE_S = 0.5
"""Time (s) within which a description packet and an attitude error belong to the same control cycle."""
_LATEST_START_S = 2.0
"""Latest mission time (s) at which a complete log begins. The packets are sent every second, so a log that
begins later has lost its oldest segments."""


def detumbling_periods(run: Run, end: float) -> list[tuple[float, float, bool]]:
    """Return start and end, s, of each period in mode detumble, and whether mode acquire or hold followed."""
    times = np.append(seconds(run["mode"]), end)
    modes = run["mode"]["mode"].tolist()
    return [
        (float(times[k]), float(times[k + 1]), modes[k + 1 : k + 2] in ([Mode.ACQUIRE], [Mode.HOLD]))
        for k, mode in enumerate(modes)
        if mode == Mode.DETUMBLE
    ]


def body_speeds(run: Run) -> tuple[FloatArray, FloatArray, str]:
    """Return times (n,), s, rotation speeds (n,), rad/s, and their source, "truth" or "imu".

    Readings without a valid rate are omitted.
    """
    name = "truth" if len(run["truth"]) else "imu"
    packets = run[name][np.isfinite(run[name]["rate"]).all(axis=1)]
    return seconds(packets), np.linalg.norm(packets["rate"].astype(float), axis=1), name


def magnetometer_rates(run: Run) -> PacketArray:
    """Return the spin packets that contain a rate estimated from the magnetometer."""
    known: PacketArray = run["spin"][run["spin"]["known"] == 1]
    return known


def detumbling(run: Run) -> Object | None:
    """Return the periods of detumbling, and the error of the rate that the magnetometer alone gives.

    Returns None for a body without spin packets. The error is NaN without a truth log.
    """
    if not len(run["spin"]):
        return None
    time, speed, source = body_speeds(run)
    end = float(time[-1]) if len(time) else float(seconds(run["spin"])[-1])
    periods = []
    for begin, stop, slowed in detumbling_periods(run, end):
        inside = speed[(time >= begin) & (time <= stop)]
        rates = (inside[0], inside.max(), inside[-1]) if len(inside) else (math.nan,) * 3
        names = ("first_rate_rad_s", "largest_rate_rad_s", "last_rate_rad_s")
        period = {"begin_s": begin, "duration_s": stop - begin, "slowed": slowed}
        periods.append(period | dict(zip(names, map(float, rates), strict=True)))
    truth, rms = run["truth"], math.nan
    spin = within_truth(truth, magnetometer_rates(run))
    if len(spin):
        at, times, rate = seconds(spin), seconds(truth), truth["rate"].astype(float)
        true = np.column_stack([np.interp(at, times, column) for column in rate.T])
        rms = float(np.sqrt(np.mean((spin["rate"].astype(float) - true) ** 2)))
    return {
        "rate_source": source,
        "periods": periods,
        "rate_error_rms_rad_s": rms,
        "rate_known_share": float(np.mean(run["spin"]["known"])),
        "restarts": int(run["spin"]["restarts"][-1]),
    }


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeErrors:
    """Attitude errors about the body axes over time.

    Attributes:
        times: mission times (n,), s.
        error: rotation vectors (n, 3), rad, from the reference attitude to the evaluated attitude.
        sigma: standard deviations (n, 3) of the attitude estimate, rad.
        source: origin of the flown attitude, "truth" or "estimate".
    """

    times: FloatArray
    error: FloatArray
    sigma: FloatArray
    source: str = "truth"


def attitude_errors(run: Run) -> AttitudeErrors:
    """Return the errors of the attitude estimates against the truth.

    The arrays are empty without a truth log.
    """
    packets, truth = run["attitude"], run["truth"]
    known = packets[np.isfinite(packets["quaternion"][:, 0])]
    if not len(known) or not len(truth):
        return AttitudeErrors(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    true = true_quaternions(truth, known)
    known, true = known[np.isfinite(true[:, 0])], true[np.isfinite(true[:, 0])]
    error = to_rotation_vector(multiply(true, conjugate(known["quaternion"].astype(float))))
    return AttitudeErrors(seconds(known), error, known["angle_sigma"].astype(float))


def knowledge(run: Run) -> Object | None:
    """Return the fraction of time at each level of attitude knowledge, and the errors at the level fine.

    An error counts as "with stars" for `WITH_STARS_S` s after an accepted star attitude. Returns None
    without navigation packets.
    """
    packets = run["navigation"]
    if not len(packets):
        return None
    level = packets["knowledge"].astype(int)
    errors = attitude_errors(run)
    at = np.searchsorted(seconds(packets), errors.times, side="right") - 1
    fine = level[np.maximum(at, 0)] == FINE
    error, sigma = errors.error[fine], errors.sigma[fine]
    size = np.linalg.norm(errors.error, axis=1)
    age = stars_age(run, errors.times)
    last = packets[-1]
    return {
        "share": {name: float(np.mean(level == k)) for k, name in enumerate(("lost", "coarse", "fine"))},
        "fine_after_s": float(seconds(packets)[level == FINE][0]) if (level == FINE).any() else math.nan,
        "fine_error_rms_rad": _rms(size[fine]),
        "with_stars_error_rms_rad": _rms(size[fine & (age < WITH_STARS_S)]),
        "fine_error_worst_rad": float(size[fine].max()) if len(error) else math.nan,
        "worst_sigmas": float((np.abs(error) / sigma).max()) if len(error) else math.nan,
        "nees_per_axis": float(np.mean((error / sigma) ** 2)) if len(error) else math.nan,
        "refused": int(last["refused"]),
        "fixes_refused": int(last["fixes_refused"]),
        "restarts": int(last["restarts"]),
        "dipole_error_share": dipole_errors(run),
        "dipole_judged_s": {name: float(len(rows)) for name, rows in _judged_dipoles(run).items()},
        "star_camera": star_camera_knowledge(run),
        "description": learned_description(run),
    }


def stars_age(run: Run, times: FloatArray) -> FloatArray:
    """Return the ages (n,), s, of the newest accepted star attitude at `times` (n,), s.

    Before the first accepted star attitude, the age is infinite.
    """
    stars = run["stars"]
    accepted = np.concatenate([[-math.inf], seconds(stars[stars["accepted"] == 1])])
    return np.asarray(times - accepted[np.searchsorted(accepted, times, side="right") - 1])


def camera_errors(run: Run) -> AttitudeErrors:
    """Return the errors of the estimated attitude of the star camera, about the body axes.

    The misalignment of the star camera is part of the body's attitude errors, but not of the star camera's.
    The result is empty without description packets of the estimate and of the truth.
    """
    errors, packets, true = attitude_errors(run), run["description"], run["true_description"]
    if not len(packets) or not len(true) or not len(errors.times):
        return AttitudeErrors(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    # The attitude error is that of the same control cycle; the estimated misalignment changes slowly.
    at = np.minimum(np.searchsorted(errors.times, seconds(packets)), len(errors.times) - 1)
    inside = np.abs(errors.times[at] - seconds(packets)) < _SAME_CYCLE_S
    packets, at = packets[inside], at[inside]
    misaligned = true["camera"][0].astype(float) - packets["camera"].astype(float)
    error = errors.error[at] + misaligned
    return AttitudeErrors(errors.times[at], error, packets["camera_attitude_sigma"].astype(float))


def star_camera_knowledge(run: Run) -> Object | None:
    """Return rms error with stars and NEES per axis (normalised squared error) of the star camera's attitude.

    Returns None without a star attitude, and without description packets of the estimate and of the truth.
    """
    found = camera_errors(run)
    if not len(found.times) or not len(run["stars"]):
        return None
    with_stars = stars_age(run, found.times) < WITH_STARS_S
    return {
        "with_stars_error_rms_rad": _rms(np.linalg.norm(found.error[with_stars], axis=1)),
        "nees_per_axis": float(np.mean((found.error / found.sigma) ** 2)),
    }


def learned_description(run: Run) -> list[Object]:
    """Return the errors of the learned inertia, coils and sensors, with the rms of their uncertainty.

    The rms error of the first estimate is `first_error`, and that of the last estimate is `error`.

    The elements of the inertia are divided by the trace, because the scale of the inertia is observable only
    relative to the coils' dipole. The result is empty without description packets of the estimate and of the
    truth.
    """
    packets, true = run["description"], run["true_description"]
    if not len(packets) or not len(true):
        return []
    last, real = packets[-1], true[0]
    rows = []
    for name in ("inertia", "coils", "gyro", "field", "camera"):
        found, target = last[name].astype(float), real[name].astype(float)
        ratio = "_ratio" if name == "inertia" else ""
        sigma, first = last[f"{name}{ratio}_sigma"].astype(float), packets[0][name].astype(float)
        if ratio:
            found, target, first = (one / one[:3].sum() for one in (found, target, first))
        errors = {"first_error": _rms(first - target), "error": _rms(found - target), "sigma": _rms(sigma)}
        rows.append({"name": name, **errors})
    return rows


def dipole_errors(run: Run) -> dict[str, float]:
    """Return the rms error of the residual dipole relative to the true dipole, in sunlight and in shadow.

    Only the last ten minutes in sunlight and in shadow are evaluated. The two values are NaN without an
    estimate or a truth log.
    """
    found = {}
    for name, rows in _judged_dipoles(run).items():
        error, true = rows[:, 0], rows[:, 1]
        size = max(float(np.sqrt(np.sum(true**2))), MIN_DIPOLE)
        found[name] = float(np.sqrt(np.sum(error**2))) / size if len(rows) else math.nan
    return found


def _judged_dipoles(run: Run) -> dict[str, FloatArray]:
    """Return errors and true residual dipoles (n, 2, 3), A m^2, in sunlight and in shadow.

    The rows are those of the last ten minutes in sunlight, or in shadow, one row per second.
    """
    packets, truth = run["navigation"], run["orbit_truth"]
    packets = within_truth(truth, packets[np.isfinite(packets["residual_dipole"][:, 0])])
    if not len(packets):
        return {"sunlight": np.empty((0, 2, 3)), "shadow": np.empty((0, 2, 3))}
    at = np.clip(np.searchsorted(seconds(truth), seconds(packets)), 0, len(truth) - 1)
    true, lit = truth["residual_dipole"][at].astype(float), truth["sunlit"][at]
    rows = np.stack([packets["residual_dipole"].astype(float) - true, true], axis=1)
    return {"sunlight": rows[lit > SUNLIT][-JUDGED:], "shadow": rows[lit < 1.0 - SUNLIT][-JUDGED:]}


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def pointing_errors(run: Run) -> AttitudeErrors:
    """Return the rotations from the target attitude to the flown attitude in the pointing modes.

    The flown attitude is the true one if the run has a truth log, otherwise the estimate.
    """
    packets = run["attitude"]
    in_mode = np.isin(packets["mode"], [int(mode) for mode in POINTING])
    packets = packets[in_mode & np.isfinite(packets["target"][:, 0])]
    flown, source = packets["quaternion"].astype(float), "estimate"
    if len(run["truth"]) and len(packets):
        flown, source = true_quaternions(run["truth"], packets), "truth"
    known = np.isfinite(flown[:, 0])
    error = to_rotation_vector(multiply(flown[known], conjugate(packets["target"][known].astype(float))))
    sigma = packets["angle_sigma"][known].astype(float)
    return AttitudeErrors(seconds(packets)[known], np.reshape(error, (-1, 3)), sigma, source)


def pointing(run: Run, axis: npt.ArrayLike, power: PowerHistory | None) -> Object | None:
    """Return the pointing results of each target, or None for a run without pointing.

    The evaluation of a target begins `SETTLED_AFTER_S` s after its first pointing cycle, or at the end of its
    first slew if the slew ends later. The pointing axis in body axes is `axis` (3,). A target whose event is
    not in the log is named "-".
    """
    found = pointing_errors(run)
    if not len(found.times):
        return None
    happened, unit = run["event"], np.asarray(axis, dtype=float)
    slew_ends = seconds(happened[happened["code"] == events.SLEW_ENDED.code])
    announced = happened[happened["code"] == events.TARGET.code]
    starts = [*map(float, seconds(announced))]
    names = [text_of(row["text"]) for row in announced]
    if not starts or found.times[0] < starts[0]:  # the event of the first target is not in the log
        starts, names = [-math.inf, *starts], ["-", *names]
    rows = []
    for name, start, stop in zip(names, starts, [*starts[1:], math.inf], strict=True):
        inside = (found.times >= start) & (found.times < stop)
        if not inside.any():
            continue
        begin, end = float(found.times[inside][0]), float(found.times[inside][-1])
        slewed = min(slew_ends[(slew_ends >= start) & (slew_ends < stop)], default=-math.inf)
        error = found.error[inside & (found.times >= max(begin + SETTLED_AFTER_S, slewed))]
        axis_error = np.linalg.norm(error - np.outer(error @ unit, unit), axis=1)
        rows.append(
            {
                "target": name,
                "begin_s": begin,
                "duration_s": end - begin,
                "axis_rms_rad": _rms(axis_error),
                "axis_worst_rad": float(axis_error.max()) if len(error) else math.nan,
                "all_axes_rms_rad": _rms(np.linalg.norm(error, axis=1)),
                "supply_w": math.nan if power is None else power.average(power.supply, begin, end),
                "heat_w": math.nan if power is None else power.average(power.heat, begin, end),
            }
        )
    return {"source": found.source, "settled_after_s": SETTLED_AFTER_S, "targets": rows}


def object_tracks(run: Run) -> list[PacketArray]:
    """Return the packets of each tracked object, in the order of object numbers."""
    packets = run["track"]
    return [packets[packets["number"] == number] for number in np.unique(packets["number"])]


def objects(run: Run) -> list[Object]:
    """Return the results for each tracked object, in the order of detection."""
    rows = []
    for packets in object_tracks(run):
        detected = packets["seen"] > 0
        speed = np.linalg.norm(packets["rate"].astype(float), axis=1)
        sigma = float(np.median(packets["measured_sigma"][detected])) if detected.any() else None
        magnitude = packets["magnitude"][np.isfinite(packets["magnitude"])]
        rows.append(
            {
                "number": int(packets["number"][0]),
                "first_s": float(packets["middle_ns"][0]) * 1e-9,
                "last_s": float(packets["middle_ns"][-1]) * 1e-9,
                "frames": len(packets),
                "seen": int(detected.sum()),
                "rate_least_rad_s": float(speed.min()),
                "rate_most_rad_s": float(speed.max()),
                "magnitude": float(np.median(magnitude)) if len(magnitude) else math.nan,
                "sighting_sigma_rad": sigma,
            }
        )
    return rows


def requirements(
    config: OrbitConfig,
    detumbled: Object | None,
    known: Object | None,
    pointed: Object | None,
    seen: Object | None,
    end_s: float,
) -> list[Object]:
    """Return the comparisons of the results with the limits in the configuration's section `requirements`.

    The arguments `detumbled`, `known`, `pointed` and `seen` are the report's results on detumbling, attitude
    knowledge, pointing and the star camera. The log ends at `end_s`. If the log ends before an event and
    before the time limit of this event, the verdict is "unknown".
    """
    limits = config.requirements

    def pending(begin: float, limit: float | None) -> float:
        return math.nan if limit is None or end_s < begin + limit else math.inf

    periods = detumbled["periods"][:1] if detumbled else []
    slow = [
        one["duration_s"] if one["slowed"] else pending(one["begin_s"], limits.slow_within) for one in periods
    ]
    rows = [("detumbling time", slow, limits.slow_within, "s")]
    if known is not None:
        slowed_at = [one["begin_s"] + one["duration_s"] for one in periods if one["slowed"]]
        fine_at = known["fine_after_s"]
        fine = [
            pending(at, limits.fine_within) if math.isnan(fine_at) else max(0.0, fine_at - at)
            for at in slowed_at
        ]
        # The star camera's attitude is evaluated, because the body's attitude includes the mounting error.
        camera = known.get("star_camera") or known
        error = [math.degrees(camera["with_stars_error_rms_rad"])]
        rows.append(("time from detumbling to fine attitude", fine, limits.fine_within, "s"))
        whose = "attitude error" if camera is known else "star camera's attitude error"
        rows.append((f"{whose} with stars, rms", error, limits.knowledge_deg, "deg"))
    for target in pointed["targets"] if pointed else []:
        error = [math.degrees(target["axis_rms_rad"])]
        rows.append((f"pointing to {target['target']}, rms", error, limits.pointing_deg, "deg"))
    if seen is not None:
        missed = [100.0 * (1.0 - seen["share"])]
        name = "unobstructed frames without attitude or rate"
        rows.append((name, missed, limits.camera_missed_percent, "%"))
    return [judge(name, values, limit, unit) for name, values, limit, unit in rows if limit is not None]


def star_camera(run: Run, config: OrbitConfig) -> Object | None:
    """Count the instants of the star camera: scheduled, unobstructed, and with a measurement.

    The instants are those of the camera's schedule: every `camera.period` s, and every `camera.fine_period` s
    while the attitude is fine and the body rotates slowly. An instant is unobstructed if the true body rate
    is below `camera.max_rate` and the true boresight is outside `pointing.cones` of Sun and Earth. An instant
    is measured if a frame exposed between this instant and the next gives an attitude or a rate. The longest
    gap is the longest time without a measurement, not counting obstructed instants. Returns None without a
    star camera or a truth log.
    """
    camera = config.camera
    if camera is None or not len(run["truth"]) or not len(run["orbit_truth"]):
        return None
    instants, ends, slow = _schedule(run, camera)
    boresight = attitude_matrix(np.array(camera.mounting))[2]
    clear = _outside_cones(run, instants, boresight, config.pointing.cones.angles())
    measured = _measured_at(run)
    first = np.searchsorted(measured, instants)
    gave = np.searchsorted(measured, ends) > first
    free = slow & clear
    longest = gap = 0.0
    for at, end, without in zip(instants, ends, free & ~gave, strict=True):
        gap = gap + float(end - at) if without else 0.0
        longest = max(longest, gap)
    return {
        "instants": len(instants),
        "slow": int(slow.sum()),
        "unobstructed": int(free.sum()),
        "measured": int((free & gave).sum()),
        "share": float(np.mean(gave[free])) if free.any() else math.nan,
        "longest_gap_s": longest,
    }


def _schedule(run: Run, camera: Camera) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return start and end (n,), s, of the frame periods, and whether the body rotates slowly at each start.

    The body rotates slowly if its rate is below `camera.max_rate`. As in flight, the wait for the next frame
    begins at the last instant at which the body rotated slowly. If the oldest segments of the log were
    deleted, the intervals before the oldest remaining packets are omitted.
    """
    names = ("truth", "orbit_truth", "navigation")
    oldest = max(float(seconds(run[name])[0]) for name in names if len(run[name]))
    first = camera.period * max(0, math.ceil((oldest - _LATEST_START_S) / camera.period))
    last = min(float(seconds(run[name])[-1]) for name in ("truth", "orbit_truth"))
    ticks = np.arange(first, last + camera.period, camera.period)
    truth, known = run["truth"], run["navigation"]
    rates = np.linalg.norm(truth["rate"][_rows(truth, ticks)].astype(float), axis=1)
    steady = rates <= FAST
    slow = rates < (math.inf if camera.max_rate is None else camera.max_rate)
    fine = known["knowledge"][_rows(known, ticks)] == FINE if len(known) else np.zeros(len(ticks), dtype=bool)
    rest = camera.period if camera.fine_period is None else camera.fine_period
    chosen, exposed = [], -math.inf
    for tick, at in enumerate(ticks):
        if not (slow[tick] and steady[tick] and fine[tick]) or at - exposed >= rest:
            chosen.append(tick)
            exposed = at if slow[tick] else exposed
    instants, ends = ticks[chosen[:-1]], ticks[chosen[1:]]
    return instants, ends, slow[chosen[:-1]]


def _outside_cones(
    run: Run, instants: FloatArray, boresight: FloatArray, cones: dict[str, float]
) -> BoolArray:
    """Return flags (n,) that are true if the boresight (3,), body axes, is outside both cones."""
    body, around = run["truth"], run["orbit_truth"]
    to_body = attitude_matrix(body["quaternion"][_rows(body, instants)].astype(float))
    shown = np.einsum("nij,i->nj", to_body, boresight)
    around = around[_rows(around, instants)]
    position = around["position"].astype(float)
    distance = np.linalg.norm(position, axis=1)
    from_sun = _angles(shown, around["sun"].astype(float))
    from_limb = _angles(shown, -position / distance[:, None]) - np.arcsin(EARTH_RADIUS / distance)
    return np.asarray((from_sun >= cones.get("sun", 0.0)) & (from_limb >= cones.get("earth", 0.0)))


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angles (n,), rad, between unit vectors (n, 3)."""
    return np.asarray(np.arccos(np.clip(np.sum(first * second, axis=1), -1.0, 1.0)))


def _rows(packets: PacketArray, instants: FloatArray) -> IntArray:
    """Return the indices (n,) of the last packets before the instants."""
    return np.maximum(np.searchsorted(seconds(packets), instants, side="right") - 1, 0)


def _measured_at(run: Run) -> FloatArray:
    """Return the sorted times (m,), s, of the exposures that gave an attitude or a rate."""
    streaks, stars = run["streak"], run["stars"]
    rates = np.array([text_of(status) == StreakStatus.RATE.value for status in streaks["status"]], dtype=bool)
    starts = streaks["exposure_start_ns"] * 1e-9
    fixed = set(stars["sequence"][np.isfinite(stars["quaternion"][:, 0])].tolist())
    attitudes = np.array([sequence in fixed for sequence in streaks["sequence"].tolist()], dtype=bool)
    return np.sort(starts[rates | attitudes])
