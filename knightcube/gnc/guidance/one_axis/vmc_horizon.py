"""Finds the horizon of a path: the one asked for, the shortest feasible one, or the best at a price of time.

All three minimise energy plus a price per second between a least and a greatest horizon. With a price far
above the coil's power and the asked horizon as the least, the solution is the asked horizon if a path there
keeps the limits, else the shortest feasible horizon: no infeasible program is ever solved.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.gnc.guidance.one_axis.vmc_program import LIMIT_TOLERANCE, FreeHorizon, Program, Trial

ProgramAt = Callable[[float], Program]
"""Builds the program whose family is whitened around the prey over a horizon in s."""

PRICE_OF_HASTE = 7.0
"""Price per second, in R Imax^2, to find the shortest horizon. An infinite price would give the family's
shortest path, bang-bang, whose cost is up to 1 % above the true optimum at that horizon; this price ends
about 0.3 % later, where the cost is within 0.25 %."""

_HASTE_STRETCH = 1.015
"""That price may stretch a horizon by as much although the asked one has a path."""

_START_BELOW = 1.7
_GROW_TO = 1.4
_RETRY = 1.4
ALONG_LIMIT = 0.99
"""Of a limit: from here on a path runs along it."""
_ATTEMPTS = 10
_AT_BOUND = 1e-9
_ANCHORS = (0.85, 0.7, 0.5, 0.35, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)
_STEP, _LEAST_STEP = 1.15, 1.01
_MOST_EVALUATIONS = 3000
_PRICED_STEPS = 12
_PRICED_CHANGE = 0.03


@dataclass(slots=True)
class Search:
    """One search for a path; counts the evaluations of the cost.

    Attributes:
        program_at: builds programs.
        warm: (N,) difference between an earlier path and its prey on the nodes; None to start from the prey.
        evaluations: of the cost so far.
    """

    program_at: ProgramAt
    warm: FloatArray | None = None
    evaluations: int = field(default=0)

    def within(self, asked: float, longest: float) -> tuple[Program, Trial | None]:
        """Return the least-energy path over `asked` s, or over the shortest feasible time up to `longest` s.

        Current scales with 1/T^2 for a rest-to-rest slew, so solutions without limits lead to a horizon near
        the shortest feasible one, where the program with a free horizon starts. If the program fails, it is
        solved again from a longer horizon.
        """
        if self.warm is not None:
            program = self.program_at(asked)
            trial = self._resumed(program, self.warm, asked, longest)
            self.evaluations += program.evaluations
            if trial is not None:
                return self._kept(program, trial, asked)
        time = asked
        for _ in range(_ATTEMPTS):
            program = self.program_at(time)
            relaxed = program.unlimited(program.prey(time))
            trial, growth = None, _RETRY
            if relaxed is not None:
                current, q2 = np.abs(program.ratios(relaxed)).max(axis=1).tolist()
                if time == asked and max(current, q2) <= 1.0 + LIMIT_TOLERANCE:
                    trial = relaxed
                elif current < _START_BELOW or time == longest:
                    trial = self._hasty(program, relaxed, asked, longest)
                else:
                    growth = math.sqrt(current / _GROW_TO)
            self.evaluations += program.evaluations
            if trial is not None or time == longest:
                break
            time = min(longest, time * growth)
        if trial is None:
            return self._continued(program, asked, longest)
        return self._kept(program, trial, asked)

    def priced(
        self, guess: float, least: float, longest: float, price: float
    ) -> tuple[Program, Trial | None]:
        """Return the path of least energy plus `price` W times its horizon; `guess` s is the initial horizon.

        The slope of the least energy over the horizon is the partial derivative at that optimum. A horizon is
        a lower bound where lengthening it saves more energy than its price, else an upper bound; the next
        horizon follows from E ~ 1/T^3 for a slew without limits. Only the last program imposes the limits.
        """
        low, high, time = least, longest, min(max(guess, least), longest)
        price = min(price, PRICE_OF_HASTE * self.program_at(time).bang_power)
        for _ in range(_PRICED_STEPS):
            program = self.program_at(time)
            relaxed = program.unlimited(program.prey(time))
            self.evaluations += program.evaluations
            if relaxed is None:
                break
            current = float(np.abs(program.ratios(relaxed)[0]).max())
            _, _, slope = program.energy(relaxed)
            if current > _START_BELOW:
                low, following = time, time * math.sqrt(current / _GROW_TO)
            else:
                low, high = (time, high) if slope < -price else (low, time)
                following = time * min(max(max(-slope / price, 0.0) ** 0.25, 0.5), 2.0)
            if not low < following < high:
                following = math.sqrt(low * high)
            if abs(following - time) <= _PRICED_CHANGE * time or high <= low * (1.0 + _PRICED_CHANGE):
                spent = program.evaluations
                trial = program.limited(relaxed, FreeHorizon(least, longest, price))
                self.evaluations += program.evaluations - spent
                if trial is not None:
                    return program, trial
                break
            time = following
        return self.within(time, longest)

    def _kept(self, program: Program, trial: Trial, asked: float) -> tuple[Program, Trial]:
        """Return a path over `asked` s in place of a slightly longer one, where there is such a path.

        It starts from the longer path, in a program whitened around the asked horizon.
        """
        if not asked * (1.0 + _AT_BOUND) < trial.horizon <= asked * _HASTE_STRETCH:
            return program, trial
        at_asked, found = self.over(asked, program.from_prey(trial))
        return (program, trial) if found is None else (at_asked, found)

    def _continued(self, failed: Program, asked: float, longest: float) -> tuple[Program, Trial | None]:
        """Return a path over `asked` s, or longer, by continuation from horizons that can be solved.

        Where a thread pulls harder than the coil, only some horizons have paths: those of the body's swings.
        From a solved horizon, shorter ones first, the horizon changes in steps, each started from the last
        path.
        """
        stretched: tuple[Program, Trial] | None = None
        for factor in _ANCHORS:
            if asked * factor > longest or self.evaluations > _MOST_EVALUATIONS:
                break
            program, trial = self.over(asked * factor, None)
            step = _STEP
            while trial is not None and trial.horizon != asked and step > _LEAST_STEP:
                ratio = min(max(asked / trial.horizon, 1.0 / step), step)
                wanted = asked if 1.0 / step < ratio < step else trial.horizon * ratio
                further, found = self.over(wanted, program.from_prey(trial))
                if found is None:
                    step = math.sqrt(step)
                else:
                    program, trial = further, found
                    step = min(step * step, _STEP)
            if trial is not None and trial.horizon == asked:
                return program, trial
            if trial is not None and trial.horizon > asked and stretched is None:
                stretched = program, trial
        return stretched or (failed, None)

    def over(self, time: float, apart: FloatArray | None) -> tuple[Program, Trial | None]:
        """Return the program at `time` s and a path within the limits, from `apart` (N,) beside the prey."""
        program = self.program_at(time)
        trial = None if apart is None else program.limited(program.beside_prey(apart, time))
        if trial is None:
            start = program.prey(time) if apart is None else program.beside_prey(apart, time)
            trial = program.unlimited(start)
            if trial is None or float(np.abs(program.ratios(trial)).max()) > 1.0 + LIMIT_TOLERANCE:
                trial = program.limited(start if trial is None else trial)
        self.evaluations += program.evaluations
        return program, trial

    def _resumed(self, program: Program, warm: FloatArray, asked: float, longest: float) -> Trial | None:
        """Return the path found when starting from an earlier one; None when that fails.

        Where the earlier path ran along a limit, the limits are imposed at once.
        """
        start = program.beside_prey(warm, asked)
        worst = float(np.abs(program.ratios(start)).max())
        if not worst < _START_BELOW:
            return None
        if worst > ALONG_LIMIT:
            return self._hasty(program, start, asked, longest)
        trial = program.unlimited(start)
        if trial is None or float(np.abs(program.ratios(trial)).max()) > 1.0 + LIMIT_TOLERANCE:
            return None
        return trial

    def _hasty(self, program: Program, start: Trial, asked: float, longest: float) -> Trial | None:
        """Return the shortest path of at least `asked` s; of least energy if its horizon is `asked`."""
        price = PRICE_OF_HASTE * program.bang_power
        trial = program.limited(start, FreeHorizon(asked, longest, price))
        if trial is None or trial.horizon > asked * (1.0 + _AT_BOUND):
            return trial
        return program.limited(Trial(trial.parameters, asked)) or trial
