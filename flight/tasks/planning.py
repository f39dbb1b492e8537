"""Planning: asks the worker for a path every few seconds and at each new target, and offers it to guidance.

The horizon recedes: each plan starts from the newest estimate and reaches the target a whole horizon later
(Sease ch. 5, Optimal Path Planning).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from flight import events
from flight.estimation.single_axis import Estimate
from flight.events import EventLog
from flight.executive.jobs import JobResult, JobRunner
from flight.executive.rate_group import Cycle
from flight.guidance.guidance import Guidance
from flight.guidance.job import PlanJob
from flight.guidance.vmc import NODES, Plan, PlanStatus
from flight.plant import SingleAxisPlant, angle_of
from flight.tasks.targets import Target
from flight.telemetry.definitions import MAX_NODES, PLAN
from flight.telemetry.recorder import Recorder

WORKER = "planner"


@dataclass(frozen=True, slots=True)
class PlanningSettings:
    """Horizon asked for and the longest allowed, s; ns after which a plan is late; nodes of the path."""

    horizon: float
    max_horizon: float
    late_after_ns: int
    nodes: int = NODES


class Planning:
    """Owns the job that is under way and the wish for the next one."""

    def __init__(
        self,
        plant: SingleAxisPlant,
        settings: PlanningSettings,
        guidance: Guidance,
        jobs: JobRunner,
        recorder: Recorder,
        event_log: EventLog,
    ) -> None:
        self._plant = plant
        self._settings = settings
        self._guidance = guidance
        self._jobs = jobs
        self._recorder = recorder
        self._events = event_log
        self._wanted = False
        self._job: PlanJob | None = None
        self._count = 0
        self.flown = 0
        self.accepted = 0
        self.refused = 0

    def aim(self, target: Target) -> None:
        """Want another attitude, and a plan for it at once; the present path is flown until that comes."""
        self._guidance.aim(target.q2)
        self._wanted = True

    def request(self) -> None:
        """Want a plan as soon as there is an estimate to start from and the worker is free."""
        self._wanted = True

    def replan(self, cycle: Cycle) -> None:
        """Want a plan because its time has come: the task of the replanning rate group."""
        if self._job is None:
            self._wanted = True
        elif cycle.start_ns - self._job.origin_ns > self._settings.late_after_ns:
            self._events.tell(
                events.PLANNER_BUSY, cycle.start_ns, f"plan {self._job.number} is not finished yet"
            )
            self._wanted = True

    def serve(self, estimate: Estimate | None, target: Target, now_ns: int) -> None:
        """Hand the wanted job over."""
        if not self._wanted or estimate is None or self._job is not None:
            return
        job = PlanJob(
            self._count + 1,
            now_ns,
            self._plant,
            estimate.q2,
            estimate.rate,
            target.q2,
            target.rate,
            self._settings.horizon,
            self._settings.max_horizon,
            self._settings.nodes,
        )
        if self._jobs.submit(WORKER, job):
            self._wanted = False
            self._count = job.number
            self._job = job

    def finish(self, result: JobResult, now_ns: int) -> None:
        """Offer the worker's plan to guidance, which flies it or says why not."""
        job, self._job = self._job, None
        if job is None:
            return
        if result.outcome != "done":
            self.refused += 1
            self._events.tell(events.PLANNER_FAILED, now_ns, f"{result.outcome}: {result.error}")
            self._record(job, None, result.outcome, False, now_ns)
            return
        plan: Plan = result.value
        verdict = self._guidance.offer(plan, job.origin_ns, now_ns, angle_of(job.start_q2), job.start_rate)
        reason = verdict.reason
        if reason:
            self.refused += 1
            self._events.tell(events.PLAN_REFUSED, now_ns, f"plan {job.number}: {reason}")
        else:
            self.accepted += 1
            self.flown = job.number
            if plan.status is PlanStatus.STRETCHED:
                text = (
                    f"plan {job.number}: {plan.horizon_asked:g} s is too short, flying {plan.horizon:.2f} s"
                )
                self._events.tell(events.PLAN_STRETCHED, now_ns, text)
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
