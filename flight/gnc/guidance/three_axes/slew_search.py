"""The search for a slew's path: guesses on a coarse grid, the promising ones within the limits, then refined.

Without limits a path is found from most guesses in a dozen Newton steps; its heat is a lower bound of that
within the limits. Where the asked horizon does not suffice, a longer slew is shortened step by step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import zip_longest

import numpy as np

from flight.gnc.guidance.three_axes.slew_prey import guesses
from flight.gnc.guidance.three_axes.slew_solver import LAST_BARRIER, WALK_BARRIER, Found, Solver, transferred
from flight.gnc.guidance.three_axes.slew_task import HORIZON_RANGE, LEAST_TIME, SlewTask
from flight.gnc.guidance.three_axes.slew_transcription import Trajectory, Transcription

_COARSE = 10
"""Intervals of the search."""
_ENOUGH = 3
"""Solved guesses of which the cheapest is taken; where none keeps the limits, as many more are solved."""
_MOST_TRIED = 16
_LONGER = 1.0, 1.4, 2.0, 2.8
"""Times the asked horizon, for paths without limits."""
_FIRST_STEP, _COARSE_STEP, _LAST_STEP = 1.2, 1.02, 1.004
"""Ratios of horizons on the walk to a shorter one; from the second on the grid is the fine one."""
_CROSSED = 1.3
"""Times the depth to which a path crosses a cone between the nodes, every cone is widened."""
_GROWING = 0.15, 0.4, 0.7, 1.0
"""Shares of the depth to which a path without limits crosses a cone, as that cone grows."""
_WIDENED = 4
"""Times at most that cones are widened."""
_PEAK = 0.9
"""Of the limit: the dipole of the slew at which the walk begins."""


class Search:
    """The search of one task; `tried` guesses."""

    def __init__(self, task: SlewTask) -> None:
        self._task = task
        self.solver = Solver(task)
        self._coarse = min(task.nodes, _COARSE)
        self._widened = 0
        self.tried = 0

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

    def widened(self, found: Found, depth: float) -> Found | None:
        """Return a path near one that crosses a cone by `depth` rad between the nodes, None without one."""
        self._widened += 1
        if self._widened > _WIDENED:
            return None
        self.solver.margin += _CROSSED * depth + math.radians(0.02)
        return self.solver.limited(found, found.equations.count, found.horizon, LAST_BARRIER)

    def _relaxed(self) -> Iterator[list[Found]]:
        """Yield paths without limits, a few at a time, over the asked horizon or the next that has any.

        The longer a slew, the more the field turns under way, and the nearer a guess is to a path.
        """
        for longer in _LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            batch: list[Found] = []
            any_found = False
            for guess in self._guesses(self.solver.equations(horizon, self._coarse))[:_MOST_TRIED]:
                self.tried += 1
                found = self.solver.free(self.solver.equations(horizon, self._coarse), guess)
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
            if best is not None and self.solver.energy(start) >= self.solver.energy(best):
                break
            found = self._within(start)
            if found is not None and (best is None or self.solver.energy(found) < self.solver.energy(best)):
                best = found
        return best

    def _distinct(self, relaxed: list[Found]) -> list[Found]:
        """Return paths without limits, the cheapest first, each once."""
        ordered = sorted(relaxed, key=self.solver.energy)
        costs = [(found.horizon, self.solver.energy(found)) for found in ordered]
        return [
            found
            for k, found in enumerate(ordered)
            if k == 0 or not np.allclose(costs[k], costs[k - 1], rtol=1e-4, atol=0.0)
        ]

    def _within(self, start: Found) -> Found | None:
        """Return the path within the limits, on the fine grid, near a coarse one without."""
        nodes, time = self._task.nodes, start.horizon
        if self.solver.is_kept(start):
            equations = self.solver.equations(time, nodes)
            fine = self.solver.free(equations, transferred(start, equations))
            if fine is not None and self.solver.is_kept(fine):
                return fine
        coarse = self._over(start, time) or self._grown(start)
        return None if coarse is None else self.solver.limited(coarse, nodes, time, LAST_BARRIER)

    def _grown(self, start: Found) -> Found | None:
        """Return the path within the limits as cones grow from where `start` just keeps them."""
        times, q = start.equations.times, start.at.states[:, :4]
        depth = -min((float(cone.clearance(q, times).min()) for cone in self._task.cones), default=0.0)
        if depth <= 0.0:
            return None
        found: Found | None = start
        wanted = self.solver.margin
        for share in _GROWING:
            self.solver.margin = wanted - (1.0 - share) * depth
            found = found and self._over(found, start.horizon)
        self.solver.margin = wanted
        return found

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
        longer = (self.solver.limited(best, nodes, float(time), WALK_BARRIER) for time in times)
        fine = next(filter(None, longer), None)
        if fine is None:
            return None
        fine = self._walked(fine, least, price, _COARSE_STEP, _LAST_STEP)
        return self.solver.limited(fine, nodes, fine.horizon, LAST_BARRIER) or fine

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
        return found.horizon * math.sqrt(self.solver.peak(found) / _PEAK)

    def _begins(self, start: Found, least: float) -> list[float]:
        """Return horizons at which a walk may begin from a path without limits, s, the shortest first."""
        time = max(self._fastest(start), least)
        times = [time, start.horizon] if time < start.horizon else [longer * time for longer in _LONGER]
        return [each for each in times if each <= self._task.longest]

    def _value(self, found: Found, price: float) -> float:
        """Return what a path costs, J; s where time alone counts."""
        return found.horizon if math.isinf(price) else self.solver.energy(found) + price * found.horizon

    def _over(self, start: Found, time: float) -> Found | None:
        """Return the path of least energy within the limits over `time` s, from one over another horizon."""
        return self.solver.limited(start, start.equations.count, time, WALK_BARRIER)
