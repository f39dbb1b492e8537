"""From a slew's path without the dipoles' limit to one within it; walks to shorter horizons; wider cones."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.three_axes.slew_solver import (
    LAST_BARRIER,
    WALK_BARRIER,
    Found,
    Solver,
    transferred,
)
from knightcube.gnc.guidance.three_axes.slew_task import SlewTask, in_the_way

ENOUGH = 3
"""Relaxed paths of which the best is taken."""
LONGER = 1.0, 1.4, 2.0, 2.8
"""Times a horizon that does not suffice."""
_COARSE_STEPS, _FINE_STEPS, _STRETCHED_STEPS = (1.2, 1.02), (1.02, 1.004), (1.02, 1.015)
"""Ratios of horizons on the walk to a shorter one, the first and the last: on the coarse grid, on the fine
one, and there where a slew is only to be stretched."""
_CROSSED = 1.3
"""Times the depth to which a path crosses a cone between the points, the cone is widened there."""
_BEYOND = math.radians(0.02)
"""rad, by which it is widened besides."""
_BETWEEN = 16
"""Intervals of a path from which the fine grid is reached where it is not from the coarse one."""
_LOST, _EASED_STEP = 1.5, 1.03
"""Of the limit, beyond which a path is lost when flown; and how much longer one beyond the limit takes."""
_PEAK = 0.9
"""Of the limit: the dipole of the slew at which the walk begins."""


class Walker:
    """Walks of one task."""

    def __init__(self, task: SlewTask, solver: Solver, budget: float) -> None:
        """After a `budget` of work no other step of a walk is begun."""
        self._task, self._solver, self._budget = task, solver, budget
        self._lost: set[tuple[float, float, float]] = set()  # coarse paths that led to no fine one

    def within(self, start: Found) -> Found | None:
        """Return the path within the limits, on the fine grid, near a coarse one without."""
        solver, nodes, time = self._solver, self._task.nodes, start.horizon
        if solver.is_kept(start):
            equations = solver.equations(time, nodes)
            fine = solver.free(equations, transferred(start, equations))
            if fine is not None and solver.is_kept(fine):
                return fine
        coarse = self._over(start, time)
        return None if coarse is None else self._finer(coarse, time, LAST_BARRIER)

    def shortened(self, relaxed: list[Found], least: float, price: float) -> Found | None:
        """Return the best path on walks to shorter horizons, as long as `price` W makes them cheaper.

        A walk begins where a relaxed path just keeps the dipoles', with the path that needs the least
        time for that.
        """
        best: Found | None = None
        for start in sorted(self.distinct(relaxed), key=self._fastest)[:ENOUGH]:
            times = self._begins(start, least)
            ways = (self._over(start, time) for time in times)
            begun = next(filter(None, ways), None)
            if begun is None:
                continue
            if self._task.cones:
                begun = self._finer(begun, begun.horizon, WALK_BARRIER) or begun
            ended = self._walked(begun, least, price, _COARSE_STEPS)
            if best is None or self._value(ended, price) < self._value(best, price):
                best = ended
            if best.horizon <= least or self._solver.work > self._budget:
                break
        return None if best is None else self._refined(best, least, price)

    def distinct(self, relaxed: list[Found]) -> list[Found]:
        """Return relaxed paths, the cheapest first, each once."""
        ordered = sorted(relaxed, key=self._solver.energy)
        costs = [(found.horizon, self._solver.energy(found)) for found in ordered]
        return ordered[:1] + [
            found
            for found, (before, cost) in zip(ordered[1:], pairwise(costs), strict=True)
            if not np.allclose(cost, before, rtol=1e-4, atol=0.0)
        ]

    def widened(self, found: Found, depths: FloatArray) -> Found | None:
        """Return a path near one that crosses cones between the points, None without one.

        `depths` (cones, 2 nodes) rad are those between each two points. The last point stays where it is.
        """
        wider = np.where(depths > 0.0, _CROSSED * depths + _BEYOND, 0.0)
        both = wider.copy()
        both[:, :-1] = np.maximum(wider[:, :-1], wider[:, 1:])
        both[:, -1] = 0.0
        self._solver.extra = self._solver.extra + both
        return self._solver.limited(found, found.equations.count, found.horizon, LAST_BARRIER)

    def eased(self, found: Found, peak: float) -> Found | None:
        """Return a path near one whose dipoles take `peak` of their limit when flown, None without one.

        It uses less of the limit, or takes longer where that leads to none or the horizon is not asked.
        """
        task, solver, time = self._task, self._solver, found.horizon
        if peak > _LOST:
            return None
        solver.share /= peak
        if task.time_price is None and time <= task.horizon * (1.0 + 1e-6):
            eased = solver.limited(found, task.nodes, time, LAST_BARRIER)
            if eased is not None:
                return eased
        time *= _EASED_STEP * math.sqrt(peak)
        if time > task.longest or in_the_way(task, time) is not None:
            return None
        return solver.limited(found, task.nodes, time, LAST_BARRIER)

    def _refined(self, best: Found, least: float, price: float) -> Found | None:
        """Return the best path on the fine grid, by a walk that begins with a coarse one."""
        times = best.horizon * np.array([1.0, 1.02, 1.1])
        longer = (self._finer(best, float(time), WALK_BARRIER) for time in times)
        fine = next(filter(None, longer), None)
        if fine is None:
            return None
        ratios = _STRETCHED_STEPS if self._task.time_price is None else _FINE_STEPS
        fine = self._walked(fine, least, price, ratios)
        return self._solver.limited(fine, self._task.nodes, fine.horizon, LAST_BARRIER) or fine

    def _finer(self, coarse: Found, time: float, last: float) -> Found | None:
        """Return a coarse path on the fine grid, over `time` s."""
        nodes, solver = self._task.nodes, self._solver
        key = (coarse.horizon, solver.energy(coarse), time)
        if key in self._lost:
            return None
        fine = solver.limited(coarse, nodes, time, last)
        if fine is None and nodes > _BETWEEN:
            middle = solver.limited(coarse, _BETWEEN, time, WALK_BARRIER)
            fine = None if middle is None else solver.limited(middle, nodes, time, last)
        if fine is None:
            self._lost.add(key)
        return fine

    def _walked(self, best: Found, least: float, price: float, ratios: tuple[float, float]) -> Found:
        """Return the best path on a walk to shorter horizons, to the last ratio of one without a better."""
        (first, last), failed = ratios, 0.0
        while best.horizon > max(least, last * failed) and self._solver.work < self._budget:
            time = max(best.horizon / first, least, math.sqrt(best.horizon * failed))
            further = self._over(best, time)
            if further is not None and self._value(further, price) < self._value(best, price):
                best = further
            else:
                failed = time
        return best

    def _fastest(self, found: Found) -> float:
        """Return about which horizon a relaxed path takes for its dipoles to keep theirs, s."""
        return found.horizon * math.sqrt(self._solver.peak(found) / _PEAK)

    def _begins(self, start: Found, least: float) -> list[float]:
        """Return horizons at which a walk may begin from a relaxed path, s, the shortest first."""
        time = max(self._fastest(start), least)
        times = [time, start.horizon] if time < start.horizon else [longer * time for longer in LONGER]
        if start.horizon == self._task.horizon and self._task.time_price is None and start.horizon in times:
            times.remove(start.horizon)  # it was tried
        task = self._task
        return [each for each in times if each <= task.longest and in_the_way(task, each) is None]

    def _value(self, found: Found, price: float) -> float:
        """Return what a path costs, J; s where time alone counts."""
        return found.horizon if math.isinf(price) else self._solver.energy(found) + price * found.horizon

    def _over(self, start: Found, time: float) -> Found | None:
        """Return the path of least energy within the limits over `time` s, from one over another horizon."""
        return self._solver.limited(start, start.equations.count, time, WALK_BARRIER)
