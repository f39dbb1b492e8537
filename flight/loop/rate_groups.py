"""Which task runs when: the rate groups of the loop, in order of importance."""

from __future__ import annotations

from dataclasses import dataclass

from flight.app.composition.settings import SECOND_NS
from flight.app.composition.tasks import LoopRooms
from flight.loop.executive.rate_group import RateGroup, Task
from flight.loop.performance import CONTROL
from flight.schema.sections import Config

HEALTH_PERIOD_NS = SECOND_NS // 4
COMMAND_PERIOD_NS = SECOND_NS // 10


@dataclass(frozen=True, slots=True)
class LoopTasks:
    """The tasks that are the loop's own, beside those of single rooms."""

    control: Task
    health: Task
    housekeeping: Task


def rate_groups(config: Config, rooms: LoopRooms, tasks: LoopTasks, commanded: bool) -> list[RateGroup]:
    """Lay the groups, control first; nobody listens for commands where none can come (`commanded`)."""
    control_ns = round(SECOND_NS / config.executive.control_rate_hz)
    replan_ns = round(config.guidance.replan_period * SECOND_NS)
    groups = [
        RateGroup(CONTROL, control_ns, tasks.control),
        RateGroup("planning", replan_ns, rooms.planning.replan),
    ]
    if rooms.imaging is not None and config.camera is not None:
        groups.append(RateGroup("camera", round(config.camera.period * SECOND_NS), rooms.imaging.trigger))
    if commanded:
        groups.append(RateGroup("commands", COMMAND_PERIOD_NS, rooms.commanding.run))
    groups.append(RateGroup("health", HEALTH_PERIOD_NS, tasks.health))
    groups.append(RateGroup("housekeeping", SECOND_NS, tasks.housekeeping))
    return groups
