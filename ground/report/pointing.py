"""How well a satellite pointed: errors about the body's axes, and the figures of each target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flight.link import events
from flight.link.modes import POINTING
from flight.link.telemetry.packets import to_text
from ground.report.signals import CoilPower, seconds, true_rows
from ground.telemetry.reader import Run
from knightcube.astro.arrays import FloatArray
from knightcube.astro.quaternion import conjugate, multiply, to_rotation_vector

Object = dict[str, Any]
SETTLED_AFTER = 600.0
"""s after the first moment on a target, from which on its error is judged, or from its first slew's end."""


@dataclass(frozen=True, slots=True, eq=False)
class PointingErrors:
    """Turns (n, 3) rad about the body's axes from wanted to flown at times (n,) s.

    `sigma` (n, 3) rad is claimed for the attitude; `source` is "truth" or "estimate".
    """

    times: FloatArray
    error: FloatArray
    sigma: FloatArray
    source: str


def pointing_errors(run: Run) -> PointingErrors:
    """Return the errors while the body was to point, against the truth where it is known."""
    packets = run["attitude"]
    pointing = np.isin(packets["mode"], [int(mode) for mode in POINTING])
    packets = packets[pointing & np.isfinite(packets["target"][:, 0])]
    flown, source = packets["quaternion"].astype(float), "estimate"
    if len(run["truth"]) and len(packets):
        place = true_rows(run["truth"], packets)
        packets = packets[place >= 0]
        flown, source = run["truth"]["quaternion"][place[place >= 0]].astype(float), "truth"
    known = np.isfinite(flown[:, 0])
    error = to_rotation_vector(multiply(flown[known], conjugate(packets["target"][known].astype(float))))
    sigma = packets["angle_sigma"][known].astype(float)
    return PointingErrors(seconds(packets)[known], np.reshape(error, (-1, 3)), sigma, source)


def across(error: FloatArray, axis: npt.ArrayLike) -> FloatArray:
    """Return how far (n,) rad an axis (3,) of the body is turned by small errors (n, 3)."""
    unit = np.asarray(axis, dtype=float)
    return np.asarray(np.linalg.norm(error - np.outer(error @ unit, unit), axis=1))


def pointing(run: Run, axis: npt.ArrayLike, power: CoilPower | None) -> Object | None:
    """Return the figures of each target that was pointed to; None for a run that never pointed.

    A target is judged from `SETTLED_AFTER` on, or from the end of its first slew where that is later; `axis`
    (3,) of the body is the one that points.
    """
    found = pointing_errors(run)
    if not len(found.times):
        return None
    aims = _aims(run)
    ends = [begin for begin, _ in aims[1:]] + [math.inf]
    rows = []
    for (begin, text), end in zip(aims, ends, strict=True):
        inside = (found.times >= begin) & (found.times < end)
        if not inside.any():
            continue
        rows.append({"target": text, **_figures(found, inside, axis, power, _slewed(run, begin, end))})
    return {"source": found.source, "settled_after_s": SETTLED_AFTER, "targets": rows}


def _slewed(run: Run, begin: float, end: float) -> float:
    """Return when the first slew ended between two times, s; minus infinity without one."""
    happened = run["event"]
    ended = seconds(happened[happened["code"] == events.SLEW_ENDED.code])
    return float(min(ended[(ended >= begin) & (ended < end)], default=-math.inf))


def _figures(
    found: PointingErrors,
    inside: npt.NDArray[np.bool_],
    axis: npt.ArrayLike,
    power: CoilPower | None,
    slewed: float,
) -> Object:
    times = found.times[inside]
    begin, end = float(times[0]), float(times[-1])
    settled = inside & (found.times >= max(begin + SETTLED_AFTER, slewed))
    off = across(found.error[settled], axis)
    return {
        "begin_s": begin,
        "duration_s": end - begin,
        "axis_rms_rad": _rms(off),
        "axis_worst_rad": float(off.max()) if len(off) else math.nan,
        "all_axes_rms_rad": _rms(np.linalg.norm(found.error[settled], axis=1)),
        "supply_w": math.nan if power is None else _mean(power, power.supply, begin, end),
        "heat_w": math.nan if power is None else _mean(power, power.heat, begin, end),
    }


def _aims(run: Run) -> list[tuple[float, str]]:
    """Return when each target was announced, s, and its words; one without words for a log without events."""
    happened = run["event"]
    announced = happened[happened["code"] == events.TARGET.code]
    aims = [(float(at), to_text(row["text"])) for at, row in zip(seconds(announced), announced, strict=True)]
    return aims or [(-math.inf, "-")]


def _mean(power: CoilPower, values: FloatArray, begin: float, end: float) -> float:
    """Return the mean of the power's supply or heat from `begin` to `end`, W; NaN without an interval."""
    inside = (power.time >= begin) & (power.time < end)
    spans = power.spans[inside]
    return float(values[inside] @ spans / spans.sum()) if inside.any() else math.nan


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan
