"""The closing of a path: its states and dipoles are corrected until an integrator finds the same end.

Collocation on 24 intervals solves the motion to some thousandths of a degree. Here each interval is
integrated in small steps from its first node, and what it misses the next node by is taken back by the
factors of the last Newton step: multiple shooting by a chord method.
"""

from __future__ import annotations

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.errors import PlanningError
from knightcube.gnc.guidance.three_axes.slew_model import Along, Motion, SlewCraft
from knightcube.gnc.guidance.three_axes.slew_program import Point, Program
from knightcube.gnc.guidance.three_axes.slew_transcription import Trajectory

_STEPS = 4
"""Runge-Kutta steps of an interval, an even number."""
_ROUNDS, _CLOSED, _LOST = 6, 1e-7, 1e-4
"""At most; what is missed at a node when it is closed, and when it cannot be: rad, half an angle."""


def closed(craft: SlewCraft, unit: float, along: Along, program: Program, point: Point) -> Trajectory:
    """Return the trajectory near a solved `point` whose dipoles, integrated, lead through its states.

    `unit` A m^2 is that of the dipoles, `along` gives the surroundings. Raises PlanningError where the
    equations at the point are singular, or do not lead there.
    """
    equations, at = program.equations, point.at
    place, count, scale = equations.layout, equations.count, equations.scale
    around = along(np.linspace(0.0, scale, 2 * _STEPS * count + 1))
    firsts = 2 * _STEPS * np.arange(count)
    motions = [Motion(craft, scale, unit, around.part(firsts + k)) for k in range(2 * _STEPS + 1)]
    factors = program.factors(point)
    middles, ends = _integrated(motions, at, 1.0 / count)
    for _ in range(_ROUNDS):
        missed = np.zeros(place.size)
        missed[place.equations[:, 7:]] = at.states[2::2] - ends
        missed[place.start], missed[place.end] = equations.ends_missed(at)
        if float(np.abs(missed).max()) < _CLOSED:
            break
        change = factors.solve(-missed)
        at = Trajectory(at.states + change[place.states], at.dipoles + change[place.dipoles])
        middles, ends = _integrated(motions, at, 1.0 / count)
    if not float(np.abs(missed).max()) < _LOST:
        raise PlanningError("what the path misses grows as it is mended")
    states = at.states.copy()
    states[1::2] = middles
    return Trajectory(states, at.dipoles)


def _integrated(motions: list[Motion], at: Trajectory, length: float) -> tuple[FloatArray, FloatArray]:
    """Return the states (k, 7) in the middle and at the end of each interval, integrated from its begin."""
    x, h = at.states[:-1:2], length / _STEPS
    slope = (at.dipoles[1:] - at.dipoles[:-1]) / (2 * _STEPS)
    middle = x
    for k in range(0, 2 * _STEPS, 2):
        m = [at.dipoles[:-1] + (k + part) * slope for part in range(3)]
        first = motions[k].flow(x, m[0])
        second = motions[k + 1].flow(x + 0.5 * h * first, m[1])
        third = motions[k + 1].flow(x + 0.5 * h * second, m[1])
        last = motions[k + 2].flow(x + h * third, m[2])
        x = x + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)
        if k + 2 == _STEPS:
            middle = x
    return middle, x
