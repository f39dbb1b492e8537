"""The search for a slew's path: guesses on a coarse grid, the promising ones within the limits, then refined.

Without the dipoles' limit a path that keeps the cones is found from most guesses in a dozen Newton steps;
its heat is a lower bound of that within the limit. A guess that lacks much after some steps is put off: most
of those lead nowhere. Where the asked horizon does not suffice, or none of its guesses leads to a path, a
longer slew is shortened.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.three_axes.slew_prey import guesses
from knightcube.gnc.guidance.three_axes.slew_program import Descent
from knightcube.gnc.guidance.three_axes.slew_solver import MET, Found, Solver
from knightcube.gnc.guidance.three_axes.slew_task import HORIZON_RANGE, LEAST_TIME, SlewTask, in_the_way
from knightcube.gnc.guidance.three_axes.slew_transcription import Trajectory
from knightcube.gnc.guidance.three_axes.slew_walk import ENOUGH, LONGER, Walker

GRIDS, GRIDS_WITH_CONES = ((10, 5000),), ((12, 3500), (16, 3000))
"""Searches, one after the other: intervals, and the work, Newton steps times intervals, after which no other
guess is begun with. A thousand take about a tenth of a second. On ten intervals, what goes round cones is far
from what does on the fine grid."""
_WALKS = 1.8
"""Times the work of a search, after which a walk ends with what it has."""
_MOST_TRIED = 16
"""Guesses over one horizon."""
_LOOK = 8
"""Newton steps of every guess."""
_FURTHER, _FURTHER_WITH_CONES = ((17, 1.5),), ((12, 1.0), (20, 0.4))
"""How many more it is given, one after the other, where its equations lack less in all; else it is put off.
Four of five that lead to a path lack less than 1.5 after eight, three of four that do not lack more (320
guesses, seed 41 of the bench `orbit_slews`)."""
_PATIENCE = 120
"""Newton steps without a path, after which the other guesses over a horizon are put off."""
_WIDENED = 4
"""Times at most that cones are widened, and dipoles eased, for a path."""


class Search:
    """The search of one task; `tried` guesses."""

    def __init__(self, task: SlewTask, coarse: int, budget: int) -> None:
        """Search on `coarse` intervals; after a `budget` of work nothing else is begun with."""
        self._task, self._budget = task, budget
        self.solver = Solver(task)
        self._walker = Walker(task, self.solver, _WALKS * budget)
        self._coarse = min(task.nodes, coarse)
        self._further = _FURTHER_WITH_CONES if task.cones else _FURTHER
        self._widened = 0
        self._known: list[float] = []  # heats, J, of relaxed paths that were looked at
        self.tried = 0

    def paths(self) -> Iterator[Found]:
        """Yield paths within all limits at the nodes, the best first."""
        price = self._task.time_price
        for batches in self._rungs():
            relaxed: list[Found] = []
            for batch in batches:
                relaxed += batch
                if price is None:
                    yield from map(self._fresh, self._cheapest(batch))
                elif (found := self._walker.shortened(batch, HORIZON_RANGE[0], price)) is not None:
                    yield self._fresh(found)
            if price is not None or not relaxed:
                continue
            if (found := self._walker.shortened(relaxed, self._task.horizon, LEAST_TIME)) is not None:
                yield self._fresh(found)

    def widened(self, found: Found, depths: FloatArray) -> Found | None:
        """Return a path near one that crosses cones by `depths` (cones, 2 nodes) rad between the points.

        None without one.
        """
        self._widened += 1
        return self._walker.widened(found, depths) if self._widened <= _WIDENED else None

    def eased(self, found: Found, peak: float) -> Found | None:
        """Return a path near one whose dipoles, flown, take `peak` of their limit; None without one."""
        self._widened += 1
        return self._walker.eased(found, peak) if self._widened <= _WIDENED else None

    def _fresh(self, found: Found) -> Found:
        """Return a path whose cones are not widened, within the whole limit."""
        self._widened, self.solver.share = 0, 1.0
        self.solver.extra = np.zeros_like(self.solver.extra)
        return found

    def _rungs(self) -> Iterator[Iterator[list[Found]]]:
        """Yield relaxed paths over the asked horizon, longer ones, and at last from what was put off.

        The longer a slew, the more the field turns under way, and the nearer a guess is to a path.
        """
        put_off: list[Descent] = []
        for longer in LONGER:
            horizon = min(longer * self._task.horizon, self._task.longest)
            if self.solver.work < self._budget and in_the_way(self._task, horizon) is None:
                yield self._relaxed(horizon, put_off)
            if horizon == self._task.longest:
                break
        yield self._late(put_off)

    def _relaxed(self, horizon: float, put_off: list[Descent]) -> Iterator[list[Found]]:
        """Yield relaxed paths over a horizon, a few at a time; add to what is put off."""
        batch: list[Found] = []
        solver, least = self.solver, self.solver.steps + _PATIENCE
        for guess in self._guesses(horizon)[:_MOST_TRIED]:
            self.tried += 1
            descent = solver.descent(solver.equations(horizon, self._coarse), guess)
            if solver.steps > least and not batch:
                put_off.append(descent)
                continue
            found = solver.found(descent, _LOOK)
            for steps, lack in self._further:
                if found is None and descent.lack < lack:
                    found = solver.found(descent, steps, MET)
            if found is not None:
                batch.append(found)
            elif not descent.is_over:
                put_off.append(descent)
            if len(batch) == ENOUGH:
                yield batch
                batch, least = [], solver.steps + _PATIENCE
        if batch:
            yield batch

    def _late(self, put_off: list[Descent]) -> Iterator[list[Found]]:
        """Yield relaxed paths from guesses that were put off, those that lack least first."""
        for descent in sorted(put_off, key=lambda descent: descent.lack):
            if self.solver.work > self._budget:
                break
            found = self.solver.found(descent, self._further[-1][0], MET)
            if found is not None:
                yield [found]

    def _guesses(self, horizon: float) -> list[Trajectory]:
        """Return guesses over a horizon, the promising ones first."""
        equations, craft = self.solver.equations(horizon, self._coarse), self._task.craft
        kept = self.solver.kept(equations)
        return guesses(
            equations.motion, craft, equations.start, equations.end, equations.around, kept, horizon
        )

    def _cheapest(self, batch: list[Found]) -> list[Found]:
        """Return paths within the limits over the asked horizon, the cheapest first."""
        kept: list[Found] = []
        energy = self.solver.energy
        for start in self._walker.distinct([start for start in batch if start.horizon <= self._task.horizon]):
            if (kept and energy(start) >= min(map(energy, kept))) or self.solver.work > self._budget:
                break
            if any(math.isclose(energy(start), known, rel_tol=1e-4) for known in self._known):
                continue  # it led nowhere before
            self._known.append(energy(start))
            found = self._walker.within(start)
            if found is not None:
                kept.append(found)
        return sorted(kept, key=energy)
