"""Shortest time of a single-axis slew, by shooting with full current in one direction and then in the other.

The method is independent of planner and collocation. The motion is integrated forward from the start at one
current limit, and backward from the end at the opposite limit. The current switches where both curves meet in
the phase plane. A single switch is optimal if the slew takes less than half a period of the torsion pendulum.
In the tests, half a period is more than 20 s.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from tests.support.collocation_oracle import Slew

_STEP = 0.05
_LONGEST = 24.0
_NEAR = 0.02
_NEWTON_STEPS = 12


def shortest_time(slew: Slew) -> float:
    """Return the shortest feasible duration (s) of a slew, or inf if no slew of up to 48 s is feasible."""
    return min(_meeting(slew, 1.0), _meeting(slew, -1.0))


def _meeting(slew: Slew, sign: float) -> float:
    """Return the shortest total time (s) of a slew whose first current has the given sign, or inf."""
    out = _run(slew, (slew.start_angle, slew.start_rate), sign, _STEP)
    back = _run(slew, (slew.end_angle, slew.end_rate), -sign, -_STEP)
    apart = np.abs(out[:, None, 0] - back[None, :, 0]) + np.abs(out[:, None, 1] - back[None, :, 1])
    first, second = np.nonzero(apart < _NEAR)
    best = np.inf
    for i, j in sorted(zip(first.tolist(), second.tolist(), strict=True), key=sum)[::5]:
        if (i + j) * _STEP > best:
            break
        best = min(best, _refined(slew, sign, np.array([i * _STEP, j * _STEP])))
    return best


def _refined(slew: Slew, sign: float, times: FloatArray) -> float:
    """Return the sum of the times before and after the switch, or inf if Newton's iteration fails."""
    for _ in range(_NEWTON_STEPS):
        if times.min() < -1e-9 or times.max() > _LONGEST:
            return float("inf")
        out = _at(slew, (slew.start_angle, slew.start_rate), sign, float(times[0]))
        back = _at(slew, (slew.end_angle, slew.end_rate), -sign, -float(times[1]))
        miss = out - back
        if np.abs(miss).max() < 1e-9:
            return float(times.sum())
        slope = np.column_stack([_slope(slew, out, sign), _slope(slew, back, -sign)])
        if abs(np.linalg.det(slope)) < 1e-12:
            return float("inf")
        times = times - np.linalg.solve(slope, miss)
    return float("inf")


def _slope(slew: Slew, state: FloatArray, sign: float) -> FloatArray:
    gain = sign * slew.torque_constant * slew.current_limit
    torque = gain * np.cos(state[0]) - slew.stiffness * state[0] - slew.damping * state[1]
    return np.array([state[1], torque / slew.inertia + slew.disturbance])


def _stepped(slew: Slew, state: FloatArray, sign: float, dt: float) -> FloatArray:
    """Return the state after one classical Runge-Kutta step."""
    k1 = _slope(slew, state, sign)
    k2 = _slope(slew, state + 0.5 * dt * k1, sign)
    k3 = _slope(slew, state + 0.5 * dt * k2, sign)
    k4 = _slope(slew, state + dt * k3, sign)
    return np.asarray(state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))


def _run(slew: Slew, state: tuple[float, float], sign: float, dt: float) -> FloatArray:
    """Return states (m, 2) every `dt` s until the coil has no more authority or the time limit is reached."""
    now = np.array(state)
    states = [now]
    for _ in range(round(_LONGEST / abs(dt))):
        now = _stepped(slew, now, sign, dt)
        if abs(now[0]) > 1.5:
            break
        states.append(now)
    return np.array(states)


def _at(slew: Slew, state: tuple[float, float], sign: float, time: float) -> FloatArray:
    """Return the state (2,) after `time` s; `time` may be negative."""
    now = np.array(state)
    count = max(1, int(np.ceil(abs(time) / 0.1)))
    for _ in range(count):
        now = _stepped(slew, now, sign, time / count)
    return now
