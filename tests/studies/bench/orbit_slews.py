"""Plan slews in orbit, random or recorded.

The slews rotate by 30 to 180 deg from rest to rest, in the orbits of the space station and of a
Sun-synchronous satellite, with the magnetic field of WMM2025. A 1U (inertia 1.1e-3 kg m^2, 0.0959 A m^2)
slews in 80 to 400 s, and a 3U (0.0066 and 0.0333 kg m^2, 0.2 A m^2) in 300 to 1,200 s. `--recorded` plans the
slews of `optimum_orbit.json`, compares them with their optima, and integrates the dipoles independently.
`--job` runs the planning job of the flight software instead. The job predicts the orbit, plans the slew and
computes the table of the path. Its slew avoids exclusion cones. The torques of air drag and sunlight follow
from the areas that the body exposes along the slew. Times are processor times of this process.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np

from knightcube.astro.arrays import FloatArray
from knightcube.astro.earth.disturbance import box_areas
from knightcube.astro.earth.orbit_knowledge import OrbitState
from knightcube.errors import PlanningError
from knightcube.gnc.control import pointing_job
from knightcube.gnc.control.pointing_job import RESERVE, PointingJob, SlewRequest, slew
from knightcube.gnc.guidance import slew_vmc
from knightcube.gnc.guidance.pointing_target import Goal, PointingTarget
from knightcube.gnc.guidance.slew_model import MINIMUM_TIME, AttitudeEnd, SlewPath, SlewTask
from knightcube.gnc.guidance.slew_plan import SlewPlan, SlewStatus, plan_task
from tests.studies.campaigns.orbit_pointing_flight import TORQUE
from tests.studies.command import Seed, command
from tests.support.pointing_settings import AXES, WEIGHTS
from tests.support.random_slews import _DATE, STAR_CAMERA, clearance, slews
from tests.support.recorded_slews import FILE, flown, off_degrees, task_of
from tests.support.recorded_slews import recorded as recorded_slews

Planner = Callable[[SlewTask], SlewPlan]
PLANNERS: dict[str, Planner] = {"collocation": plan_task, "vmc": slew_vmc.plan_task}


@command
def main(
    *,
    runs: Annotated[int, "slews to plan"] = 200,
    seed: Seed = 1,
    recorded: Annotated[bool, "those with known optima instead"] = False,
    cones: Annotated[bool, "of Sun, Earth and Moon, for the star camera"] = False,
    job: Annotated[bool, "the planner's job as flown, in cones"] = False,
    planner: Annotated[str, "of slews, not of jobs", tuple(PLANNERS)] = "collocation",
) -> int:
    """Print the results; return the exit status."""
    if job:
        return _jobs(runs, seed)
    if recorded:
        return _recorded(PLANNERS[planner])
    return _random(runs, seed, cones, PLANNERS[planner])


def _recorded(planner: Planner) -> int:
    """Plan the recorded slews, and compare them with their optima; return the exit status."""
    if not FILE.exists():
        sys.stdout.write(f"no optima of slews at {FILE.name}\n")
        return 1
    sys.stdout.write(f"{'slew':28} of the optimum  peak   off, deg  processor, s\n")
    ratios = []
    for case in recorded_slews()["problems"]:
        least = case["kind"] == "time"
        task = task_of(case, case["T"], time_cost=MINIMUM_TIME if least else None)
        begin = time.process_time()
        try:
            plan = planner(task)
        except PlanningError as error:
            sys.stdout.write(f"{case['name']:28} refused: {error}\n")
            continue
        spent = time.process_time() - begin
        ratio = plan.horizon / case["T"] if least else plan.energy / case["energy_J"]
        off = off_degrees(flown(plan, task)[:4], np.array(case["qf"]))
        ratios.append(ratio)
        kind = "time" if least else "heat"
        sys.stdout.write(f"{case['name']:28} {kind} {ratio:.5f}   {plan.peak:.4f}  {off:.5f}  {spent:.2f}\n")
    sys.stdout.write(
        f"{len(ratios)} planned: {np.median(ratios):.5f} in the median, {max(ratios):.5f} at most\n"
    )
    return 0


def _random(runs: int, seed: int, with_cones: bool, planner: Planner) -> int:
    """Plan random slews; return the exit status."""
    taken, found, failed, nearest = [], list[SlewPlan](), 0, np.inf
    for name, task in slews(runs, seed, with_cones):
        begin = time.process_time()
        try:
            found.append(planner(task))
        except PlanningError as error:
            failed += 1
            sys.stdout.write(f"{name}: {error}\n")
        else:
            taken.append(time.process_time() - begin)
            nearest = min(nearest, clearance(task, found[-1]))
    stretched = sum(plan.status is SlewStatus.STRETCHED for plan in found)
    sys.stdout.write(f"{len(found)} of {runs} planned, {stretched} of them stretched, {failed} failed\n")
    sys.stdout.write(f"{_times(taken)}\n")
    if np.isfinite(nearest):
        sys.stdout.write(f"nearest to a cone: {np.degrees(nearest):.3f} deg outside\n")
    return 0


def _jobs(runs: int, seed: int) -> int:
    """Run the flight's planning job for random slews; return the exit status."""
    rng = np.random.default_rng([seed, 1])
    whole, plans = list[float](), list[float]()
    planner, planned = slew, 0

    def timed(*arguments: Any) -> SlewPath | None:
        begin = time.process_time()
        path = planner(*arguments)
        plans.append(time.process_time() - begin)
        return path

    with patch.object(pointing_job, "slew", timed):
        for name, task in slews(runs, seed, True):
            job = _job(name, task, rng.normal(size=9))
            begin = time.process_time()
            planned += pointing_job.new_table(job).slew is not None
            whole.append(time.process_time() - begin)
    sys.stdout.write(f"{planned} of {runs} jobs gave a slew\n")
    sys.stdout.write(f"whole jobs: {_times(whole)}\nof these the slew: {_times(plans)}\n")
    return 0


def _times(taken: Sequence[float]) -> str:
    late = sum(spent > 1.5 for spent in taken)
    return (
        f"{np.median(taken):.2f} s in the median, {max(taken):.2f} s at most, {late} over 1.5 s; "
        f"the first, from cold, {taken[0]:.2f} s"
    )


def _job(name: str, task: SlewTask, draw: FloatArray) -> PointingJob:
    """Return a task's planning job, whose torques are `draw` (9,) times the prior sigmas of the filter."""
    craft = {"1U": "knightcube", "3U": "cubesat_3u"}[name[:2]]
    place = task.along(np.array([0.0, 1.0])).position
    end = task.end(task.horizon)
    assert isinstance(end, AttitudeEnd)
    x, y, z, w = end.quaternion.tolist()
    angles = {"sun": 0.4, "earth": 0.15, "moon": 0.2}
    return PointingJob(
        0,
        0,
        OrbitState(_DATE, place[0], place[1] - place[0], 0.0),
        task.craft.inertia,
        AXES,
        replace(WEIGHTS[craft], fastest=np.radians(2.0)),
        PointingTarget(Goal.INERTIAL, (x, y, z, w)),
        task.quaternion,
        task.rate,
        TORQUE[craft][0] * draw,
        float(task.craft.limit.mean()) / RESERVE,
        box_areas(task.craft.inertia),
        SlewRequest(task.horizon, task.craft.weights, np.zeros(3), STAR_CAMERA, angles),
    )
