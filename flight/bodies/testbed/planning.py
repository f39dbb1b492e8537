"""Planning: asks the worker for paths and offers them to guidance.

Three strategies. GOAL plans a step at its command for a goal time, and again every few seconds from the
newest estimate for what is left until then: each new plan is the optimal rest of the step. When little is
left the path is flown to its end, which is held; a body that is carried off its path is planned for again.
RECEDING is the thesis's: each plan reaches the target a whole horizon after it is made (Sease ch. 5, Optimal
Path Planning). STEP makes no plan: the controller is shown the target itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from flight.bodies.testbed.thread_estimate import ThreadEstimate, ThreadReader
from flight.bodies.testbed.thread_law import ThreadLaw, law_of
from flight.gnc.estimation.estimate import Estimate
from flight.gnc.guidance.one_axis.guidance import Guidance
from flight.gnc.guidance.one_axis.job import PlanJob
from flight.gnc.guidance.one_axis.path import FARTHEST
from flight.gnc.guidance.one_axis.plant import SingleAxisPlant, angle_of, q2_of
from flight.gnc.guidance.one_axis.vmc import Plan, PlanStatus
from flight.link import events
from flight.link.telemetry.definitions import MAX_NODES, PLAN
from flight.loop.body import PLANNER
from flight.loop.control_output import Target
from flight.loop.executive.jobs import JobResult
from flight.loop.executive.rate_group import Cycle
from flight.loop.services import Services

_AGAIN_NS = 1_000_000_000


class Strategy(StrEnum):
    """What a path is planned towards."""

    GOAL = "goal"
    RECEDING = "receding"
    STEP = "step"


@dataclass(frozen=True, slots=True)
class PlanningSettings:
    """How paths are asked for.

    Attributes:
        horizon: s, asked for at a new target; a first guess where time has a price.
        max_horizon: s, the longest allowed.
        late_after_ns: after which a plan is late.
        nodes: of the path.
        strategy: see the module.
        time_price: W, what a second of a slew is worth; None for the horizon as it is.
        current_share: of the coil's limit that a plan may use; the rest is the controller's.
        least_horizon: s before the goal from which on no plan is made any more.
        displaced: rad off the path from which on there is a new plan.
    """

    horizon: float
    max_horizon: float
    late_after_ns: int
    nodes: int
    strategy: Strategy
    time_price: float | None
    current_share: float
    least_horizon: float = 2.0
    displaced: float = 0.05


class Planning:
    """Owns the job that is under way, the wish for the next one and the goal time."""

    def __init__(
        self,
        plant: SingleAxisPlant,
        settings: PlanningSettings,
        guidance: Guidance,
        reader: ThreadReader,
        services: Services,
    ) -> None:
        self._plant = replace(plant, current_limit=plant.current_limit * settings.current_share)
        self._settings = settings
        self._guidance = guidance
        self._read = reader.read
        self._jobs = services.jobs
        self._recorder = services.recorder
        self._events = services.events
        self._wanted = False
        self._job: PlanJob | None = None
        self._goal_ns: int | None = None
        self._due_ns: int | None = None
        self._asked_ns = 0
        self._count = 0
        self._accepted = 0
        self._refused = 0
        self.flown = 0

    def counts(self) -> tuple[int, int]:
        """Return how many plans were accepted and refused since the start."""
        return self._accepted, self._refused

    def busy_since_ns(self) -> int | None:
        """Return since when a plan is being made, None when none is."""
        return None if self._job is None else self._asked_ns

    def aim(self, target: Target, now_ns: int) -> None:
        """Want another attitude, and a plan for it at once; the present path is flown until that comes."""
        law = law_of(target)
        self._guidance.aim(law.q2, law.rate, now_ns)
        self._goal_ns = self._due_ns = None
        self._wanted = True
        if self._settings.strategy is Strategy.STEP:
            self._guidance.hold(angle_of(law.q2), now_ns)
            self._due_ns = now_ns + round(self._settings.horizon * 1e9)

    def due_angle(self, law: ThreadLaw, now_ns: int) -> float | None:
        """Return where the body should be by now, rad; None while it is on its way to the target.

        It is due at the end of the first path to the target, whatever is planned after that; where paths are
        not planned, a horizon after the command.
        """
        if self._due_ns is None or now_ns < self._due_ns:
            return None
        return _moved(law, (now_ns - self._due_ns) * 1e-9)

    def request(self, now_ns: int) -> None:
        """Want a plan as soon as there is an estimate to start from and the worker is free."""
        self._wanted = True
        if self._is_near_goal(now_ns):
            self._goal_ns = None

    def resume(self, now_ns: int) -> None:
        """Want the rest of a path anew after nobody steered along it; an end that is held is held on."""
        if now_ns - self._asked_ns > _AGAIN_NS and not self._is_near_goal(now_ns):
            self._wanted = True

    def replan(self, cycle: Cycle) -> None:
        """Want a plan because its time has come: the task of the replanning rate group."""
        if self._job is None:
            self._wanted = self._wanted or not self._is_near_goal(cycle.start_ns)
        elif cycle.start_ns - self._job.origin_ns > self._settings.late_after_ns:
            self._events.report(
                events.PLANNER_BUSY, cycle.start_ns, f"plan {self._job.number} is not finished yet"
            )
            self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Hand the wanted job over."""
        if estimate is None or self._settings.strategy is Strategy.STEP:
            return
        now = self._read(estimate)
        if self._is_displaced(now.angle, now_ns):
            self.request(now_ns)
        if self._is_near_goal(now_ns):
            self._wanted = False  # by the time the worker was free the goal was near
        if not self._wanted or self._job is not None:
            return
        job = self._job_from(now, law_of(target), now_ns)
        if self._jobs.submit(PLANNER, job):
            self._wanted = False
            self._count = job.number
            self._job = job
            self._asked_ns = now_ns

    def _job_from(self, estimate: ThreadEstimate, law: ThreadLaw, now_ns: int) -> PlanJob:
        settings, goal_ns = self._settings, self._goal_ns
        towards_goal = settings.strategy is Strategy.GOAL
        begun = goal_ns is not None
        horizon = (goal_ns - now_ns) * 1e-9 if goal_ns is not None else settings.horizon
        end_q2 = self._due_q2(law, now_ns, horizon) if towards_goal else law.q2
        if end_q2 != self._guidance.target_q2:
            self._guidance.aim(end_q2, law.rate, now_ns)
        return PlanJob(
            self._count + 1,
            now_ns,
            replace(self._plant, disturbance=estimate.disturbance) if towards_goal else self._plant,
            estimate.q2,
            estimate.rate,
            end_q2,
            law.rate,
            horizon,
            settings.max_horizon,
            settings.nodes,
            None if begun else settings.time_price,
            self._guidance.remains(now_ns) if begun else None,
        )

    def _due_q2(self, law: ThreadLaw, now_ns: int, horizon: float) -> float:
        """Return q2 to be reached in `horizon` s: a target that moves has moved on since it was first due."""
        if law.rate == 0.0 or self._due_ns is None:
            return law.q2
        late = horizon - (self._due_ns - now_ns) * 1e-9
        return q2_of(_moved(law, max(late, 0.0)))

    def _is_near_goal(self, now_ns: int) -> bool:
        """Tell whether too little is left until the goal to plan for it."""
        if self._settings.strategy is not Strategy.GOAL or self._goal_ns is None:
            return False
        return self._goal_ns - now_ns < self._settings.least_horizon * 1e9

    def _is_displaced(self, angle: float, now_ns: int) -> bool:
        """Tell whether the body is off its path, so that the path is of no more use; not each cycle anew."""
        sample = self._guidance.sample(now_ns)
        if self._settings.strategy is not Strategy.GOAL or sample is None:
            return False
        return (
            self._goal_ns is not None
            and now_ns - self._asked_ns > _AGAIN_NS
            and abs(math.remainder(angle - sample.angle, 2.0 * math.pi)) > self._settings.displaced
        )

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Offer the worker's plan to guidance, which flies it or says why not."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            self._refused += 1
            self._events.report(events.PLANNER_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._record(job, None, result.outcome, False, now_ns)
            return
        plan: Plan = result.value
        verdict = self._guidance.offer(
            plan,
            job.origin_ns,
            now_ns,
            angle_of(job.start_q2),
            job.start_rate,
            job.plant.disturbance,
        )
        reason = verdict.reason
        if reason:
            self._refused += 1
            self._events.report(events.PLAN_REFUSED, now_ns, f"plan {job.number}: {reason}")
        else:
            self._accepted += 1
            self.flown = job.number
            end_ns = job.origin_ns + round(plan.horizon * 1e9)
            self._due_ns = self._due_ns or end_ns
            if self._settings.strategy is Strategy.GOAL:
                self._goal_ns = end_ns
            if plan.status is PlanStatus.STRETCHED:
                text = (
                    f"plan {job.number}: {plan.horizon_asked:g} s is too short, flying {plan.horizon:.2f} s"
                )
                self._events.report(events.PLAN_STRETCHED, now_ns, text)
        self._record(job, plan, reason or plan.status.value, not reason, now_ns)

    def _record(self, job: PlanJob, plan: Plan | None, status: str, accepted: bool, now_ns: int) -> None:
        count = len(plan.node_q2) if plan else 0
        nodes = [float(q2) for q2 in plan.node_q2] if plan else []
        self._recorder.record(
            PLAN,
            now_ns,
            number=job.number,
            accepted=int(accepted),
            status=status,
            origin_ns=job.origin_ns - self._recorder.epoch_ns,
            horizon_asked=job.horizon,
            horizon=plan.horizon if plan else math.nan,
            start_q2=job.start_q2,
            start_rate=job.start_rate,
            target_q2=job.end_q2,
            cost=plan.energy if plan else math.nan,
            peak_current=plan.peak_current if plan else math.nan,
            evaluations=plan.evaluations if plan else 0,
            nodes=count,
            node_q2=nodes + [math.nan] * (MAX_NODES - count),
        )


def _moved(law: ThreadLaw, since: float) -> float:
    """Return the angle of a law `since` s after it was due, rad, as far as the coil has authority."""
    return min(max(angle_of(law.q2) + law.rate * since, -FARTHEST), FARTHEST)
