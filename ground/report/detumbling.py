"""The detumbling of a satellite in orbit: times and rates of each period in which its body was braked."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flight.link.modes import Mode
from flight.link.telemetry.packets import PacketArray
from ground.report.signals import seconds
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]


def braked(run: Run, end: float) -> list[tuple[float, float, bool]]:
    """Return begin and end, s, of each period in mode detumble, and whether the body was slow in the end."""
    modes = run["mode"]
    times = np.append(seconds(modes), end)
    following = [Mode(int(mode)) for mode in modes["mode"]]
    found = []
    for k, mode in enumerate(following):
        if mode is Mode.DETUMBLE:
            slowed = k + 1 < len(following) and following[k + 1] in {Mode.ACQUIRE, Mode.HOLD}
            found.append((float(times[k]), float(times[k + 1]), slowed))
    return found


def speeds(run: Run) -> tuple[FloatArray, FloatArray, str]:
    """Return times (n,) s and speeds (n,) rad/s: true ones where the truth is known, else the gyro's."""
    name = "truth" if len(run["truth"]) else "imu"
    packets = run[name]
    return seconds(packets), np.linalg.norm(packets["rate"].astype(float), axis=1), name


def rate_errors(run: Run) -> FloatArray:
    """Return the errors (n, 3) rad/s of the rates by the magnetometer alone; (0, 3) without a truth."""
    spin, truth = known_rates(run), run["truth"]
    if not len(truth) or not len(spin):
        return np.zeros((0, 3))
    at, times = seconds(spin), seconds(truth)
    true = np.column_stack([np.interp(at, times, truth["rate"][:, axis].astype(float)) for axis in range(3)])
    return np.asarray(spin["rate"].astype(float) - true)


def known_rates(run: Run) -> PacketArray:
    """Return the spin packets that hold a rate."""
    spin = run["spin"]
    known: PacketArray = spin[spin["known"] == 1]
    return known


def detumbling(run: Run) -> Object | None:
    """Return the periods of braking and the errors of the rate; None for a body without spin packets."""
    if not len(run["spin"]):
        return None
    time, speed, source = speeds(run)
    end = float(time[-1]) if len(time) else float(seconds(run["spin"])[-1])
    periods = []
    for begin, stop, slowed in braked(run, end):
        inside = speed[(time >= begin) & (time <= stop)]
        periods.append(
            {
                "begin_s": begin,
                "duration_s": stop - begin,
                "slowed": slowed,
                "first_rate_rad_s": float(inside[0]) if len(inside) else math.nan,
                "largest_rate_rad_s": float(inside.max()) if len(inside) else math.nan,
                "last_rate_rad_s": float(inside[-1]) if len(inside) else math.nan,
            }
        )
    errors = rate_errors(run)
    return {
        "rate_source": source,
        "periods": periods,
        "rate_error_rms_rad_s": float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan,
        "rate_known_share": float(np.mean(run["spin"]["known"])),
        "restarts": int(run["spin"]["restarts"][-1]),
    }
