"""Availability of the star camera in orbit: the fraction of unobstructed instants with a measurement."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flight.link.telemetry.packets import PacketArray
from flight.schema.devices import FAST, Camera
from flight.schema.orbit import OrbitConfig
from ground.report.signals import seconds
from ground.telemetry import Run, text_of
from knightcube.astro.arrays import BoolArray, FloatArray, IntArray
from knightcube.astro.earth.figure import EARTH_RADIUS
from knightcube.astro.quaternion import attitude_matrix
from knightcube.vision.streaks.streak_result import StreakStatus

Object = dict[str, Any]
FINE = 2
"""Level of attitude knowledge (navigation packet) at which frames are taken every `fine_period`."""


def star_camera(run: Run, config: OrbitConfig) -> Object | None:
    """Count the instants of the star camera: scheduled, unobstructed, and with a measurement.

    The instants are those of the camera's schedule: every `camera.period` s, and every `camera.fine_period` s
    while the attitude is fine and the body rotates slowly. An instant is unobstructed if the true body rate
    is below `camera.max_rate` and the true boresight is outside `pointing.cones` of Sun and Earth. An instant
    has a measurement if a frame exposed before the next instant gives an attitude or a rate. The longest gap
    is the longest total time of consecutive unobstructed instants without a measurement. Returns None without
    a star camera or a truth log.
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
    return {
        "instants": len(instants),
        "slow": int(slow.sum()),
        "unobstructed": int(free.sum()),
        "measured": int((free & gave).sum()),
        "share": float(np.mean(gave[free])) if free.any() else math.nan,
        "longest_gap_s": _longest_gap(instants, ends, free, gave),
    }


def _schedule(run: Run, camera: Camera) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return start and end times (n,), s, of the camera's intervals, and whether the body rotates slowly.

    The body rotates slowly if its rate is below `camera.max_rate`. As in flight, an instant at which the body
    rotates too fast for a frame does not delay the next instant.
    """
    last = min(float(seconds(run[name])[-1]) for name in ("truth", "orbit_truth"))
    ticks = np.arange(0.0, last + camera.period, camera.period)
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
    """Return flags (n,): whether the boresight (3,), body axes, is outside the cones of Sun and Earth."""
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


def _longest_gap(instants: FloatArray, ends: FloatArray, free: BoolArray, gave: BoolArray) -> float:
    """Return the longest total time, s, of consecutive unobstructed instants without a measurement."""
    longest = gap = 0.0
    for at, end, wanted in zip(instants, ends, free & ~gave, strict=True):
        gap = gap + float(end - at) if wanted else 0.0
        longest = max(longest, gap)
    return longest
