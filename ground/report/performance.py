"""The figures of Sease 2013, Table 5.3: how well each attitude step was made.

Definitions: sample 0 is the step's command. The step runs from the target before, where the body held that
target, else from where the body was, to its own target. Rise: from 10 to 90 % of the step. Overshoot: beyond
the target, in % of the step. Settling: the last entry into +-5 % of the step about the target. Steady state:
the largest error over the last 30 s, in degrees of theta = 2 asin q2, of a target that stands for a minute at
least. Crossings are interpolated between samples. A step that ends within 30 s, not settled, is interrupted:
nothing of it is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from knightcube.astro.arrays import FloatArray

SETTLING_BAND = 0.05
STEADY_STATE_S = 30.0
LEAST_STEP = 1e-6  # of q2: below it there is no step to speak of

STEADY_STATE_LIMIT_DEG = 4.5
OVERSHOOT_LIMIT_PERCENT = 20.0
RISE_LIMIT_S = 8.0
SETTLING_LIMIT_S = 30.0
AVERAGE_SUPPLY_POWER_LIMIT_W = 0.10
"""The thesis's average power consumption (ch. 5, Hardware Results), compared with the supply's V |I|."""
CURRENT_LIMIT_A = 0.148


@dataclass(frozen=True, slots=True)
class Command:
    """One commanded step: when, s; from which q2 to which; how long it stands, s.

    `from_target`: it begins at a target that the body held. `again`: a step of this index came before.
    """

    index: int
    time: float
    start: float
    target: float
    duration: float
    from_target: bool = True
    again: bool = False


@dataclass(frozen=True, slots=True)
class Response:
    """How a step was made. NaN: does not apply to this step; inf: was never reached in its time."""

    steady_state_deg: float
    overshoot_percent: float
    rise_s: float
    settling_s: float


def commands(
    indices: Sequence[int], times: FloatArray, targets: FloatArray, release_q2: float, end: float
) -> list[Command]:
    """Return the steps of commands at `times` (n,) s to `targets` (n,) of q2.

    Args:
        indices: n numbers of the steps.
        times: ascending.
        targets: q2.
        release_q2: q2 at the first command.
        end: when the last step's time is up, s.
    """
    starts = np.concatenate([[release_q2], targets[:-1]])
    ends = np.append(times[1:], end)
    return [
        Command(int(i), float(t), float(start), float(target), float(stop - t))
        for i, t, start, target, stop in zip(indices, times, starts, targets, ends, strict=True)
    ]


def placed(listed: Sequence[Command], time: FloatArray, q2: FloatArray, stops: FloatArray) -> list[Command]:
    """Return the commands as they were met: from where the body was, and until something ended them.

    Args:
        listed: commands from target to target.
        time: (n,) s of the samples.
        q2: (n,).
        stops: s, ascending, when a mode ended whatever step there was.
    """
    met: list[Command] = []
    for command in listed:
        was = float(np.interp(command.time, time, q2))
        held = abs(was - command.start) <= SETTLING_BAND * abs(command.target - command.start)
        later = stops[stops > command.time]
        duration = min(command.duration, float(later[0]) - command.time if len(later) else math.inf)
        met.append(
            replace(
                command,
                start=command.start if held else was,
                duration=duration,
                from_target=held and bool(met),
                again=any(before.index == command.index for before in met),
            )
        )
    return met


def interrupted(command: Command, found: Response) -> bool:
    """Return whether a step was ended before it could be judged."""
    return command.duration < SETTLING_LIMIT_S and math.isinf(found.settling_s)


def response(time: FloatArray, q2: FloatArray, command: Command) -> Response:
    """Return the figures of one step from samples q2 (n,) at `time` (n,) s that cover it."""
    inside = (time > command.time) & (time < command.time + command.duration)
    t = np.concatenate([[0.0], time[inside] - command.time])
    y = np.concatenate([[np.interp(command.time, time, q2)], q2[inside]])
    steady = _steady_state(t, y, command)
    step = command.target - command.start
    if abs(step) < LEAST_STEP:
        return Response(steady, math.nan, math.nan, math.nan)
    progress = (y - command.start) / step
    rise = _first_crossing(t, progress, 0.9) - _first_crossing(t, progress, 0.1)
    return Response(
        steady_state_deg=steady,
        overshoot_percent=100.0 * max(0.0, float(progress.max()) - 1.0),
        rise_s=math.inf if math.isnan(rise) else rise,
        settling_s=_settling(t, np.abs(progress - 1.0)),
    )


def _steady_state(t: FloatArray, y: FloatArray, command: Command) -> float:
    """Return the largest error over the last 30 s; NaN when the step may still be under way then."""
    if command.duration < 2.0 * STEADY_STATE_S:
        return math.nan
    last = y[t >= command.duration - STEADY_STATE_S]
    error = _angle(last) - _angle(np.array([command.target]))
    return float(np.degrees(np.max(np.abs(error)))) if len(last) else math.nan


def _angle(q2: FloatArray) -> FloatArray:
    """Return theta = 2 asin q2, rad."""
    return np.asarray(2.0 * np.arcsin(np.clip(q2, -1.0, 1.0)))


def _first_crossing(t: FloatArray, progress: FloatArray, level: float) -> float:
    """Return when `progress` first reaches `level`: 0 if it begins there, inf if it never does."""
    reached = np.flatnonzero(progress >= level)
    if not len(reached):
        return math.inf
    i = int(reached[0])
    return 0.0 if i == 0 else _interpolate(t, progress, i - 1, level)


def _settling(t: FloatArray, distance: FloatArray) -> float:
    """Return when `distance` from the target last comes within the band: inf if it ends outside."""
    outside = np.flatnonzero(distance > SETTLING_BAND)
    if not len(outside):
        return 0.0
    i = int(outside[-1])
    return math.inf if i == len(t) - 1 else _interpolate(t, distance, i, SETTLING_BAND)


def _interpolate(t: FloatArray, y: FloatArray, i: int, level: float) -> float:
    """Return when the line through samples i and i + 1 is at `level`."""
    return float(t[i] + (level - y[i]) / (y[i + 1] - y[i]) * (t[i + 1] - t[i]))
