"""The search for a slew's path: guesses on a coarse grid, the promising ones within the limits, then refined.

Without limits a path is found from most guesses in a dozen Newton steps; its heat is a lower bound of that
within the limits. Where the asked horizon does not suffice, a longer slew is shortened step by step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from flight.gnc.guidance.three_axes.slew_cones import Kept
from flight.gnc.guidance.three_axes.slew_limits import Limits
from flight.gnc.guidance.three_axes.slew_prey import guesses
from flight.gnc.guidance.three_axes.slew_program import Point, Program
from flight.gnc.guidance.three_axes.slew_task import HORIZON_RANGE, LEAST_TIME, SlewTask
from flight.gnc.guidance.three_axes.slew_transcription import Trajectory, Transcription
from flight.gnc.math.arrays import FloatArray

_COARSE = 10
"""Intervals of the search."""
_ENOUGH = 3
"""Solved guesses of which the cheapest is taken; where none keeps the limits, as many more are solved."""
_MOST_TRIED = 12
_LONGER = 1.0, 1.4, 2.0, 2.8
"""Times the asked horizon, for paths without limits."""
_STEPS_FREE = 25
_STEPS_LIMITED = 40
_WALK_BARRIER, _LAST_BARRIER = 1e-5, 1e-8
_FIRST_STEP, _COARSE_STEP, _LAST_STEP = 1.2, 1.02, 1.004
"""Ratios of horizons on the walk to a shorter one; from the second on the grid is the fine one."""
_CONE_MARGINS = math.radians(0.1), math.radians(0.5), math.radians(2.0)
"""Added to every cone, the next where a path crosses it between the nodes."""
_PEAK = 0.9
"""Of the limit: the dipole of the slew at which the walk begins."""


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


class Search:
    """The search of one task; `unit` A m^2 is that of its dipoles."""

    def __init__(self, task: SlewTask) -> None:
        self._task = task
        self.unit = float(np.mean(task.craft.limit))
        self._limit = task.craft.limit / self.unit
        self._full = task.craft.weights / float(task.craft.weights @ self._limit**2)
        self._coarse = min(task.nodes, _COARSE)
        self._margins = list(_CONE_MARGINS)
        self._margin = 0.0
        self.steps = self.tried = 0

    def best(self) -> Found | None:
        """Return the best path within all limits at the nodes, None without one."""
        price = self._task.time_price
        relaxed: list[Found] = []
        for batch in self._relaxed():
            relaxed += batch
            if price is None:
                found = self._cheapest(batch)
            else:
                found = self._shortened(batch, HORIZON_RANGE[0], price)
            if found is not None:
                return found
        return self._shortened(relaxed, self._task.horizon, LEAST_TIME) if price is None else None

    def widened(self, found: Found) -> Found | None:
        """Return a path near one that crosses a cone between the nodes, None without one."""
        if not self._margins:
            return None
        self._margin = self._margins.pop(0)
        return self._limited(found, found.equations.count, found.horizon, _LAST_BARRIER)

    def energy(self, found: Found) -> float:
        """Return the heat of a path, J."""
        equations = found.equations
        power = float(self._task.craft.weights @ self._task.craft.limit**2)
        return equations.cost(found.at) * equations.scale * power / float(equations.weights @ self._limit**2)

    def _relaxed(self) -> Iterator[list[Found]]:
        """Yield paths without limits, a few at a time, over the asked horizon or the next that has any.

        The longer a slew, the more the field turns under way, and the nearer a guess is to a path.
        """
        for longer in _LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            batch: list[Found] = []
            any_found = False
            for guess in self._guesses(self._equations(horizon, self._coarse))[:_MOST_TRIED]:
                self.tried += 1
                found = self._free(self._equations(horizon, self._coarse), guess)
                if found is not None:
                    any_found = True
                    batch.append(found)
                if len(batch) == _ENOUGH:
                    yield batch
                    batch = []
            if batch:
                yield batch
            if any_found or horizon == self._task.longest:
                return

    def _guesses(self, equations: Transcription) -> list[Trajectory]:
        """Return guesses: of each way round those that lack least first, the ways in turn."""
        ways = []
        made = guesses(equations.motion, self._task.craft, equations.start, equations.end, equations.around)
        for way in made:
            lacks = [float(np.abs(equations.remainders(guess)[0][:, 11:]).sum()) for guess in way]
            ways.append(sorted(zip(lacks, way, strict=True), key=lambda pair: pair[0]))
        turns = (sorted(filter(None, turn), key=lambda pair: pair[0]) for turn in zip_longest(*ways))
        return [guess for turn in turns for _, guess in turn]

    def _cheapest(self, batch: list[Found]) -> Found | None:
        """Return the cheapest path within the limits over the asked horizon, from paths without limits."""
        best: Found | None = None
        for start in self._distinct([start for start in batch if start.horizon <= self._task.horizon]):
            if best is not None and self.energy(start) >= self.energy(best):
                break
            found = self._within(start)
            if found is not None and (best is None or self.energy(found) < self.energy(best)):
                best = found
        return best

    def _distinct(self, relaxed: list[Found]) -> list[Found]:
        """Return paths without limits, the cheapest first, each once."""
        ordered = sorted(relaxed, key=self.energy)
        costs = [(found.horizon, self.energy(found)) for found in ordered]
        return [
            found
            for k, found in enumerate(ordered)
            if k == 0 or not np.allclose(costs[k], costs[k - 1], rtol=1e-4, atol=0.0)
        ]

    def _within(self, start: Found) -> Found | None:
        """Return the path within the limits, on the fine grid, near a coarse one without."""
        nodes, time = self._task.nodes, start.horizon
        if self._is_kept(start):
            equations = self._equations(time, nodes)
            fine = self._free(equations, _transferred(start, equations))
            if fine is not None and self._is_kept(fine):
                return fine
        coarse = self._limited(start, self._coarse, time, _WALK_BARRIER)
        return None if coarse is None else self._limited(coarse, nodes, time, _LAST_BARRIER)

    def _shortened(self, relaxed: list[Found], least: float, price: float) -> Found | None:
        """Return the best path on walks to shorter horizons, as long as `price` W makes them cheaper.

        A walk begins where a path without limits just keeps the dipoles', with the path that needs the least
        time for that.
        """
        best: Found | None = None
        for start in sorted(self._distinct(relaxed), key=self._fastest)[:_ENOUGH]:
            times = self._begins(start, least)
            begun = next(filter(None, (self._over(start, time) for time in times)), None)
            if begun is None:
                continue
            ended = self._walked(begun, least, price, _FIRST_STEP, _COARSE_STEP)
            if best is None or self._value(ended, price) < self._value(best, price):
                best = ended
            if best.horizon <= least:
                break
        return None if best is None else self._refined(best, least, price)

    def _refined(self, best: Found, least: float, price: float) -> Found | None:
        """Return the best path on the fine grid, by a walk that begins with a coarse one."""
        nodes, times = self._task.nodes, best.horizon * np.array([1.0, _COARSE_STEP])
        longer = (self._limited(best, nodes, float(time), _WALK_BARRIER) for time in times)
        fine = next(filter(None, longer), None)
        if fine is None:
            return None
        fine = self._walked(fine, least, price, _COARSE_STEP, _LAST_STEP)
        return self._limited(fine, nodes, fine.horizon, _LAST_BARRIER) or fine

    def _walked(self, best: Found, least: float, price: float, step: float, last: float) -> Found:
        """Return the best path on a walk to shorter horizons, in ratios from `step` to `last`."""
        while step > last and best.horizon > least:
            further = self._over(best, max(best.horizon / step, least))
            if further is not None and self._value(further, price) < self._value(best, price):
                best = further
            else:
                step = math.sqrt(step)
        return best

    def _fastest(self, found: Found) -> float:
        """Return about which horizon a path without limits takes for its dipoles to keep theirs, s."""
        return found.horizon * math.sqrt(self._peak(found) / _PEAK)

    def _begins(self, start: Found, least: float) -> list[float]:
        """Return horizons at which a walk may begin from a path without limits, s, the shortest first."""
        time = max(self._fastest(start), least)
        times = [time, start.horizon] if time < start.horizon else [longer * time for longer in _LONGER]
        return [each for each in times if each <= self._task.longest]

    def _value(self, found: Found, price: float) -> float:
        """Return what a path costs, J; s where time alone counts."""
        return found.horizon if math.isinf(price) else self.energy(found) + price * found.horizon

    def _peak(self, found: Found) -> float:
        """Return the largest dipole of a path over its limit."""
        return float((np.abs(found.at.dipoles) / self._limit).max())

    def _over(self, start: Found, time: float) -> Found | None:
        """Return the path of least energy within the limits over `time` s, from one over another horizon."""
        return self._limited(start, start.equations.count, time, _WALK_BARRIER)

    def _equations(self, scale: float, count: int) -> Transcription:
        task = self._task
        start = np.concatenate([task.quaternion, scale * task.rate])
        return Transcription(task.craft, self.unit, task.along, start, task.end, count, scale, self._full)

    def _free(self, equations: Transcription, guess: Trajectory) -> Found | None:
        """Return the path without limits from a guess."""
        equations.weights = self._full / max(equations.cost(guess), 1e-9)
        limits = Limits(equations, None, Kept((), 0.0, equations.times[1:]))
        return self._solved(Program(equations, limits), guess, None, _LAST_BARRIER, _STEPS_FREE)

    def _limited(self, start: Found, count: int, time: float, last: float) -> Found | None:
        """Return the path within all limits on `count` intervals over `time` s, from one near it."""
        equations = self._equations(time, count)
        at, before = _transferred(start, equations), start.equations.weights
        equations.weights = self._full / max(equations.cost(at), 1e-9)
        same = count == start.equations.count
        price = start.point.price * float(equations.weights[0] / before[0]) if same else None
        if last == _LAST_BARRIER or self._peak(start) > 1.0:
            at = Trajectory(at.states, np.clip(at.dipoles, -0.98 * self._limit, 0.98 * self._limit))
        program = Program(equations, Limits(equations, self._limit, self._kept(equations)))
        return self._solved(program, at, price, last, _STEPS_LIMITED)

    def _solved(
        self, program: Program, guess: Trajectory, price: FloatArray | None, last: float, most: int
    ) -> Found | None:
        point = program.minimise(guess, price, last=last, most=most)
        self.steps += program.steps
        if point is None or not program.equations.end.is_met(point.at.states[-1, :4]):
            return None
        return Found(program, point)

    def _kept(self, equations: Transcription) -> Kept:
        return Kept(self._task.cones, self._margin, equations.times[1:])

    def _is_kept(self, found: Found) -> bool:
        kept = self._kept(found.equations).values(found.at.states[1:, :4])
        return self._peak(found) <= 1.0 and bool(np.all(kept >= 0.0))


def _transferred(start: Found, equations: Transcription) -> Trajectory:
    """Return a path on the grid and over the horizon of other equations.

    Slower by a ratio, the same way takes dipoles smaller by its square.
    """
    at, own = start.at, start.equations
    dipoles = at.dipoles * (own.scale / equations.scale) ** 2
    if own.count == equations.count:
        return Trajectory(at.states, dipoles)
    share = np.linspace(0.0, 1.0, 2 * own.count + 1)
    states = CubicHermiteSpline(share, at.states, own.motion.flow(at.states, at.all_dipoles()))
    wanted = np.linspace(0.0, 1.0, 2 * equations.count + 1)
    parts = [np.interp(wanted[::2], share[::2], part) for part in dipoles.T]
    return Trajectory(np.asarray(states(wanted)), np.stack(parts, axis=1))
