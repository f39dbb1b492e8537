"""Plant parameters of the KnightCube, and the slews of the guidance tests."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from knightcube.gnc.guidance.plant import Q2_LIMIT, SingleAxisPlant, angle_of
from knightcube.gnc.guidance.vmc import StepPlan, plan
from tests.support.collocation_oracle import Slew
from tests.support.shortest_step import shortest_time

KNIGHTCUBE = SingleAxisPlant(1.05e-3, 80 * 0.0081 * 4.5e-4, 23.0, 0.148)
OPTIMUM_FILE = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "optimum.json"


@dataclass(frozen=True)
class Problem:
    """Plant, boundary states (q2, rad/s) and duration (s) of a slew."""

    plant: SingleAxisPlant
    start_q2: float
    start_rate: float
    end_q2: float
    end_rate: float
    horizon: float

    def planned(self, **options: Any) -> StepPlan:
        """Return the planner's result for the slew."""
        states = self.start_q2, self.start_rate, self.end_q2, self.end_rate
        return plan(self.plant, *states, self.horizon, **options)

    def slew(self, horizon: float) -> Slew:
        """Return the same slew for the collocation oracle, with the duration `horizon` s."""
        plant = self.plant
        return Slew(
            angle_of(self.start_q2),
            self.start_rate,
            angle_of(self.end_q2),
            self.end_rate,
            horizon,
            plant.inertia,
            plant.torque_constant,
            plant.resistance,
            plant.current_limit,
            plant.stiffness,
            plant.damping,
            plant.disturbance,
        )


@dataclass(frozen=True)
class KnownOptimum:
    """A problem of the data file, with its optimum (J) and its shortest feasible duration (s)."""

    problem: Problem
    energy: float
    shortest: float


THESIS = Problem(KNIGHTCUBE, 0.4, 0.015, -0.3, 0.0, 10.0)
STEPS = [
    Problem(KNIGHTCUBE, start, 0.0, start + 0.1, 0.0, 10.0)
    for start in np.round(np.arange(-0.3, 0.25, 0.1), 1).tolist()
]


def known_optima() -> list[KnownOptimum]:
    """Return the 20 problems of the data file; skip the test if the file is missing."""
    if not OPTIMUM_FILE.exists():
        pytest.skip(f"{OPTIMUM_FILE.name}: the shared data folder is not beside the repository")
    content = json.loads(OPTIMUM_FILE.read_text())
    numbers = content["parameters"]
    torque_constant = numbers["turns"] * numbers["area_m2"] * numbers["field_T"]
    return [
        KnownOptimum(
            Problem(
                SingleAxisPlant(
                    numbers["inertia_kgm2"],
                    torque_constant,
                    numbers["resistance_ohm"],
                    numbers["current_limit_A"],
                    entry["thread_stiffness"],
                    entry["thread_damping"],
                ),
                entry["q2_initial"],
                entry["omega_initial"],
                entry["q2_final"],
                entry["omega_final"],
                entry["horizon_s"],
            ),
            entry["energy_J"],
            entry["shortest_s"],
        )
        for entry in content["problems"]
    ]


def random_problems(count: int, seed: int, horizons: tuple[float, float] = (6.0, 20.0)) -> list[Problem]:
    """Return random slews over the range of the testbed.

    In a third of the slews, the body is suspended by a thread.
    """
    rng = np.random.default_rng(seed)
    problems = []
    for _ in range(count):
        stiffness = float(rng.choice([0.0, 1e-5, 2e-5]))
        plant = SingleAxisPlant(
            KNIGHTCUBE.inertia,
            KNIGHTCUBE.torque_constant,
            KNIGHTCUBE.resistance,
            KNIGHTCUBE.current_limit,
            stiffness,
            2e-6 if stiffness else 0.0,
        )
        start_q2, end_q2 = rng.uniform(-0.45, 0.45, 2).tolist()
        start_rate = float(rng.normal(0.0, 0.02))
        problems.append(Problem(plant, start_q2, start_rate, end_q2, 0.0, float(rng.uniform(*horizons))))
    return problems


def feasible_problems(
    count: int, seed: int, share: tuple[float, float] = (1.1, 2.5)
) -> list[tuple[Problem, float]]:
    """Return slews of `share` times their shortest feasible duration, and these shortest durations (s).

    A third of the plants has no suspension thread; the others have a thread of one of two stiffnesses. Half
    of the plants have a disturbance, and half of the slews end with a rate.
    """
    rng = np.random.default_rng(seed)
    problems: list[tuple[Problem, float]] = []
    while len(problems) < count:
        stiffness = float(rng.choice([0.0, 1e-5, 2e-5]))
        disturbance = float(rng.choice([0.0, rng.normal(0.0, 2e-3)]))
        plant = replace(
            KNIGHTCUBE, stiffness=stiffness, damping=2e-6 if stiffness else 0.0, disturbance=disturbance
        )
        start_q2, end_q2 = rng.uniform(-0.45, 0.45, 2).tolist()
        start_rate = float(rng.normal(0.0, 0.02))
        end_rate = float(rng.choice([0.0, rng.normal(0.0, 0.01)]))
        factor = float(rng.uniform(*share))
        drawn = Problem(plant, start_q2, start_rate, end_q2, end_rate, 1.0)
        shortest = shortest_time(drawn.slew(1.0))
        if 1.0 < shortest < 20.0:  # a slew of less than a second is trivial
            problems.append((replace(drawn, horizon=factor * shortest), shortest))
    return problems


def largest_ratio(problem: Problem, found: StepPlan) -> float:
    """Return the largest ratio of |I| or |q2| to its limit along the path."""
    motion = found.path.motion(np.linspace(0.0, found.horizon * (1.0 - 1e-12), 4001))
    current = float(np.abs(problem.plant.currents(*motion)).max()) / problem.plant.current_limit
    return max(current, float(np.abs(np.sin(0.5 * motion[0])).max()) / Q2_LIMIT)
