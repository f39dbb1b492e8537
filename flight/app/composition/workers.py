"""The workers that a configuration needs, and their time limits."""

from __future__ import annotations

from flight.app.composition.bodies import body_kind
from flight.loop.body import PLANNER, Planner
from flight.loop.executive.jobs import Worker
from flight.loop.fdir.progress import WorkerWatch
from flight.loop.tasks import imaging as imaging_task
from flight.loop.tasks import wide_imaging as wide_task
from flight.loop.tasks.imaging import Imaging
from flight.loop.tasks.wide_imaging import WideImaging
from flight.schema.sections import Config, Executive
from hal.interfaces.wires import SECOND_NS
from knightcube.vision import frame_job, wide_job


def workers(config: Config, planner_latency_ns: int = 0, vision_latency_ns: int = 0) -> list[Worker]:
    """Return the workers that a configuration needs; latencies apply to lock-step simulation only."""
    planner_timeout_ns = round(config.executive.planner_timeout * SECOND_NS)
    vision_timeout_ns = round(config.executive.vision_timeout * SECOND_NS)
    plan = body_kind(config).plan
    made = [] if plan is None else [Worker(PLANNER, plan, planner_latency_ns, planner_timeout_ns)]
    if config.camera is not None:
        made.append(Worker(imaging_task.WORKER, frame_job.run, vision_latency_ns, vision_timeout_ns))
    if config.wide_cameras:
        made.append(Worker(wide_task.WORKER, wide_job.run, vision_latency_ns, vision_timeout_ns))
    return made


def worker_watches(
    limits: Executive, planner: Planner, imaging: Imaging | None, wide: WideImaging | None
) -> list[WorkerWatch]:
    """Return the watch over each worker, with twice the timeout of the runner as its patience."""
    busy = [(PLANNER, planner.busy_since_ns, limits.planner_timeout)]
    if imaging is not None:
        busy.append((imaging_task.WORKER, imaging.busy_since_ns, limits.vision_timeout))
    if wide is not None:
        busy.append((wide_task.WORKER, wide.busy_since_ns, limits.vision_timeout))
    return [WorkerWatch(name, since, round(2.0 * limit * SECOND_NS)) for name, since, limit in busy]
