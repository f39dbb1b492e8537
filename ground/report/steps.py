"""Performance measures of each attitude step of the testbed (Sease 2013, Table 5.3).

Time zero is the time of the step's command. A step begins at the previous target if the body held that
target, otherwise at the attitude of the body. Rise time is from 10 to 90 % of the step. Overshoot is the
excursion beyond the target, in % of the step. Settling time is the time of the last entry into +-5 % of the
step around the target. Steady-state error is the largest error over the last 30 s, in degrees of theta = 2
asin q2, for targets held for a minute or more. Crossings are interpolated between samples. A step that ends
within 30 s without settling counts as interrupted and is not evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flight.link.events import STEERING
from ground.report.signals import ThreadMotion, seconds
from ground.telemetry import Run, text_of
from knightcube.astro.arrays import FloatArray

Object = dict[str, Any]

SETTLING_BAND = 0.05
STEADY_STATE_S = 30.0
MIN_STEP = 1e-6
"""Smallest change of q2 that counts as a step."""

STEADY_STATE_LIMIT_DEG = 4.5
OVERSHOOT_LIMIT_PERCENT = 20.0
RISE_LIMIT_S = 8.0
SETTLING_LIMIT_S = 30.0
AVERAGE_SUPPLY_POWER_LIMIT_W = 0.10
"""Average power (W) in the thesis (chapter 5, Hardware Results), a limit for V |I| at the coils."""
CURRENT_LIMIT_A = 0.148


@dataclass(frozen=True, slots=True)
class StepCommand:
    """One commanded attitude step.

    Attributes:
        index: number of the step in the configuration.
        time: mission time of the step command, s.
        start: q2 at the beginning of the step.
        target: commanded q2.
        duration: time until the step ends, s.
        from_target: whether the step begins at a target that the body held.
        again: whether the step repeats an earlier step with the same index.
    """

    index: int
    time: float
    start: float
    target: float
    duration: float
    from_target: bool = True
    again: bool = False

    @property
    def rise_is_judged(self) -> bool:
        """Whether the thesis limits the rise time of the step.

        The first step, and a step that does not begin at a held target, have no limit.
        """
        return self.index > 0 and self.from_target


@dataclass(frozen=True, slots=True)
class StepResponse:
    """Performance measures of one step.

    A measure is NaN if it is not applicable, and infinite if its level was never reached.
    """

    steady_state_deg: float = math.nan
    overshoot_percent: float = math.nan
    rise_s: float = math.nan
    settling_s: float = math.nan


def commanded_steps(
    indices: Sequence[int], times: FloatArray, targets: FloatArray, release_q2: float, end: float
) -> list[StepCommand]:
    """Return the steps between successive `targets` (n,), values of q2.

    The targets are commanded at ascending `times` (n,), s. The `indices` (n,) are the numbers of the steps in
    the configuration. The first step begins at `release_q2`, and the last step ends at `end`, s.
    """
    starts = np.concatenate([[release_q2], targets[:-1]])
    ends = np.append(times[1:], end)
    return [
        StepCommand(int(i), float(t), float(start), float(target), float(stop - t))
        for i, t, start, target, stop in zip(indices, times, starts, targets, ends, strict=True)
    ]


def flown_steps(
    commanded: Sequence[StepCommand], time: FloatArray, q2: FloatArray, stops: FloatArray
) -> list[StepCommand]:
    """Return the executed steps, which a mode change may have ended early.

    A step starts at the previous target if the body held that target, otherwise at the body's attitude.
    The attitude `q2` (n,) is sampled at `time` (n,), s. The `stops` are ascending times, s, at which a mode
    ended the step in progress.
    """
    flown: list[StepCommand] = []
    for command in commanded:
        was = float(np.interp(command.time, time, q2))
        held = abs(was - command.start) <= SETTLING_BAND * abs(command.target - command.start)
        later = stops[stops > command.time]
        duration = min(command.duration, float(later[0]) - command.time if len(later) else math.inf)
        start, from_target = command.start if held else was, held and bool(flown)
        again = any(one.index == command.index for one in flown)
        made = replace(command, start=start, duration=duration, from_target=from_target, again=again)
        flown.append(made)
    return flown


def is_interrupted(command: StepCommand, found: StepResponse) -> bool:
    """Return whether a step ended before it could be evaluated."""
    return command.duration < SETTLING_LIMIT_S and math.isinf(found.settling_s)


def response(time: FloatArray, q2: FloatArray, command: StepCommand) -> StepResponse:
    """Return the measures of a step from samples of q2 (n,) at `time` (n,), s, that cover the step."""
    inside = (time > command.time) & (time < command.time + command.duration)
    t = np.concatenate([[0.0], time[inside] - command.time])
    y = np.concatenate([[np.interp(command.time, time, q2)], q2[inside]])
    steady = math.nan
    if command.duration >= 2.0 * STEADY_STATE_S:  # in a shorter step, the body may still slew
        last = y[t >= command.duration - STEADY_STATE_S]
        error = _angle(last) - _angle(np.array([command.target]))
        steady = float(np.degrees(np.max(np.abs(error)))) if len(last) else math.nan
    step = command.target - command.start
    if abs(step) < MIN_STEP:
        return StepResponse(steady)
    progress = (y - command.start) / step
    rise = _first_crossing(t, progress, 0.9) - _first_crossing(t, progress, 0.1)
    distance = np.abs(progress - 1.0)
    outside = np.flatnonzero(distance > SETTLING_BAND)
    settling = 0.0
    if len(outside):
        i = int(outside[-1])
        settling = math.inf if i == len(t) - 1 else _interpolate(t, distance, i, SETTLING_BAND)
    overshoot = 100.0 * max(0.0, float(progress.max()) - 1.0)
    return StepResponse(steady, overshoot, math.inf if math.isnan(rise) else rise, settling)


def _angle(q2: FloatArray) -> FloatArray:
    """Return theta = 2 asin q2, rad."""
    return np.asarray(2.0 * np.arcsin(np.clip(q2, -1.0, 1.0)))


def _first_crossing(t: FloatArray, progress: FloatArray, level: float) -> float:
    """Return the time at which `progress` first reaches `level`, or infinity if it never does."""
    reached = np.flatnonzero(progress >= level)
    if not len(reached):
        return math.inf
    i = int(reached[0])
    return 0.0 if i == 0 else _interpolate(t, progress, i - 1, level)


def _interpolate(t: FloatArray, y: FloatArray, i: int, level: float) -> float:
    """Return the interpolated time at which the signal crosses `level` between samples i and i + 1."""
    return float(t[i] + (level - y[i]) / (y[i + 1] - y[i]) * (t[i + 1] - t[i]))


def judged_steps(
    run: Run, attitude: ThreadMotion, planned_end: float, notes: list[str]
) -> list[tuple[StepCommand, StepResponse | None]]:
    """Return each commanded step with its response, which is None for an interrupted or unrecorded step.

    The reasons for missing values are appended to `notes`.
    """
    targets = run["target"]
    if not len(targets):
        notes.append("no target packets: no attitude step can be judged")
        return []
    if len(attitude.time) < 2:
        notes.append("no attitude in the log: no attitude step can be judged")
        return []
    times = seconds(targets)
    log_end = float(attitude.time[-1])
    if math.isfinite(planned_end):
        end = max(planned_end, float(times[-1]))
    else:  # if the end is unknown, the last step is assumed to last as long as the longest step
        end = float(times[-1] + np.max(np.diff(times))) if len(times) > 1 else max(log_end, float(times[-1]))
    release = float(np.interp(times[0], attitude.time, attitude.q2))
    listed = commanded_steps(targets["index"].tolist(), times, targets["q2"].astype(float), release, end)
    modes = run["mode"]
    by_command = np.array([text_of(row["trigger"]).startswith("commanded") for row in modes], dtype=bool)
    steering = np.isin(modes["mode"], [int(mode) for mode in STEERING])
    # A commanded mode, or a mode without attitude control, ends a step.
    listed = flown_steps(listed, attitude.time, attitude.q2, seconds(modes)[by_command | ~steering])
    sample = 3.0 * float(np.median(np.diff(attitude.time)))
    steps: list[tuple[StepCommand, StepResponse | None]] = []
    for command in listed:
        begun = attitude.time[0] - sample <= command.time
        complete = begun and command.time + command.duration <= log_end + sample
        found = response(attitude.time, attitude.q2, command) if complete else None
        if found is not None and is_interrupted(command, found):
            found = None
            notes.append(f"step {command.index}: interrupted after {command.duration:.1f} s, not judged")
        else:
            notes += [f"step {command.index}: {remark}" for remark in _remarks(found)]
        steps.append((command, found))
    return steps


def _remarks(found: StepResponse | None) -> list[str]:
    """Return the reasons for missing values of a step."""
    if found is None:
        return ["the log does not cover the whole step, not judged"]
    if math.isnan(found.settling_s):
        return ["the target equals the previous one, only the steady state is judged"]
    remarks = ["too short to judge the steady state"] if math.isnan(found.steady_state_deg) else []
    never = {"never reached 90 %": found.rise_s, "never settled": found.settling_s}
    return remarks + [text for text, value in never.items() if math.isinf(value)]


def step_row(command: StepCommand, found: StepResponse | None) -> Object:
    """Return the entry of a step in the report."""
    answer = found or StepResponse()
    return {
        "index": command.index,
        "again": command.again,
        "start_s": command.time,
        "duration_s": command.duration,
        "complete": found is not None,
        "from_q2": command.start,
        "from_target": command.from_target,
        "target_q2": command.target,
        "steady_state_deg": answer.steady_state_deg,
        "overshoot_percent": answer.overshoot_percent,
        "rise_s": answer.rise_s,
        "rise_judged": command.rise_is_judged,
        "settling_s": answer.settling_s,
    }


def judge(quantity: str, values: Sequence[float], limit: float, unit: str) -> Object:
    """Return the largest of `values` and the result for its limit: "pass", "miss", or "unknown" if NaN."""
    known = [value for value in values if not math.isnan(value)]
    worst = max(known, default=math.nan)
    within = worst <= limit * (1.0 + 1e-9)
    verdict = ("pass" if within else "miss") if known else "unknown"
    return {"quantity": quantity, "worst": worst, "limit": limit, "unit": unit, "verdict": verdict}


def against_thesis(steps: list[tuple[StepCommand, StepResponse | None]], power: Object) -> list[Object]:
    """Return the worst value, the thesis's limit and the verdict of each performance measure.

    The argument `power` is the report's section about power.
    """
    judged = [(command, found) for command, found in steps if found is not None]
    rise = [found.rise_s for command, found in judged if command.rise_is_judged]
    steady, overshoot, settling = (
        [getattr(found, name) for _, found in judged]
        for name in ("steady_state_deg", "overshoot_percent", "settling_s")
    )
    return [
        judge("steady-state error", steady, STEADY_STATE_LIMIT_DEG, "deg"),
        judge("overshoot", overshoot, OVERSHOOT_LIMIT_PERCENT, "%"),
        judge("rise time", rise, RISE_LIMIT_S, "s"),
        judge("settling time", settling, SETTLING_LIMIT_S, "s"),
        *(
            judge(f"average supply power at the {place}", [average], AVERAGE_SUPPLY_POWER_LIMIT_W, "W")
            for place, average in (("coils", power["supply_average_w"]), ("bus", power["bus_average_w"]))
        ),
        judge("largest current", [power["peak_current_a"]], CURRENT_LIMIT_A, "A"),
    ]
