"""Solves for one path of a slew: a relaxed one, without the dipoles' limit, from a guess, or one within."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.hermite import HermiteCubic
from knightcube.gnc.guidance.three_axes.slew_cones import Kept
from knightcube.gnc.guidance.three_axes.slew_limits import Limits
from knightcube.gnc.guidance.three_axes.slew_path import SlewPath
from knightcube.gnc.guidance.three_axes.slew_program import FIRST_BARRIER, Descent, Point, Program
from knightcube.gnc.guidance.three_axes.slew_task import SlewTask
from knightcube.gnc.guidance.three_axes.slew_transcription import Trajectory, Transcription

WALK_BARRIER, LAST_BARRIER = 1e-5, 1e-8
"""Of a path that others begin from, and of one that is flown."""
MET, _FLOWN_MET = 1e-2, 3e-3
"""Sum of all violations below which a path that others begin from is one, though no optimum yet, and at last
one that is flown: many come to their optimum slowly. What is missed is mended by the closing."""
_STEPS_FREE = 25
"""Newton steps of a path without the dipoles' limit."""
_LOOKS = (12, 1.2), (8, 0.2), (40, 0.0)
"""Newton steps within limits, one after the other, and from which lack on a way is left after them: half of
those that lead nowhere are after the first, one in twenty of the others is."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A solved path."""

    program: Program
    point: Point

    @property
    def equations(self) -> Transcription:
        """Its equations."""
        return self.program.equations

    @property
    def at(self) -> Trajectory:
        """The trajectory."""
        return self.point.at

    @property
    def horizon(self) -> float:
        """The duration, s."""
        return self.equations.scale


class Solver:
    """Solves for one task; `unit` A m^2 is that of its dipoles.

    `extra` (cones, 2 nodes) rad is added to its cones at the points of the fine grid; `share` of the dipoles'
    limit is used. `steps` are Newton's so far, `work` those times the intervals.
    """

    def __init__(self, task: SlewTask) -> None:
        self._task = task
        self.unit = float(np.mean(task.craft.limit))
        self._limit = task.craft.limit / self.unit
        self._full = task.craft.weights / float(task.craft.weights @ self._limit**2)
        self.extra = np.zeros((len(task.cones), 2 * task.nodes))
        self.share = 1.0
        self.steps = self.work = 0

    def energy(self, found: Found) -> float:
        """Return the heat of a path, J."""
        equations = found.equations
        power = float(self._task.craft.weights @ self._task.craft.limit**2)
        return equations.cost(found.at) * equations.scale * power / float(equations.weights @ self._limit**2)

    def peak(self, found: Found) -> float:
        """Return the largest dipole of a path over its limit."""
        return float((np.abs(found.at.dipoles) / self._limit).max())

    def is_kept(self, found: Found) -> bool:
        """Return whether a relaxed path keeps it."""
        kept = self.kept(found.equations).values(found.at.states[1:, :4])
        return self.peak(found) <= 1.0 and bool(np.all(kept >= 0.0))

    def equations(self, scale: float, count: int) -> Transcription:
        """Return the equations over `scale` s on `count` intervals."""
        task = self._task
        start = np.concatenate([task.quaternion, scale * task.rate])
        return Transcription(task.craft, self.unit, task.along, start, task.end, count, scale, self._full)

    def free(self, equations: Transcription, guess: Trajectory) -> Found | None:
        """Return the path that is flown, without the dipoles' limit, from a guess."""
        return self.found(self.descent(equations, guess, LAST_BARRIER), _STEPS_FREE)

    def descent(self, equations: Transcription, guess: Trajectory, last: float = WALK_BARRIER) -> Descent:
        """Return the way from a guess to a path that keeps the cones, without the dipoles' limit."""
        equations.weights = self._full / max(equations.cost(guess), 1e-9)
        return Descent(Program(equations, Limits(equations, None, self.kept(equations))), guess, last=last)

    def limited(self, start: Found, count: int, time: float, last: float) -> Found | None:
        """Return the path within all limits on `count` intervals over `time` s, from one near it."""
        equations = self.equations(time, count)
        at, before = transferred(start, equations), start.equations.weights
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        same = count == start.equations.count
        price = start.point.price * float(equations.weights[0] / before[0]) if same else None
        limit = self.share * self._limit
        near = same and time == start.horizon and self.peak(start) < self.share
        if not near and (last == LAST_BARRIER or self.peak(start) > self.share):
            at = Trajectory(at.states, np.clip(at.dipoles, -0.98 * limit, 0.98 * limit))
        return self._led(equations, at, price, (WALK_BARRIER if near else FIRST_BARRIER, last))

    def again(self, path: SlewPath) -> Found | None:
        """Return the path within all limits near one of a task that is nearly the same."""
        equations = self.equations(path.horizon, (len(path.times) - 1) // 2)
        states = np.concatenate([path.quaternion, path.horizon * path.rate], axis=1)
        at = Trajectory(states, path.dipole[::2] / self.unit)
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        return self._led(equations, at, None, (WALK_BARRIER, LAST_BARRIER))

    def _led(
        self,
        equations: Transcription,
        at: Trajectory,
        price: FloatArray | None,
        barriers: tuple[float, float],
    ) -> Found | None:
        """Return the path within all limits that a trajectory leads to; barriers fall from first to last."""
        limits = Limits(equations, self.share * self._limit, self.kept(equations))
        descent = Descent(Program(equations, limits), at, price, *barriers)
        found = None
        for look, (steps, lack) in enumerate(_LOOKS):
            enough = _FLOWN_MET * (look == len(_LOOKS) - 1)
            if look and barriers[1] == WALK_BARRIER:
                enough = MET
            found = self.found(descent, steps, enough)
            if found is not None or descent.lack >= lack:
                break
        return found

    def found(self, descent: Descent, most: int, enough: float = 0.0) -> Found | None:
        """Return the path found within `most` more steps, None without one.

        It need not be an optimum where the violations sum to less than is `enough`.
        """
        program, before = descent.program, descent.program.steps
        point = descent.run(most)
        if point is None and descent.missed < enough:
            point = descent.point
        self.steps += program.steps - before
        self.work += (program.steps - before) * program.equations.count
        if point is None or not program.equations.end.is_met(point.at.states[-1, :4]):
            return None
        return Found(program, point)

    def kept(self, equations: Transcription) -> Kept:
        """Return the cones at the points of equations but the first."""
        wider = self.extra if self.extra.shape[1] == 2 * equations.count else 0.0
        return Kept(self._task.cones, np.asarray(wider), equations.times[1:])


def transferred(start: Found, equations: Transcription) -> Trajectory:
    """Return a path on the grid and over the horizon of other equations.

    Slower by a ratio, the same way takes dipoles smaller by its square.
    """
    at, own = start.at, start.equations
    dipoles = at.dipoles * (own.scale / equations.scale) ** 2
    if own.count == equations.count:
        return Trajectory(at.states, dipoles)
    share = np.linspace(0.0, 1.0, 2 * own.count + 1)
    states = HermiteCubic(share, at.states, own.motion.flow(at.states, at.all_dipoles()))
    wanted = np.linspace(0.0, 1.0, 2 * equations.count + 1)
    parts = [np.interp(wanted[::2], share[::2], part) for part in dipoles.T]
    return Trajectory(states(wanted), np.stack(parts, axis=1))
